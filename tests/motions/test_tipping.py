"""Tipping of a block over its edges: heights, and the largest energy with which it stays upright."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.motions.tipping import TippingPath, tipping_path

WIDTH, HEIGHT = 0.5, 1.0
AXIS, UP = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def block_path(degrees: float) -> TippingPath:
    """Return the path of a frame with equal masses at its four corners, tilted by ``degrees``."""
    corners = np.array([[x, 0.0, z] for x in (-0.5 * WIDTH, 0.5 * WIDTH) for z in (-0.5 * HEIGHT, 0.5 * HEIGHT)])
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), 0.0, -np.sin(angle)], [0.0, 1.0, 0.0], [np.sin(angle), 0.0, np.cos(angle)]])
    return tipping_path(np.full(4, 0.5), corners @ turn.T, AXIS, angle, UP)


@pytest.mark.parametrize("degrees", [5.0, 60.0, 90.0, 120.0])
def test_heights_of_a_block(degrees: float) -> None:
    """The centre of mass is highest over an edge, at half of the diagonal, or at the start if the tilt is less than the
    angle of the diagonal."""
    path = block_path(degrees)
    diagonal = 0.5 * np.hypot(WIDTH, HEIGHT)
    angle = np.radians(degrees)
    start = 0.5 * HEIGHT * np.cos(angle) + 0.5 * WIDTH * np.sin(angle)
    assert path.top == pytest.approx(diagonal if degrees > 30.0 else start, rel=1e-3)
    assert path.upright == pytest.approx(0.5 * HEIGHT) and path.next_top == pytest.approx(diagonal, rel=1e-3)


def test_excess_of_a_block() -> None:
    """Angular momentum about the last edge is conserved when the base lands flat. With the largest excess of energy,
    the energy after the impact is just sufficient to reach the highest position over the edge on the other side."""
    path = block_path(90.0)
    square = 0.25 * (WIDTH**2 + HEIGHT**2)
    ratio = (square + 0.25 * (HEIGHT**2 - WIDTH**2)) / (2.0 * square)
    assert path.speed_ratio == pytest.approx(ratio) and path.inertia_ratio == pytest.approx(1.0)
    before = path.max_excess + path.top - path.upright
    assert ratio**2 * before == pytest.approx(path.next_top - path.upright)
