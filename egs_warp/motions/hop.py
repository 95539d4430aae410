"""Hops: jumps in a row, each to its own square, aimed from where the one before has landed.

See docs/concepts/motions.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPlan, JumpTarget
from egs_warp.motions.sequence import MotionTask, Stance
from egs_warp.motions.stance import sole_shares


@dataclass(frozen=True)
class HopOutcome:
    """How near a hop came to its square."""

    target_error: float
    """From the middle of the feet to that of the square at the end, in lengths of the jump."""


class Hop:
    """A jump whose feet aim at a point of the ground."""

    def __init__(self, place: Stance, square: np.ndarray, height: float) -> None:
        """``square`` (3,): where the middle of the feet shall land; ``height``: rise of the centre of mass, both
        metres."""
        way = square - sole_shares(place.body, place.ground, place.standing) @ place.standing
        place = place.with_forward(way)
        forward, _, rise = place.ground.axes @ way
        target = JumpTarget(float(forward), height + max(float(rise), 0.0), float(rise))
        self.jump, self.square = Jump(place, target), square
        self._feet = sole_shares(place.body, place.ground, place.standing)

    @property
    def expected_time(self) -> float:
        """That of the jump."""
        return self.jump.expected_time

    @property
    def is_at_rest(self) -> bool:
        """Whether the jump is at rest."""
        return self.jump.resting

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Those of the jump."""
        return self.jump.objectives(state, report, dt)

    def plan_record(self) -> JumpPlan:
        """What the jump aims at."""
        return self.jump.plan

    def planned_com(self, elapsed: float) -> np.ndarray:
        """That of the jump."""
        return self.jump.planned_com(elapsed)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> HopOutcome:
        """How near the feet came to the square."""
        return HopOutcome(self.miss(trajectory.positions[last]) / self.jump.target.distance)

    def notes(self) -> list[str]:
        """What kept the jump from its target, for the user."""
        return self.jump.notes()

    def miss(self, positions: np.ndarray) -> float:
        """Metres from the middle of the feet to the middle of the square, along the ground."""
        off = self._feet @ positions - self.square
        up = self.jump.ground.axes[2]
        return float(np.linalg.norm(off - (off @ up) * up))


class HopTargets:
    """A row of squares ahead of a place; made when the first hop begins, so that later ones do not add up their
    errors."""

    def __init__(self, distance: float, height: float, count: int, asked: Mapping[str, float]) -> None:
        """``distance`` from square to square and ``height`` of each jump in metres; ``asked`` is what a report says."""
        self.distance, self.height, self.count, self.asked = distance, height, count, asked
        self._first: np.ndarray | None = None
        self._way = np.zeros(3)
        self._clearance = 0.0

    def parts(self) -> list[MotionTask]:
        """The hops, for a sequence."""
        return [
            MotionTask("hop", {**self.asked, "square": float(k)}, lambda place, k=k: self._begin(place, k))
            for k in range(1, self.count + 1)
        ]

    def _begin(self, place: Stance, number: int) -> Hop:
        if self._first is None:
            share = sole_shares(place.body, place.ground, place.standing)
            self._first = share @ place.standing
            self._way = place.ground.axes[0]
            # The middle of the feet is a little above what they stand on.
            self._clearance = -place.surface_height_above(self._first)
        square = self._first + number * self.distance * self._way
        rise = place.surface_height_above(square) + self._clearance
        return Hop(place, square + rise * place.ground.axes[2], self.height)
