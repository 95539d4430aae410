"""Somersaults of a block that is posed by hand: plan, refusals, target momentum on the ground and target shape in the
air."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.contact.terrain import Solid, step
from egs_warp.fem.body import BodyState
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.objectives import AngularMomentumObjective, Objective
from egs_warp.motions.balance import Weights
from egs_warp.motions.flip import Flip, FlipPlan
from egs_warp.motions.flip_worlds import LANDING_ANGLE, TUCK_INERTIA, angle_about_left
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPhase, JumpTarget
from egs_warp.motions.sequence import Stance, TargetError
from tests.support.meshes import box_mesh
from tests.support.stances import DT, FLOOR, FORWARD, block_place

HEIGHT = 1.0


def turned(place: Stance, angle: float, up: float = 0.0) -> np.ndarray:
    """Return the nodes (N, 3) of the standing body, turned forward by ``angle`` rad and moved ``up`` m up."""
    com = place.body.centre_of_mass(place.standing)
    turn = Rotation.from_rotvec(angle * place.ground.axes[1]).as_matrix()
    return com + (place.standing - com) @ turn.T + [0.0, 0.0, up]


def test_the_planned_momentum_turns_the_body_once() -> None:
    """Half of the spin at take-off acts during the thrust; in the air, the inertia is smaller. The ground force and its
    mean lever arm produce the momentum: L = d m (v + g t)."""
    place = block_place()
    flip = Flip(place, HEIGHT)
    plan, body, left = flip.plan_record(), place.body, place.ground.axes[1]
    assert isinstance(plan, FlipPlan)
    inertia = left @ body.inertia(place.standing) @ left
    spin = plan.angular_momentum / inertia
    rotation = spin * (0.5 * plan.thrust_time + plan.flight_time / TUCK_INERTIA)
    assert rotation == pytest.approx(2.0 * np.pi + LANDING_ANGLE)
    impulse = body.mass * (plan.speed_up + 9.81 * plan.thrust_time)
    assert plan.lever * impulse == pytest.approx(plan.angular_momentum)


def test_bodies_that_cannot_turn_over_are_refused() -> None:
    place = block_place()
    with pytest.raises(TargetError) as refused:
        Flip(place, 0.1)
    text = str(refused.value)
    assert text.startswith("the feet are too short for a somersault with a height of 0.1: the ground force must act ")
    smallest = float(text.rpartition("give a height of at least ")[2])
    Flip(place, smallest)
    with pytest.raises(TargetError):
        Flip(place, smallest - 0.05)
    narrow = block_place(box_mesh((2, 2, 8), (0.2, 0.4, 1.0)))
    with pytest.raises(TargetError) as short:
        Flip(narrow, 4.0)
    assert str(short.value) == (
        "the feet are too short to land a somersault: they are 0.2 body heights long in its direction, and 0.3 are"
        " necessary; use jump, hop or spin"
    )
    lying = block_place(box_mesh((8, 2, 2), (2.0, 0.4, 0.4)))
    with pytest.raises(TargetError, match="a somersault needs a body that stands; this one lies along the ground"):
        Flip(lying, HEIGHT)


FLOOR_SOLID, LEFT = Solid((FLOOR,)), np.array([0.0, 1.0, 0.0])
OBSTACLES = {
    "wall": ((FLOOR_SOLID, step(FLOOR, 0.6 * FORWARD, FORWARD, 3.0)), "there is a wall"),
    "half space": ((FLOOR_SOLID, Solid((Plane(-FORWARD, 1.7),))), "there is a wall"),
    "corner of a wall": ((FLOOR_SOLID, Solid((Plane(-FORWARD, 0.6), Plane(-LEFT, 0.15)))), "there is a wall"),
    "step": ((FLOOR_SOLID, step(FLOOR, 1.8 * FORWARD, FORWARD, 0.05)), "the ground is 0.05 body heights higher"),
    "hollow": ((Solid((FLOOR, Plane(FORWARD, -0.9))), Solid((Plane(FLOOR.normal, 0.2),))), "0.2 body heights lower"),
    "edge": ((Solid((FLOOR, Plane(FORWARD, -0.4))),), "the ground ends"),
}


@pytest.mark.parametrize("case", OBSTACLES)
def test_the_ground_must_be_level_up_to_the_largest_distance(case: str) -> None:
    """Only an obstacle in the direction of travel is refused."""
    solids, obstacle = OBSTACLES[case]
    place = replace(block_place(), solids=solids)
    with pytest.raises(TargetError) as refused:
        Flip(place, HEIGHT)
    text = str(refused.value)
    assert text.startswith("a somersault needs 2 body heights of level ground in its direction; ") and obstacle in text
    assert text.endswith("; turn to another direction first, or walk to more level ground")
    Flip(place.with_forward(-place.ground.axes[0]), HEIGHT)


def test_obstacles_beyond_the_largest_distance_are_accepted() -> None:
    place = block_place()
    Flip(replace(place, solids=(*place.solids, step(FLOOR, 2.3 * FORWARD, FORWARD, 0.5))), HEIGHT)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_thrust_requests_momentum_in_the_direction_of_travel(side: float) -> None:
    place = block_place()
    forward = side * place.ground.axes[0]
    flip = Flip(place.with_forward(forward), HEIGHT)
    flip.phase = JumpPhase.THRUST
    rising = np.zeros_like(place.standing)
    rising[:, 2] = 0.9 * flip.plan.speed_up
    objectives = flip.objectives(BodyState(place.standing, rising, 0.0), None, DT)
    (asked,) = (one for one in objectives if isinstance(one, AngularMomentumObjective))
    assert np.cross(asked.target, [0.0, 0.0, 1.0]) @ forward > 0.0


def test_in_the_air_the_length_is_adjusted_to_the_rotation() -> None:
    """The target shape turns with the body, which is 115 degrees from upright: a body that turns too slowly for the
    remaining rotation becomes shorter along its own axis, one that turns too fast longer."""
    place = block_place()
    body, left = place.body, place.ground.axes[1]
    angle, rates = 2.0, []
    for factor in (0.8, 1.4):
        flip = Flip(place, HEIGHT)
        flip.phase = JumpPhase.THRUST
        positions = turned(place, angle, 1.0)
        time = np.sqrt(2.0 * 1.0 / 9.81)
        spin = factor * (2.0 * np.pi + LANDING_ANGLE - angle) / time
        arms = positions - body.centre_of_mass(positions)
        state = BodyState(positions, np.cross(spin * left, arms), 0.0)
        flip._worlds.turned[:] = angle  # pyright: ignore[reportAttributeAccessIssue]
        for when in (0.0, 0.5, 0.5):
            objectives = flip.objectives(BodyState(state.positions, state.velocities, when), None, DT)
        assert flip.phase is JumpPhase.FLIGHT
        (shape,) = (one for one in objectives if isinstance(one, Objective) and one.name == "pose")
        along = Rotation.from_rotvec(angle * left).apply([0.0, 0.0, 1.0])
        stretching = (arms @ along)[:, None] * along
        rates.append(float(shape.target @ (shape.rows @ stretching.ravel())))
    assert rates[0] < -0.01 and rates[1] > 0.01


def test_a_note_states_a_rotation_that_is_incomplete_at_touch_down() -> None:
    place = block_place()
    flip = Flip(place, HEIGHT)
    flip.phase = JumpPhase.LAND
    assert flip.notes() == []
    flip._worlds.turned[:] = 5.0  # pyright: ignore[reportAttributeAccessIssue]
    upside = BodyState(turned(place, 5.0), np.zeros_like(place.standing), 0.0)
    flip.objectives(upside, None, DT)
    assert flip.notes() == ["it touched down after 286 of 360 degrees"]


def test_the_rotation_at_touch_down_is_the_mean_of_soles_and_feet() -> None:
    """A body at rest must have flat soles, and its feet under the centre of mass. If they are ahead of it, less than a
    turn is done."""
    place = block_place()
    flip = Flip(place, HEIGHT)
    flip.phase = JumpPhase.LAND
    com, shear = place.body.centre_of_mass(place.standing), 0.7
    sheared = place.standing + shear * np.outer(com[2] - place.standing[:, 2], place.ground.axes[0])
    flip._worlds.turned[:] = 2.0 * np.pi  # pyright: ignore[reportAttributeAccessIssue]
    flip.objectives(BodyState(sheared, np.zeros_like(sheared), 0.0), None, DT)
    landed = float(np.degrees(flip._worlds.landed[0]))  # pyright: ignore[reportAttributeAccessIssue]
    axes, feet = place.ground.axes, np.degrees(np.arctan(shear))
    soles = -np.degrees(angle_about_left(axes @ place.body.best_fit_rotation(sheared) @ axes.T))
    assert 0.0 < soles < feet - 2.0
    assert landed == pytest.approx(360.0 - 0.5 * (soles + feet), abs=1.0)
    assert flip.notes() == [f"it touched down after {landed:.0f} of 360 degrees"]


def test_a_landed_body_is_balanced_with_the_full_weights() -> None:
    """After a jump, lower weights suffice, and they grow gradually."""
    place = block_place()
    weights = []
    for jump in (Flip(place, HEIGHT), Jump(place, JumpTarget(0.0, HEIGHT))):
        jump.phase = JumpPhase.LAND
        objectives = jump.objectives(BodyState(place.standing, np.zeros_like(place.standing), 0.0), None, DT)
        weights.append(next(one.weight for one in objectives if isinstance(one, AngularMomentumObjective)))
    assert weights[0] == Weights().spin and weights[1] < Weights().landing * Weights().spin


def test_the_rotation_is_measured_without_wrapping() -> None:
    place = block_place()
    flip = Flip(place, HEIGHT)
    for end, failures in ((2.0 * np.pi, ()), (1.8 * np.pi, ("rotation 324 of 360 degrees",))):
        nodes = np.array([turned(place, angle) for angle in np.linspace(0.0, end, 20)])
        outcome = flip.outcome_record(cast(Any, SimpleNamespace(positions=nodes)), 0, 19)
        assert outcome.rotation_degrees == pytest.approx(np.degrees(end)) and outcome.failures == failures
