"""Torque-free rotation of a rigid body (Euler's equations), and its inverse problem."""

from __future__ import annotations

import numpy as np
from scipy.optimize import root
from scipy.spatial.transform import Rotation

_STEPS = 16
"""Number of steps of the midpoint rule, which is then accurate to 0.2 degrees for half a turn."""
_TOLERANCE = 1e-4
"""Tolerance of the root search for the spin."""


def integrate_rotation(inertia: np.ndarray, spin: np.ndarray, seconds: float) -> Rotation:
    """Integrate the rotation of a free body.

    The angular momentum is constant. The spin varies, and the body wobbles, unless it rotates about a principal axis.

    Args:
        inertia: (3, 3) kg m^2, world axes, at the start.
        spin: (3,) rad/s, world axes, at the start.
        seconds: duration, s.

    Returns:
        The rotation after ``seconds``.
    """
    momentum, turned = inertia @ spin, Rotation.identity()
    step = seconds / _STEPS

    def spinning(turn: Rotation) -> np.ndarray:
        axes = turn.as_matrix()
        return axes @ np.linalg.solve(inertia, axes.T @ momentum)

    for _ in range(_STEPS):
        middle = Rotation.from_rotvec(0.5 * step * spinning(turned)) * turned
        turned = Rotation.from_rotvec(step * spinning(middle)) * turned
    return turned


def spin_for_rotation(inertia: np.ndarray, upright: np.ndarray, turn: np.ndarray, seconds: float) -> np.ndarray:
    """Find the initial spin of a free body that produces a given rotation.

    Args:
        inertia: (3, 3) kg m^2, world axes.
        upright: (3,) rotation vector that is applied first.
        turn: (3,) rotation vector that is applied second; its angle may exceed half a turn.
        seconds: duration, s.

    Returns:
        (3,) rad/s; the constant spin (upright + turn) / seconds if the root search fails.
    """
    target = Rotation.from_rotvec(turn) * Rotation.from_rotvec(upright)
    steady = (upright + turn) / seconds
    solution = root(
        lambda spin: (target * integrate_rotation(inertia, spin, seconds).inv()).as_rotvec(), steady, tol=_TOLERANCE
    )
    return solution.x if solution.success else steady
