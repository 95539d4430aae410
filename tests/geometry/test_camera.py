"""Framing by the nearest camera that shows all points within its margins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera, fitted_camera


@pytest.mark.parametrize(("width", "height"), [(200, 200), (320, 100), (90, 240)])
@pytest.mark.parametrize("stretch", [(1.0, 1.0, 1.0), (5.0, 0.5, 0.2), (0.2, 0.1, 4.0)])
def test_a_fitted_camera_is_the_nearest_that_shows_all(
    width: int, height: int, stretch: tuple[float, float, float]
) -> None:
    """All points are within the margins; a camera that is slightly nearer does not show all of them."""
    points = np.random.default_rng(0).normal(0.0, 1.0, (200, 3)) * stretch + [3.0, -2.0, 7.0]
    start = Camera.look_at(np.array([2.0, -5.0, 1.5]), np.zeros(3), np.eye(3)[2], width=width, height=height)
    camera = fitted_camera(start, points, sides=0.8, top=0.9, bottom=0.6)
    np.testing.assert_array_equal(camera.rotation, start.rotation)
    limits = np.array([[0.1 * width, 0.05 * height], [0.9 * width, 0.8 * height]])

    def extremes(one: Camera) -> np.ndarray:
        local = points @ one.rotation.T + one.translation
        assert local[:, 2].min() > one.near > 0.0
        pixels = local[:, :2] / local[:, 2:] * [one.fx, one.fy] + [one.cx, one.cy]
        return np.array([pixels.min(axis=0), pixels.max(axis=0)])

    found = extremes(camera)
    assert (found[0] > limits[0] - 1e-6).all() and (found[1] < limits[1] + 1e-6).all()
    # Along one image axis, points reach both margins, so that no nearer camera shows all points, however it is shifted.
    assert np.abs(found - limits).max(axis=0).min() < 1e-6
    # Along both axes, the distances to the two margins are equal, also if some points are much nearer than others.
    np.testing.assert_allclose(found[0] - limits[0], limits[1] - found[1], atol=1e-4)
    nearer = extremes(replace(camera, translation=camera.translation - [0.0, 0.0, 0.01]))
    assert np.ptp(nearer, axis=0).max() > np.ptp(found, axis=0).max()


def test_the_far_plane_may_be_infinitely_far() -> None:
    """Everything in front of the camera is drawn then; an infinite near plane is refused."""
    camera = Camera.look_at(3.0 * np.eye(3)[0], np.zeros(3), np.eye(3)[2], width=8, height=8, far=np.inf)
    assert replace(camera, near=1e9).far == np.inf
    with pytest.raises(UserError, match="near inf: give a finite number above 0"):
        replace(camera, near=np.inf)
