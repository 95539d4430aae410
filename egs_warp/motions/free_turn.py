"""Torque-free rotation of rigid bodies (Euler's equations), and its inverse problem.

In the shapes below, "..." is the world axis, or nothing for one world.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.geometry.frames import times

_STEPS = 16
"""Number of steps of the midpoint rule; with it, the rotation is accurate to 0.2 degrees for half a turn."""
_TOLERANCE, _MAX_ERROR = 1e-8, 1e-4
"""Error of the rotation, in radians, at which the search for the spin ends, and largest error of an accepted result."""
_MAX_ITERATIONS, _DIFFERENCE = 20, 1e-6
"""Maximum number of Newton iterations, and relative step of the difference quotients."""


def integrate_rotation(inertia: np.ndarray, spin: np.ndarray, seconds: np.ndarray | float) -> np.ndarray:
    """Integrate the rotation of a free body.

    The angular momentum is constant. The spin varies, and the body wobbles, unless it rotates about a principal axis.

    Args:
        inertia: (..., 3, 3) kg m^2, world axes, at the start.
        spin: (..., 3) rad/s, world axes, at the start.
        seconds: (...,) s, duration.

    Returns:
        (..., 3, 3), the rotation after ``seconds``.
    """
    momentum, turned = times(inertia, spin), np.broadcast_to(np.eye(3), (*spin.shape, 3))
    step, inverse = np.asarray(seconds)[..., None] / _STEPS, np.linalg.inv(inertia)

    def spinning(axes: np.ndarray) -> np.ndarray:
        return times(axes @ inverse, times(axes.swapaxes(-1, -2), momentum))

    for _ in range(_STEPS):
        middle = rotations_of(0.5 * step * spinning(turned)) @ turned
        turned = rotations_of(step * spinning(middle)) @ turned
    return turned


def spin_for_rotation(
    inertia: np.ndarray, upright: np.ndarray, turn: np.ndarray, seconds: np.ndarray | float
) -> np.ndarray:
    """Find the initial spin of a free body that produces a given rotation, with Newton's method.

    Args:
        inertia: (..., 3, 3) kg m^2, world axes.
        upright: (..., 3) rotation vector that is applied first.
        turn: (..., 3) rotation vector that is applied second; its angle may exceed half a turn.
        seconds: (...,) s, duration.

    Returns:
        (..., 3) rad/s; the constant spin (upright + turn) / seconds if the search fails.
    """
    target = rotations_of(turn) @ rotations_of(upright)
    steady = (upright + turn) / np.asarray(seconds)[..., None]
    sizes = _DIFFERENCE * np.maximum(np.linalg.norm(steady, axis=-1, keepdims=True), 1.0)
    # The first of the four rotations belongs to the spin itself, the others to the difference quotients.
    offsets = np.concatenate([np.zeros((1, 3)), np.eye(3)]).reshape(4, *np.ones(steady.ndim - 1, int), 3) * sizes
    spin = steady
    missing = np.full_like(steady, np.inf)
    for _ in range(_MAX_ITERATIONS):
        ends = integrate_rotation(inertia, spin + offsets, seconds)
        errors = rotation_vectors(target @ ends.swapaxes(-1, -2))
        missing = errors[0]
        if np.linalg.norm(missing, axis=-1).max() <= _TOLERANCE:
            break
        slopes = np.moveaxis((errors[1:] - missing) / sizes, 0, -1)
        is_regular = (np.abs(np.linalg.det(slopes)) > 0.0)[..., None, None]
        step = times(np.linalg.inv(np.where(is_regular, slopes, np.eye(3))), missing)
        spin = np.where(is_regular[..., 0], spin - step, spin)
    is_found = (np.linalg.norm(missing, axis=-1) <= _MAX_ERROR)[..., None]
    return np.where(is_found, spin, steady)


def rotations_of(vectors: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of rotation ``vectors`` (..., 3)."""
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def rotation_vectors(matrices: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (..., 3) of rotation ``matrices`` (..., 3, 3)."""
    return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec().reshape(matrices.shape[:-1])
