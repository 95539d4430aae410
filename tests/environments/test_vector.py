"""The vector environment: spaces, episodes and rewards, and steps that equal those of a single stepper."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("gymnasium")

from egs_warp.environments.vector import CreatureVectorEnv, Transition
from egs_warp.errors import ArgumentError, UserError
from egs_warp.locomotion.objectives import AngularMomentumObjective, centre_of_mass_velocity, node_velocities
from egs_warp.locomotion.rollout import solver_steps
from tests.support.creatures import coarse_pawn


def test_worlds_follow_their_targets_as_single_steppers() -> None:
    creature, targets = coarse_pawn(), np.array([[0.0, 0.0, 0.3], [0.0, 0.0, -0.2]])
    worlds = CreatureVectorEnv(creature, 2, reward=lambda one: one.after.displacement[:, 2])
    worlds.reset()
    _, rewards, terminated, truncated, _ = worlds.step(targets)
    assert not terminated.any() and not truncated.any()
    body, (dt, count) = creature.body, solver_steps(creature.body)
    for target, reward in zip(targets, rewards, strict=True):
        speed = body.speed_unit * target
        goals = [
            centre_of_mass_velocity(body, speed, 2.0),
            AngularMomentumObjective(np.zeros(3), 1.0),
            node_velocities(body, np.tile(speed, (len(body.node_mass), 1)), 0.1),
        ]
        state, memory = creature.start, creature.stepper.initial_memory()
        for _ in range(count):
            state, memory, _ = creature.stepper.advance(state, memory, goals, dt)
        rise = (body.centre_of_mass(state.positions) - body.centre_of_mass(creature.start.positions))[2] / body.height
        # The tolerance is for OSQP, the solver of a single stepper on a CPU, which agrees with the kernel of the batch
        # to about 1e-6.
        assert reward == pytest.approx(rise, abs=1e-6) and abs(rise) > 1e-4


def test_activations_are_limited_to_their_rate_and_episodes_begin_again() -> None:
    creature, seen = coarse_pawn(), list[Transition]()

    def reward(one: Transition) -> np.ndarray:
        seen.append(one)
        return np.ones(2)

    worlds = CreatureVectorEnv(creature, 2, actions="activations", reward=reward, frames=2)
    observations, _ = worlds.reset()
    assert worlds.observation_space.contains(observations)
    assert worlds.action_space.shape is not None
    actions = np.ones(worlds.action_space.shape)
    ends = [worlds.step(actions) for _ in range(3)]
    assert [end[1].tolist() for end in ends] == [[1.0, 1.0], [1.0, 1.0], [0.0, 0.0]]
    assert [end[3].tolist() for end in ends] == [[False] * 2, [True] * 2, [False] * 2]
    dt, count = solver_steps(creature.body)
    assert seen[0].after.activations.max() <= 7.0 * count * dt / creature.body.time_unit + 1e-12
    # The last step began a new episode in the start state and ignored its action.
    np.testing.assert_array_equal(ends[2][0], observations)


def test_a_world_that_fails_ends_alone() -> None:
    creature = coarse_pawn()
    worlds = CreatureVectorEnv(creature, 2)
    worlds.reset()
    worlds._state.velocities[1] = np.nan
    observations, rewards, terminated, truncated, _ = worlds.step(np.zeros((2, 3)))
    assert terminated.tolist() == [False, True] and not truncated.any() and rewards[1] == 0.0
    assert np.isfinite(observations[0]).all()
    observations, _, terminated, _, _ = worlds.step(np.zeros((2, 3)))
    assert not terminated.any() and np.isfinite(observations).all()


def test_bad_arguments_are_one_line() -> None:
    creature = coarse_pawn()
    with pytest.raises(ArgumentError, match=r"^num_envs 0: give a whole number of at least 1$"):
        CreatureVectorEnv(creature, 0)
    with pytest.raises(ArgumentError, match=r"^frictions: the length is 1; give one for each of 2 worlds$"):
        CreatureVectorEnv(creature, 2, frictions=[0.5])
    with pytest.raises(UserError, match=r"^actions 'target' are not known \(did you mean 'targets'\?\)"):
        CreatureVectorEnv(creature, 2, actions="target")
