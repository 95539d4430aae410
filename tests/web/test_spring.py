"""Pull of the user by a spring: its force, and its effect in a step."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.web.spring import MAX_FORCE, STIFFNESS, Spring
from tests.support.live_sessions import coarse_pawn


def test_force_is_that_of_a_spring_up_to_its_strongest():
    creature = coarse_pawn()
    body = creature.body
    spring = Spring(body, int(np.argmax(body.mesh.nodes[:, 2])))
    rest = BodyState(body.mesh.nodes, np.zeros_like(body.mesh.nodes))
    spring.target = np.zeros(3)
    held = -spring.force(rest) / np.linalg.norm(spring.force(rest))
    # The position of the grip is determined from pulls along the axes.
    away = np.array([0.1, 0.0, 0.0])
    spring.target = held + away
    before = spring.force(rest)
    spring.target = held + away + 0.01 * away
    np.testing.assert_allclose(spring.force(rest) - before, 0.0, atol=MAX_FORCE * body.weight)
    spring.target = 100.0 * np.ones(3)
    assert np.linalg.norm(spring.force(rest)) == pytest.approx(MAX_FORCE * body.weight)
    moving = BodyState(rest.positions, np.tile([0.0, 0.0, 0.3], (len(rest.positions), 1)))
    resting = Spring(body, spring.node)
    resting.target = rest.positions[spring.node]
    assert (resting.force(moving) - resting.force(rest))[2] < 0.0
    small = 1e-3 * body.height * np.array([0.0, 1.0, 0.0])
    first = resting.force(rest)
    resting.target = resting.target + small
    np.testing.assert_allclose(
        resting.force(rest) - first, [0.0, STIFFNESS * body.weight * 1e-3, 0.0], atol=1e-9 * body.weight
    )


def test_a_step_under_a_pull_has_its_impulse_and_its_torque():
    """In free flight without muscles, a step with the force F at x changes the momentum by dt (F + m g) and the angular
    momentum by dt (x - c) x F, to rounding."""
    creature = coarse_pawn()
    body, stepper = creature.body, creature.stepper
    spring = Spring(body, int(np.argmax(body.mesh.nodes[:, 2])))
    high = BodyState(body.mesh.nodes + [0.0, 0.0, 3.0], np.zeros_like(body.mesh.nodes))
    spring.target = high.positions[spring.node] + [0.2, 0.1, 0.0]
    dt = 1.0 / 60.0
    after, _, reports = stepper.advance(
        high.with_velocity_kick(spring.kick(high, dt)), stepper.initial_memory(), [], dt
    )
    assert reports[-1].contacts.count == 0 and len(reports) == 1
    force = spring.force(high)
    momentum = body.mass * body.centre_of_mass(after.velocities)
    np.testing.assert_allclose(momentum, dt * (force + body.mass * body.gravity), atol=1e-8 * body.weight)
    shares = body.node_mass * spring._shares
    arms = high.positions - body.centre_of_mass(high.positions)
    spin = body.angular_momentum(after.positions, after.velocities)
    np.testing.assert_allclose(spin, dt * np.cross(shares @ arms, force), atol=1e-8 * body.weight * body.height)
