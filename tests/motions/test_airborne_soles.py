"""Objectives of the soles of a body in the air."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective, BodyPart, Objective
from egs_warp.locomotion.reduced_objectives import ReducedObjectives
from egs_warp.motions.airborne_soles import BASE_SWING_WEIGHT, BASE_TILT_WEIGHT, AirborneSoles
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import BalanceController, sole_shares
from tests.support.stances import block_place

RATE = 3.0


def airborne(place: Stance, turn: Rotation, *, on_legs: bool) -> tuple[BodyState, BodyPart, list[AnyObjective]]:
    """Return the state of a standing body of which only the base is rotated, the base, and the objectives of its soles
    for the pose at rest, with a rate of 3 / s and half of the weights."""
    feet = place.feet()
    soles = [foot.sole for foot in feet] if on_legs else []
    controller = BalanceController(
        place.body, place.ground, place.standing, place.contact_points, place.friction, soles=soles
    )
    base = BodyPart.of(place.body, "sole", np.flatnonzero(sole_shares(place.body, place.ground, place.standing)))
    positions = place.standing.copy()
    centre = base.centre(positions)
    positions[base.nodes] = centre + turn.apply(positions[base.nodes] - centre)
    state = BodyState(positions, np.zeros_like(positions))
    moments = controller.reduced(state, None).moments
    airborne_soles = AirborneSoles.of(place, feet, on_legs=on_legs)
    targets = np.eye(3), np.asarray(RATE), np.asarray(0.5), np.zeros(3)
    affine = airborne_soles.objectives(controller.balance, moments, *targets)
    reduced = ReducedObjectives(affine, np.zeros(3), np.asarray(0.0)).with_world_axis()
    return state, base, reduced.of_one_world(controller.shares, positions)


@pytest.mark.parametrize(("tilt", "yaw"), [(0.3, 0.0), (-0.2, 0.0), (0.0, 0.4)])
def test_a_base_is_turned_flat_but_not_about_the_up_axis(tilt: float, yaw: float) -> None:
    """The target rate of rotation is the sine of the tilt times the rate of approach, and opposite to the tilt. The
    whole body is also turned about the up axis."""
    place = block_place()
    turn = Rotation.from_rotvec([0.0, 0.0, yaw]) * Rotation.from_rotvec(tilt * place.ground.axes[1])
    state, base, objectives = airborne(place, turn, on_legs=False)
    _, move, flatten = (cast(Objective, one) for one in objectives)
    assert (move.weight, flatten.weight) == (0.5 * BASE_SWING_WEIGHT, 0.5 * BASE_TILT_WEIGHT)
    spin = np.array([0.0, -RATE * np.sin(tilt)])
    radius = np.sqrt(0.5 * np.trace(base.inertia(state.positions)) / base.masses.sum())
    assert np.allclose(flatten.target, radius * spin, atol=1e-9)
    # A rigid rotation of the base at this rate meets the target.
    arms = state.positions - base.centre(state.positions)
    assert np.allclose(flatten.rows @ np.cross(spin @ place.ground.axes[:2], arms).ravel(), flatten.target, atol=1e-9)


def test_feet_on_legs_are_only_moved() -> None:
    """Each foot has three rows."""
    place = block_place()
    _, _, objectives = airborne(place, Rotation.from_rotvec([0.0, 0.3, 0.0]), on_legs=True)
    moves = [one for one in objectives if isinstance(one, Objective)]
    assert {one.name for one in moves} == {"sole velocity"}
    assert sum(len(one.target) for one in moves) == 3 * len(place.feet())


def test_the_soles_of_a_turning_pose_turn_with_it() -> None:
    """A rigid rotation of a body in the target pose, at the angular velocity of the pose, meets all objectives."""
    place, turning = block_place(), np.array([0.4, 3.0, -0.7])
    turn = Rotation.from_rotvec([0.3, 2.0, 0.5])
    controller = BalanceController(place.body, place.ground, place.standing, place.contact_points, place.friction)
    arms = turn.apply(place.standing - place.body.centre_of_mass(place.standing))
    moments = controller.reduced(BodyState(arms, np.zeros_like(arms)), None).moments
    soles = AirborneSoles.of(place, place.feet(), on_legs=False)
    targets = turn.as_matrix(), np.asarray(RATE), np.asarray(1.0), turning
    affine = soles.objectives(controller.balance, moments, *targets)
    reduced = ReducedObjectives(affine, np.zeros(3), np.asarray(0.0)).with_world_axis()
    rigid = np.cross(turning, arms).ravel()
    objectives = [one for one in reduced.of_one_world(controller.shares, arms) if isinstance(one, Objective)]
    assert len(objectives) == 2
    for one in objectives:
        assert np.allclose(one.rows @ rigid, one.target, atol=1e-9) and np.abs(one.target).max() > 0.1
