"""Directions in which an object may rest on a plane."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.assets import pawn
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.segmentation.base_plane import guess_up
from egs_warp.segmentation.resting_directions import resting_directions


def test_a_block_rests_on_its_six_sides() -> None:
    random = np.random.default_rng(0)
    points = random.uniform(-0.5, 0.5, (3000, 3))
    points[np.arange(3000), np.arange(3000) % 3] = 0.5 * random.choice([-1.0, 1.0], 3000)
    turn = Rotation.from_euler("xyz", [20, 35, -15], degrees=True).as_matrix()
    ups = resting_directions(points * [1.0, 2.0, 0.7] @ turn.T, at_most=6)
    cosines = ups @ turn
    assert sorted(np.argmax(np.abs(cosines), axis=1)) == [0, 0, 1, 1, 2, 2]
    assert np.abs(cosines).max(axis=1).min() > np.cos(np.radians(0.5))


@pytest.mark.parametrize(
    "points", [np.zeros((50, 3)), np.eye(3), np.random.default_rng(0).normal(size=(50, 3)) * [1, 1, 0]]
)
def test_without_volume_there_are_none(points: np.ndarray) -> None:
    assert resting_directions(points, at_most=6).shape == (0, 3)


@pytest.mark.parametrize("degrees", [12, 30])
def test_up_of_a_tilted_pawn_is_the_normal_of_its_base(degrees: int) -> None:
    thing = pawn(gaussian_count=2000)
    turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    tilted = to_body_frame(thing.cloud, BodyFrame(turn, np.zeros(3), 1.0))
    up, reason = guess_up(tilted)
    assert up @ turn @ thing.up > np.cos(np.radians(2.0))
    assert re.search(rf"tilted by ({degrees}|{degrees - 1}|{degrees + 1}) degrees from \+z, clearly ahead of", reason)
    # In scenes, only axes are candidates, and none fits an object that is tilted by 30 degrees.
    assert ("no axis fits well" in guess_up(tilted, tilted=False)[1]) == (degrees == 30)
