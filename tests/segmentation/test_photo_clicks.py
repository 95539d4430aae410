"""Object selected by clicks in a capture with photos, as the minimum of the energy, for a ball that touches other
things."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.locate_plane import _on_unseen_ground, locate_plane
from egs_warp.segmentation.clicks import Click, click_at
from egs_warp.segmentation.object_mask import segment
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.segmentation.photo_clicks import (
    ClicksInPhotos,
    object_of_clicks,
    object_without_ground,
    share_below,
    with_photos,
)
from egs_warp.segmentation.surface_graph import SurfaceGraph
from egs_warp.segmentation.votes import MaskedView
from tests.support.grounds import level, sheet
from tests.support.scenes import FLOOR, lying, shell

BALL = 1500
UP = np.array([0.0, 0.0, 1.0])
FRONT = (0.0, -0.5, 0.5)


def ball(middle: float, colour: tuple[float, float, float]) -> GaussianCloud:
    """Return a ball of diameter 1 on the floor, at ``middle`` on the x axis."""
    skin = shell(BALL)
    return sheet(skin + [middle, 0.0, 0.0], 2.0 * (skin - [0.0, 0.0, 0.5]), 0.045, colour)


def photos(count: int, distance: float = 2.2) -> list[Camera]:
    """Return cameras on an arc in front of the ball at the origin, which fills their images."""
    middle = np.array([0.0, 0.0, 0.5])
    angles = np.radians(np.linspace(-150.0, -30.0, count))
    eyes = [middle + distance * np.array([np.cos(angle), np.sin(angle), 0.5]) for angle in angles]
    return [Camera.look_at(eye, middle, UP, width=160, height=120, vertical_fov_degrees=45.0) for eye in eyes]


def click(cloud: GaussianCloud, point: tuple[float, float, float], *, inside: bool = True) -> Click:
    """Return a click on ``point`` in the middle one of nine photos."""
    camera = photos(9)[4]
    x, y, z = camera.rotation @ np.array(point) + camera.translation
    hit = click_at(cloud, camera, camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z, inside=inside)
    assert hit is not None
    return hit


@pytest.fixture(scope="module")
def against_wall() -> GaussianCloud:
    """Create a ball that touches a long wall behind it, both on a floor."""
    wall = level((-4.0, 0.03), (4.0, 2.0), 0.5, 0.06)[:, [0, 2, 1]]
    floor = lying(level((-4.0, -2.0), (4.0, 0.5), 0.0, 0.06))
    upright = sheet(wall, np.tile([0.0, -1.0, 0.0], (len(wall), 1)), 0.06, (0.3, 0.5, 0.6))
    return concatenate(ball(0.0, (0.8, 0.2, 0.1)), upright, floor)


@pytest.fixture(scope="module")
def twins() -> GaussianCloud:
    """Create two touching balls of one colour on a floor."""
    floor = lying(level((-2.0, -1.5), (2.0, 1.5), 0.0, 0.06))
    return concatenate(ball(0.0, (0.8, 0.2, 0.1)), ball(1.0, (0.8, 0.2, 0.1)), floor)


def test_a_wall_behind_the_object_is_left_out(against_wall: GaussianCloud) -> None:
    """The wall is connected to the ball, so without photos a point selects both; with photos, it selects the ball."""
    alone = ObjectSpec(point=np.array(FRONT))
    heights = against_wall.means.numpy()[:, 2]
    own = (np.arange(against_wall.count) < BALL) & (heights > 0.1)
    wall = (np.arange(against_wall.count) >= BALL) & (heights > 0.1)
    both = segment(against_wall, FLOOR, alone).object_mask
    assert both[own].mean() > 0.99 and both[wall].mean() > 0.95
    found = segment(against_wall, FLOOR, with_photos(against_wall, alone, photos(9))).object_mask
    assert found[own].mean() > 0.95 and found[wall].mean() < 0.02


def test_a_concave_crease_separates_two_balls_of_one_colour(twins: GaussianCloud) -> None:
    surface = SurfaceGraph.of(twins, photos(9))
    chosen = object_of_clicks(surface, [click(twins, FRONT)], FLOOR)
    assert chosen[:BALL].mean() > 0.9 and chosen[BALL : 2 * BALL].mean() < 0.2


def test_a_second_click_adds_and_a_click_beside_removes(twins: GaussianCloud) -> None:
    surface = SurfaceGraph.of(twins, photos(9, 3.5))
    first, right = click(twins, FRONT), click(twins, (0.75, -0.43, 0.5))
    off = replace(right, inside=False)
    added, removed = (object_of_clicks(surface, [first, other], FLOOR) for other in (right, off))
    assert added[right.hits].all() and added[BALL : 2 * BALL].mean() > 0.5
    assert not removed[off.hits].any() and removed[BALL : 2 * BALL].mean() < 0.2
    assert removed[:BALL].mean() > 0.9


def test_of_opposite_clicks_on_one_place_the_later_one_counts(twins: GaussianCloud) -> None:
    surface = SurfaceGraph.of(twins, photos(9))
    plus, minus = (click(twins, FRONT, inside=inside) for inside in (True, False))
    assert not object_of_clicks(surface, [plus, minus], FLOOR).any()
    assert object_of_clicks(surface, [minus, plus], FLOOR)[:BALL].mean() > 0.9


def test_a_wide_hit_of_a_click_is_no_constraint(against_wall: GaussianCloud) -> None:
    """A click on the ball that also hits a Gaussian of the wall, four times as wide as a click, does not select it."""
    spec = with_photos(against_wall, ObjectSpec.of_clicks([click(against_wall, FRONT)]), photos(9))
    scales = against_wall.log_scales.numpy().copy()
    scales[BALL + 40] = np.log([0.4, 0.4, 0.01])
    wide = GaussianCloud.from_numpy(
        against_wall.means.numpy(),
        against_wall.rotations.numpy(),
        scales,
        against_wall.opacity_logits.numpy(),
        against_wall.sh.numpy(),
    )
    hit = Click(spec.clicks[0].point, np.append(spec.clicks[0].hits, BALL + 40))
    found = segment(wide, FLOOR, with_photos(wide, ObjectSpec.of_clicks([hit]), photos(9))).object_mask
    assert found[spec.clicks[0].hits].all() and not found[BALL + 40]


def test_the_visible_area_of_a_ball_is_its_area(twins: GaussianCloud) -> None:
    """The area is four times the silhouette (Cauchy), which perspective enlarges by 1 / (1 - R^2 / D^2)."""
    alone, radius = twins.subset(np.arange(twins.count) < BALL), 0.5
    away = float(np.linalg.norm(photos(9)[4].centre - [0.0, 0.0, 0.5]))
    expected = 4.0 * np.pi * radius**2 / (1.0 - (radius / away) ** 2) / (away * np.tan(np.radians(22.5))) ** 2
    assert SurfaceGraph.of(alone, photos(9)).visible_area.sum() == pytest.approx(expected, rel=0.1)


def test_the_unit_of_length_changes_nothing(twins: GaussianCloud) -> None:
    expected = object_of_clicks(SurfaceGraph.of(twins, photos(9)), [click(twins, FRONT)], FLOOR)
    hit, larger = click(twins, FRONT), twins.scaled(100.0)
    cameras = [replace(one, translation=100.0 * one.translation, near=100.0 * one.near) for one in photos(9)]
    again = object_of_clicks(
        SurfaceGraph.of(larger, cameras), [Click(100.0 * hit.point, hit.hits)], FLOOR.scaled(100.0)
    )
    assert (again != expected).mean() < 0.002


def test_photos_are_used_only_if_enough_of_them_show_the_point(twins: GaussianCloud) -> None:
    spec = ObjectSpec(point=np.array(FRONT))
    assert with_photos(twins, spec, photos(7)) is spec
    elsewhere = [Camera.look_at(np.array([0.0, 9.0, 1.0]), np.array([0.0, 20.0, 1.0]), UP, width=64, height=48)] * 9
    assert with_photos(twins, spec, [*photos(7), *elsewhere]) is spec
    masked = ObjectSpec(masks=(MaskedView(photos(1)[0], np.ones((120, 160), bool), "photo"),))
    assert with_photos(twins, masked, photos(9)) is masked


def test_an_object_below_its_plane_is_reported(twins: GaussianCloud) -> None:
    spec = with_photos(twins, ObjectSpec.of_clicks([click(twins, FRONT)]), photos(9))
    with pytest.raises(UserError, match="nothing of it lies above the plane around the clicks; click on more of it"):
        segment(twins, Plane(UP, -5.0), spec)


def test_the_object_is_whole_if_no_photo_shows_its_ground() -> None:
    """Without a floor, the widest level plane is a slice through the top of a dome. The dome is found nevertheless, on
    a plane under its lowest parts."""
    whole = ball(0.0, (0.8, 0.2, 0.1))
    dome = whole.subset(whole.means.numpy()[:, 2] > 0.2)
    spec = ObjectSpec.of_clicks([click(dome, (0.0, -0.35, 0.85))])
    located = locate_plane(dome, spec, cameras=photos(9))
    assert not located.in_sight
    assert located.segmentation.object_mask.mean() > 0.95
    assert located.plane.normal[2] > np.cos(np.radians(3.0))
    assert -located.plane.offset == pytest.approx(0.2, abs=0.03)


def test_the_length_of_the_up_direction_does_not_matter() -> None:
    whole = ball(0.0, (0.8, 0.2, 0.1))
    dome = whole.subset(whole.means.numpy()[:, 2] > 0.2)
    spec = ObjectSpec.of_clicks([click(dome, (0.0, -0.35, 0.85))])
    once, twice = (locate_plane(dome, spec, cameras=photos(9), up=length * UP) for length in (1.0, 2.0))
    assert not twice.in_sight
    np.testing.assert_array_equal(twice.segmentation.object_mask, once.segmentation.object_mask)


def test_ground_that_surrounds_the_object_is_in_sight(twins: GaussianCloud) -> None:
    """A plane through the middle of a ball, or of a box with a floor around it, is no reason to lay a plane under
    these. The ball is found on its floor, and a click on the floor is refused."""
    box = [
        level((-1.0, -1.0), (1.0, 1.0), 0.8, 0.05),
        *(level((-1.0, 0.0), (1.0, 0.8), side, 0.05)[:, [0, 2, 1]] for side in (-1.0, 1.0)),
        *(level((-1.0, 0.0), (1.0, 0.8), side, 0.05)[:, [2, 0, 1]] for side in (-1.0, 1.0)),
    ]
    normals = np.array([[0, 0, 1], [0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0]], float)
    faces = [sheet(p, np.tile(n, (len(p), 1)), 0.05, (0.5, 0.3, 0.2)) for p, n in zip(box, normals, strict=True)]
    floor = level((-1.6, -1.6), (1.6, 1.6), 0.0, 0.05)
    floor = lying(floor[np.abs(floor[:, :2]).max(axis=1) > 1.0])
    for cloud, point, height in ((twins, FRONT, 0.5), (concatenate(*faces, floor), (0.4, -0.6, 0.8), 0.78)):
        cameras = photos(9, 4.0)
        spec = with_photos(cloud, ObjectSpec.of_clicks([click(cloud, point)]), cameras)
        assert isinstance(spec, ClicksInPhotos)
        plane = Plane(UP, -height)
        assert share_below(spec, object_without_ground(spec, UP), plane) > 0.1
        assert _on_unseen_ground(cloud, spec, plane, UP, ()) is None
    spec = ObjectSpec.of_clicks([click(twins, FRONT)])
    assert locate_plane(twins, spec, cameras=photos(9)).in_sight
    spec = ObjectSpec.of_clicks([click(twins, (0.0, -1.1, 0.0))])
    with pytest.raises(UserError, match="lies on the ground, beside an object"):
        locate_plane(twins, spec, cameras=photos(9))


def test_the_share_below_a_plane_is_that_of_the_object_without_its_floor(twins: GaussianCloud) -> None:
    """By Archimedes' hat-box theorem, the area of a slice of a ball is proportional to its height. The lowest 3 % of
    the ball's size do not count."""
    alone = twins.subset(np.arange(BALL))
    spec = with_photos(alone, ObjectSpec.of_clicks([click(alone, FRONT)]), photos(9))
    assert isinstance(spec, ClicksInPhotos) and spec.surface is not None
    spec = replace(spec, surface=replace(spec.surface, visible_area=np.ones(alone.count)))
    found = object_without_ground(spec, UP)
    assert found.mean() > 0.95
    shares = [share_below(spec, found, Plane(UP, -height)) for height in (0.0, 0.25, 0.5)]
    np.testing.assert_allclose(shares, [0.0, 0.2, 0.45], atol=0.04)
