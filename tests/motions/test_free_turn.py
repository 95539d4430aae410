"""Rotation of a rigid body in the air, compared with the closed form of a symmetric top."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.motions.free_turn import integrate_rotation, spin_for_rotation


def leaning(inertia: list[float], lean: float) -> np.ndarray:
    """Return an inertia (3, 3) with these principal moments, about axes tilted by ``lean`` radians."""
    axes = Rotation.from_rotvec([lean, 0.3 * lean, 0.0]).as_matrix()
    return axes @ np.diag(inertia) @ axes.T


@pytest.mark.parametrize("seconds", [0.2, 1.0, 2.0])
def test_a_symmetric_top_precesses_about_its_angular_momentum(seconds: float) -> None:
    """The rate of precession is |L| / I with the moment of inertia I about a transverse axis (Landau and Lifshitz,
    Mechanics, section 33)."""
    axis = np.array([0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0])
    along, across = 0.5, 1.2
    inertia = across * np.eye(3) + (along - across) * np.outer(axis, axis)
    spin = np.array([0.3, -0.2, 1.4])
    momentum = inertia @ spin
    wanted = Rotation.from_rotvec(seconds / across * momentum).apply(axis)
    assert np.allclose(integrate_rotation(inertia, spin, seconds) @ axis, wanted, atol=5e-3)


def test_about_a_principal_axis_a_body_does_not_wobble() -> None:
    inertia = np.diag([0.4, 0.9, 0.6])
    turned = integrate_rotation(inertia, np.array([0.0, 0.0, 2.0]), 1.3)
    assert np.allclose(turned, Rotation.from_rotvec([0.0, 0.0, 2.6]).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("turn", [0.4, -1.6, 4.0])
def test_a_tilted_body_reaches_the_requested_rotation(turn: float) -> None:
    """The requested rotation vector divided by the time is a spin that misses the target by more than 0.5 degrees; the
    spin from the root search misses it by less than 0.02 degrees."""
    inertia, upright, asked = leaning([0.5, 0.8, 0.3], 0.25), np.array([0.05, -0.08, 0.02]), np.array([0.0, 0.0, turn])
    goal = Rotation.from_rotvec(asked) * Rotation.from_rotvec(upright)

    def missed(spin: np.ndarray) -> float:
        return float(
            np.degrees((goal * Rotation.from_matrix(integrate_rotation(inertia, spin, 1.2)).inv()).magnitude())
        )

    assert missed((upright + asked) / 1.2) > 0.5
    assert missed(spin_for_rotation(inertia, upright, asked, 1.2)) < 0.02
