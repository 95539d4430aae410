"""New arrays for the renderer's stages."""

from __future__ import annotations

from typing import Any, TypeAlias

import warp as wp

Shape: TypeAlias = int | tuple[int, ...]


def empty(shape: Shape, dtype: Any, device: Any) -> wp.array:
    """Array of undefined contents. Warp's own stub admits only Python's ``float`` as a type."""
    return wp.empty(shape, dtype=dtype, device=device)


def zeros(shape: Shape, dtype: Any, device: Any) -> wp.array:
    """Array of zeros."""
    return wp.zeros(shape, dtype=dtype, device=device)
