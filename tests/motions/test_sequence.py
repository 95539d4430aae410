"""Sequences of motions of a block that is posed by hand: geometry and records without a simulation."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import MotionSequence, MotionTask, Stance
from egs_warp.motions.turn import Turn
from tests.support.stances import DT, moved


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.5, np.pi])
def test_a_stance_follows_the_feet(place: Stance, angle: float) -> None:
    """After a rotation and a translation, also to another level, the stance has the same shape, and forward rotates
    with it."""
    shift = np.array([0.4, -1.2, 0.25])
    now = place.moved_to(moved(place, angle, shift))
    assert np.abs(now.standing - moved(place, angle, shift)).max() < 1e-12
    assert np.allclose(now.ground.axes[0], [np.cos(angle), np.sin(angle), 0.0])
    assert np.allclose(now.ground.local(now.standing), place.ground.local(place.standing))
    leaning = moved(place, angle, shift)
    leaning[:, 0] += 0.3 * (leaning[:, 2] - leaning[:, 2].min())
    feet = place.moved_to(leaning).standing
    assert np.ptp(feet[:, 2]) == pytest.approx(np.ptp(place.standing[:, 2]))


def test_facing_rotates_the_frame_and_not_the_body(place: Stance) -> None:
    other = place.with_forward(np.array([0.0, 2.0, 5.0]))
    assert np.allclose(other.ground.axes, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    assert other.standing is place.standing


class Waits:
    """Motion that is at rest after three steps."""

    def __init__(self, place: Stance) -> None:
        self.place, self.steps = place, 0

    @property
    def is_at_rest(self) -> bool:
        return self.steps >= 3

    @property
    def expected_time(self) -> float:
        return 3.0 * DT

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        self.steps += 1
        return []

    def plan_record(self) -> JumpTarget:
        return JumpTarget(0.0, 0.0)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> None:
        return None

    def planned_com(self, elapsed: float) -> None:
        return None

    def notes(self) -> list[str]:
        return []


def test_each_motion_starts_from_the_current_stance(place: Stance) -> None:
    sequence = MotionSequence(place, [MotionTask("a", {}, Waits), MotionTask("b", {}, Waits)])
    times = [0.0]
    for k in range(8):
        assert sequence.is_finished == (k >= 6)
        positions = moved(place, 0.1 * k, np.array([0.1 * k, 0.0, 0.0]))
        sequence.objectives(BodyState(positions, 0 * positions, times[-1]), None, DT)
        times.append(times[-1] + DT)
    first, second = (done.motion for done in sequence.done)
    assert isinstance(first, Waits) and isinstance(second, Waits)
    assert first.place is place
    assert np.allclose(second.place.ground.axes[0], [np.cos(0.3), np.sin(0.3), 0.0])
    assert sequence.spans(np.array(times)) == [(0, 3), (3, 8)]
    standing = place.body.centre_of_mass(moved(place, 0.3, np.array([0.3, 0.0, 0.0])))
    com = sequence.done[1].standing_com
    assert com is not None and np.allclose(com, standing)


def test_a_motion_cut_off_by_the_last_frame_is_reported(place: Stance) -> None:
    sequence = MotionSequence(
        place, [MotionTask("a", {}, Waits), MotionTask("b", {}, Waits), MotionTask("c", {}, Waits)]
    )
    positions = moved(place, 0.0, np.zeros(3))
    told = []
    for k in range(9):
        sequence.objectives(BodyState(positions, 0 * positions, k * DT), None, DT)
        told.append(sequence.unfinished_note())
    assert told[3] == [
        "b was cut off before it came to rest; give more frames",
        "1 of 3 motions did not begin: c",
    ]
    assert told[2] == ["2 of 3 motions did not begin: b, c"]
    assert told[8] == []


def test_a_motion_that_cannot_be_is_refused_before_the_first(place: Stance) -> None:
    with pytest.raises(UserError, match="walk: the path takes more than 400 steps"):
        motion("hop x2, jump, walk to 9,9 0.01").check(place)
    motion("hop x2, jump").check(place)


def test_a_script_becomes_parts(place: Stance) -> None:
    script = motion("hop 0.6 x3, twist 90, jump x2")
    parts = script.parts(place.body.height)
    assert [part.name for part in parts] == ["hop", "hop", "hop", "twist", "jump", "jump"]
    assert [part.asked.get("square") for part in parts[:3]] == [1.0, 2.0, 3.0]
    turn = parts[3].begin(place)
    assert isinstance(turn, Turn) and turn.jumps[0].target_heading == pytest.approx(np.pi / 2)
    jump = parts[4].begin(place)
    assert isinstance(jump, Jump) and jump.target.distance == pytest.approx(0.5 * place.body.height)
    assert script.frames() == 3 * motion("hop").frames() + motion("twist, jump x2").frames()
    assert script.frames(4.0) == 2 * script.frames() and script.frames(0.1) == script.frames()
