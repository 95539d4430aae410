"""Up direction of a scene from its file, its cameras or its shape."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.plane import Plane
from egs_warp.io.capture import Capture, read_capture
from egs_warp.io.spz import write_spz
from egs_warp.pipelines.locate_plane import locate_plane, up_of_scene
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.object_spec import ObjectSpec
from tests.support.scenes import FLOOR, ball_on_floor

CAMERAS = ring_cameras(FLOOR, np.zeros(3), 1.0, count=9)
"""Cameras whose up direction is +z, as in ``ball_on_floor``."""


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """A .spz file, which states +y, of a scene whose up direction is +z: written without a rotation."""
    cloud, _ = ball_on_floor()
    write_spz(tmp_path / "a.spz", cloud)
    return read_capture(tmp_path / "a.spz", device="cpu")


def test_cameras_override_an_up_direction_of_the_file_that_contradicts_them(capture: Capture) -> None:
    assert capture.up is not None and capture.up[1] == 1.0
    up, (note,), _ = up_of_scene(capture, CAMERAS)
    assert up[2] > np.cos(np.radians(1.0))
    assert note.startswith("up is taken to be ") and "up in the file differs by 90 degrees" in note
    found = locate_plane(capture, ObjectSpec(point=np.array([0.0, -0.5, 0.5])), cameras=CAMERAS)
    assert found.plane.normal[2] > np.cos(np.radians(1.0))


def test_up_of_the_file_is_used_if_the_cameras_are_missing_or_agree(capture: Capture) -> None:
    up, notes, _ = up_of_scene(capture, [])
    assert up[1] == 1.0 and notes == ()
    leaning = np.array([0.0, np.sin(np.radians(15.0)), np.cos(np.radians(15.0))])
    capture = replace(capture, up=leaning)
    up, notes, _ = up_of_scene(capture, CAMERAS)
    np.testing.assert_array_equal(up, leaning)
    assert notes == ()


def test_a_misplaced_click_is_named_with_the_reason_of_the_failure() -> None:
    """No plane is below a click under the floor; without this click, the ball is found."""
    cloud, truth = ball_on_floor()
    means = cloud.means.numpy()
    top = Click(np.array([0.0, 0.0, 1.0]), np.flatnonzero(truth & (means[:, 2] > 0.97)))
    below = Click(np.array([0.0, 0.9, -0.6]), np.flatnonzero(np.linalg.norm(means - [0.0, 0.9, 0.0], axis=1) < 0.06))
    spec = ObjectSpec.of_clicks([top, below])
    with pytest.raises(
        UserError, match=r"without the click \+0,0\.9,-0\.6, which is 0\.\d+ of its size away"
    ) as caught:
        locate_plane(cloud, spec, up=FLOOR.normal)
    reason = caught.value.__cause__
    assert isinstance(reason, UserError) and reason.message.removeprefix("object: ") in caught.value.message
    assert caught.value.message.endswith("leave this click out, or move it")


def test_a_click_below_the_plane_is_reported_as_not_in_the_object() -> None:
    plane = Plane(FLOOR.normal, -0.05)
    cloud, truth = ball_on_floor()
    means = cloud.means.numpy()
    top = Click(np.array([0.0, 0.0, 1.0]), np.flatnonzero(truth & (means[:, 2] > 0.97)))
    ground = Click(np.array([0.0, 0.9, 0.0]), np.flatnonzero(np.linalg.norm(means - [0.0, 0.9, 0.0], axis=1) < 0.06))
    located = locate_plane(cloud, ObjectSpec.of_clicks([top, ground]), plane=plane)
    assert "the click +0,0.9,0 is not in the object: it lies on or below the plane, or on haze; check the plane" in (
        located.notes
    )
    opposite = replace(ground, inside=False)
    located = locate_plane(cloud, ObjectSpec.of_clicks([top, ground, opposite]), plane=plane)
    reason = "the later click -0,0.9,0 hits the same Gaussians; leave one of them out"
    assert f"the click +0,0.9,0 is not in the object: {reason}" in located.notes
