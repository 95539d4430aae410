"""A body that lies gets up: thrown up with the spin that turns it upright, it lands on its feet and stands."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.fem.body import DEFAULT_SAG, BodyState
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.fall import FallWatch
from egs_warp.motions.get_up import GetUp, GetUpPhase, lie_down
from egs_warp.motions.sequence import MotionSequence, Part
from egs_warp.motions.stand import StandFor
from tests.support.creatures import CoarseCreature, coarse_creature
from tests.support.meshes import ball_mesh, box_mesh
from tests.support.places import DT, FORWARD

LEFT = np.array([0.0, 1.0, 0.0])


@cache
def block() -> CoarseCreature:
    mesh = box_mesh((2, 2, 4), (0.5, 0.5, 1.0))
    return coarse_creature(mesh, forward=FORWARD, sag=DEFAULT_SAG, all_round=True)


def lying(degrees: float, axis: np.ndarray = LEFT) -> BodyState:
    made = block()
    return BodyState(lie_down(made.place, degrees, axis), np.zeros_like(made.start.positions))


@pytest.mark.parametrize(("degrees", "axis"), [(90.0, LEFT), (-60.0, LEFT), (170.0, FORWARD)])
def test_it_knows_how_it_lies(degrees: float, axis: np.ndarray) -> None:
    """The angle to upright, and the level axis about which that is undone."""
    angle, about = GetUp(block().place)._tilt(lying(degrees, axis).positions)
    assert np.degrees(angle) == pytest.approx(abs(degrees), abs=1e-6)
    assert about == pytest.approx(-np.sign(degrees) * axis, abs=1e-6)
    assert lying(degrees, axis).positions[:, 2].min() == pytest.approx(1e-3)


def test_the_flight_is_that_of_a_thrown_body() -> None:
    """Height over time, from how it lies up to how it stands: z0 + v t - g t^2 / 2."""
    get_up = GetUp(block().place)
    get_up._low = 0.2
    speed = 3.0
    time = get_up._flight(speed)
    assert 0.2 + speed * time - 0.5 * 9.81 * time**2 == pytest.approx(get_up._standing_height)
    assert speed - 9.81 * time < 0.0


def test_a_body_that_stands_is_up() -> None:
    made = block()
    get_up = GetUp(made.place)
    for step in range(20):
        get_up.objectives(replace(made.start, time=step * DT), None, DT)
        if get_up.resting:
            break
    assert get_up.up and get_up.resting and get_up.throws == 0 and get_up.notes() == []


def test_a_ball_lies_any_way_up() -> None:
    ball = coarse_creature(ball_mesh(), forward=FORWARD, all_round=True)
    with pytest.raises(UserError, match="get up: a ball lies any way up; walk or jump on"):
        GetUp(ball.place)


def test_it_gives_up_after_its_throws() -> None:
    """Shown a body that never moves from its side."""
    get_up, state = GetUp(block().place), lying(90.0)
    for step in range(2000):
        get_up.objectives(replace(state, time=step * DT), None, DT)
        if get_up.resting:
            break
    assert get_up.phase is GetUpPhase.GIVEN_UP and not get_up.up and get_up.throws == 3
    assert get_up.notes() == ["it does not get up: it lies after 3 throws"]


@cache
def risen() -> tuple[FallWatch, list[StepReport], BodyState, BodyState]:
    """Laid on its side while it was to stand for a second, and then to stand for another."""
    made, start = block(), lying(80.0)
    parts = [
        Part("stand", {}, lambda place: StandFor(place, 1.0)),
        Part("stand", {}, lambda place: StandFor(place, 0.2)),
    ]
    watch = FallWatch(MotionSequence(made.place, parts), made.place, gets_up=True)
    state, memory, reports = start, made.stepper.initial_memory(), []
    for _ in range(1000):
        wishes = watch.objectives(state, reports[-1] if reports else None, DT)
        state, memory, fresh = made.stepper.advance(state, memory, wishes, DT)
        reports += fresh
        if watch.finished:
            break
    return watch, reports, start, state


@pytest.mark.slow
def test_a_block_gets_up_and_goes_on() -> None:
    """The motion that fell is over, the next one is done from where it has come to stand."""
    watch, _, _, end = risen()
    assert watch.fallen is None and watch.finished
    assert [entry.name for entry in watch.sequence.done] == ["stand", "get up", "stand"]
    fell, get_up, last = watch.sequence.done
    assert fell.fell is not None and fell.fell.startswith("tilted by") and fell.got_up and last.fell is None
    assert isinstance(get_up.motion, GetUp) and get_up.motion.up and watch.spent > 0.5
    angle, _ = GetUp(block().place)._tilt(end.positions)
    assert np.degrees(angle) < 12.0


@pytest.mark.slow
def test_every_step_of_getting_up_is_audited() -> None:
    made = block()
    _, reports, start, _ = risen()
    recorder = Recorder(made.stepper.body, made.stepper.muscles, made.stepper.geometry, start, 0.0, drag=0.0)
    recorder.add(reports)
    found = audit(recorder.trajectory(), newton_unconverged=sum(not report.converged for report in reports))
    assert found.momentum_residual < 1e-5 and found.angular_momentum_residual < 1e-4 and found.penetration < 0.01
    assert found.cone_violation < 1e-4 and found.complementarity_gap < 1e-4 and found.inverted_elements == 0
    assert found.energy_residual < 1e-6 and found.contact_velocity < 1e-6
