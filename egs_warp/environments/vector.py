"""Vector environment of Gymnasium: many worlds of one creature on one device, stepped in lockstep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import torch

from egs_warp.checked_calls import checked_constructor
from egs_warp.environments.measurement import Measurement, measure
from egs_warp.errors import ArgumentError, UserError, did_you_mean
from egs_warp.installation import install_command
from egs_warp.locomotion.batch import BatchStepper
from egs_warp.locomotion.batch_objectives import BatchObjectives
from egs_warp.locomotion.batch_state import BatchState, merged
from egs_warp.locomotion.rollout import solver_steps
from egs_warp.locomotion.step_tensors import WeightedRows
from egs_warp.pipelines.captured_body import Friction
from egs_warp.pipelines.creature import Creature

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise UserError(f"environments: Gymnasium is not installed; {install_command('gymnasium')}") from error

CENTRE_WEIGHT, MOMENTUM_WEIGHT, SHAPE_WEIGHT = 2.0, 1.0, 0.1
"""Weights of the objectives of ``Actions.TARGETS``: velocity of the centre of mass, angular momentum, and velocities of
all nodes."""
MAX_TARGET = 3.0
"""Bound of the target velocities, in sqrt(g H)."""


class Actions(Enum):
    """Meaning of the actions of an environment."""

    ACTIVATIONS = "activations"
    """(m,) target activation of each synergy in the frame, as a fraction of its bounds. The rate at which activations
    approach their targets is limited."""
    TARGETS = "targets"
    """(3,) target velocity of the centre of mass in sqrt(g H). Each solver step plans activations that aim at this
    velocity and at zero angular momentum."""

    @classmethod
    def _missing_(cls, value: object) -> Actions:
        names = [one.value for one in cls]
        raise UserError(f"actions {value!r} are not known{did_you_mean(value, names)}; give one of {', '.join(names)}")


@dataclass(frozen=True)
class Transition:
    """Transition of all worlds of an environment in one step."""

    before: Measurement
    after: Measurement
    actions: np.ndarray
    """(B, ...) actions."""
    failed: np.ndarray
    """(B,) bool, True for worlds whose step could not be solved."""


def upward_speed(transition: Transition) -> np.ndarray:
    """Return the upward velocity (B,) of the centre of mass as a reward."""
    return transition.after.velocity[:, 2]


@checked_constructor
class CreatureVectorEnv(VectorEnv):
    """Many worlds of one creature as a Gymnasium vector environment.

    A step of the environment is one frame of 1/60 s. An observation is ``Measurement.vectors``. An episode ends
    (``terminated``) when a step cannot be solved, or (``truncated``) after ``frames`` frames. The next step of the
    environment begins a new episode of that world and ignores its action (``AutoresetMode.NEXT_STEP``).
    """

    def __init__(
        self,
        creature: Creature,
        num_envs: int,
        *,
        actions: Actions | str = Actions.TARGETS,
        reward: Callable[[Transition], np.ndarray] = upward_speed,
        frames: int = 60,
        frictions: Sequence[Friction] | None = None,
    ) -> None:
        """Build the worlds, in which the creature stands.

        Args:
            creature: The creature; the worlds are on its device.
            num_envs: Number of worlds B.
            actions: Meaning of the actions.
            reward: Function that returns the rewards (B,) of a transition.
            frames: Number of frames of an episode.
            frictions: (B,) Coulomb coefficients of the worlds; None uses the friction of the creature.

        Raises:
            UserError: An argument is invalid.
        """
        for name, value in (("num_envs", num_envs), ("frames", frames)):
            if value < 1:
                raise ArgumentError(name, "give a whole number of at least 1", value=value)
        if frictions is not None and len(frictions) != num_envs:
            raise ArgumentError("frictions", f"the length is {len(frictions)}; give one for each of {num_envs} worlds")
        self.actions, self.reward, self.frames, self.creature = Actions(actions), reward, frames, creature
        body, planner = creature.body, creature.stepper.planner
        self._stepper = BatchStepper(
            *(body, creature.muscles, creature.geometry, frictions or [creature.geometry.friction] * num_envs),
            settings=creature.stepper.settings,
            planner=planner,
        )
        self._planner, self._dt, self._per_frame = planner, *solver_steps(body)
        device = self._stepper.device
        self._start = self._stepper.start([creature.start] * num_envs)
        self._nodes = self._start.positions[0]
        members = planner.synergies.members.toarray()
        self._members = torch.as_tensor(members * creature.muscles.bounds[:, None], device=device)
        self._means = torch.as_tensor(members / members.sum(axis=0) / creature.muscles.bounds[:, None], device=device)
        self._rows = self._target_rows()
        self._state, self._ages = self._start, np.zeros(num_envs, int)
        self._ended, self._measurement = np.zeros(num_envs, bool), self._measured()
        self.num_envs, self.render_mode = num_envs, None
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}
        size = self._measurement.vectors.shape[1]
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self._bound, count = (MAX_TARGET, 3) if self.actions is Actions.TARGETS else (1.0, members.shape[1])
        self.single_action_space = gymnasium.spaces.Box(-self._bound, self._bound, (count,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @property
    def measurement(self) -> Measurement:
        """Measured values of all worlds."""
        return self._measurement

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin a new episode in all worlds and return the observations (B, D). The start state is always the same, so
        ``seed`` only seeds the environment's random generator; ``options`` are ignored."""
        super().reset(seed=seed, options=options)  # pyright: ignore[reportArgumentType]
        self._restart(np.ones(self.num_envs, bool))
        self._measurement = self._measured()
        return self._measurement.vectors, {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance all worlds by one frame under the ``actions`` (B, ...).

        Returns:
            Observations (B, D), rewards (B,), terminated (B,) bool, truncated (B,) bool, and an empty dictionary.
        """
        actions = np.clip(np.asarray(actions, dtype=np.float64), -self._bound, self._bound)
        begins = self._ended
        self._restart(begins)
        before = self._measured() if begins.any() else self._measurement
        failed = self._advance(actions, begins)
        self._ages += ~begins
        self._measurement = self._measured()
        rewards = np.asarray(self.reward(Transition(before, self._measurement, actions, failed)), dtype=np.float64)
        rewards = np.where(begins | failed, 0.0, rewards)
        truncated = (self._ages >= self.frames) & ~failed
        self._ended = failed | truncated
        return self._measurement.vectors, rewards, failed, truncated, {}

    def _measured(self) -> Measurement:
        return measure(self.creature.body, self._nodes, self._state, self._means)

    def _restart(self, worlds: np.ndarray) -> None:
        """Return the ``worlds`` (B,) bool to the start state."""
        if not worlds.any():
            return
        again, others = (torch.as_tensor(np.flatnonzero(each), device=self._nodes.device) for each in (worlds, ~worlds))
        self._state = merged(self._state.gather(others), self._start.gather(again))
        self._ages[worlds] = 0
        self._ended = self._ended & ~worlds

    def _advance(self, actions: np.ndarray, resting: np.ndarray) -> np.ndarray:
        """Compute the solver steps of a frame in all worlds that are not ``resting`` (B,) bool. A failed world stays at
        its last solved state. Return the mask (B,) bool of failed worlds."""
        device = self._nodes.device
        active = self._state.gather(torch.as_tensor(np.flatnonzero(~resting), device=device))
        left = [self._state.gather(torch.as_tensor(np.flatnonzero(resting), device=device))]
        values = torch.as_tensor(actions, device=device)
        failed = torch.zeros(self.num_envs, dtype=torch.bool, device=device)
        for _ in range(self._per_frame):
            if len(active.worlds) == 0:
                break
            before = active
            if self.actions is Actions.TARGETS:
                active, _, lost = self._stepper.advance(before, self._objectives(values[before.worlds]), self._dt)
            else:
                desired = self._activations(before, values[before.worlds])
                active, _, lost = self._stepper.advance_with_activations(before, desired, self._dt)
            failed[before.worlds[lost]] = True
            left.append(before.gather(lost.nonzero().squeeze(1)))
        for part in left:
            active = merged(active, part) if len(part.worlds) > 0 else active
        self._state = active
        return failed.cpu().numpy()

    def _activations(self, state: BatchState, desired: torch.Tensor) -> torch.Tensor:
        """Return the activations (c, M) m of all muscles. They are nearest to the ``desired`` activations (c, m) of the
        synergies among those that their maximum rate allows."""
        lower, upper = self._planner.activation_bounds(state.activations @ self._means, self._dt)
        return torch.maximum(torch.minimum(desired, upper), lower) @ self._members.T

    def _target_rows(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the rows of the objectives of ``Actions.TARGETS``, scaled by sqrt(2 weight): (3, 3N) for the centre of
        mass, and the diagonal (3N,) of those for the nodes."""
        body = self.creature.body
        rows = np.sqrt(2.0 * CENTRE_WEIGHT) * np.asarray(body.mean_rows)
        shares = np.sqrt(2.0 * SHAPE_WEIGHT) * body.mass_roots
        return torch.as_tensor(rows, device=self._nodes.device), torch.as_tensor(shares, device=self._nodes.device)

    def _objectives(self, targets: torch.Tensor) -> BatchObjectives:
        """Return the objectives for the ``targets`` (c, 3): this velocity for the centre of mass and, with a small
        weight, for all nodes; and zero angular momentum."""
        (rows, entries), count = self._rows, len(targets)
        speeds = self.creature.body.speed_unit * targets
        indices = torch.arange(len(entries), device=targets.device)
        return BatchObjectives(
            WeightedRows(
                indices.expand(count, -1),
                entries.expand(count, -1),
                entries * speeds.repeat(1, len(entries) // 3),
                rows.expand(count, -1, -1),
                np.sqrt(2.0 * CENTRE_WEIGHT) * speeds,
            ),
            targets.new_full((count, 1), MOMENTUM_WEIGHT),
            targets.new_zeros(count, 1, 3),
            targets.new_zeros(count, len(entries) // 3),
        )
