"""Short text representations of records with large arrays, for consoles and debuggers."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from pathlib import PurePath
from typing import Any

_MAX_ITEMS = 4
"""Maximum number of items of a sequence or array that are written out."""


def short_repr(self: Any) -> str:
    """Return ``Class(field=value, ...)`` for a dataclass, with the type and shape of arrays and the class of records.

    Fields that have their default value are left out. To use it, assign it in the body of the dataclass:
    ``__repr__ = short_repr``.
    """
    values = [(field, getattr(self, field.name)) for field in fields(self) if field.repr]
    shown = ", ".join(f"{field.name}={_short(value)}" for field, value in values if not _is_default(field, value))
    return f"{type(self).__name__}({shown})"


def _is_default(field: Field[Any], value: Any) -> bool:
    return field.default is not MISSING and type(value) is type(field.default) and bool(value == field.default)


def _short(value: Any) -> str:
    if isinstance(value, Enum):
        return f"{type(value).__name__}.{value.name}"
    if is_dataclass(value):
        return f"{type(value).__name__}(...)"
    if isinstance(value, PurePath):
        return reprlib.repr(value.name)
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        shape = tuple(value.shape)
        if hasattr(value, "tolist") and (shape == () or (len(shape) == 1 and shape[0] <= _MAX_ITEMS)):
            return _short(value.tolist())
        return f"{getattr(value.dtype, '__name__', value.dtype)}{list(shape)}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple | list) and (len(value) > _MAX_ITEMS or any(is_dataclass(item) for item in value)):
        return f"{type(value).__name__} of {len(value)}"
    if isinstance(value, tuple | list):
        text = ", ".join(map(_short, value))
        return f"[{text}]" if isinstance(value, list) else f"({text},)" if len(value) == 1 else f"({text})"
    if isinstance(value, Mapping) and len(value) > _MAX_ITEMS:
        return f"{type(value).__name__} of {len(value)}"
    if type(value).__repr__ is object.__repr__:
        return f"{type(value).__name__}(...)"
    return reprlib.repr(value)
