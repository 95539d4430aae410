"""Positions of the visible surface in an image: those from heights are on the floor, those from depths are biased
upwards."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.seen_surface import SeenSurface
from tests.support.grounds import level
from tests.support.scenes import FLOOR, lying

SPACING = 0.03


@pytest.fixture(scope="module")
def floor_view() -> SeenSurface:
    """Create a view of a floor from an elevation of 30 degrees."""
    eye = np.array([0.0, -2.2, 1.3])
    camera = Camera.look_at(
        eye, np.zeros(3), np.array([0.0, 0.0, 1.0]), width=120, height=120, vertical_fov_degrees=30.0
    )
    return SeenSurface.of(lying(level((-2.0, -2.0), (2.0, 2.0), 0.0, SPACING)), camera)


def test_heights_are_right_where_depths_are_too_high(floor_view: SeenSurface) -> None:
    rays = camera_rays(floor_view.camera)
    by_depth = floor_view.camera.centre + floor_view.depth[..., None] * rays
    assert floor_view.opaque.mean() > 0.9
    assert by_depth[floor_view.opaque][:, 2].mean() > 0.1 * SPACING, "nearer splats hide those behind them"
    points = floor_view.points(FLOOR, floor_view.opaque)
    assert len(points) == floor_view.opaque.sum()
    assert np.abs(points[:, 2]).max() < 1e-6
    # Each point lies on the ray of its pixel.
    along = (points - floor_view.camera.centre) @ floor_view.camera.rotation[2]
    np.testing.assert_allclose(points, floor_view.camera.centre + along[:, None] * rays[floor_view.opaque], atol=1e-9)


def test_a_rough_plane_is_sufficient(floor_view: SeenSurface) -> None:
    """For a plane tilted by two degrees, the error is at most the width of a splat times the sine of the tilt."""
    tilt = np.radians(2.0)
    rough = Plane(np.array([0.0, np.sin(tilt), np.cos(tilt)]), 0.02)
    points = floor_view.points(rough, floor_view.opaque)
    assert np.abs(points[:, 2]).max() < 3.0 * SPACING * np.sin(tilt)


def test_pixels_without_a_surface_have_no_depth(floor_view: SeenSurface) -> None:
    """The depth is zero for empty pixels, for rays at or above the horizon, and for a plane above the camera."""
    up = Camera.look_at(
        np.array([0.0, -1.0, 0.5]), np.array([0.0, 1.0, 0.9]), np.array([0.0, 0.0, 1.0]), width=64, height=64
    )
    floor = lying(level((-2.0, -2.0), (2.0, 2.0), 0.0, SPACING))
    look = SeenSurface.of(floor, up)
    depth = look.depth_over(FLOOR)
    slope = camera_rays(up) @ FLOOR.normal
    assert (depth[slope >= 0.0] == 0.0).all() and (depth[look.opaque & (slope < 0.0)] > 0.0).all()
    assert (depth[look.depth == 0.0] == 0.0).all()
    assert not floor_view.depth_over(Plane(-FLOOR.normal, 5.0)).any()
