"""Plane under an object in a room, which is the table top that it stands on and not the wider floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.locate_plane import locate_plane
from egs_warp.segmentation import table_top as module
from egs_warp.segmentation.object_mask import segment
from egs_warp.segmentation.object_spec import Box, ObjectSpec, Segmentation
from egs_warp.segmentation.selection_masks import masks_from_selection
from egs_warp.segmentation.table_top import is_own_ledge, planes_below, surface_around
from tests.support.grounds import ball, furnished_room, level, sheet

UP = np.array([0.0, 0.0, 1.0])
BALL = 5000
MIDDLE = np.array([0.0, 0.0, 0.5])


@pytest.fixture(scope="module")
def room() -> GaussianCloud:
    return furnished_room()


@pytest.fixture(scope="module")
def candidates(room: GaussianCloud) -> list[Plane]:
    return planes_below(room, UP, MIDDLE)


@pytest.mark.parametrize(
    "click",
    [
        (0.0, 0.0, 0.5),
        pytest.param((0.3, 0.2, 0.85), marks=pytest.mark.slow),
        pytest.param((0.2, -0.35, 0.2), marks=pytest.mark.slow),
    ],
)
def test_a_click_on_a_ball_finds_the_table_top(room: GaussianCloud, click: tuple[float, float, float]) -> None:
    """The plane is within 1 degree and 0.5 % of the ball's height, and the ball is the object; the floor is much
    wider."""
    located = locate_plane(room, ObjectSpec(point=np.array(click)), up=UP)
    assert located.plane.normal @ UP > np.cos(np.radians(1.0))
    assert abs(float(located.plane.heights(np.zeros(3)))) < 5e-3
    found = located.segmentation.object_mask
    assert found[:BALL].mean() > 0.97 and found[BALL:].sum() == 0


@pytest.mark.slow
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


def test_candidates_are_sorted_from_the_top_and_extend_around_the_ball(
    room: GaussianCloud, candidates: list[Plane]
) -> None:
    heights = [-plane.offset for plane in candidates]
    assert heights == sorted(heights, reverse=True)
    assert any(abs(height) < 0.02 for height in heights)
    point = ObjectSpec(point=MIDDLE)
    top = Plane(UP, 0.0)
    assert surface_around(room, top, segment(room, top, point)) > 0.95
    middle = Plane(UP, -0.3)
    assert surface_around(room, middle, segment(room, middle, point)) < 0.05


@pytest.mark.parametrize(("reach", "is_own"), [(0.7, False), (3.0, True)])
def test_a_ledge_is_a_part_of_the_object_if_the_object_contains_most_of_it(
    room: GaussianCloud, reach: float, is_own: bool
) -> None:
    """An object found above the floor contains the ball and the table top within ``reach`` of the ball's axis."""
    top, means = Plane(UP, 0.0), room.means.numpy()
    standing = segment(room, top, ObjectSpec(point=MIDDLE))
    near = (np.linalg.norm(means[:, :2], axis=1) < reach) & (np.abs(means[:, 2]) < 0.1)
    whole = replace(standing, object_mask=standing.object_mask | near)
    assert is_own_ledge(room, top, standing, whole) == is_own


def test_candidates_do_not_depend_on_the_unit_of_length(room: GaussianCloud, candidates: list[Plane]) -> None:
    scaled = planes_below(room.scaled(10.0), UP, 10.0 * MIDDLE)
    np.testing.assert_allclose(
        [plane.offset for plane in scaled], [10.0 * plane.offset for plane in candidates], atol=1e-3
    )


def test_dust_far_away_changes_no_candidate(room: GaussianCloud, candidates: list[Plane]) -> None:
    """Gaussians too faint to be visible do not affect the size of the capture."""
    dust = GaussianCloud.from_numpy(
        np.random.default_rng(0).uniform(-60.0, 60.0, (4000, 3)),
        np.tile([1.0, 0.0, 0.0, 0.0], (4000, 1)),
        np.full((4000, 3), -3.0),
        np.full(4000, -3.0),
        np.zeros((4000, *room.sh.shape[1:], 3)),
    )
    found = planes_below(concatenate(room, dust), UP, MIDDLE)
    assert [plane.offset for plane in found] == [plane.offset for plane in candidates]


def on_surface(points: np.ndarray, spacing: float, cover: float) -> float:
    """Return ``surface_around`` a ball of one unit that touches z = 0 at (-3, 2), for flat Gaussians at ``points`` (n,
    3) relative to its foot, on a grid of ``spacing``; their opacities cover ``cover`` of the area.
    """
    thing, foot = ball(), np.array([-3.0, 2.0, 0.0])
    flat = sheet(points, np.tile(UP, (len(points), 1)), spacing, (0.5, 0.5, 0.5))
    # The integral of a Gaussian's opacity is 2 pi s1 s2 times its peak.
    full = 2.0 * np.pi * flat.opacities()[0] * np.exp(2.0 * float(flat.log_scales.numpy()[0, 0])) / spacing**2
    whole = concatenate(
        thing, sheet(points, np.tile(UP, (len(points), 1)), spacing * np.sqrt(cover / full), (0.5, 0.5, 0.5))
    )
    whole = GaussianCloud.from_numpy(
        whole.means.numpy() + foot,
        whole.rotations.numpy(),
        whole.log_scales.numpy(),
        whole.opacity_logits.numpy(),
        whole.sh.numpy(),
    )
    mine = np.arange(whole.count) < thing.count
    nothing = np.zeros(whole.count, bool)
    return surface_around(whole, Plane(UP, 0.0), Segmentation(mine, nothing, nothing, float(np.sqrt(3.0))))


def test_surface_around_measures_the_extent_of_the_surface() -> None:
    """The surface extends half-way around a ball whose centre is over the edge of a table. It extends all around if
    Gaussians cover enough of the area, and nowhere if they cover less or begin a cell farther out.
    """
    spacing, enough = 0.02, module._COVERED
    half, whole = (level((left, -1.0), (1.0, 1.0), 0.0, spacing) for left in (0.0, -1.0))
    # After the blur, the edge is where the cover has half of its value.
    assert on_surface(half, spacing, 2.0 * enough) == pytest.approx(0.5, abs=0.03)
    assert on_surface(whole, spacing, 1.2 * enough) > 0.95
    assert on_surface(whole, spacing, 0.8 * enough) < 0.05
    # The ball's foot is a circle of radius 0.35; neither the cell at its outline nor one outside the apron counts.
    reach = 0.35 + (1 + module._APRON + 1) * module._CELL * np.sqrt(3.0)
    assert on_surface(whole[np.linalg.norm(whole[:, :2], axis=1) > reach], spacing, 2.0) < 0.2
