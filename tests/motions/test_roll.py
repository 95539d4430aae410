"""Rolling: a ball reaches its target without slipping, and is recognised as a ball in any orientation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from egs_warp.contact.terrain import step
from egs_warp.errors import UserError
from egs_warp.fem.body import DEFAULT_SAG, BodyState
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory, measure
from egs_warp.motions.fall_monitor import FallMonitor
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.gait_selection import move_along, turn_in_place
from egs_warp.motions.roll import Roll
from egs_warp.motions.route import path_route, straight_route
from egs_warp.motions.sequence import MotionSequence, MotionTask, Stance
from egs_warp.motions.turn import Turn
from tests.support.creatures import CoarseCreature, coarse_creature
from tests.support.meshes import UP, ball_mesh
from tests.support.stances import DT, FORWARD

WAY = np.array([[0.3, 0.2]])


@cache
def ball() -> CoarseCreature:
    return coarse_creature(ball_mesh(), forward=FORWARD, sag=DEFAULT_SAG, all_round=True)


@dataclass(frozen=True)
class Rolled:
    """Result of a roll."""

    roll: Roll
    trajectory: Trajectory
    reports: list[StepReport]
    end: BodyState
    fallen: str | None


@cache
def rolled() -> Rolled:
    """Simulate a roll along the path ``WAY``, which leads ahead and to the left."""
    made = ball()
    sequence = MotionSequence(
        made.place, [MotionTask("walk to", {}, lambda place: move_along(place, path_route(WAY), 0.1))]
    )
    watch = FallMonitor(sequence, made.place)
    state, memory, reports = made.start, made.stepper.initial_memory(), []
    for _ in range(260):
        wishes = watch.objectives(state, reports[-1] if reports else None, DT)
        state, memory, fresh = made.stepper.advance(state, memory, wishes, DT)
        reports += fresh
        if watch.is_finished:
            break
    recorder = Recorder(made.stepper.body, made.stepper.muscles, made.stepper.geometry, made.start, 0.0, drag=0.0)
    recorder.add(reports)
    roll = sequence.done[0].motion
    assert isinstance(roll, Roll) and roll.is_at_rest
    return Rolled(roll, recorder.trajectory(), reports, state, watch.fallen)


def test_a_ball_is_recognised() -> None:
    place = ball().place
    assert place.base() is SupportKind.ROUND_BASE
    assert isinstance(move_along(place, straight_route(1.0), 0.1), Roll) and isinstance(
        turn_in_place(place, 1.0, 0.1), Turn
    )


def test_a_ball_that_has_rolled_over_is_still_a_ball() -> None:
    """The kind of support follows from the current shape, not from the side on which the ball stood before."""
    made = ball()
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    com = made.place.body.centre_of_mass(made.place.standing)
    report = _report(made)
    over = made.place.next_stance(com + (made.place.standing - com) @ turn.T, report)
    assert over.base() is SupportKind.ROUND_BASE and over.ground.axes == pytest.approx(made.place.ground.axes)


def test_a_ball_that_has_turned_about_up_faces_elsewhere() -> None:
    made = ball()
    com = made.place.body.centre_of_mass(made.place.standing)
    turned = com + (made.place.standing - com) @ made.place.ground.rotation_about_up(0.6).T
    ahead = made.place.next_stance(turned, _report(made)).ground.axes[0]
    assert ahead == pytest.approx([np.cos(0.6), np.sin(0.6), 0.0], abs=1e-6)


def _report(made: CoarseCreature) -> StepReport:
    _, _, reports = made.stepper.advance(made.start, made.stepper.initial_memory(), [], DT)
    return reports[-1]


def test_a_step_across_the_path_is_refused() -> None:
    place = ball().place
    wall = (step(Plane(UP, 0.0), 0.5 * FORWARD, FORWARD, 0.2),)
    blocked = Stance(place.body, place.ground, place.standing, place.contact_points, DT, wall)
    with pytest.raises(UserError, match="the path leads over a step"):
        move_along(blocked, straight_route(1.0), 0.1)


@pytest.mark.slow
def test_a_ball_rolls_to_its_target_without_slipping() -> None:
    """The ball ends within 0.03 of the target, has rotated by the distance divided by its radius, and does not count as
    fallen."""
    done = rolled()
    local = done.roll.ground.local(done.end.positions)
    com = done.roll.body.centre_of_mass(local)
    assert com[:2] == pytest.approx(WAY[0], abs=0.03) and done.fallen is None
    way = float(np.linalg.norm(WAY))
    assert np.radians(done.roll.outcome_record(done.trajectory, 0, -1).rolled_degrees) == pytest.approx(
        way / float(com[2]), rel=0.1
    )
    assert measure(done.trajectory).airborne_frames == 0.0


@pytest.mark.slow
def test_every_step_of_a_roll_is_audited() -> None:
    done = rolled()
    found = audit(done.trajectory, newton_unconverged=sum(not report.converged for report in done.reports))
    assert found.momentum_residual < 1e-5 and found.angular_momentum_residual < 1e-4 and found.penetration < 0.01
    assert found.cone_violation < 1e-4 and found.complementarity_gap < 1e-4 and found.inverted_elements == 0
    assert found.energy_residual < 1e-6 and found.contact_velocity < 1e-6
