"""Getting up: a lying body pushes itself up, rolls over the edge of its base and stands."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.fem.body import DEFAULT_SAG, BodyState
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.objectives import AngularMomentumObjective, Objective
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.fall_monitor import FallMonitor
from egs_warp.motions.get_up import MAX_TRIES, GetUp, GetUpPhase, lie_down
from egs_warp.motions.sequence import MotionSequence, MotionTask
from egs_warp.motions.stand import Stand, StandFor
from tests.support.creatures import CoarseCreature, coarse_creature
from tests.support.meshes import ball_mesh, box_mesh
from tests.support.stances import DT, FORWARD

LEFT = np.array([0.0, 1.0, 0.0])


@cache
def block() -> CoarseCreature:
    mesh = box_mesh((2, 2, 4), (0.5, 0.5, 1.0))
    return coarse_creature(mesh, forward=FORWARD, sag=DEFAULT_SAG, all_round=True)


def lying(degrees: float, axis: np.ndarray = LEFT) -> BodyState:
    made = block()
    return BodyState(lie_down(made.place, degrees, axis), np.zeros_like(made.start.positions))


@pytest.mark.parametrize(("degrees", "axis"), [(90.0, LEFT), (-60.0, LEFT), (170.0, FORWARD)])
def test_tilt_of_a_lying_body(degrees: float, axis: np.ndarray) -> None:
    """The tilt consists of the angle from upright and the horizontal axis of the rotation that makes the body
    upright again."""
    angle, about, _ = GetUp(block().place)._tilt(lying(degrees, axis).positions)
    assert np.degrees(angle) == pytest.approx(abs(degrees), abs=1e-6)
    assert about == pytest.approx(-np.sign(degrees) * axis, abs=1e-6)
    assert lying(degrees, axis).positions[:, 2].min() == pytest.approx(1e-3)


def test_the_body_rotates_about_the_edge_of_its_base() -> None:
    """The target velocity of the centre of mass and the target spin form one rotation about the lower edge of the base.
    Later, the spin equals the spin of a body that falls back about this edge."""
    get_up, state = GetUp(block().place), lying(90.0)
    get_up.phase, get_up._entered, get_up._start_degrees = GetUpPhase.ROLL, 0.0, 90.0
    com, spin, _ = get_up.objectives(replace(state, time=0.05), None, DT)
    assert isinstance(com, Objective) and isinstance(spin, AngularMomentumObjective)
    body = get_up.body
    rate = np.linalg.solve(body.inertia(state.positions), spin.target)
    assert rate[1] < 0.0 and abs(rate[0]) + abs(rate[2]) < 1e-3 * abs(rate[1])
    edge = state.positions[np.argmin(state.positions @ [1.0, 0.0, 1.0])]
    arm = (body.centre_of_mass(state.positions) - edge) * [1.0, 0.0, 1.0]
    assert com.target == pytest.approx(np.cross(rate, arm), rel=0.02, abs=1e-6)
    _, spin, _ = get_up.objectives(replace(state, time=0.2), None, DT)
    assert isinstance(spin, AngularMomentumObjective)
    about = body.inertia(state.positions)[1, 1] + body.mass * arm @ arm
    falls = DT * body.weight * arm[0] / about
    assert np.linalg.solve(body.inertia(state.positions), spin.target)[1] == pytest.approx(falls, rel=0.01)


@pytest.mark.parametrize(("rate", "crouches"), [(1.0, True), (6.0, False)])
def test_a_roll_without_enough_energy_crouches(rate: float, crouches: bool) -> None:
    """In the free roll, a body that would not pass the top moves its centre of mass towards the edge and shortens; one
    with enough energy rolls rigidly. The angular momentum about the edge changes only by the torque of the weight."""
    get_up, lain = GetUp(block().place), lying(50.0)
    get_up.phase, get_up._entered, body = GetUpPhase.ROLL, 0.0, get_up.body
    edge = lain.positions[np.argmin(lain.positions @ [1.0, 0.0, 1.0])]
    rolling = replace(lain, velocities=np.cross([0.0, -rate, 0.0], lain.positions - edge))
    for step in range(8, 16):
        com, spin, nodes = get_up.objectives(replace(rolling, time=step * DT), None, DT)
    assert isinstance(com, Objective) and isinstance(nodes, Objective) and isinstance(spin, AngularMomentumObjective)
    arm = (body.centre_of_mass(lain.positions) - edge) * [1.0, 0.0, 1.0]
    about = body.inertia(lain.positions)[1, 1] + body.mass * arm @ arm
    momentum = -(spin.target + body.mass * np.cross(arm, com.target))[1]
    assert momentum == pytest.approx(about * rate - DT * body.weight * arm[0], rel=0.01)
    towards = -float(com.target @ arm) / np.linalg.norm(arm)
    head = lain.positions[:, 2].argmax()
    target = (nodes.target / body.mass_roots).reshape(-1, 3)[head] - com.target
    outward = lain.positions[head] - body.centre_of_mass(lain.positions)
    assert (towards > 0.1) == crouches and (target @ outward < -0.05) == crouches


def test_a_try_learns_from_the_last_one() -> None:
    """The planned excess of energy is corrected by the measured one: upwards after the body has fallen back, downwards
    after it has fallen over the other side."""
    get_up = GetUp(block().place)
    roll = get_up._measure(lying(90.0), None)
    get_up._begin_try(roll)
    aim = get_up._margin
    get_up._excess = -0.07
    get_up._begin_try(roll)
    assert get_up._margin == pytest.approx(2.0 * aim + 0.07)
    get_up._excess = 3.0 * aim
    get_up._begin_try(replace(roll, axis=-roll.axis))
    assert get_up._margin == pytest.approx(0.07) and get_up.tries == MAX_TRIES


def test_a_body_that_was_caught_stands_low() -> None:
    """The target velocity of the centre of mass is downward in a crouched stand, but not in a straight one; a stand
    does not rest as long as the body moves."""
    made = block()
    for crouch, down in ((1.0, False), (0.75, True)):
        stand = Stand(made.place, at_rest=False, crouch=crouch)
        com = stand.objectives(made.start, None, DT)[0]
        assert isinstance(com, Objective) and (com.target[2] < -0.01) == down and not stand.is_at_rest
    assert Stand(made.place).is_at_rest


def test_a_body_that_stands_is_up() -> None:
    made = block()
    get_up = GetUp(made.place)
    for step in range(20):
        get_up.objectives(replace(made.start, time=step * DT), None, DT)
        if get_up.is_at_rest:
            break
    assert get_up.is_up and get_up.is_at_rest and get_up.tries == 0 and get_up.notes() == []


def test_a_ball_cannot_fall_over() -> None:
    ball = coarse_creature(ball_mesh(), forward=FORWARD, all_round=True)
    with pytest.raises(UserError, match="get up: a ball cannot fall over; walk or jump instead"):
        GetUp(ball.place)


def test_the_height_does_not_depend_on_the_frame_of_the_fallen_body() -> None:
    """The origin of the stance of a fallen body is at the height of its base, above the ground."""
    state = lying(90.0)
    fallen = block().place.moved_to(state.positions)
    assert fallen.ground.origin[2] > 0.1
    missing = [GetUp(place)._measure(state, None).missing for place in (block().place, fallen)]
    assert missing[0] == pytest.approx(missing[1]) and missing[0] == pytest.approx(0.31, abs=0.03)


def test_a_crouched_body_has_less_height_to_gain() -> None:
    """The top of the path of a crouched body is the half diagonal of its own sides: of a block of 1.0 x 0.5 that is
    shortened by a quarter and widened by an eighth."""
    get_up, lain = GetUp(block().place), lying(50.0).positions
    get_up.phase, get_up._crouch_depth = GetUpPhase.ROLL, 0.25
    crouched = get_up._crouched_arms(lain - get_up.body.centre_of_mass(lain))
    crouched[:, 2] -= crouched[:, 2].min()
    tilt, half, across = np.radians(50.0), 0.5 * 0.75, 0.25 * 1.125
    rise = np.hypot(half, across) - (half * np.cos(tilt) + across * np.sin(tilt))
    state = BodyState(crouched, np.zeros_like(crouched))
    assert get_up._measure(state, None).missing == pytest.approx(rise, abs=0.005)


def given_up(get_up: GetUp, state: BodyState) -> str:
    """Return the note of ``get_up`` for a body that never moves."""
    for step in range(3000):
        get_up.objectives(replace(state, time=step * DT), None, DT)
        if get_up.is_at_rest:
            break
    assert get_up.phase is GetUpPhase.GIVEN_UP and not get_up.is_up
    (note,) = get_up.notes()
    return note


def test_a_push_without_effect_is_not_repeated() -> None:
    get_up = GetUp(block().place)
    assert given_up(get_up, lying(90.0)).startswith(
        "cannot get up: its push lifted the centre of mass by 0.00 of the 0.29 body heights"
    )
    assert get_up.tries == 1


def test_a_weak_body_does_not_try() -> None:
    """The strength of the muscles is tested before the first push."""
    muscles = block().stepper.muscles
    weak = replace(muscles, stiffness=0.01 * muscles.stiffness)
    get_up = GetUp(replace(block().place, muscles=weak))
    assert given_up(get_up, lying(90.0)).startswith(
        "cannot get up: a push of its muscles lifts the centre of mass by at"
    )
    assert get_up.tries == 0
    strong = GetUp(replace(block().place, muscles=muscles))
    strong.objectives(lying(90.0), None, DT)
    assert not strong._is_too_weak(lying(90.0), strong._measure(lying(90.0), None))


def test_it_gives_up_after_the_last_try() -> None:
    get_up = GetUp(block().place)
    get_up.tries = MAX_TRIES
    assert given_up(get_up, lying(90.0)) == "cannot get up: it still lies after 3 tries"


@cache
def risen(degrees: float, sideways: bool) -> tuple[FallMonitor, list[StepReport], BodyState, BodyState]:
    """Simulate a body that starts on its side, with two stands, the first of which lasts a second. Return the monitor,
    all reports, and the first and the last state. The stands take no capture steps, with which this body may recover
    without getting up."""
    made, start = block(), lying(degrees, FORWARD if sideways else LEFT)
    parts = [
        MotionTask("stand", {}, lambda place: StandFor(place, 1.0)),
        MotionTask("stand", {}, lambda place: StandFor(place, 0.2)),
    ]
    watch = FallMonitor(MotionSequence(made.place, parts), made.place, gets_up=True)
    state, memory, reports = start, made.stepper.initial_memory(), []
    with patch("egs_warp.motions.stand.MAX_CAPTURE_STEPS", 0):
        # This number of steps is sufficient for all attempts.
        for _ in range(1800):
            wishes = watch.objectives(state, reports[-1] if reports else None, DT)
            state, memory, fresh = made.stepper.advance(state, memory, wishes, DT)
            reports += fresh
            if watch.is_finished:
                break
    return watch, reports, start, state


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "sideways"), [(90.0, False), (80.0, False), (90.0, True)])
def test_a_block_gets_up_and_continues(degrees: float, sideways: bool) -> None:
    """The motion in which the body fell is finished; the next one starts from the new stance."""
    watch, _, _, end = risen(degrees, sideways)
    assert watch.fallen is None and watch.is_finished
    assert [entry.name for entry in watch.sequence.done] == ["stand", "get up", "stand"]
    fell, get_up, last = watch.sequence.done
    assert (
        fell.fall_note is not None and fell.fall_note.startswith("tilted by") and fell.got_up and last.fall_note is None
    )
    assert isinstance(get_up.motion, GetUp) and get_up.motion.is_up and watch.get_up_time > 0.5
    angle, _, _ = GetUp(block().place)._tilt(end.positions)
    assert np.degrees(angle) < 12.0


@pytest.mark.slow
def test_getting_up_takes_little_work() -> None:
    """An attempt takes less than 20 m g H of muscle work (measured: at most 18)."""
    watch, _, _, _ = risen(90.0, False)
    _, entry, last = watch.sequence.done
    assert isinstance(entry.motion, GetUp)
    found = _recorded().trajectory()
    books, starts = energy_balance(found), found.time[:-1] + 1e-9
    rising = (starts >= entry.start_time) & (starts < last.start_time)
    assert 0.0 < books.muscle_work[rising].sum() < 20.0 * books.energy_unit * entry.motion.tries


def _recorded() -> Recorder:
    made = block()
    _, reports, start, _ = risen(90.0, False)
    recorder = Recorder(made.stepper.body, made.stepper.muscles, made.stepper.geometry, start, 0.0, drag=0.0)
    recorder.add(reports)
    return recorder


@pytest.mark.slow
def test_every_step_of_getting_up_is_audited() -> None:
    _, reports, _, _ = risen(90.0, False)
    found = audit(_recorded().trajectory(), newton_unconverged=sum(not report.converged for report in reports))
    assert found.momentum_residual < 1e-5 and found.angular_momentum_residual < 1e-4 and found.penetration < 0.01
    assert found.cone_violation < 1e-4 and found.complementarity_gap < 1e-4 and found.inverted_elements == 0
    assert found.energy_residual < 1e-6 and found.contact_velocity < 1e-6
