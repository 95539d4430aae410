"""Distances and connected parts of bool masks (rows, columns), in pixels."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from scipy import ndimage


def depth_inside(mask: np.ndarray) -> np.ndarray:
    """(rows, columns) float64, distance of each set pixel to the nearest unset one; 0 for unset pixels."""
    return np.asarray(cast(Any, ndimage.distance_transform_edt(mask)))


def distance_to(mask: np.ndarray) -> np.ndarray:
    """(rows, columns) float64, distance of each pixel to the nearest set one."""
    return depth_inside(~mask)


def nearest_set(mask: np.ndarray) -> np.ndarray:
    """(2, rows, columns) int, row and column of the set pixel nearest to each pixel."""
    result: Any = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return np.asarray(result)


def connected_parts(mask: np.ndarray, *, corners: bool = False) -> tuple[np.ndarray, int]:
    """Label the connected parts of a mask.

    Args:
        mask: (rows, columns) bool.
        corners: whether pixels that touch only at a corner are connected.

    Returns:
        (rows, columns) int, the number of each pixel's part from 1 and 0 for unset pixels; and the number of parts.
    """
    result: Any = ndimage.label(mask, np.ones((3, 3)) if corners else None)
    return np.asarray(result[0]), int(result[1])
