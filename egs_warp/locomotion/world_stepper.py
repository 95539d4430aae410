"""The stepper of a world of several bodies on a common ground (docs/concepts/bodies.md).

Bodies that may touch each other in a step form an island. An island of one body is stepped by its own
``LocomotionStepper``, a larger one by an ``IslandStepper``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from egs_warp.contact.islands import find_islands
from egs_warp.contact.pair_contact import PairBody, PairContactDetector
from egs_warp.fem.body import BodyState
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.island_stepper import IslandStepper
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport, WarmStart
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.meshing.level_set import LevelSet
from egs_warp.short_repr import short_repr


@dataclass(frozen=True)
class WorldBody:
    """A body of a world. All bodies are in the same frame and on the same ground."""

    __repr__ = short_repr

    stepper: LocomotionStepper
    """Body, muscles and contact with the ground; a prop has no muscles."""
    level_set: LevelSet
    """Level set of the captured shape."""
    rest_positions: np.ndarray
    """(N, 3) m, nodes of the cage at rest in the frame of the level set."""


class WorldStepper:
    """Stepper of the bodies of one world."""

    def __init__(self, bodies: Sequence[WorldBody], *, frictions: np.ndarray | None = None) -> None:
        """Make the stepper of k bodies.

        Args:
            bodies: the bodies; the Coulomb coefficient of each with the ground is that of its contact geometry.
            frictions: (k, k) Coulomb coefficients between the bodies, symmetric; None takes the geometric mean of their
                coefficients with the ground.
        """
        self.bodies = tuple(bodies)
        with_ground = np.array([body.stepper.geometry.friction for body in bodies])
        self.frictions = np.sqrt(np.outer(with_ground, with_ground)) if frictions is None else np.asarray(frictions)
        """(k, k) Coulomb coefficients between the bodies."""
        self.pairs = PairContactDetector(
            [
                PairBody(body.stepper.geometry, body.stepper.selector, body.level_set, body.rest_positions)
                for body in bodies
            ],
            device="cpu",
        )
        """Contact between the bodies."""
        self._islands: dict[tuple[int, ...], IslandStepper] = {}

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
            the state at the end and the warm start of the next step (``WarmStart.from_report``). The contacts of a
            report include those with other bodies (``IslandStepper``); their faces are negative.
        """
        done: list[list[StepReport]] = [[] for _ in self.bodies]
        for members in self.islands(states, dt):
            if len(members) == 1:
                body = members[0]
                memory = _with_ground_only(memories[body], self.pairs.point_counts[body])
                _, _, done[body] = self.bodies[body].stepper.advance(states[body], memory, objectives[body], dt)
                continue
            with one_blas_thread():
                reports = self._island(members).advance(
                    [states[i] for i in members], [memories[i] for i in members], [objectives[i] for i in members], dt
                )
            for body, each in zip(members, reports, strict=True):
                done[body] = each
        return done

    def islands(self, states: Sequence[BodyState], dt: float) -> list[tuple[int, ...]]:
        """Return the islands of a step of ``dt`` s: bodies whose inflated boxes overlap at the end of a ballistic
        motion, or are connected by such overlaps; in the order of their first bodies."""
        ends = [
            StepProblem(body.stepper.body, state, dt).ballistic_positions
            for body, state in zip(self.bodies, states, strict=True)
        ]
        overlaps = self.pairs.body_pairs(np.concatenate(ends))
        roots = find_islands(len(self.bodies), np.array(overlaps, int).reshape(-1, 2))
        return [tuple(np.flatnonzero(roots == root).tolist()) for root in np.unique(roots)]

    def _island(self, members: tuple[int, ...]) -> IslandStepper:
        if members not in self._islands:
            steppers = [self.bodies[i].stepper for i in members]
            self._islands[members] = IslandStepper(
                members, steppers, self.pairs.subset(members), self.frictions[np.ix_(members, members)]
            )
        return self._islands[members]


def _with_ground_only(memory: WarmStart, point_count: int) -> WarmStart:
    """Return the warm start without contacts with other bodies, for a body with ``point_count`` contact points."""
    on_ground = (memory.points >= 0) & (memory.points < point_count)
    if on_ground.all():
        return memory
    return replace(memory, points=memory.points[on_ground], forces=memory.forces[on_ground])
