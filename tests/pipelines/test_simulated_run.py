"""View direction of a video: 35 degrees from the facing direction, unless something blocks the view."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from egs_warp.geometry.camera import FILMED_FROM
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.pipelines.creature import usual_view
from egs_warp.pipelines.facing_direction import Front
from egs_warp.pipelines.simulated_run import SimulatedRun
from tests.support.grounds import level, sheet
from tests.support.scenes import lying, round_ones

MIDDLE = np.array([0.0, 0.0, 0.5])
USUAL = np.array(FILMED_FROM[:2]) / np.hypot(*FILMED_FROM[:2])


def side(scene: GaussianCloud) -> np.ndarray:
    """Return the horizontal view direction (2,) for a body of one unit that faces x."""
    ground = SimpleNamespace(local=lambda points: points)
    body = SimpleNamespace(height=1.0)
    stub: Any = SimpleNamespace(creature=SimpleNamespace(body=body), place=SimpleNamespace(ground=ground))
    way = SimulatedRun._clear_side(stub, scene, MIDDLE, 4.0, np.array(FILMED_FROM))
    return way[:2] / np.hypot(*way[:2])


def wall(way: np.ndarray, away: float) -> GaussianCloud:
    """Return a screen of two by one and a half units, orthogonal to ``way`` (2,)."""
    along = np.array([-way[1], way[0]])
    grid = level((-1.0, 0.0), (1.0, 1.5), 0.0, 0.05)
    points = np.column_stack([away * way + grid[:, :1] * along, grid[:, 1]])
    return sheet(points, np.tile([*-way, 0.0], (len(points), 1)), 0.05, (0.5, 0.5, 0.5))


FLOOR = lying(level((-3.0, -3.0), (3.0, 3.0), 0.0, 0.05))


def test_floaters_do_not_turn_the_camera_away_from_the_face() -> None:
    random = np.random.default_rng(0)
    near = 1.5 * np.array([*USUAL, 0.3]) + random.normal(0.0, 0.2, (12, 3))
    assert side(FLOOR) == pytest.approx(USUAL)
    assert side(concatenate(FLOOR, round_ones(near, 0.02))) == pytest.approx(USUAL)


def test_an_occluder_turns_the_camera_and_a_wall_behind_it_does_not() -> None:
    turned = side(concatenate(FLOOR, wall(USUAL, 1.5)))
    assert -0.1 < turned @ USUAL < 0.8, "the nearest side that is clear"
    assert side(concatenate(FLOOR, wall(USUAL, 4.5))) == pytest.approx(USUAL)


@pytest.mark.parametrize(("degrees", "azimuth"), [(None, None), (90.0, 45.0), (-100.0, -50.0), (180.0, -60.0)])
def test_an_unclear_front_is_filmed_from_between_both_candidates(degrees: float | None, azimuth: float | None) -> None:
    """If the front of a body that faces x is uncertain, the view is half-way towards the other candidate, but at most
    60 degrees away."""
    other = None if degrees is None else np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.0])
    front = Front(np.array([1.0, 0.0, 0.0]), "guessed", other)
    ground: Any = SimpleNamespace(axes=np.eye(3))
    way = usual_view(front, ground)
    assert np.linalg.norm(way) == pytest.approx(1.0)
    if azimuth is None:
        assert way * np.linalg.norm(FILMED_FROM) == pytest.approx(FILMED_FROM)
        return
    assert np.degrees(np.arctan2(way[1], way[0])) == pytest.approx(azimuth)
