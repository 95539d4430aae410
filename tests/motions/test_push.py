"""Pushes: impulses and gusts in the balances of momenta and energy, and a standing body that keeps its balance or
falls."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.rollout import RolloutResult
from egs_warp.locomotion.trajectory import Trajectory, measure
from egs_warp.motions.fall_monitor import FallMonitor
from egs_warp.motions.push import DIRECTIONS, Push, PushKicks, kick_of, read_pushes
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import MotionSequence
from egs_warp.motions.stand import StandFor
from egs_warp.pipelines.report import AUDIT_LIMITS
from egs_warp.pipelines.simulated_run import simulate
from tests.support.creatures import CoarseCreature, coarse_creature
from tests.support.live_sessions import coarse_pawn
from tests.support.meshes import box_mesh
from tests.support.runs import roll_out
from tests.support.stances import DT, FORWARD, block_place

LEFT = np.array(DIRECTIONS["left"])
HARD_PUSH = "0.05 0.5 ahead"
"""Push that moves the capture point of the block outside its base."""


def block() -> CoarseCreature:
    return coarse_creature(box_mesh((2, 2, 4), (0.5, 0.5, 1.0)), forward=FORWARD)


@pytest.fixture(scope="module")
def standing_block() -> CoarseCreature:
    return block()


def simulate_pushes(
    standing_block: CoarseCreature, pushes: str, frames: int = 40, **given: Path
) -> tuple[RolloutResult, str | None]:
    """Simulate a standing block; return the result, and the description of its fall or None."""
    place = standing_block.place
    watch = FallMonitor(MotionSequence(place, motion("stand 0.5").parts(place.body.height)), place)
    simulation = roll_out(
        *(standing_block.stepper, standing_block.start, watch),
        frames=frames,
        kicks=PushKicks(place, read_pushes(pushes)),
        finished=lambda: watch.is_finished,
        parts=(lambda: given["parts"]) if "parts" in given else None,
        resume=given.get("resume"),
    )
    return simulation, watch.fallen


@pytest.fixture(scope="module")
def pushed(standing_block: CoarseCreature) -> Trajectory:
    simulation, fallen = simulate_pushes(standing_block, "0.1 0.06 left 0.8, 0.2-0.3 0.05 back")
    assert fallen is None and all(report.converged for report in simulation.reports)
    return simulation.trajectory


@pytest.mark.parametrize("dt", [1 / 60, 0.013, 0.2])
@pytest.mark.parametrize("push", [Push(0.25, LEFT), Push(0.25, LEFT, duration=0.31), Push(0.0, LEFT, duration=0.001)])
def test_steps_share_out_all_of_a_push(push: Push, dt: float) -> None:
    shares = [push.share(step * dt, dt) for step in range(int(np.ceil(1.0 / dt)))]
    assert sum(shares) == pytest.approx(1.0) and min(shares) >= 0.0
    if push.duration == 0.0:
        assert sorted(shares)[-2:] == [0.0, 1.0]


def test_a_push_has_its_momentum_and_its_lever_arm(standing_block: CoarseCreature) -> None:
    """A push of 1 gives a body of mass M the momentum M sqrt(g H). A push near the top or the bottom rotates the body;
    a push of all nodes does not."""
    place, body = standing_block.place, standing_block.place.body
    for height in (None, 0.9, 0.1):
        kick = PushKicks(place, [Push(0.0, 0.3 * LEFT, height)])(0.0, DT)
        assert kick is not None
        momentum = body.node_mass @ kick
        np.testing.assert_allclose(momentum, 0.3 * body.mass * body.speed_unit * place.ground.axes[1], atol=1e-12)
        turning = place.ground.axes @ body.angular_momentum(place.standing, kick)
        sign = {None: 0.0, 0.9: -1.0, 0.1: 1.0}[height]
        unit = body.mass * body.speed_unit * body.height
        assert abs(turning[0]) < 1e-12 * unit if height is None else sign * turning[0] > 0.05 * unit
    assert PushKicks(place, [Push(0.5, LEFT)])(0.0, DT) is None


def test_a_push_acts_near_its_height(standing_block: CoarseCreature) -> None:
    """Nodes within a quarter of a body height are pushed; if a coarse cage has none there, the nearest ones are."""
    heights = standing_block.place.ground.local(standing_block.place.standing)[:, 2] / standing_block.place.body.height
    for height in (0.0, 0.5, 1.0):
        sizes = np.linalg.norm(kick_of(standing_block.place, 0.1 * LEFT, height), axis=1)
        assert (np.abs(heights[sizes > 0.0] - height) < 0.25).all()
        assert sizes.argmax() in np.flatnonzero(np.abs(heights - height) < np.abs(heights - height).min() + 0.01)
    thin = block_place(box_mesh((4, 4, 1), (2.0, 2.0, 0.5)))
    sizes = np.linalg.norm(kick_of(thin, 0.1 * LEFT, 0.4), axis=1)
    assert thin.body.node_mass @ sizes == pytest.approx(0.1 * thin.body.mass * thin.body.speed_unit)
    below, above = thin.standing[:, 2] < 0.25, thin.standing[:, 2] > 0.25
    assert sizes[below].min() > sizes[above].max() >= 0.0


def test_the_balances_include_the_pushes(pushed: Trajectory) -> None:
    """The balances of momenta and energy hold in every step, but not if one push is omitted or made 1 % stronger."""
    assert len(pushed.kick_step) == 1 + 6
    held = audit(pushed)
    assert held.energy_residual < 1e-8
    assert held.momentum_residual < 1e-6 and held.angular_momentum_residual < 1e-6
    left_out = replace(pushed, kick_step=pushed.kick_step[1:], kick_velocity=pushed.kick_velocity[1:])
    for wrong in (left_out, replace(pushed, kick_velocity=1.01 * pushed.kick_velocity)):
        found = audit(wrong)
        assert found.energy_residual > 1e-6
        assert found.momentum_residual > 1e-4 and found.angular_momentum_residual > 1e-5


def test_a_pushed_body_moves_with_the_push_and_keeps_its_feet(
    standing_block: CoarseCreature, pushed: Trajectory
) -> None:
    """A tenth of a second after the first push, the centre of mass has moved to the left. At the end the body has
    hardly moved its soles and is almost at rest."""
    place = standing_block.place
    com = np.array([place.body.centre_of_mass(place.ground.local(x)) for x in pushed.positions])
    after = int(np.searchsorted(pushed.time, 0.2))
    assert com[after, 1] > 0.005 > com[0, 1] + 0.001
    reached = StandFor(place, 0.5).outcome_record(pushed, 0, len(pushed.dt))
    lean = np.linalg.norm((com - com[0])[:, :2], axis=1).max() / place.body.height
    assert reached.lean == pytest.approx(lean) and reached.sole_shift < 0.3 * lean
    assert np.linalg.norm(pushed.node_mass @ pushed.velocities[-1]) < 0.05 * place.body.mass * place.body.speed_unit


def test_a_hard_push_topples_a_body_that_keeps_its_feet(
    standing_block: CoarseCreature, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The energy of the push is larger than the energy that lifts the centre of mass over the edge of the base, so no
    controller can keep the balance without a step."""
    monkeypatch.setattr("egs_warp.motions.stand.MAX_CAPTURE_STEPS", 0)
    simulation, fallen = simulate_pushes(standing_block, HARD_PUSH, frames=90)
    assert fallen is not None and fallen.startswith("tilted by")
    assert audit(simulation.trajectory).energy_residual < 1e-6
    t = simulation.trajectory
    reached = StandFor(standing_block.place, 0.5).outcome_record(t, 0, len(t.dt))
    sole = standing_block.place.ground.local(standing_block.place.standing)[:, 2] < 0.01
    middle = np.array([standing_block.place.ground.local(x)[sole, :2].mean(axis=0) for x in t.positions])
    shift = np.linalg.norm(middle - middle[0], axis=1).max() / standing_block.place.body.height
    assert reached.sole_shift == pytest.approx(shift) and reached.lean > 0.2


def test_a_hop_catches_a_body_that_falls_over_its_edge(standing_block: CoarseCreature) -> None:
    """The capture hop moves the feet of the block by more than a quarter of its height."""
    simulation, fallen = simulate_pushes(standing_block, HARD_PUSH, frames=130)
    t = simulation.trajectory
    assert fallen is None and measure(t).tilt_degrees < 2.0
    assert StandFor(standing_block.place, 0.5).outcome_record(t, 0, len(t.dt)).sole_shift > 0.25
    assert np.linalg.norm(t.node_mass @ t.velocities[-1]) < 0.05 * t.node_mass.sum() * np.sqrt(9.81 * t.height)
    assert audit(t).energy_residual < 1e-6


def test_a_pushed_run_continues_to_the_same_bits(pushed: Trajectory, tmp_path: Path) -> None:
    """The run is interrupted during the gust."""
    parts = tmp_path / "parts"
    simulate_pushes(block(), "0.1 0.06 left 0.8, 0.2-0.3 0.05 back", frames=15, parts=parts)
    whole, _ = simulate_pushes(block(), "0.1 0.06 left 0.8, 0.2-0.3 0.05 back")
    again, _ = simulate_pushes(block(), "0.1 0.06 left 0.8, 0.2-0.3 0.05 back", resume=parts)
    for name in ("positions", "velocities", "kick_step", "kick_velocity"):
        np.testing.assert_array_equal(getattr(again.trajectory, name), getattr(whole.trajectory, name))


def test_pushes_after_the_end_of_the_run_are_reported() -> None:
    pushes = read_pushes("0.5 0.1 left, 1-3 0.1 back, 2 0.1 left")
    assert [push.unapplied_note(2.0) for push in pushes] == [
        None,
        "the gust until 3 s did not act in full: the run ended earlier",
        "the push at 2 s did not act: the run ended earlier",
    ]
    assert [push.unapplied_note(3.0) for push in pushes] == [None] * 3


@pytest.mark.slow
@pytest.mark.parametrize("script", ["stand 0.2", pytest.param("turn 10", marks=pytest.mark.slow)])
def test_a_creature_is_pushed_while_it_stands_or_turns(script: str) -> None:
    """The direction is relative to the body at the start of the run; a push after the end of the run is reported."""
    creature = coarse_pawn()
    done = simulate(creature, motion(script), pushes=read_pushes("0.1 0.05 left, 0.2-0.3 0.05 back 0.8, 60 0.1 up"))
    t = done.trajectory
    assert done.fallen is None and done.unfinished_note() == ["the push at 60 s did not act: the run ended earlier"]
    momentum = np.einsum("n,kni->ki", t.node_mass, t.kick_velocity) @ done.place.ground.axes.T
    unit = 0.05 * creature.body.mass * creature.body.speed_unit
    np.testing.assert_allclose(momentum[0] / unit, [0.0, 1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(momentum[1:].sum(axis=0) / unit, [-1.0, 0.0, 0.0], atol=1e-9)
    held = vars(audit(t, newton_unconverged=sum(not report.converged for report in done.simulation.reports)))
    assert {name for name, limit in AUDIT_LIMITS.items() if not held[name] <= limit} == set()


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ({"time": -1.0}, "time -1: give a number from 0 to 600"),
        ({"impulse": np.array([0.0, np.nan, 0.0])}, "Push: impulse is array([ 0., nan,  0.]); give finite numbers"),
        ({"impulse": np.array([0.0, 8.0, 8.0])}, "impulse 11.3137: give a number from 0 to 10"),
        ({"height": 1.5}, "height 1.5: give a number from 0 to 1"),
        ({"duration": np.inf}, "duration inf: give a number from 0 to 600"),
    ],
)
def test_numbers_that_no_push_has_are_refused(numbers: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError) as error:
        Push(**{"time": 0.0, "impulse": LEFT, **numbers})
    assert str(error.value) == said


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("", "push 1 (''): give a time, an impulse and a direction"),
        ("0.5 0.1", "push 1 ('0.5 0.1'): give a time, an impulse and a direction"),
        ("0.5 0.1 left, soon 0.1 left", "push 2 ('soon 0.1 left'): time 'soon': give seconds"),
        ("0.5 0.1 sideways", "unknown direction 'sideways'; give one of ahead, back, left, right, up, down"),
        ("0.5 nan left", "impulse nan: give m sqrt(g H) from 0 to 10"),
        ("0.5 1e9 left", "impulse 1e9: give m sqrt(g H) from 0 to 10"),
        ("2-1 0.1 left", "time 1: give seconds from 2 to 600"),
        ("0.5 0.1 left 1.5", "height 1.5: give body heights from 0 to 1"),
    ],
)
def test_a_bad_push_is_a_one_line_error(line: str, said: str) -> None:
    with pytest.raises(UserError) as error:
        read_pushes(line)
    assert said in str(error.value) and "\n" not in str(error.value)
