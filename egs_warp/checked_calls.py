"""Checks of the arguments of the public interface: names, types, and messages that say what is accepted instead."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from enum import Enum
from functools import cached_property, wraps
from os import PathLike
from pathlib import Path
from types import FunctionType, UnionType
from typing import Any, Literal, Protocol

import numpy as np

from egs_warp.errors import CallError, did_you_mean

_MAX_TEXT = 60
"""Maximum length of the text of a value in a message, characters."""
_POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


class PublicNames(Protocol):
    """Other names of an interface, for messages."""

    def function_returning(self, class_name: str) -> str | None:
        """Return the name of the function that returns an object of this class; None if there is none."""
        ...

    def callables_with(self, argument: str) -> Sequence[str]:
        """Return the names of the functions and options dataclasses that have an argument of this name."""
        ...


class _WrongTypeError(Exception):
    """A value that an annotation does not accept; ``place`` is its position in the argument, such as ``[2]``."""

    def __init__(self, value: object, accepted: str, place: str = "") -> None:
        self.value, self.accepted, self.place = value, accepted, place
        super().__init__()


@dataclass(frozen=True)
class _Kind:
    """Values that an annotation accepts."""

    text: str
    """Description for messages, such as "a number"."""
    accepts: Callable[[Any], bool]
    """True for values that are passed on as they are."""
    convert: Callable[[Any], Any] | None = None
    """Function that returns another accepted value as the annotated type, or raises ``_WrongTypeError``."""

    def checked(self, value: Any) -> Any:
        """Return the value to pass on. Raises ``_WrongTypeError``."""
        if self.accepts(value):
            return value
        if self.convert is None:
            raise _WrongTypeError(value, self.text)
        return self.convert(value)


def with_checked_arguments(public: Any, names: PublicNames, *, is_result: bool = False) -> Any:
    """Return a public function, or a public class with its constructors and methods, that checks its arguments.

    A call with an unknown or missing argument, or with an argument of a wrong type or shape, raises ``CallError``.
    Where an array, a path or a tuple is annotated, a list, a text and a list are converted. Classes are changed in
    place; exceptions, enumerations and protocols, and values that are neither functions nor classes, are returned
    unchanged.

    Args:
        public: The function or class.
        names: The other names of the interface.
        is_result: True for a class that programs do not construct; its ``__init__`` is not checked.
    """
    if inspect.isfunction(public):
        checked = _checked(public, public.__name__, names)
        # A function is pickled as a name of its module, where it must be the same object.
        checked.__module__ = public.__module__.partition(".")[0]
        return checked
    is_plain = isinstance(public, type) and not issubclass(public, BaseException | Enum)
    if not is_plain or getattr(public, "_is_protocol", False):
        return public
    for name, member in list(vars(public).items()):
        is_constructor = name == "__init__"
        if name.startswith("_") and (is_result or not is_constructor):
            continue
        title = public.__name__ if is_constructor else f"{public.__name__}.{name}"
        if isinstance(member, classmethod | staticmethod):
            skipped = 1 if isinstance(member, classmethod) else 0
            setattr(public, name, type(member)(_checked(member.__func__, title, names, skipped=skipped)))
        elif inspect.isfunction(member):
            setattr(public, name, _checked(member, title, names, skipped=1))
    return public


def _checked(function: FunctionType, title: str, names: PublicNames, *, skipped: int = 0) -> Callable[..., Any]:
    """Return ``function`` with checks; ``title`` is its name in messages, and its first ``skipped`` arguments are the
    object or the class."""
    call = _Call(function, title, names, skipped)
    if not call.parameters:
        return function

    @wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        args, kwargs = call.checked(args, kwargs)
        return function(*args, **kwargs)

    return checked


class _Call:
    """Parameters of a public function, and the check of a call."""

    def __init__(self, function: FunctionType, title: str, names: PublicNames, skipped: int) -> None:
        self._function, self._title, self._public, self._skipped = function, title, names, skipped
        every = list(inspect.signature(function).parameters.values())[skipped:]
        self.parameters = {one.name: one for one in every}
        self._positional = [one.name for one in every if one.kind in _POSITIONAL]
        self._rest = next((one.name for one in every if one.kind is inspect.Parameter.VAR_POSITIONAL), None)
        self._others = next((one.name for one in every if one.kind is inspect.Parameter.VAR_KEYWORD), None)
        self._named = [one.name for one in every if one.name not in (self._rest, self._others)]
        self._required = [name for name in self._named if self.parameters[name].default is inspect.Parameter.empty]

    @cached_property
    def _kinds(self) -> Mapping[str, _Kind | None]:
        """Kind of each parameter; None if its annotation cannot be checked. Computed at the first call, because
        annotations may name classes that are defined later."""
        namespace = self._function.__globals__
        return {
            name: _kind_of(_resolved(parameter.annotation, namespace), self._public)
            for name, parameter in self.parameters.items()
        }

    def checked(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Return the arguments to pass on. Raises ``CallError`` for a call that the function does not accept."""
        first, given = args[: self._skipped], args[self._skipped :]
        if len(given) > len(self._positional) and self._rest is None:
            raise self._error(self._too_many(len(given)))
        by_position = [*self._positional[: len(given)], *[self._rest or ""] * (len(given) - len(self._positional))]
        for name in kwargs:
            if name not in self._named and self._others is None:
                raise self._error(self._unknown(name))
            if name in by_position:
                raise self._error(f"{name} is given twice, by position and by name; give it once")
        missing = [name for name in self._required if name not in by_position and name not in kwargs]
        if missing:
            kind = self._kinds[missing[0]]
            advice = f"; give {kind.text}" if len(missing) == 1 and kind is not None else ""
            raise self._error(f"{_either(missing, 'and')} {'is' if len(missing) == 1 else 'are'} missing{advice}")
        return (
            (*first, *(self._value(name, value) for name, value in zip(by_position, given, strict=True))),
            {name: self._value(name, value) for name, value in kwargs.items()},
        )

    def _value(self, name: str, value: Any) -> Any:
        kind = self._kinds[name if name in self.parameters else self._others or name]
        if kind is None or value is self._default(name):
            return value
        try:
            return kind.checked(value)
        except _WrongTypeError as error:
            hint = _name_among(error.value, error.accepted)
            each = " as each argument" if name == self._rest else ""
            problem = f"{name}{error.place} is {_shown(error.value)}; give {error.accepted}{each}{hint}"
        raise self._error(problem)

    def _default(self, name: str) -> Any:
        return self.parameters[name].default if name in self.parameters else inspect.Parameter.empty

    def _error(self, problem: str) -> CallError:
        return CallError(f"{self._title}: {problem}")

    def _too_many(self, count: int) -> str:
        named = ", ".join(name for name in self._named if name not in self._positional)
        allowed = f"{len(self._positional)} ({', '.join(self._positional)})" if self._positional else "none"
        advice = f"give the others by name: {named}" if named else "leave the others out"
        return f"{count} arguments by position are too many, allowed are {allowed}; {advice}"

    def _unknown(self, name: str) -> str:
        options = {field: text for argument, text in self._options() for field, text in _calls(argument, text)}
        if name in options:
            return f"there is no argument {name}; pass {options[name].format('...')}"
        near = did_you_mean(name, self._named)
        others = [] if near else self._public.callables_with(name)
        elsewhere = f"; give it to {_either([f'{other}({name}=...)' for other in others])}" if others else ""
        near = near or elsewhere or did_you_mean(name, options)
        takes = f"{self._title} takes {', '.join(self._named)}" if self._named else f"{self._title} takes no arguments"
        return f"there is no argument {name}{near}; {takes}"

    def _options(self) -> Iterator[tuple[type, str]]:
        """Yield the dataclass and the text of each argument that takes an options dataclass."""
        for name, parameter in self.parameters.items():
            annotation = _resolved(parameter.annotation, self._function.__globals__)
            for one in typing.get_args(annotation) or (annotation,):
                if is_options(one):
                    yield one, f"{name}={{}}"


def is_options(candidate: object) -> bool:
    """Return True for a dataclass of which every field has a default."""
    return (
        isinstance(candidate, type)
        and is_dataclass(candidate)
        and all(field.default is not MISSING or field.default_factory is not MISSING for field in fields(candidate))
    )


def _calls(record: type, pattern: str) -> Iterator[tuple[str, str]]:
    """Yield each field of the dataclass ``record`` and of its nested dataclasses, with the text of an argument that
    sets it.

    Fields of ``record`` come last, because they take precedence over nested fields of the same name. ``pattern`` is the
    text of an argument, with ``{}`` for the record.
    """
    own = {field.name: pattern.format(f"{record.__name__}({field.name}={{}})") for field in fields(record)}
    for field in fields(record):
        inner = field.default_factory
        if inner is not MISSING and isinstance(inner, type) and is_dataclass(inner):
            yield from _calls(inner, own[field.name])
    yield from own.items()


def _resolved(annotation: Any, namespace: dict[str, Any]) -> Any:
    """Return the type of an annotation; ``Any`` if it names a class that is imported for type checkers only."""
    try:
        # The value of an alias may be a text, too.
        while isinstance(annotation, str):
            annotation = eval(annotation, dict(namespace))
    except NameError:
        return Any
    return annotation


def _kind_of(annotation: Any, names: PublicNames) -> _Kind | None:
    """Return the kind of ``annotation``; None if it accepts anything or cannot be checked."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        kind = _kind_of(parts[0], names)
        return _shaped(kind, parts[1:]) if kind is not None and parts[0] is np.ndarray else kind
    if origin in (typing.Union, UnionType):
        kinds = [_kind_of(part, names) for part in parts]
        return None if None in kinds else _union([kind for kind in kinds if kind is not None])
    if origin is Literal:
        return _Kind(f"one of {', '.join(map(repr, parts))}", lambda value: value in parts)
    if origin is tuple:
        return _tuple(parts, names)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _Kind("a mapping", lambda value: isinstance(value, Mapping))
    if isinstance(origin, type) and issubclass(origin, Sequence):
        return _sequence(_kind_of(parts[0], names) if parts else None)
    if isinstance(origin, type) and issubclass(origin, Iterable):
        # A generator may be longer than the memory.
        return _Kind("a list", lambda value: isinstance(value, Iterable) and not isinstance(value, str))
    if origin is Callable or annotation is Callable:
        return _Kind("a function", callable)
    if annotation in _SIMPLE:
        return _SIMPLE[annotation]
    if not isinstance(annotation, type) or annotation in (object, Any):
        return None
    return _instance(annotation, names)


def _is_number(value: Any, method: str) -> bool:
    return hasattr(type(value), method) and getattr(value, "ndim", 0) == 0


def _to_array(value: Any) -> np.ndarray:
    wrong = _WrongTypeError(value, _ARRAY)
    if isinstance(value, str) or not (isinstance(value, Sequence) or hasattr(value, "__array__")):
        raise wrong
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError):
        raise wrong from None
    if array.dtype.kind not in "biuf":
        raise wrong
    return array


def _to_path(value: Any) -> Path:
    if not isinstance(value, str | PathLike):
        raise _WrongTypeError(value, "a path")
    return Path(value)


_ARRAY = "an array of numbers"
_SIMPLE: Mapping[Any, _Kind] = {
    type(None): _Kind("None", lambda value: value is None),
    bool: _Kind("True or False", lambda value: isinstance(value, bool | np.bool_)),
    int: _Kind("a whole number", lambda value: _is_number(value, "__index__")),
    float: _Kind("a number", lambda value: _is_number(value, "__float__") or _is_number(value, "__index__")),
    str: _Kind("a text", lambda value: isinstance(value, str)),
    Path: _Kind("a path", lambda value: isinstance(value, Path), _to_path),
    np.ndarray: _Kind(_ARRAY, lambda value: isinstance(value, np.ndarray), _to_array),
}


def _shaped(array: _Kind, sides: Sequence[object]) -> _Kind:
    """Return the kind of arrays with these ``sides``: numbers, or names of sides of any length."""
    text = f"{_ARRAY} of shape ({', '.join(map(str, sides))}{',' * (len(sides) == 1)})"

    def checked(value: Any) -> np.ndarray:
        values = array.checked(value)
        fits = values.ndim == len(sides) and all(
            isinstance(side, str) or side == length for side, length in zip(sides, values.shape, strict=True)
        )
        if not fits:
            raise _WrongTypeError(value, text)
        return values

    return _Kind(text, lambda value: False, checked)


def _instance(annotation: type, names: PublicNames) -> _Kind:
    """Return the kind of the objects of a class."""
    name = annotation.__name__
    name = f"{annotation.__module__.partition('.')[0]}.{name}" if name.islower() else name
    if issubclass(annotation, Enum):
        members = [f"{name}.{member.name}" for member in annotation]
        return _Kind(_either(members), lambda value: isinstance(value, annotation))
    source = names.function_returning(name)
    text = f"{_article(name)} {name}" + (f" ({source} returns one)" if source is not None else "")
    if getattr(annotation, "_is_protocol", False):
        declared = {*vars(annotation), *vars(annotation).get("__annotations__", {})}
        needed = [one for one in declared if not one.startswith("_")]
        return _Kind(text, lambda value: all(hasattr(value, one) for one in needed))
    return _Kind(text, lambda value: isinstance(value, annotation))


def _union(kinds: Sequence[_Kind]) -> _Kind:
    """Return the kind of the values that one of ``kinds`` accepts."""
    text = _either([kind.text for kind in kinds if kind.text != "None"])

    def convert(value: Any) -> Any:
        inner: _WrongTypeError | None = None
        converted: list[Any] = []
        for kind in kinds:
            try:
                converted.append(kind.checked(value))
            except _WrongTypeError as error:
                inner = error if error.place else inner
        if not converted:
            raise inner or _WrongTypeError(value, text)
        return next((one for one in converted if one is value), converted[0])

    return _Kind(text, lambda value: any(kind.accepts(value) for kind in kinds), convert)


def _sequence(item: _Kind | None, build: Callable[[list[Any]], Any] = list) -> _Kind:
    """Return the kind of sequences with elements of the kind ``item``; iterables are converted with ``build``."""
    text = "a list" if item is None else f"a list of {_plural(item.text)}"

    def convert(value: Any) -> Any:
        if isinstance(value, str | bytes | Mapping) or not isinstance(value, Iterable):
            raise _WrongTypeError(value, text)
        is_final = isinstance(value, np.ndarray | tuple if build is tuple else np.ndarray | Sequence)
        values = value if is_final else build(list(value))
        if item is None or isinstance(values, np.ndarray):
            return values
        return _checked_items(values, [item] * len(values))

    return _Kind(text, lambda value: False, convert)


def _tuple(parts: tuple[Any, ...], names: PublicNames) -> _Kind:
    """Return the kind of tuples; other sequences with the same elements are converted."""
    kinds = [_kind_of(part, names) for part in parts if part is not Ellipsis]
    if Ellipsis in parts:
        kind = _sequence(kinds[0], tuple)
        # An array is not hashable, unlike the tuple of a frozen dataclass.
        return _Kind(kind.text, kind.accepts, lambda value: tuple(kind.checked(value)))
    texts = ["a value" if kind is None else kind.text for kind in kinds]
    count = len(kinds)
    text = f"{count} numbers" if {*texts} <= {"a number", "a whole number"} else f"{count} values: {', '.join(texts)}"

    def convert(value: Any) -> Any:
        if isinstance(value, str | bytes | Mapping) or not isinstance(value, Iterable):
            raise _WrongTypeError(value, text)
        values = tuple(value)
        if len(values) != count:
            raise _WrongTypeError(value, text)
        return _checked_items(values, kinds)

    return _Kind(text, lambda value: False, convert)


def _checked_items(values: Any, kinds: Sequence[_Kind | None]) -> Any:
    """Return ``values``, with converted elements if elements have to be converted."""
    checked = []
    for number, (value, kind) in enumerate(zip(values, kinds, strict=True)):
        try:
            checked.append(value if kind is None else kind.checked(value))
        except _WrongTypeError as error:
            raise _WrongTypeError(error.value, error.accepted, f"[{number}]{error.place}") from None
    if all(one is other for one, other in zip(checked, values, strict=True)):
        return values
    return tuple(checked) if isinstance(values, tuple) else checked


def _name_among(value: object, accepted: str) -> str:
    """Return `` (did you mean ...?)`` if ``value`` is similar to a name in the text of the accepted values."""
    if not isinstance(value, str):
        return ""
    choices = {word.partition(".")[2].lower(): word for word in accepted.replace(",", " ").split() if "." in word}
    return f" (did you mean {choices[value.lower()]}?)" if value.lower() in choices else ""


def _either(texts: Sequence[str], word: str = "or") -> str:
    *first, last = texts
    return f"{', '.join(first)} {word} {last}" if first else last


def _plural(text: str) -> str:
    """Return a description of several values, such as "numbers" for "a number", and "Push" for "a Push"."""
    one = text.partition(" ")[2] if text.startswith(("a ", "an ")) else text
    return f"{one}s" if one in ("number", "whole number", "text", "path") else one


def _article(name: str) -> str:
    return "an" if name[0].lower() in "aeiou" else "a"


def _shown(value: object) -> str:
    """Return the text of a value for a message: the value if it is short, or else its type."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    name = type(value).__name__
    if isinstance(value, np.ndarray) and value.size > 4:
        return f"an array of shape {value.shape}"
    is_plain = value is None or isinstance(value, str | int | float | list | tuple | dict | Path | np.ndarray)
    text = repr(value) if is_plain and not hasattr(value, "_fields") else ""
    if not text or len(text) > _MAX_TEXT or "\n" in text:
        return f"{_article(name)} {name}"
    return text
