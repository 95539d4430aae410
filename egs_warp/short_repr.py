"""Short text representations of records with large arrays, for consoles and debuggers."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

_MAX_ITEMS = 4
"""Maximum number of items of a sequence that are written out."""


def short_repr(self: Any) -> str:
    """Return ``Class(field=value, ...)`` for a dataclass, with the type and shape of arrays and the class of records.

    To use it, assign it in the body of the dataclass: ``__repr__ = short_repr``.
    """
    values = ", ".join(f"{field.name}={_short(getattr(self, field.name))}" for field in fields(self) if field.repr)
    return f"{type(self).__name__}({values})"


def _short(value: Any) -> str:
    if isinstance(value, Enum):
        return f"{type(value).__name__}.{value.name}"
    if is_dataclass(value):
        return f"{type(value).__name__}(...)"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{getattr(value.dtype, '__name__', value.dtype)}{list(value.shape)}"
    if isinstance(value, tuple | list) and (len(value) > _MAX_ITEMS or any(is_dataclass(item) for item in value)):
        return f"{type(value).__name__} of {len(value)}"
    if isinstance(value, Mapping) and len(value) > _MAX_ITEMS:
        return f"{type(value).__name__} of {len(value)}"
    return reprlib.repr(value)
