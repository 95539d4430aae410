"""Base class of motions whose state machine has a world axis: a motion is one row of a record of many worlds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import numpy as np

from egs_warp.fem.batched import BatchedRecord
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.reduced_objectives import ReducedObjectives
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.balance import Balance
from egs_warp.motions.moments import ReducedState
from egs_warp.motions.stance import BalanceController


@dataclass(frozen=True)
class MotionWorlds(BatchedRecord, ABC):
    """State machines of c worlds with the same body. Their state changes in place."""

    current: Balance
    """Balance in the current reference frame."""

    @property
    @abstractmethod
    def is_resting(self) -> np.ndarray:
        """(c,) bool, True for bodies at rest."""

    @abstractmethod
    def step(self, state: ReducedState, dt: float) -> ReducedObjectives:
        """Return the objectives of the time step of ``dt`` s that starts at ``state`` and advance the state
        machines."""


WorldsT = TypeVar("WorldsT", bound=MotionWorlds)


class JoinedMotion(Generic[WorldsT]):
    """Motion of one world. Its state is a row of ``MotionWorlds``, which it may share with motions of other worlds."""

    def __init__(self, reference: BalanceController, worlds: WorldsT) -> None:
        """Create the motion.

        Args:
            reference: controller that defines the parts of the body and the reference pose of their moments.
            worlds: state of one world.
        """
        self.reference = reference
        self._worlds, self._row = worlds, 0
        self._prepared: ReducedObjectives | None = None

    @classmethod
    def join(cls, motions: Sequence[Self]) -> WorldsT:
        """Join the states of ``motions`` into one record, which the motions share afterwards."""
        worlds = motions[0]._worlds
        is_joined = len(worlds.current.friction) == len(motions)
        if is_joined and all(one._worlds is worlds and one._row == row for row, one in enumerate(motions)):
            return worlds
        worlds = type(worlds).concatenated([one._worlds.gather(np.array([one._row])) for one in motions])
        for row, one in enumerate(motions):
            one._worlds, one._row = worlds, row
        return worlds

    @classmethod
    def prepare(
        cls, motions: Sequence[Self], states: Sequence[BodyState], reports: Sequence[StepReport | None], dt: float
    ) -> None:
        """Compute the objectives of many motions at once. The next call of a motion's ``objectives`` returns those of
        the motion.

        Args:
            motions: motions of one class, whose bodies have equally many parts.
            states: the states at the start of the step.
            reports: the reports of the previous steps.
            dt: size of the time step, s.
        """
        each = [one.reference.reduced(*at) for one, at in zip(motions, zip(states, reports, strict=True), strict=True)]
        capacity = max(len(one.contact_points) for one in each)
        reduced = ReducedState.concatenated([one.with_capacity(capacity).with_world_axis() for one in each])
        objectives = cls.join(motions).step(reduced, dt)
        for row, one in enumerate(motions):
            one._prepared = objectives.gather(np.array([row]))

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        reduced, self._prepared = self._prepared, None
        if reduced is None:
            self.join([self])
            reduced = self._worlds.step(self.reference.reduced(state, report).with_world_axis(), dt)
        return reduced.of_one_world(self.reference.shares, state.positions)

    @property
    def gesture_turn(self) -> np.ndarray:
        """(3,) rotation vector of the body that is caused by gestures of its parts; see ``Balance.gesture_turn``."""
        return self._worlds.current.gesture_turn[self._row]

    @gesture_turn.setter
    def gesture_turn(self, turn: np.ndarray) -> None:
        self._worlds.current.gesture_turn[self._row] = turn
