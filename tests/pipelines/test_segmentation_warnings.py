"""Warnings about the segmentation of an object; a complete object causes none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.pipelines.locate_plane import LocatedPlane, locate_plane
from egs_warp.pipelines.pictures import segmentation_picture
from egs_warp.pipelines.segmentation_warnings import segmentation_warnings
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.object_spec import Box, ObjectSpec, Segmentation
from tests.support.grounds import level
from tests.support.scenes import FLOOR, lying, round_ones, shell

CAMERAS = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.5]), 1.0, count=4, elevations=(20.0,), size=120)


@pytest.fixture(scope="module")
def located_ball() -> tuple[GaussianCloud, LocatedPlane]:
    """Locate a ball on a floor by a point; return the scene and the located plane."""
    cloud = concatenate(round_ones(shell(), 0.03), lying(level((-1.5, -1.5), (1.5, 1.5), 0.0, 0.05)))
    return cloud, locate_plane(cloud, ObjectSpec(point=np.array([0.0, -0.5, 0.5])), plane=FLOOR)


def changed(located: LocatedPlane, object_mask: np.ndarray) -> LocatedPlane:
    return replace(located, segmentation=replace(located.segmentation, object_mask=object_mask))


def test_a_complete_object_causes_no_warning(located_ball: tuple[GaussianCloud, LocatedPlane]) -> None:
    cloud, located = located_ball
    assert segmentation_warnings(cloud, located, cloud.subset(located.segmentation.object_mask), CAMERAS) == []


def test_a_point_outside_the_capture_is_refused(located_ball: tuple[GaussianCloud, LocatedPlane]) -> None:
    cloud, _ = located_ball
    with pytest.raises(UserError, match="object: the point 50,50,50 is outside the capture, which extends from -1"):
        locate_plane(cloud, ObjectSpec(point=np.full(3, 50.0)), plane=FLOOR)
    click = Click(np.full(3, 50.0), np.array([0]), camera=CAMERAS[0], pixel=(60.0, 40.0), text="+60,40@a")
    with pytest.raises(UserError, match=r"object: the click \+60,40@a hits a floater at 50,50,50, .*another photo$"):
        locate_plane(cloud, ObjectSpec.of_clicks([click]), plane=FLOOR)


def test_an_object_at_the_edge_of_pictures(located_ball: tuple[GaussianCloud, LocatedPlane]) -> None:
    cloud, located = located_ball
    thing = cloud.subset(located.segmentation.object_mask)
    near = [replace(CAMERAS[0], cx=CAMERAS[0].cx + 50.0), *CAMERAS[1:]]
    assert segmentation_warnings(cloud, located, thing, near) == [
        "touches the picture's edge in 1 of 4 views: is it whole?"
    ]


def test_surroundings_that_came_along(located_ball: tuple[GaussianCloud, LocatedPlane]) -> None:
    """A wall and a ceiling around the ball were segmented with it. They touch three edges of one view, and no edge of
    the other views."""
    cloud, located = located_ball
    near = [replace(CAMERAS[0], fx=4.0 * CAMERAS[0].fx, fy=4.0 * CAMERAS[0].fy), *CAMERAS[1:]]
    assert segmentation_warnings(cloud, located, cloud.subset(located.segmentation.object_mask), near) == [
        "touches the picture's edges all round in 1 of 4 views: its surroundings are included; click with a minus on"
        " what does not belong to it, or mark it with masks"
    ]


def cropped(cloud: GaussianCloud, located: LocatedPlane, kept: np.ndarray) -> tuple[GaussianCloud, LocatedPlane]:
    """Return the ``kept`` (n,) bool part of a capture, and its segmentation."""
    old = located.segmentation
    masks = (old.object_mask[kept], old.buried_mask[kept], old.floater_mask[kept])
    return cloud.subset(kept), replace(located, segmentation=Segmentation(*masks, old.size))


@pytest.mark.parametrize("is_surrounded", [True, False])
def test_a_large_object_may_include_its_surroundings_if_no_ground_surrounds_it(
    located_ball: tuple[GaussianCloud, LocatedPlane], is_surrounded: bool
) -> None:
    """The ball has more than half of the Gaussians of a capture that is little wider than the ball. It stands free on a
    small floor, or the floor is visible on one side only."""
    whole, located = located_ball
    x, y = whole.means.numpy()[:, :2].T
    on_floor = (np.abs(x) < 0.8) & (np.abs(y) < 0.8) & (is_surrounded | (y < -0.3))
    cloud, cut = cropped(whole, located, located.segmentation.object_mask | on_floor)
    object_mask = cut.segmentation.object_mask
    warnings = segmentation_warnings(cloud, cut, cloud.subset(object_mask), CAMERAS)
    percent = round(100 * object_mask.mean())
    assert percent > 50
    unseen = replace(cut, in_sight=False)
    assert segmentation_warnings(cloud, unseen, cloud.subset(object_mask), CAMERAS) == []
    assert warnings == (
        []
        if is_surrounded
        else [
            f"has {percent} % of the capture's Gaussians; if this is more than the object, click with a minus on what"
            " does not belong to it, or mark it with masks"
        ]
    )


def test_an_object_with_most_of_the_gaussians_of_a_wide_capture_causes_no_warning(
    located_ball: tuple[GaussianCloud, LocatedPlane],
) -> None:
    """A part of the wide floor beside the ball is missing, so that the ball has half of the Gaussians."""
    whole, located = located_ball
    cloud, cut = cropped(whole, located, np.arange(whole.count) < 3000)
    object_mask = cut.segmentation.object_mask
    assert object_mask.mean() > 0.45
    assert segmentation_warnings(cloud, cut, cloud.subset(object_mask), CAMERAS) == []


def test_an_object_without_its_foot(located_ball: tuple[GaussianCloud, LocatedPlane]) -> None:
    """The lowest 0.17 of a ball of diameter 1 is missing, which is a tenth of its size, the diagonal of its box."""
    cloud, located = located_ball
    kept = located.segmentation.object_mask & (cloud.means.numpy()[:, 2] > 0.17)
    (line,) = segmentation_warnings(cloud, changed(located, kept), cloud.subset(kept), CAMERAS)
    assert line == "rests on nothing: its lowest part is 10 % of its size above the ground"


def test_a_floor_that_came_along(located_ball: tuple[GaussianCloud, LocatedPlane]) -> None:
    """The floor on one side, which is half of the floor within the object's size, was segmented with the object."""
    cloud, located = located_ball
    means = cloud.means.numpy()
    kept = located.segmentation.object_mask | ((np.arange(cloud.count) >= 1500) & (means[:, 0] > 0.0))
    (line,) = segmentation_warnings(
        cloud, changed(located, kept), cloud.subset(located.segmentation.object_mask), CAMERAS
    )
    assert line.startswith("includes ") and line.endswith(" % of the floor around it")
    assert 45 <= int(line.split()[1]) <= 55


@pytest.mark.parametrize(
    ("high", "sides"), [((0.7, 0.7, 1.2), ""), ((0.3, 0.7, 1.2), "+x"), ((0.7, 0.2, 0.7), "+y, +z")]
)
def test_a_box_that_cuts_its_object(
    located_ball: tuple[GaussianCloud, LocatedPlane], high: tuple[float, float, float], sides: str
) -> None:
    cloud, _ = located_ball
    box = Box(np.array([-0.7, -0.7, -0.1]), np.array(high))
    located = locate_plane(cloud, ObjectSpec(box=box), plane=FLOOR)
    lines = segmentation_warnings(cloud, located, cloud.subset(located.segmentation.object_mask), CAMERAS)
    cut = "is cut: what is connected to it continues beyond these sides of the box: "
    assert [line for line in lines if "box" in line] == (
        [f"{cut}{sides}; if that belongs to it, enlarge the box"] if sides else []
    )


def test_the_warnings_are_in_the_image(located_ball: tuple[GaussianCloud, LocatedPlane]) -> None:
    cloud, located = located_ball
    thing = cloud.subset(located.segmentation.object_mask)
    plain, told = (segmentation_picture(cloud, thing, cloud, CAMERAS[:2], words) for words in ((), ("includes floor",)))
    np.testing.assert_array_equal(told[: len(plain)], plain)
    strip = told[len(plain) :]
    assert strip.shape[0] < 40 and (strip < 60).any() and strip[:, -20:].min() == 255
    # The letters grow with the sheet.
    wide = segmentation_picture(cloud, thing, cloud, [*CAMERAS[:2]] * 6, ("includes floor",))
    rows = [np.ptp(np.flatnonzero((one < 60).any(axis=(1, 2)))) for one in (strip, wide[len(plain) :])]
    assert rows[1] > 1.6 * rows[0]


def test_an_object_whose_colours_continue_beside_it_may_be_incomplete(
    located_ball: tuple[GaussianCloud, LocatedPlane],
) -> None:
    cloud, located = located_ball
    thing, found = cloud.subset(located.segmentation.object_mask), located.segmentation
    for share, count in ((0.12, 0), (0.21, 1)):
        doubtful = replace(located, segmentation=replace(found, shared_colours=share))
        lines = segmentation_warnings(cloud, doubtful, thing, CAMERAS)
        assert [line.startswith("may be incomplete: 21 % of it") for line in lines] == [True] * count
