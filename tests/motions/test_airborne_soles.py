"""Objectives of the soles of a body in the air."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import BodyPart, Objective
from egs_warp.motions.airborne_soles import BASE_SWING_WEIGHT, BASE_TILT_WEIGHT, AirborneSoles
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import BalanceController
from tests.support.stances import block_place


def airborne(place: Stance, turn: Rotation) -> tuple[BodyState, BalanceController, BodyPart]:
    """Return the state of a standing body whose base alone was rotated, its controller and its base."""
    controller = BalanceController(place.body, place.ground, place.standing, place.contact_points, place.friction)
    (base,) = AirborneSoles.of(place, place.feet(), on_legs=False).parts
    positions = place.standing.copy()
    centre = base.centre(positions)
    positions[base.nodes] = centre + turn.apply(positions[base.nodes] - centre)
    return BodyState(positions, np.zeros_like(positions)), controller, base


@pytest.mark.parametrize(("tilt", "yaw"), [(0.3, 0.0), (-0.2, 0.0), (0.0, 0.4)])
def test_a_base_is_turned_flat_but_not_about_the_up_axis(tilt: float, yaw: float) -> None:
    """The target rate is the sine of the tilt times the rate of approach, against the tilt. The whole body is also
    turned about the up axis."""
    place, rate = block_place(), 3.0
    turn = Rotation.from_rotvec([0.0, 0.0, yaw]) * Rotation.from_rotvec(tilt * place.ground.axes[1])
    state, controller, base = airborne(place, turn)
    soles = AirborneSoles.of(place, place.feet(), on_legs=False)
    move, flatten = (cast(Objective, one) for one in soles.objectives(controller, state, np.eye(3), rate, 0.5))
    assert (move.weight, flatten.weight) == (0.5 * BASE_SWING_WEIGHT, 0.5 * BASE_TILT_WEIGHT)
    spin = np.array([0.0, -rate * np.sin(tilt)])
    radius = np.sqrt(0.5 * np.trace(base.inertia(state.positions)) / base.masses.sum())
    assert np.allclose(flatten.target, radius * spin, atol=1e-9)
    # A rigid rotation of the base at this rate meets the target.
    arms = state.positions - base.centre(state.positions)
    assert np.allclose(flatten.rows @ np.cross(spin @ place.ground.axes[:2], arms).ravel(), flatten.target, atol=1e-9)


def test_feet_on_legs_are_only_moved() -> None:
    place = block_place()
    soles = AirborneSoles.of(place, place.feet(), on_legs=True)
    state, controller, _ = airborne(place, Rotation.from_rotvec([0.0, 0.3, 0.0]))
    assert len(soles.objectives(controller, state, np.eye(3), 1.0, 1.0)) == len(place.feet())
