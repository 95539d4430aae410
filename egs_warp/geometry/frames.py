"""Directions, orthonormal bases, rotations and axis-aligned boxes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from egs_warp.errors import ArgumentError

Direction: TypeAlias = np.ndarray | Sequence[float] | str
"""A direction: three numbers, or the name of an axis such as ``-y``."""
AXES = "x, y, z, -x, -y, -z"
"""Names of axes, for messages."""


def axis_named(name: str) -> np.ndarray | None:
    """Return the (3,) unit vector of an axis such as ``-y``; None for other names."""
    name = name.strip().lower()
    axis = ("x", "y", "z").index(name.lstrip("+-")) if name.lstrip("+-") in ("x", "y", "z") else None
    return None if axis is None else (-1.0 if name.startswith("-") else 1.0) * np.eye(3)[axis]


def direction_of(direction: Direction, argument: str) -> np.ndarray:
    """Return the (3,) float64 vector of ``direction``.

    Raises ``ArgumentError``, which names ``argument``, for a name that is not an axis, and for numbers that are all
    zero or not all finite.
    """
    vector = axis_named(direction) if isinstance(direction, str) else None
    try:
        vector = np.asarray(direction, dtype=np.float64) if vector is None else vector
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        raise ArgumentError(argument, f"give three numbers or one of {AXES}", value=direction)
    return vector


def orthonormal_basis(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors (3,) orthogonal to the unit ``direction`` (3,); (first, second, direction) is
    right-handed."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(helper, direction)
    first /= np.linalg.norm(first)
    return first, np.cross(direction, first)


def cross_matrices(arms: np.ndarray) -> np.ndarray:
    """Return the matrices (n, 3, 3) with columns e_k x arm: the derivatives of ``arms`` (n, 3) with respect to
    rotations about the axes k."""
    matrices = np.zeros((len(arms), 3, 3))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        matrices[:, i, k], matrices[:, j, k] = -arms[:, j], arms[:, i]
    return matrices


def kabsch_rotation(masses: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) that best maps the arms ``before`` (n, 3) to ``after`` (n, 3), in the least-squares
    sense with weights ``masses`` (n,) (Kabsch algorithm)."""
    return nearest_rotation(np.einsum("n,ni,nj->ij", masses, after, before))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation (..., 3, 3) nearest to each ``matrix`` (..., 3, 3)."""
    u, _, vt = np.linalg.svd(matrix)
    signs = np.ones(matrix.shape[:-1])
    signs[..., 2] = np.sign(np.linalg.det(u @ vt))
    return u * signs[..., None, :] @ vt


def times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the products (..., i) of ``matrices`` (..., i, j) and ``vectors`` (..., j)."""
    return (matrices @ vectors[..., None])[..., 0]


def dots(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the dot products (...,) of vectors (..., k)."""
    return (one * other).sum(axis=-1)


def box_corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the corners (8, 3) of the box from ``low`` (3,) to ``high`` (3,)."""
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
