"""Checks of the arguments of the public interface: names, types, ranges, and messages that say what is accepted
instead."""

from __future__ import annotations

import inspect
import math
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from enum import Enum
from functools import cached_property, wraps
from importlib import import_module
from pathlib import Path
from types import FunctionType, UnionType
from typing import Any, TypeVar

import numpy as np

from egs_warp.errors import ArgumentError, CallError, did_you_mean

_MAX_TEXT = 60
"""Maximum length of the text of a value in a message, characters."""
_MAX_WHOLE = 10**30
"""Largest whole number that a message contains with all digits."""
_Method = TypeVar("_Method", bound=Callable[..., Any])
_Class = TypeVar("_Class", bound=type)


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high`` that an argument accepts: ``Annotated[float, Range(0.0, 1.0)]``."""

    low: float = -math.inf
    high: float = math.inf
    what: str = ""
    """Description of the numbers for messages, such as "a number of pixels"; empty for the one of the type."""
    above: bool = False
    """True to exclude ``low``."""
    infinite: bool = False
    """True to accept infinite numbers, too."""

    def __contains__(self, value: Any) -> bool:
        """Return True if the number ``value`` is accepted."""
        number = _float(value)
        is_allowed = self.infinite or math.isfinite(number)
        return is_allowed and self.low <= number <= self.high and not (self.above and number == self.low)

    def described(self, kind: str) -> str:
        """Return the description of the numbers; ``kind`` is the one of their type, such as "a whole number"."""
        what, low, high = (
            self.what or kind,
            *(
                re.sub(r"e([+-])0*", r"e\1", f"{x:g}" if isinstance(x, float) else str(x)).replace("e+", "e")
                for x in (self.low, self.high)
            ),
        )
        if math.isinf(self.low):
            return what.replace("a number", "a finite number") if math.isinf(self.high) else f"{what} of at most {high}"
        if math.isinf(self.high):
            return f"{what} {'above' if self.above else 'of at least'} {low}"
        return f"{what} above {low}, at most {high}" if self.above else f"{what} from {low} to {high}"


Fraction: typing.TypeAlias = typing.Annotated[float, Range(0.0, 1.0)]
"""A number from 0 to 1."""
Finite: typing.TypeAlias = typing.Annotated[float, Range()]
"""A number that is not infinite."""
Positive: typing.TypeAlias = typing.Annotated[float, Range(0.0, above=True)]
"""A number above 0."""
NonNegative: typing.TypeAlias = typing.Annotated[float, Range(0.0)]
"""A number of at least 0."""
Count: typing.TypeAlias = typing.Annotated[int, Range(0)]
"""A whole number of at least 0."""
Seed: typing.TypeAlias = typing.Annotated[int, Range(0, (1 << 32) - 1)]
"""A seed of random numbers."""
PositiveCount: typing.TypeAlias = typing.Annotated[int, Range(1)]
"""A whole number of at least 1."""


def checked_function(function: FunctionType) -> Callable[..., Any]:
    """Return a public function that checks its arguments.

    A call with an unknown or missing argument, or with an argument of a wrong type or shape, raises ``CallError``, and
    one with a number outside its ``Range`` raises ``ArgumentError``. NaN is not a number.
    Where an array, a tuple or a path is annotated, a list, a list and a text are converted.
    """
    checked = _checked(function, function.__name__)
    # A function is pickled as a name of its module, where it must be the same object.
    checked.__module__ = function.__module__.partition(".")[0]
    return checked


def checked_method(method: _Method) -> _Method:
    """Make a method or class method check its arguments, as ``checked_function`` does. Decorator, below
    ``classmethod``."""
    return typing.cast("_Method", _checked(method, method.__qualname__, skipped=1))


def checked_constructor(cls: _Class) -> _Class:
    """Make the constructor of a class check its arguments, as ``checked_function`` does. Decorator, above
    ``dataclass``."""
    cls.__init__ = _checked(cls.__init__, cls.__name__, skipped=1)
    return cls


class _WrongTypeError(Exception):
    """A value that an annotation does not accept; ``place`` is its position in the argument, such as ``[2]``."""

    def __init__(self, value: object, accepted: str, place: str = "") -> None:
        self.value, self.accepted, self.place = value, accepted, place
        super().__init__()


class _WrongValueError(Exception):
    """A number outside its range, which ``accepted`` describes; ``place`` is as in ``_WrongTypeError``."""

    def __init__(self, value: object, accepted: str, place: str = "") -> None:
        self.value, self.accepted, self.place = value, accepted, place
        super().__init__()


@dataclass(frozen=True)
class _Kind:
    """Values that an annotation accepts."""

    text: str
    """Description for messages, such as "a number"."""
    accepts: Callable[[Any], bool] = lambda value: False
    """True for values that are passed on as they are."""
    convert: Callable[[Any], Any] | None = None
    """Function that returns another accepted value as the annotated type, and raises a built-in error or
    ``_WrongTypeError`` for others."""

    def checked(self, value: Any) -> Any:
        """Return the value to pass on. Raises ``_WrongTypeError``."""
        if self.accepts(value):
            return value
        try:
            if self.convert is not None:
                return self.convert(value)
        except (TypeError, ValueError, RuntimeError):
            pass
        raise _WrongTypeError(value, self.text)


def _checked(function: Callable[..., Any], title: str, *, skipped: int = 0) -> Callable[..., Any]:
    """Return ``function`` with checks; ``title`` is its name in messages, and its first ``skipped`` arguments are the
    object or the class."""
    call = _Call(function, title, skipped)

    @wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        args, kwargs = call.checked(args, kwargs)
        return function(*args, **kwargs)

    return checked


class _Call:
    """Parameters of a public function, and the check of a call."""

    def __init__(self, function: Callable[..., Any], title: str, skipped: int) -> None:
        self._title, self._skipped, self._namespace = title, skipped, function.__globals__
        every = list(inspect.signature(function).parameters.values())[skipped:]
        self.parameters = {one.name: one for one in every}
        self._positional = [one.name for one in every if one.kind <= inspect.Parameter.POSITIONAL_OR_KEYWORD]
        self._rest = next((one.name for one in every if one.kind is inspect.Parameter.VAR_POSITIONAL), None)
        self._others = next((one.name for one in every if one.kind is inspect.Parameter.VAR_KEYWORD), None)
        self._names = [one.name for one in every if one.name not in (self._rest, self._others)]
        self._required = [name for name in self._names if self.parameters[name].default is inspect.Parameter.empty]

    @cached_property
    def _kinds(self) -> Mapping[str, _Kind | None]:
        """Kind of each parameter; None if its annotation cannot be checked. Computed at the first call, because
        annotations may name classes that are defined later."""
        return {name: _kind_of(self._annotation(one)) for name, one in self.parameters.items()}

    def checked(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Return the arguments to pass on. Raises ``CallError`` for a call that the function does not accept."""
        first, given = args[: self._skipped], args[self._skipped :]
        if len(given) > len(self._positional) and self._rest is None:
            problem = f"arguments by position: {len(given)} given, {len(self._positional)} allowed"
            raise self._error(f"{problem}; by name, {self._title} takes {', '.join(self._names)}")
        by_position = [*self._positional[: len(given)], *[self._rest or ""] * (len(given) - len(self._positional))]
        for name in kwargs:
            if name not in self._names and self._others is None:
                raise self._error(self._unknown(name))
        for name in self._required:
            if name not in by_position and name not in kwargs:
                kind = self._kinds[name]
                advice = "" if kind is None else f"; give {_with_sources(kind.text)}"
                raise self._error(f"{name} is missing{advice}")
        return (
            (*first, *(self._value(name, value) for name, value in zip(by_position, given, strict=True))),
            {name: self._value(name, value) for name, value in kwargs.items()},
        )

    def _annotation(self, parameter: inspect.Parameter) -> Any:
        """Return the type of a parameter; ``Any`` if it names a class that is imported for type checkers only."""
        annotation = parameter.annotation
        try:
            # The value of an alias may be a text, too.
            while isinstance(annotation, str):
                annotation = eval(annotation, dict(self._namespace))
        except NameError:
            return Any
        return annotation

    def _value(self, name: str, value: Any) -> Any:
        parameter = self.parameters.get(name) or self.parameters[self._others or name]
        kind = self._kinds[parameter.name]
        if kind is None or value is parameter.default:
            return value
        try:
            return kind.checked(value)
        except _WrongTypeError as error:
            accepted = _with_sources(error.accepted)
            problem = f"{name}{error.place} is {_value_text(error.value)}; give {accepted}"
        except _WrongValueError as error:
            raise ArgumentError(f"{name}{error.place}", f"give {error.accepted}", value=_plain(error.value)) from None
        raise self._error(problem)

    def _error(self, problem: str) -> CallError:
        return CallError(f"{self._title}: {problem}")

    def _unknown(self, name: str) -> str:
        options: dict[str, str] = {}
        for argument, parameter in self.parameters.items():
            annotation = self._annotation(parameter)
            for one in typing.get_args(annotation) or (annotation,):
                options |= _calls(one, f"{argument}={{}}") if is_options(one) else {}
        if name in options:
            return f"there is no argument {name}; pass {options[name].format('...')}"
        near = did_you_mean(name, self._names)
        others = [] if near else import_module("egs_warp").callables_with(name)
        elsewhere = f"; give it to {_either([f'{other}({name}=...)' for other in others])}" if others else ""
        near = near or elsewhere or did_you_mean(name, options)
        return f"there is no argument {name}{near}; {self._title} takes {', '.join(self._names) or 'no arguments'}"


def is_options(candidate: object) -> bool:
    """Return True for a dataclass of which every field has a default."""
    return (
        isinstance(candidate, type)
        and is_dataclass(candidate)
        and all(field.default is not MISSING or field.default_factory is not MISSING for field in fields(candidate))
    )


def _calls(record: type, pattern: str) -> dict[str, str]:
    """Return the text of an argument that sets each field of the dataclass ``record`` and of its nested dataclasses;
    ``pattern`` is the text of an argument, with ``{}`` for the record."""
    own = {field.name: pattern.format(f"{record.__name__}({field.name}={{}})") for field in fields(record)}
    nested: dict[str, str] = {}
    for field in fields(record):
        inner = field.default_factory
        if isinstance(inner, type) and is_dataclass(inner):
            nested |= _calls(inner, own[field.name])
    return nested | own


def _kind_of(annotation: Any) -> _Kind | None:
    """Return the kind of ``annotation``; None if it accepts anything or cannot be checked."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        kind, limits = _kind_of(parts[0]), [part for part in parts[1:] if isinstance(part, Range)]
        if kind is not None and limits:
            return _limited(kind, limits[0])
        return _shaped(kind, parts[1:]) if kind is not None and parts[0] is np.ndarray else kind
    if origin in (typing.Union, UnionType):
        # Beside a path, a text is a path, too.
        kinds = [_kind_of(part) for part in parts if not (part is str and Path in parts)]
        return None if None in kinds else _union([kind for kind in kinds if kind is not None])
    if origin is tuple:
        return _tuple(parts)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _Kind("a mapping", lambda value: isinstance(value, Mapping))
    if isinstance(origin, type) and issubclass(origin, Sequence):
        return _list_of(_kind_of(parts[0]))
    if origin is Callable or annotation is Callable:
        return _Kind("a function", callable)
    if annotation in _SIMPLE:
        return _SIMPLE[annotation]
    if not isinstance(annotation, type) or annotation in (object, Any):
        return None
    return _instance(annotation)


def _is_number(value: Any, method: str) -> bool:
    # The texts and dates of NumPy have __float__, too.
    kind = getattr(getattr(value, "dtype", None), "kind", "f")
    return hasattr(type(value), method) and getattr(value, "ndim", 0) == 0 and kind in "biuf"


def _float(value: Any) -> float:
    """Return a number as a float; a whole number that is too large for one becomes infinite."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _is_nan(value: Any) -> bool:
    return bool(value != value)


def _limited(kind: _Kind, limits: Range) -> _Kind:
    """Return the kind of the numbers of ``kind`` within ``limits``."""
    text = limits.described(kind.text)

    def convert(value: Any) -> Any:
        if not kind.accepts(value) and not (_is_number(value, "__float__") and _is_nan(value)):
            raise TypeError
        number = _float(value)
        is_too_large = math.isinf(number) and limits.low <= number <= limits.high and "finite" not in text
        raise _WrongValueError(value, text.replace("a ", "a finite ", 1) if is_too_large else text)

    return _Kind(text, lambda value: kind.accepts(value) and value in limits, convert)


def _to_path(value: Any) -> Path:
    if not str(value).strip():
        raise ValueError
    return Path(value)


def _to_array(value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "biuf" or array.ndim == 0:
        raise TypeError
    return array


_ARRAY, _FINITE = "an array of numbers", "finite numbers"
_SIMPLE: Mapping[Any, _Kind] = {
    type(None): _Kind("None", lambda value: value is None),
    bool: _Kind("True or False", lambda value: isinstance(value, bool | np.bool_)),
    int: _Kind("a whole number", lambda value: _is_number(value, "__index__")),
    float: _Kind(
        "a number",
        lambda value: (_is_number(value, "__float__") or _is_number(value, "__index__")) and not _is_nan(value),
    ),
    str: _Kind("a text", lambda value: isinstance(value, str)),
    Path: _Kind("a path", lambda value: isinstance(value, Path), _to_path),
    np.ndarray: _Kind(_ARRAY, lambda value: isinstance(value, np.ndarray), _to_array),
}


def _shaped(array: _Kind, sides: Sequence[object]) -> _Kind:
    """Return the kind of arrays with these ``sides``: numbers, or names of sides of any length."""
    text = f"{_ARRAY} of shape ({', '.join(map(str, sides))}{',' * (len(sides) == 1)})"

    def convert(value: Any) -> np.ndarray:
        values = array.checked(value)
        # A different number of sides raises ValueError, too.
        if any(side != length for side, length in zip(sides, values.shape, strict=True) if isinstance(side, int)):
            raise ValueError
        if all(isinstance(side, int) for side in sides) and not np.isfinite(values).all():
            raise _WrongTypeError(value, _FINITE)
        return values

    return _Kind(text, convert=convert)


def _instance(annotation: type) -> _Kind:
    """Return the kind of the objects of a class."""
    name = annotation.__name__
    name = f"{annotation.__module__.partition('.')[0]}.{name}" if name.islower() else name
    if issubclass(annotation, Enum):
        members = [f"{name}.{member.name}" for member in annotation]
        return _Kind(_either(members), lambda value: isinstance(value, annotation))
    text = _with_article(name)
    if getattr(annotation, "_is_protocol", False):
        declared = {*vars(annotation), *vars(annotation).get("__annotations__", {})}
        needed = [one for one in declared if not one.startswith("_")]
        return _Kind(text, lambda value: all(hasattr(value, one) for one in needed))
    return _Kind(text, lambda value: isinstance(value, annotation))


def _union(kinds: Sequence[_Kind]) -> _Kind:
    """Return the kind of the values that one of ``kinds`` accepts."""
    text = _either([kind.text for kind in kinds if kind.text != "None"])

    def convert(value: Any) -> Any:
        errors: list[_WrongTypeError] = []
        # A list becomes an array only where no list is accepted.
        for kind in sorted(kinds, key=lambda kind: kind.text.startswith(_ARRAY)):
            try:
                return kind.checked(value)
            except _WrongTypeError as error:
                errors.append(error)
        raise next((error for error in errors if error.place or error.accepted == _FINITE), TypeError())

    return _Kind(text, lambda value: any(kind.accepts(value) for kind in kinds), convert)


def _list_of(item: _Kind | None, *, is_tuple: bool = False) -> _Kind:
    """Return the kind of sequences with elements of the kind ``item``."""
    text = "a list" if item is None else f"a list of {_plural(item.text)}"
    return _Kind(text, convert=lambda value: _with_checked_items(value, [item] * len(value), is_tuple=is_tuple))


def _tuple(parts: tuple[Any, ...]) -> _Kind:
    """Return the kind of tuples; other sequences with the same elements are converted."""
    if Ellipsis in parts:
        return _list_of(_kind_of(parts[0]), is_tuple=True)
    kinds = [_kind_of(part) for part in parts]
    texts = ["a value" if kind is None else kind.text for kind in kinds]
    are_numbers = all(text.startswith(("a number", "a whole number")) for text in texts)
    limits = texts[0].removeprefix("a number") if {*texts} == {texts[0]} and texts[0].startswith("a number") else ""
    text = f"{len(kinds)} numbers{limits}" if are_numbers else f"{len(kinds)} values: {', '.join(texts)}"
    return _Kind(text, convert=lambda value: _with_checked_items(value, kinds, is_tuple=True))


def _with_checked_items(value: Any, kinds: Sequence[_Kind | None], *, is_tuple: bool) -> Any:
    """Return a sequence, as a tuple if ``is_tuple``, with converted elements if elements have to be converted."""
    if isinstance(value, str | bytes) or not isinstance(value, Sequence | np.ndarray):
        raise TypeError
    if isinstance(value, np.ndarray) and not is_tuple:
        return value
    checked = []
    for number, (one, kind) in enumerate(zip(value, kinds, strict=True)):
        try:
            checked.append(one if kind is None else kind.checked(one))
        except _WrongTypeError as error:
            raise _WrongTypeError(error.value, error.accepted, f"[{number}]{error.place}") from None
        except _WrongValueError as error:
            raise _WrongValueError(error.value, error.accepted, f"[{number}]{error.place}") from None
    # An array or a list is not hashable, unlike the tuple of a frozen dataclass.
    return tuple(checked) if is_tuple else checked


def _with_sources(text: str) -> str:
    """Return the text of accepted values with the public function that returns an object of each class."""
    functions = import_module("egs_warp").RETURNED_BY
    for name in {*re.findall(r"\ban? (\w+)", text)} & {*functions}:
        text = re.sub(rf"\b(an? {name})\b", rf"\1 ({functions[name]} returns one)", text)
    return text


def _either(texts: Sequence[str]) -> str:
    *first, last = texts
    return f"{', '.join(first)} or {last}" if first else last


def _plural(text: str) -> str:
    """Return a description of several values, such as "numbers" for "a number", and "Push" for "a Push"."""
    one = text.partition(" ")[2] if text.startswith(("a ", "an ")) else text
    return re.sub("^((whole |finite )?number|text|path)", r"\1s", one)


def _with_article(name: str) -> str:
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"


def _plain(value: Any) -> object:
    """Return a number for a message, such as -1 for ``np.float64(-1.0)``."""
    value = value.item() if hasattr(value, "item") else value
    if isinstance(value, int) and abs(value) > _MAX_WHOLE:
        return f"{'-' if value < 0 else ''}1e{int(math.log10(abs(value)))}"
    return f"{value:.12g}" if isinstance(value, float) else value


def _value_text(value: object) -> str:
    """Return the text of a value for a message: the value if it is short, or else its type."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, np.ndarray) and value.size > 4:
        return f"an array of shape {value.shape}"
    is_plain = value is None or isinstance(value, str | int | float | list | tuple | dict | Path | np.ndarray)
    text = repr(value) if is_plain else "\n"
    return _with_article(type(value).__name__) if len(text) > _MAX_TEXT or "\n" in text else text
