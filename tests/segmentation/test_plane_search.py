"""Search for planes, from Gaussians that are parallel to them, with the widest first and each a single, visible
patch."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.plane_search import (
    _is_one_patch,
    find_planes,
    further_planes,
    lies_along,
    plane_under,
    plane_views,
    refine_plane,
)
from tests.support.grounds import level
from tests.support.scenes import FLOOR, lying


def test_several_planes_widest_first() -> None:
    random = np.random.default_rng(3)
    table = np.column_stack([random.uniform(-0.5, 0.5, (800, 2)), np.full(800, 0.8)])
    ground = np.column_stack([random.uniform(-1.5, 1.5, (3000, 2)), np.zeros(3000)])
    means = np.concatenate([table, ground])
    cloud = GaussianCloud.from_numpy(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1)),
        np.full((len(means), 3), -4.0),
        np.full(len(means), 3.0),
        np.zeros((len(means), 1, 3)),
    )
    found = find_planes(cloud, np.array([0.1, 0.0, 1.0]), count=2)
    assert [round(-one.plane.offset, 3) for one in found] == [0.0, 0.8]
    assert found[0].support > 0.7 and 0.15 < found[1].support < 0.3
    for height, offset in ((1.0, -0.8), (0.5, 0.0)):
        under = plane_under(found, np.array([0.0, 0.0, height]), tolerance=0.0)
        assert under is not None and abs(under.offset - offset) < 1e-3
    assert plane_under(found, np.array([0.0, 0.0, -1.0]), tolerance=0.0) is None


def test_gaussians_parallel_to_a_plane() -> None:
    """Discs count as parallel if they are tilted by less than 25 degrees, but not if they are tilted by more than 40,
    whichever axis is thin. Needles and balls do not count.
    """
    count = 200
    turns = Rotation.from_quat(np.random.default_rng(0).normal(size=(count, 4)))
    thin = np.arange(count) % 3
    scales = np.tile(np.log([0.1, 0.1, 0.1]), (count, 1))
    scales[np.arange(count), thin] = np.log(0.01)
    quaternions = turns.as_quat()[:, [3, 0, 1, 2]]
    normal = Plane.from_coefficients(0.3, -0.5, 0.8, 0.0).normal

    def found(log_scales: np.ndarray) -> np.ndarray:
        cloud = GaussianCloud.from_numpy(
            np.zeros((count, 3)), quaternions, log_scales, np.zeros(count), np.zeros((count, 1, 3))
        )
        return lies_along(cloud, Plane(normal, 0.0))

    tilt = np.degrees(np.arccos(np.abs(turns.as_matrix()[np.arange(count), :, thin] @ normal)))
    flat = found(scales)
    assert (tilt < 25.0).sum() > 10 and flat[tilt < 25.0].all() and not flat[tilt > 40.0].any()
    assert not found(-scales).any() and not found(np.full((count, 3), -3.0)).any()


def test_a_plane_is_a_single_patch() -> None:
    """One sheet is a single patch; three separate sheets at one level are not, even if another sheet above covers all
    of them."""
    one = level((-1.0, -1.0), (1.0, 1.0), 0.0, 0.03)
    apart = np.concatenate([one[:, :3] + [3.0 * k, 0.0, 0.0] for k in range(3)])
    above = level((-1.0, -1.0), (7.0, 1.0), 0.4, 0.03)
    assert _is_one_patch(lying(one), FLOOR, 0.1)
    assert not _is_one_patch(lying(np.concatenate([apart, above])), FLOOR, 0.1)
    assert not _is_one_patch(lying(one), Plane(FLOOR.normal, FLOOR.offset - 1.0), 0.1)


@pytest.mark.parametrize("scale", [1.0, 10.0])
def test_further_planes_are_level_in_one_patch_and_elsewhere(scale: float) -> None:
    """In a scene with a table, a floor below it and separate shelves at one level, the further plane that is found is
    the floor, in any unit of length."""
    table, floor = level((-0.6, -0.6), (0.6, 0.6), 0.0, 0.03), level((-2.0, -2.0), (2.0, 2.0), -0.8, 0.03)
    shelves = [level((x, y), (x + 0.7, y + 0.7), 0.7, 0.03) for x in (-2.0, 1.3) for y in (-2.0, 1.3)]
    room = lying(np.concatenate([table, floor, *shelves])).scaled(scale)
    found = further_planes(room, FLOOR, 1.0 * scale, 3)
    assert [round(one.plane.offset / scale, 3) for one in found] == [0.8]


def test_faint_surfaces_are_no_visible_planes() -> None:
    """If a floor is opaque on one side of a line and faint on the other, the visible plane ends at the line."""
    points = level((-1.5, -1.5), (1.5, 1.5), 0.0, 0.03)
    floor = lying(points)
    faint = GaussianCloud.from_numpy(
        points,
        floor.rotations.numpy(),
        floor.log_scales.numpy(),
        np.where(points[:, 0] > 0.0, 3.0, -1.5),
        floor.sh.numpy(),
    )
    eye = np.array([0.3, -0.2, 2.5])
    camera = Camera.look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0]), width=64, height=64)
    (view,) = plane_views(faint, FLOOR, [camera], centre=np.zeros(3), radius=1.0)
    seen = (camera.centre + view.depth[..., None] * camera_rays(camera))[view.mask]
    assert seen[:, 0].min() > -0.05 and seen[:, 0].max() > 0.7


@pytest.mark.parametrize(("given", "taken"), [(8, 8), (9, 5), (20, 7)])
def test_at_most_eight_cameras_are_used(given: int, taken: int) -> None:
    """The cameras are selected evenly; cameras below the plane are not used."""
    floor = lying(level((-1.5, -1.5), (1.5, 1.5), 0.0, 0.05))
    above = ring_cameras(FLOOR, np.zeros(3), 1.0, count=given, elevations=(40.0,), size=32)
    below = Camera.look_at(np.array([0.0, 1.0, -2.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]), width=32, height=32)
    views = plane_views(floor, FLOOR, [below, *above], centre=np.zeros(3), radius=1.0)
    assert len(views) == taken
    steps = np.diff([next(k for k, camera in enumerate(above) if camera is view.camera) for view in views])
    assert len(set(steps.tolist())) == 1


def test_a_plane_is_refined_equally_in_any_unit_of_length() -> None:
    """The heights of the floor scatter by 0.01 in a region of size 1. A step of 0.05 on one side, which does not belong
    to the floor, changes the plane by less than 0.01."""
    points = level((-1.5, -1.5), (1.5, 1.5), 0.0, 0.03)
    points[:, 2] = np.random.default_rng(1).normal(0.0, 0.01, len(points)) + 0.05 * (points[:, 0] > 0.6)
    fits = []
    for scale in (1.0, 10.0):
        cameras = ring_cameras(FLOOR, np.zeros(3), scale, count=4, elevations=(40.0,), size=64)
        start = Plane.from_coefficients(0.01, 0.0, 1.0, 0.0)
        fit = refine_plane(lying(points).scaled(scale), start, cameras, centre=np.zeros(3), radius=scale)
        fits.append(fit.plane)
    np.testing.assert_allclose(fits[1].normal, fits[0].normal, atol=1e-4)
    assert fits[1].offset == pytest.approx(10.0 * fits[0].offset, abs=1e-3)
    assert abs(fits[0].offset) < 0.01
