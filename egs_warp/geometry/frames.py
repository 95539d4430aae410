"""Orthonormal directions, rotations, boxes."""

from __future__ import annotations

import numpy as np


def orthonormal_basis(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (3,) square to the unit ``direction`` (3,), right-handed before it."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(helper, direction)
    first /= np.linalg.norm(first)
    return first, np.cross(direction, first)


def cross_matrices(arms: np.ndarray) -> np.ndarray:
    """(n, 3, 3) whose columns k are e_k x arm, how ``arms`` (n, 3) go as they turn about axis k."""
    turns = np.zeros((len(arms), 3, 3))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        turns[:, i, k], turns[:, j, k] = -arms[:, j], arms[:, i]
    return turns


def kabsch_rotation(masses: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(3, 3) rotation that best carries the arms ``before`` (n, 3) to those ``after``, by ``masses`` (n,) (Kabsch)."""
    return nearest_rotation(np.einsum("n,ni,nj->ij", masses, after, before))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """(3, 3) rotation nearest to a ``matrix`` (3, 3)."""
    u, _, vt = np.linalg.svd(matrix)
    return u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))] @ vt


def box_corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(8, 3) of the box from the corner ``low`` (3,) to ``high`` (3,)."""
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
