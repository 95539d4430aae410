"""How a body turns in the air, where nothing acts on its spin: Euler's equations of a rigid body."""

from __future__ import annotations

import numpy as np
from scipy.optimize import root
from scipy.spatial.transform import Rotation

_STEPS = 16
"""Of the midpoint rule: to 0.2 degrees of half a turn."""
_EXACT = 1e-4
"""Of the spin that is found."""


def integrate_rotation(inertia: np.ndarray, spin: np.ndarray, seconds: float) -> Rotation:
    """By what a body of ``inertia`` (3, 3) kg m^2 has turned ``seconds`` after it had the ``spin`` (3,) rad/s, world
    axes. Its angular momentum stays, its spin need not: off its principal axes it wobbles."""
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
    """(3,) rad/s with which a free body of ``inertia`` (3, 3) turns by the rotation vector ``upright`` (3,), then by
    ``turn`` (3,), which may be more than half a turn, in ``seconds``; as if it did not wobble where none is found."""
    asked = Rotation.from_rotvec(turn) * Rotation.from_rotvec(upright)
    steady = (upright + turn) / seconds
    found = root(
        lambda spin: (asked * integrate_rotation(inertia, spin, seconds).inv()).as_rotvec(), steady, tol=_EXACT
    )
    return found.x if found.success else steady
