"""Distance transforms and connected parts of bool masks (rows, columns), in pixels."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from scipy import ndimage


def depth_inside(mask: np.ndarray) -> np.ndarray:
    """Return the distance (rows, columns) float64 of each set pixel to the nearest unset pixel; 0 for unset pixels."""
    return np.asarray(cast(Any, ndimage.distance_transform_edt(mask)))


def distance_to(mask: np.ndarray) -> np.ndarray:
    """Return the distance (rows, columns) float64 of each pixel to the nearest set pixel."""
    return depth_inside(~mask)


def nearest_set(mask: np.ndarray) -> np.ndarray:
    """Return row and column (2, rows, columns) int of the set pixel nearest to each pixel."""
    result: Any = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return np.asarray(result)


def connected_parts(mask: np.ndarray, *, corners: bool = False) -> tuple[np.ndarray, int]:
    """Label the connected parts of a mask.

    Args:
        mask: (rows, columns) bool.
        corners: True if pixels that touch only at a corner are connected.

    Returns:
        (rows, columns) int, the part of each pixel, numbered from 1, and 0 for unset pixels; and the number of parts.
    """
    result: Any = ndimage.label(mask, np.ones((3, 3)) if corners else None)
    return np.asarray(result[0]), int(result[1])
