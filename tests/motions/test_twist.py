"""Twists of a block that is posed by hand: target spin on the ground and target shape in the air."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AngularMomentumObjective, Objective
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPhase, JumpTarget
from egs_warp.motions.jump_worlds import FORWARD_TIME_FRACTION
from egs_warp.motions.sequence import Stance
from egs_warp.motions.twist import AIRBORNE_FRACTION, LANDING_SLIDE_ANGLE, SPIN_FACTOR
from tests.support.meshes import box_mesh
from tests.support.stances import DT, block_place, moved


def yaw_asked(jump: Jump, state: BodyState) -> float:
    """Return the target angular momentum about the up axis, kg m^2/s, of the step from ``state``."""
    asked = jump.objectives(state, None, DT)[1]
    assert isinstance(asked, AngularMomentumObjective)
    return float(asked.target[2])


def inertia_about_up(place: Stance, positions: np.ndarray) -> float:
    flat = positions[:, :2] - place.body.centre_of_mass(positions)[:2]
    return float(place.body.node_mass @ (flat**2).sum(axis=1))


@pytest.mark.parametrize("turn", [np.pi, -np.pi, 3.0 * np.pi])
def test_a_twist_requests_the_remaining_spin_from_friction(turn: float) -> None:
    """In the last step of the thrust, the target is the spin that completes the remaining turn in flight, with a
    reserve. It is computed for the standing body, whatever the current shape.

    The target decreases in proportion to the completed turn. It is zero at ``LANDING_SLIDE_ANGLE`` before the end, by
    which the feet slide after landing. The heading is unwrapped beyond half turns. The masses of the body are
    symmetric, so the target that corrects its tilt has no momentum about the up axis.
    """
    place = block_place(box_mesh((2, 2, 4), (0.4, 0.4, 1.0)))
    jump = Jump(place, JumpTarget(0.0, 0.2), turn=turn)
    jump.phase = JumpPhase.THRUST
    rising, sign = np.zeros_like(place.standing), np.sign(turn)
    rising[:, 2] = 0.9 * jump.plan.speed_up
    angles = np.array([0.0, 0.3, 0.6])
    states = [BodyState(moved(place, sign * angle, np.zeros(3)), rising, 0.0) for angle in angles]
    asked = sign * np.array([yaw_asked(jump, state) for state in states])
    slope, start = np.polyfit(angles, asked, 1)
    assert np.allclose(asked, start + slope * angles, rtol=1e-6)
    assert np.degrees(abs(turn) + start / slope) == pytest.approx(np.degrees(LANDING_SLIDE_ANGLE), abs=1e-3)
    reserve = -slope * jump.plan.flight_time / inertia_about_up(place, place.standing)
    assert 1.1 < reserve < 1.7
    crouched = moved(place, float(sign * 0.6), np.zeros(3))
    middle = place.body.centre_of_mass(crouched)
    crouched = middle + (crouched - middle) * [1.1, 1.1, 0.8]
    assert sign * yaw_asked(jump, BodyState(crouched, rising, 0.0)) == pytest.approx(asked[-1], rel=1e-6)
    for angle in np.linspace(0.6, abs(turn), 12) * sign:
        jump.objectives(BodyState(moved(place, angle, np.zeros(3)), rising, 0.0), None, DT)
    assert jump.heading == pytest.approx(turn)


def test_a_twist_spins_up_with_the_upward_speed(place: Stance) -> None:
    """The target of a step is the whole spin times the ratio of the step size to the remaining time of the thrust. A
    body that rises at half of the take-off speed therefore gets twice the target of a body at rest."""
    shares = []
    for risen in (0.0, 0.5):
        jump = Jump(place, JumpTarget(0.0, 0.2), turn=1.0)
        jump.phase = JumpPhase.THRUST
        velocities = np.zeros_like(place.standing)
        velocities[:, 2] = risen * jump.plan.speed_up
        asked = yaw_asked(jump, BodyState(place.standing, velocities, 0.0))
        left = (1.0 - risen) * jump.plan.thrust_time
        whole = inertia_about_up(place, place.standing) * (1.0 - LANDING_SLIDE_ANGLE) * SPIN_FACTOR
        whole /= AIRBORNE_FRACTION * jump.plan.flight_time + 0.5 * left
        shares.append(asked / whole)
        assert shares[-1] == pytest.approx(DT / (FORWARD_TIME_FRACTION * left), rel=5e-3)
    assert shares[1] == pytest.approx(2.0 * shares[0], rel=5e-3)


def test_in_the_air_the_width_is_adjusted_to_the_turn(place: Stance) -> None:
    """The angular momentum L is conserved in flight, so a body that has to turn by the remaining angle in the remaining
    time t needs the inertia L t / angle. The target width gives this inertia, and its rate is proportional to the
    difference of the widths. At the spin that fits the standing shape, the target is zero."""
    turn, speed = 1.5, 2.5
    left = turn - LANDING_SLIDE_ANGLE
    time = 2.0 * speed / 9.81
    corners = [int(np.argmin(np.linalg.norm(place.standing - [x, x, 0.0], axis=1))) for x in (-0.2, 0.2)]
    arms = place.standing - place.body.centre_of_mass(place.standing)
    fitting = left / time
    rates = []
    for width in (1.0, 1.05, 0.95):
        jump = Jump(place, JumpTarget(0.0, 0.2), turn=turn)
        jump.phase = JumpPhase.THRUST
        spin = fitting * width**2
        velocities = np.cross([0.0, 0.0, spin], arms) + [0.0, 0.0, speed]
        flying = BodyState(place.standing, velocities, 0.01)
        for when in (0.01, 0.5, 0.5):  # at the last time, the target pose has been reached and is constant
            objectives = jump.objectives(replace(flying, time=when), None, DT)
        assert jump.phase is JumpPhase.FLIGHT
        shape = objectives[2]
        assert isinstance(shape, Objective)
        # The rows of the objective are orthonormal in the mass-weighted mean and measure only the velocities of these
        # strains.
        shares = np.repeat(place.body.node_mass / place.body.mass, 3)
        assert np.allclose((shape.rows / shares) @ shape.rows.T, np.eye(6), atol=1e-12)
        wanted = (shape.rows.T @ shape.target / shares).reshape(-1, 3)
        # The comparison is along the diagonal, where the strains cause no rotation.
        apart = (wanted[corners[1], :2] - wanted[corners[0], :2]).mean()
        if width == 1.0:
            assert abs(apart) < 1e-9
        else:
            # The target is d(arm)/dt = rate (width - 1) arm.
            rates.append(apart / (0.4 * (width - 1.0)))
    assert np.min(rates) > 1.0
    assert np.allclose(rates, rates[0], rtol=1e-6)
