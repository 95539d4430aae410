"""Connected parts of Gaussians, and the space that a shell of them encloses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.segmentation.connectivity import close_to, connected_parts, enclosed
from tests.support.scenes import FLOOR


def test_parts_and_insides() -> None:
    """Two clusters are two parts unless a long Gaussian reaches from one to the other; a shell encloses its
    interior."""
    random = np.random.default_rng(0)
    clusters = np.concatenate([random.normal(scale=0.03, size=(50, 3)) + [x, 0.0, 1.0] for x in (-0.4, 0.4)])
    means = np.concatenate([clusters, [[0.0, 0.0, 1.0]]])
    scales = np.full((101, 3), -4.0)
    scales[100] = [np.log(0.3), -5.0, -5.0]
    cloud = GaussianCloud.from_numpy(
        means, np.tile([1.0, 0, 0, 0], (101, 1)), scales, np.full(101, 3.0), np.zeros((101, 1, 3))
    )
    both = connected_parts(cloud, np.arange(100), cell=0.1, plane=FLOOR, above=0.0)
    assert len(set(both[:50])) == len(set(both[50:])) == 1 and both[0] != both[99]
    bridged = connected_parts(cloud, np.arange(101), cell=0.1, plane=FLOOR, above=0.0)
    assert len(set(bridged)) == 1
    ring = np.stack([np.cos(np.linspace(0, 6.28, 200)), np.sin(np.linspace(0, 6.28, 200))], axis=1)
    assert enclosed(np.array([[0.0, 0.0], [1.0, 0.0], [1.3, 0.0]]), ring, 0.05).tolist() == [True, True, False]


@pytest.mark.parametrize("seed", range(3))
def test_a_long_gaussian_reaches_its_ends(seed: int) -> None:
    """A Gaussian of any orientation connects clusters 3.9 cells apart; the reach of a longer one is limited to four
    cells."""
    random = np.random.default_rng(seed)
    turn = Rotation.from_quat(random.normal(size=4))
    way = turn.as_matrix()[:, seed]
    middles = np.array([0.0, 3.9, 9.0])[:, None] * 0.1 * way + [0.0, 0.0, 2.0]
    clusters = np.concatenate([random.normal(0.0, 0.005, (50, 3)) + middle for middle in middles])
    for length, reached in ((0.39, True), (0.9, False)):
        scales = np.full((151, 3), -6.0)
        scales[150, seed] = np.log(length / 1.5)
        cloud = GaussianCloud.from_numpy(
            np.concatenate([clusters, middles[:1]]),
            np.tile(turn.as_quat()[[3, 0, 1, 2]], (151, 1)),
            scales,
            np.full(151, 3.0),
            np.zeros((151, 1, 3)),
        )
        parts = connected_parts(cloud, np.arange(151), cell=0.1, plane=FLOOR, above=0.0)
        assert parts[75] == parts[0] or not reached
        assert parts[125] != parts[0]


def test_nothing_is_enclosed_by_no_shell() -> None:
    assert enclosed(np.zeros((3, 2)), np.zeros((0, 2)), 0.1).tolist() == [False] * 3


def test_close_is_within_reach_of_any() -> None:
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.5]])
    assert close_to(points, np.array([[0.0, 0.4]]), 0.45).tolist() == [True, False, True]
    assert close_to(points, np.array([[0.0, 0.4], [1.0, 0.1]]), 0.45).all()
    assert not close_to(points, np.zeros((0, 2)), 0.45).any()
