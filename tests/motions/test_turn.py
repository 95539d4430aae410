"""Turns of a block that is posed by hand, whose number of jumps depends on friction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.contact.terrain import Solid
from egs_warp.fem.body import BodyState
from egs_warp.geometry.plane import Plane
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPhase, JumpTarget
from egs_warp.motions.sequence import Stance
from egs_warp.motions.turn import Turn, largest_turn
from tests.support.stances import DT, FORWARD, moved


def land(jump: Jump, state: BodyState) -> None:
    """Set the state of a jump to that after its landing, one step before it is at rest."""
    jump.phase = JumpPhase.LAND
    worlds = jump._worlds
    worlds.current.scatter(np.array([0]), worlds.landing)
    worlds.entered[:], worlds.is_airborne[:] = -100.0, True


def test_a_turn_that_falls_short_is_completed_at_its_start(place: Stance) -> None:
    """After a jump that is 25 degrees short and lands 0.1 m to the side, the next jump turns by the missing angle and
    returns; an error of 5 degrees is tolerated."""
    turn = Turn(place, JumpTarget(0.0, 0.2), np.radians(60.0))
    short = moved(place, np.radians(35.0), np.array([0.1, 0.0, 0.0]))
    state = BodyState(short, 0 * short, 10.0)
    land(turn.jumps[0], state)
    turn.objectives(state, None, DT)
    assert len(turn.jumps) == 2
    second = turn.jumps[1]
    assert np.degrees(second.target_heading) == pytest.approx(25.0) and second.target.distance == pytest.approx(0.1)
    assert np.allclose(second.ground.axes[0], [-1.0, 0.0, 0.0])
    assert turn.notes() == ["turned in 2 jumps"] and turn.plan_record().jumps == 2.0
    there = moved(place, np.radians(55.0), np.zeros(3))
    land(second, BodyState(there, 0 * there, 20.0))
    turn.objectives(BodyState(there, 0 * there, 20.0), None, DT)
    assert len(turn.jumps) == 2 and turn.is_at_rest


def test_a_turn_at_an_edge_is_completed_in_place(place: Stance) -> None:
    """The whole base is supported at the start of the turn. After the first jump, the ground at the start no longer
    supports the base, as may happen to a rotated base, so the second jump does not return there."""
    turn = Turn(place, JumpTarget(0.0, 0.2), np.radians(60.0))
    up = np.array([0.0, 0.0, 1.0])
    turn._stance = replace(place, solids=(Solid((Plane(up, 0.0), Plane(-FORWARD, 0.08))),))
    short = moved(place, np.radians(35.0), np.array([0.3, 0.0, 0.0]))
    state = BodyState(short, 0 * short, 10.0)
    land(turn.jumps[0], state)
    turn.objectives(state, None, DT)
    assert len(turn.jumps) == 2 and turn.jumps[1].target == JumpTarget(0.0, 0.2)
    assert np.degrees(turn.jumps[1].target_heading) == pytest.approx(25.0)


def test_a_slippery_floor_takes_more_jumps(place: Stance) -> None:
    """The largest turn per jump is proportional to friction; a larger turn is divided evenly among jumps."""
    target = JumpTarget(0.0, 0.2)
    rough, smooth = (Turn(replace(place, friction=mu), target, np.pi) for mu in (0.8, 0.2))
    assert smooth.max_turn_per_jump == pytest.approx(rough.max_turn_per_jump / 4.0)
    count = np.ceil(np.pi / smooth.max_turn_per_jump)
    assert count >= 2.0 and smooth.jumps[0].target_heading == pytest.approx(np.pi / count)
    landed = moved(place, smooth.jumps[0].target_heading, np.zeros(3))
    state = BodyState(landed, 0 * landed, 10.0)
    land(smooth.jumps[0], state)
    smooth.objectives(state, None, DT)
    assert smooth.jumps[1].target_heading == pytest.approx(np.pi / count)
    most = np.degrees(smooth.max_turn_per_jump)
    assert smooth.notes()[0] == f"one jump turns the body by at most {most:.0f} degrees, or the feet would slip"


@pytest.mark.parametrize("points", ["disc", "rim"])
def test_the_largest_turn_is_that_of_a_disc_on_rough_ground(place: Stance, points: str) -> None:
    """The maximum turn equals the closed form of a disc to 5 % (docs/concepts/motions.md).

    Friction under a disc of radius R with the normal force N has the torque 2/3 mu N R; its impulse during the thrust
    rotates the body in flight. The pyramid with four facets that replaces Coulomb's cone reduces the friction in each
    direction by 1 / (|cos| + |sin|). The flight is assumed to last for nine tenths of the planned time.
    """
    radius, mu = 0.15, 0.5
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    shares = np.sqrt((np.arange(40) + 0.5) / 40) if points == "disc" else np.ones(1)
    feet = replace(place, friction=mu, contact_points=np.concatenate([radius * share * circle for share in shares]))
    jump = Jump(feet, JumpTarget(0.0, 0.2), turn=1.0)
    plan, body = jump.plan, place.body
    thrust = (np.arange(1000) + 0.5) / 1000 * plan.thrust_time
    load = body.mass * (9.81 + plan.speed_up / plan.thrust_time) * np.ones_like(thrust)
    direction = np.linspace(0.0, 2.0 * np.pi, 100_000)
    pyramid = np.mean(1.0 / (np.abs(np.cos(direction)) + np.abs(np.sin(direction))))
    momentum = np.mean(pyramid * mu * load * 2.0 / 3.0 * radius) * plan.thrust_time
    flat = place.standing[:, :2] - body.centre_of_mass(place.standing)[:2]
    inertia = float(body.node_mass @ (flat**2).sum(axis=1))
    assert largest_turn(jump, feet) == pytest.approx(0.9 * plan.flight_time * momentum / inertia, rel=0.05)
