"""The stepper of a world of several bodies on a common ground (docs/concepts/bodies.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport, WarmStart
from egs_warp.meshing.level_set import LevelSet
from egs_warp.short_repr import short_repr


@dataclass(frozen=True)
class WorldBody:
    """A body of a world. All bodies are in the same frame and on the same ground."""

    __repr__ = short_repr

    stepper: LocomotionStepper
    """Body, muscles and contact with the ground; a prop has no muscles."""
    level_set: LevelSet
    """Level set of the captured shape, in the frame of the cage."""


class WorldStepper:
    """Stepper of the bodies of one world."""

    def __init__(self, bodies: Sequence[WorldBody]) -> None:
        self.bodies = tuple(bodies)

    def initial_memories(self) -> list[WarmStart]:
        """Return the warm start of a first step of each body."""
        return [body.stepper.initial_memory() for body in self.bodies]

    def advance(
        self,
        states: Sequence[BodyState],
        memories: Sequence[WarmStart],
        objectives: Sequence[Sequence[AnyObjective]],
        dt: float,
    ) -> list[list[StepReport]]:
        """Make one step of ``dt`` s of all bodies.

        Args:
            states: state of each body at the start.
            memories: warm start of each body from the previous step.
            objectives: objectives of each body on the end of the step; none for a prop.
            dt: step size, s.

        Returns:
            For each body, the report of each step into which its step was divided, in order. The last report contains
            the state at the end and the warm start of the next step (``WarmStart.from_report``).
        """
        return [
            body.stepper.advance(state, memory, targets, dt)[2]
            for body, state, memory, targets in zip(self.bodies, states, memories, objectives, strict=True)
        ]
