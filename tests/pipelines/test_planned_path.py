"""Planned path of a jump, from the standing body over the requested height to the end of the flight."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.jump import Jump
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import BodyMotion, MotionRecord, MotionSequence
from egs_warp.pipelines.planned_path import planned_com
from tests.support.flights import rigid_flight
from tests.support.stances import DT, block_place


def standing(name: str, seconds: float) -> tuple[MotionSequence, Trajectory, np.ndarray]:
    """Return a started sequence of a body that never moves, its trajectory, and its position."""
    place = block_place()
    sequence = MotionSequence(place, motion(name).parts(place.body.height))
    sequence.objectives(BodyState(place.standing, np.zeros_like(place.standing)), None, DT)
    count = round(seconds / DT) + 1
    stood = rigid_flight().__dict__ | {
        "time": DT * np.arange(count),
        "positions": np.repeat(place.standing[None], count, axis=0),
    }
    return sequence, Trajectory(**stood), place.body.centre_of_mass(place.standing)


def test_a_jump_s_plan_crouches_rises_as_requested_and_ends_at_touch_down() -> None:
    sequence, t, start = standing("jump", 2.5)
    jump = sequence.done[0].motion
    assert isinstance(jump, Jump)
    path = planned_com(sequence, block_place().body, t) - start
    known = np.isfinite(path[:, 2])
    plan = jump.plan
    assert path[0] == pytest.approx(np.zeros(3)) and known[: known.sum()].all() and not known.all()
    whole = 0.3 * np.sqrt(jump.body.height / jump.gravity) + plan.crouch_time + plan.thrust_time + plan.flight_time
    assert known.sum() == pytest.approx(whole / DT, abs=2)
    assert path[known, 2].min() == pytest.approx(-plan.crouch_depth, rel=0.1)
    assert path[known, 2].max() == pytest.approx(jump.target.height, rel=0.15)
    # The path is continuous: a step is not much longer than the displacement at the speed of the flight.
    steps = np.linalg.norm(np.diff(path[known], axis=0), axis=1)
    assert steps.max() < 1.3 * DT * np.hypot(plan.speed_up, plan.speed_forward)
    assert path[known][-1] @ jump.ground.axes[0] > 0.5 * jump.target.distance


def test_the_plan_of_a_later_jump_begins_with_its_crouch() -> None:
    """The body settles only at the start of the run, so the plan of a later jump is not delayed."""
    sequence, _, _ = standing("jump", 2.5)
    place, first = block_place(), sequence.done[0].motion
    later = Jump(place, cast(Jump, first).target)
    later.objectives(BodyState(place.standing, np.zeros_like(place.standing), 5.0), None, DT)
    settling = 0.3 * np.sqrt(place.body.height / later.gravity)
    for time in (0.5 * later.plan.crouch_time, later.plan.crouch_time + 0.5 * later.plan.flight_time):
        assert later.planned_com(time) == pytest.approx(first.planned_com(time + settling))
    assert later.planned_com(0.5 * later.plan.crouch_time)[2] < -0.3 * later.plan.crouch_depth


@pytest.mark.parametrize("name", ["hop", "twist 90"])
def test_hops_and_twists_have_the_plan_of_their_jump(name: str) -> None:
    sequence, t, start = standing(name, 2.5)
    path = planned_com(sequence, block_place().body, t) - start
    height = sequence.done[0].asked["height"] * block_place().body.height
    assert np.nanmax(path[:, 2]) == pytest.approx(height, rel=0.15) and np.isnan(path[-1]).all()


def test_motions_without_a_plan_have_no_planned_path() -> None:
    place = block_place()
    sequence = MotionSequence(place, [])
    sequence.done.append(
        MotionRecord("stand", {}, cast(BodyMotion, SimpleNamespace(planned_com=lambda elapsed: None)), 0.0)
    )
    _, t, _ = standing("jump", 0.1)
    assert planned_com(sequence, place.body, t).shape == (0, 3)
