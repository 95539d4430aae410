"""Plane under an object on haze, found from the lowest parts of the object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from egs_warp.errors import UserError
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.locate_plane import LocatedPlane, locate_plane, with_measured_ground
from egs_warp.pipelines.prepare_scene import SceneOptions, prepare_scene
from egs_warp.segmentation.clearance import StraddlingPolicy
from egs_warp.segmentation.object_mask import segment
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.segmentation.resting_plane import resting_plane
from tests.support.grounds import level, sheet
from tests.support.scenes import FLOOR, ball_on_floor, round_ones

UP = np.array([0.0, 0.0, 1.0])
BOX = np.array([1.0, 0.6, 0.5])


def leaning(degrees: float) -> np.ndarray:
    """Return the up direction (3,), rotated about y by ``degrees``."""
    angle = np.radians(degrees)
    return np.array([np.sin(angle), 0.0, np.cos(angle)])


def skin_of_box(count: int = 3000) -> np.ndarray:
    """Return points (n, 3) on all sides of a box centred at the origin, with its underside on the floor."""
    random = np.random.default_rng(2)
    points = random.uniform(-0.5, 0.5, (count, 3))
    side = random.integers(0, 3, count)
    points[np.arange(count), side] = np.sign(points[np.arange(count), side]) / 2.0
    return points * BOX + [0.0, 0.0, 0.5 * BOX[2]]


def box_on_haze(degrees: float) -> GaussianCloud:
    """Return the box and a sheet of haze through its foot that is tilted by ``degrees``."""
    normal = leaning(degrees)
    haze = level((-2.0, -2.0), (2.0, 2.0), 0.0, 0.1)
    haze[:, 2] = 0.05 - haze[:, 0] * normal[0] / normal[2]
    return concatenate(
        round_ones(skin_of_box(), 0.008), sheet(haze, np.tile(normal, (len(haze), 1)), 0.06, (0.9, 0.9, 0.9))
    )


def degrees_between(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1.0, 1.0))))


@pytest.mark.parametrize("off", [0.0, 3.0, 8.0])
def test_a_box_rests_on_its_underside(off: float) -> None:
    """The plane is found although the initial plane cuts through the box, the given up direction is off by ``off``
    degrees, and some stray Gaussians are below the box."""
    skin = skin_of_box()
    strays = np.random.default_rng(0).uniform(-0.4, 0.4, (8, 3)) * [1.0, 1.0, 0.2] - [0.0, 0.0, 0.1]
    cloud = round_ones(np.concatenate([skin, strays]), 0.008)
    cut = Plane(leaning(-off), -0.1)
    thing = cut.heights(cloud.means.numpy().astype(np.float64)) > 0.0
    found = resting_plane(cloud, thing, cut, leaning(off), degrees=10.0, size=1.3)
    assert degrees_between(found.normal, UP) < 0.6
    assert abs(float(found.heights(np.zeros(3)))) < 0.01


@pytest.mark.parametrize("off", [-9.0, -5.0, 5.0])
def test_the_direction_is_finer_than_the_first_search(off: float) -> None:
    """The error of the direction is less than 0.15 degrees, although the first search tries directions 1.4 degrees
    apart."""
    cloud = round_ones(skin_of_box(), 0.008)
    found = resting_plane(cloud, np.ones(cloud.count, bool), FLOOR, leaning(off), degrees=10.0, size=1.3)
    assert degrees_between(found.normal, UP) < 0.15


@pytest.mark.parametrize("mirror", [(-1.0, 1.0, 1.0), (1.0, -1.0, 1.0)])
def test_a_mirrored_object_rests_on_the_mirrored_plane(mirror: tuple[float, float, float]) -> None:
    """The search prefers no side, so the plane of a mirrored object is mirrored, too."""
    for seed in range(8):
        points = np.random.default_rng(seed).normal(size=(600, 3)) * [0.3, 0.2, 0.1] + [0.0, 0.0, 0.5]
        found, other = (
            resting_plane(round_ones(each, 0.005), np.ones(600, bool), FLOOR, UP, degrees=20.0, size=1.3)
            for each in (points, points * mirror)
        )
        np.testing.assert_allclose(other.normal, found.normal * mirror, atol=1e-9)
        assert other.offset == pytest.approx(found.offset, abs=1e-9)


def test_a_mirror_image_in_a_glossy_table_carries_nothing() -> None:
    """A box stands on feet of height 0.3; as many Gaussians are 0.6 below them, as in a reflection. The plane is under
    the feet."""
    skin = skin_of_box() + [0.0, 0.0, 0.3]
    feet = np.concatenate([skin_of_box(300) * [0.1, 0.1, 0.6] + [x, y, 0.0] for x in (-0.4, 0.4) for y in (-0.2, 0.2)])
    image = skin_of_box() * [1.0, 1.0, -1.0] - [0.0, 0.0, 0.6]
    cloud = round_ones(np.concatenate([skin, feet, image]), 0.008)
    thing = np.arange(cloud.count) < len(skin) + len(feet)
    found = resting_plane(cloud, thing, FLOOR, UP, degrees=10.0, size=1.3)
    assert degrees_between(found.normal, UP) < 0.6
    assert abs(float(found.heights(np.zeros(3)))) < 0.01


def test_the_direction_is_limited() -> None:
    cloud = round_ones(skin_of_box(), 0.008)
    found = resting_plane(cloud, np.ones(cloud.count, bool), FLOOR, leaning(8.0), degrees=5.0, size=1.3)
    assert degrees_between(found.normal, leaning(8.0)) == pytest.approx(5.0, abs=0.1)


def test_haze_alone_carries_nothing() -> None:
    wide = round_ones(skin_of_box(), 0.1)
    with pytest.raises(UserError, match="the object has only 0 fine Gaussians"):
        resting_plane(wide, np.ones(wide.count, bool), FLOOR, UP, degrees=10.0, size=1.3)


def found_on(cloud: GaussianCloud) -> LocatedPlane:
    cameras = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.25]), 0.9, count=8, elevations=(20.0, 50.0), size=200)
    spec = ObjectSpec(point=np.array([0.0, 0.0, 0.45]))
    return with_measured_ground(cloud, locate_plane(cloud, spec, cameras=cameras), spec, cameras)


def test_a_tilted_visible_surface_is_replaced_by_the_resting_plane() -> None:
    """A visible surface that is tilted by 8 degrees is treated as haze, a surface tilted by 3 degrees as a table."""
    laid, seen = found_on(box_on_haze(8.0)), found_on(box_on_haze(3.0))
    assert not laid.in_sight and laid.fit is None and seen.in_sight
    assert "laid under the object's lowest parts" in laid.notes[-1]
    assert degrees_between(laid.plane.normal, UP) < 0.6
    assert abs(float(laid.plane.heights(np.zeros(3)))) < 0.01
    assert degrees_between(seen.plane.normal, leaning(3.0)) < 0.6
    assert laid.ground is None


def test_low_remnants_on_haze_are_dropped_and_haze_stays() -> None:
    """Low remnants near the foot are removed, but not distant ones; if a table is visible, no remnants are removed."""
    at = np.array([[0.54, 0.1, 0.04], [0.52, -0.1, 0.03], [1.6, 0.9, 0.0]])
    shreds = round_ones(at, 0.01)
    for degrees, dropped in ((8.0, [True, True, False]), (3.0, [False, False, False])):
        cloud = concatenate(box_on_haze(degrees), shreds)
        found = found_on(cloud)
        assert found.in_sight is not any(dropped)
        segmentation = found.segmentation
        if any(dropped):
            assert (~segmentation.background_mask[-len(at) :]).tolist() == dropped
        sheet_of_haze = np.arange(3000, cloud.count - len(at))
        assert segmentation.background_mask[sheet_of_haze].mean() > 0.9


def test_haze_is_not_filled() -> None:
    """If the plane is not visible, the floor is not inpainted, because its position is uncertain."""
    cameras = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.25]), 0.9, count=8, elevations=(20.0, 50.0), size=200)
    spec = ObjectSpec(point=np.array([0.0, 0.0, 0.45]))
    scene = prepare_scene(
        box_on_haze(8.0), spec, cameras=cameras, options=SceneOptions(clearing=StraddlingPolicy.SPLIT), plane=None
    )
    assert scene.filled is None and not scene.located.in_sight
    assert "was not filled, because no view shows" in scene.notes[-1]


def test_haze_within_an_object_is_dropped() -> None:
    """Haze inside an object belongs neither to the object nor to the background, in which it would show the outline of
    the object."""
    cloud, truth = ball_on_floor()
    where = np.array([[0.0, 0.1, 0.6], [0.1, 0.0, 0.4]])
    haze = round_ones(where, 0.2)
    haze = replace(haze, opacity_logits=wp.array(np.full(2, -1.5, np.float32)))
    found = segment(concatenate(cloud, haze), FLOOR, ObjectSpec(point=np.array([0.0, 0.0, 0.5])))
    assert found.floater_mask[-2:].all()
    assert found.object_mask[: cloud.count][truth].mean() > 0.95


def test_haze_at_an_object_in_its_colour_is_dropped() -> None:
    """Haze of another colour, or farther away, belongs to the background."""
    cloud, _ = ball_on_floor()
    where = np.array([[0.55, 0.0, 0.5], [0.0, 0.55, 0.5], [0.75, 0.0, 0.5]])
    haze = round_ones(where, 0.2)
    grey, bright = 0.0, 1.6
    haze = replace(
        haze,
        opacity_logits=wp.array(np.full(3, -1.5, np.float32)),
        sh=wp.array(np.array([grey, bright, grey])[:, None, None] * np.ones((3, 1, 3)), dtype=wp.vec3),
    )
    found = segment(concatenate(cloud, haze), FLOOR, ObjectSpec(point=np.array([0.0, 0.0, 0.5])))
    assert found.floater_mask[-3:].tolist() == [True, False, False]
    assert not found.object_mask[-3:].any()


def test_haze_around_an_object_is_left_out() -> None:
    cloud, truth = ball_on_floor()
    random = np.random.default_rng(4)
    where = random.normal(size=(30, 3))
    where = 0.55 * where / np.linalg.norm(where, axis=1, keepdims=True) + [0.0, 0.0, 0.7]
    for opacity, taken in ((0.2, False), (0.9, True)):
        haze = round_ones(where, 0.2)
        logits = np.full(30, np.log(opacity / (1.0 - opacity)), np.float32)
        both = concatenate(
            cloud,
            GaussianCloud.from_numpy(where, haze.rotations.numpy(), haze.log_scales.numpy(), logits, haze.sh.numpy()),
        )
        found = segment(both, FLOOR, ObjectSpec(point=np.array([0.0, 0.0, 0.5])))
        assert bool(found.object_mask[cloud.count :].any()) is taken
        assert found.object_mask[: cloud.count][truth].mean() > 0.95
