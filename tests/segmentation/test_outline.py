"""The step at the outline of an object, and the level ledge around its foot."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.object_spec import Segmentation
from egs_warp.segmentation.outline import ledge_around, stands_out
from tests.support.grounds import ball, level
from tests.support.scenes import FLOOR, blocks, lying


def segmented(object_cloud: GaussianCloud, rest: GaussianCloud, size: float) -> tuple[GaussianCloud, Segmentation]:
    """Return a scene whose first part is the object, and its segmentation."""
    cloud = concatenate(object_cloud, rest)
    own = np.arange(cloud.count) < object_cloud.count
    return cloud, Segmentation(own, np.zeros_like(own), np.zeros_like(own), size)


def scattered_floor(spread: float) -> GaussianCloud:
    points = level((-1.5, -1.5), (1.5, 1.5), 0.0, 0.04)
    points[:, 2] += np.random.default_rng(4).normal(0.0, spread, len(points))
    return lying(points)


@pytest.mark.parametrize("spread", [0.005, 0.02, 0.06])
def test_a_piece_of_a_floor_does_not_stand_out_however_rough_the_floor_is(spread: float) -> None:
    """The piece is what lies above the floor's plane within a disc of radius 0.7."""
    floor = scattered_floor(spread)
    means = floor.means.numpy()
    own = (np.hypot(*means[:, :2].T) < 0.7) & (means[:, 2] > 0.0)
    assert not stands_out(floor, FLOOR, Segmentation(own, np.zeros_like(own), np.zeros_like(own), 2.0))


def cushion(height: float) -> GaussianCloud:
    """Return a round cushion of diameter 1 that gets thinner towards its edge."""
    points = level((-0.5, -0.5), (0.5, 0.5), 0.0, 0.03)
    points = points[np.hypot(*points[:, :2].T) < 0.5]
    points[:, 2] = height * np.cos(np.pi * np.hypot(*points[:, :2].T)) ** 2
    return lying(points)


@pytest.mark.parametrize(
    "thing",
    [
        blocks(((-0.4, -0.3, 0.0), (0.4, 0.3, 0.04))),
        blocks(((-0.4, -0.4, 0.04), (0.4, 0.4, 0.08)), ((-0.25, -0.25, 0.0), (0.25, 0.25, 0.04))),
        ball(),
        cushion(0.3),
    ],
    ids=["book", "plate", "ball", "cushion"],
)
def test_flat_and_round_objects_stand_out(thing: GaussianCloud) -> None:
    """A book of a twenty-fifth of its diagonal, a plate on its foot, a ball and a cushion stand out of a floor, also
    where the floor ends at one side of them."""
    size = float(np.linalg.norm(np.ptp(thing.means.numpy(), axis=0)))
    for left in (-1.5, 0.0):
        floor = lying(level((left, -1.5), (1.5, 1.5), 0.0, 0.04))
        assert stands_out(*_with_plane(segmented(thing, floor, size)))


def _with_plane(scene: tuple[GaussianCloud, Segmentation]) -> tuple[GaussianCloud, Plane, Segmentation]:
    return scene[0], FLOOR, scene[1]


@pytest.mark.parametrize(("half", "least", "most"), [(0.5, 0.95, 1.0), (0.3, 0.0, 0.3)])
def test_a_ledge_surrounds_the_foot_of_a_ball_on_a_pedestal(half: float, least: float, most: float) -> None:
    """The outline of the lowest 0.08 of the size of a ball of diameter 1 has the radius 0.35. A pedestal of half side
    0.5 extends beyond it all round, and one of half side 0.3 only at its corners."""
    pedestal = blocks(((-half, -half, -1.0), (half, half, 0.0)))
    cloud, segmentation = segmented(ball(), pedestal, float(np.sqrt(3.0)))
    assert least <= ledge_around(cloud, FLOOR, segmentation) <= most


def test_a_plane_through_an_object_has_no_ledge() -> None:
    """The upper half of a ball is surrounded by nothing at the level of its edge."""
    whole = ball()
    own = whole.means.numpy()[:, 2] > 0.5
    cloud, segmentation = segmented(whole.subset(own), whole.subset(~own), 1.5)
    assert ledge_around(cloud, FLOOR.moved(np.array([0.0, 0.0, 0.5])), segmentation) < 0.3
