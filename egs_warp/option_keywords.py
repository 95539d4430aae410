"""Errors for keywords that belong to an options dataclass instead of the called function."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import MISSING, fields, is_dataclass
from functools import wraps
from inspect import signature
from typing import ParamSpec, TypeVar

from egs_warp.errors import did_you_mean

P = ParamSpec("P")
R = TypeVar("R")


def takes_options(**records: type) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator for a function with options dataclasses, such as ``@takes_options(options=CreatureOptions)``.

    Calls raise a ``TypeError`` that names the dataclass if a keyword of the call is one of its fields, or if the value
    of its argument has another type. For other unknown keywords, the message suggests a similar name.

    Args:
        records: Dataclass of each argument that takes options.
    """
    calls = {name: call for argument, record in records.items() for name, call in _calls(record, f"{argument}={{}}")}

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        arguments = signature(function).parameters

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            for name in kwargs:
                if name in arguments:
                    continue
                if name in calls:
                    record, call = calls[name]
                    raise TypeError(f"{function.__name__}: {name} is a field of {record}; pass {call}")
                near = did_you_mean(name, [*arguments, *calls])
                raise TypeError(f"{function.__name__}: there is no argument {name}{near}")
            for argument, record in records.items():
                value = kwargs.get(argument)
                if value is not None and not isinstance(value, record):
                    given = value.__name__ if isinstance(value, type) else type(value).__name__
                    raise TypeError(
                        f"{function.__name__}: {argument} is {given}; pass {argument}={record.__name__}(...)"
                    )
            return function(*args, **kwargs)

        return checked

    return decorate


def _calls(record: type, pattern: str) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield each field of the dataclass ``record`` and of its nested dataclasses, with the name of its dataclass and
    the text of an argument that sets it.

    Fields of ``record`` come last, because they take precedence over nested fields of the same name. ``pattern`` is the
    text of an argument, with ``{}`` for the record.
    """
    own = {field.name: pattern.format(f"{record.__name__}({field.name}={{}})") for field in fields(record)}
    for field in fields(record):
        inner = field.default_factory
        if inner is not MISSING and isinstance(inner, type) and is_dataclass(inner):
            yield from _calls(inner, own[field.name])
    yield from ((name, (record.__name__, call.format("..."))) for name, call in own.items())
