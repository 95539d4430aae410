"""The plane under an object in a room: the table top that it stands on, not the floor, which is wider."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.locate_plane import locate_plane
from egs_warp.segmentation.object_mask import Box, ObjectSpec, masks_from_selection, segment
from egs_warp.segmentation.table_top import planes_below, surface_around
from tests.support.grounds import furnished_room

UP = np.array([0.0, 0.0, 1.0])
BALL = 5000


@pytest.fixture(scope="module")
def room() -> GaussianCloud:
    return furnished_room()


@pytest.mark.parametrize("click", [(0.0, 0.0, 0.5), (0.3, 0.2, 0.85), (0.2, -0.35, 0.2)])
def test_a_click_on_a_ball_finds_the_table_top(room: GaussianCloud, click: tuple[float, float, float]) -> None:
    """Within 1 degree and 0.5 % of the ball's height, and the ball is the object; the floor is far wider."""
    located = locate_plane(room, ObjectSpec(point=np.array(click)), up=UP)
    assert located.plane.normal @ UP > np.cos(np.radians(1.0))
    assert abs(float(located.plane.heights(np.zeros(3)))) < 5e-3
    found = located.segmentation.object_mask
    assert found[:BALL].mean() > 0.97 and found[BALL:].sum() == 0


def test_a_mask_and_a_box_find_it_too(room: GaussianCloud) -> None:
    eye = np.array([2.0, -3.0, 2.0])
    camera = Camera.look_at(eye, np.array([0.0, 0.0, 0.4]), UP, width=240, height=240, vertical_fov_degrees=40.0)
    masks = tuple(masks_from_selection(room, np.arange(room.count) < BALL, [camera]))
    for spec in (
        ObjectSpec(masks=masks),
        ObjectSpec(box=Box(np.array([-0.55, -0.55, -0.05]), np.array([0.55, 0.55, 1.05]))),
    ):
        located = locate_plane(room, spec, up=UP)
        assert abs(float(located.plane.heights(np.zeros(3)))) < 5e-3


def test_candidates_come_from_the_highest_down_and_the_surface_goes_on_around_the_ball(room: GaussianCloud) -> None:
    planes = planes_below(room, UP, np.array([0.0, 0.0, 0.5]))
    heights = [-plane.offset for plane in planes]
    assert heights == sorted(heights, reverse=True)
    assert any(abs(height) < 0.02 for height in heights)
    point = ObjectSpec(point=np.array([0.0, 0.0, 0.5]))
    top = Plane(UP, 0.0)
    assert surface_around(room, top, segment(room, top, point)) > 0.95
    middle = Plane(UP, -0.3)
    assert surface_around(room, middle, segment(room, middle, point)) < 0.05
