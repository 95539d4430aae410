"""Up direction of a scene from its file, its cameras or its shape."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.io.capture import Capture, read_capture
from egs_warp.io.spz import write_spz
from egs_warp.pipelines.locate_plane import locate_plane, up_of_scene
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
