"""Hops: a series of jumps to targets on the ground; each jump is planned from the landing of the previous one.

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
from egs_warp.motions.landing import check_landing
from egs_warp.motions.sequence import MotionTask, Stance
from egs_warp.motions.stance import sole_shares


@dataclass(frozen=True)
class HopOutcome:
    """Measured result of a hop."""

    target_error: float
    """Distance from the middle of the feet to the target at the end, relative to the requested length of the jump."""


class Hop:
    """Jump in which the body steers its feet to a point on the ground."""

    def __init__(self, stance: Stance, square: np.ndarray, height: float, *, is_followed: bool = False) -> None:
        """Create the hop of the body that stands at ``stance``.

        Args:
            stance: stance at the start.
            square: (3,) m, target position of the middle of the feet.
            height: rise of the centre of mass, m.
            is_followed: True if another hop follows, see ``Jump``.

        Raises:
            TargetError: the ground ends where the body would land.
        """
        offset = square - sole_shares(stance.body, stance.ground, stance.standing) @ stance.standing
        stance = stance.with_forward(offset)
        forward, _, rise = stance.ground.axes @ offset
        target = JumpTarget(float(forward), height + max(float(rise), 0.0), float(rise))
        self.jump, self.square = Jump(stance, target, is_followed=is_followed), square
        check_landing(stance, self.jump.target)
        self._distance = target.distance
        shortfall = target.distance - self.jump.target.distance
        self.planned_square = square - shortfall * stance.ground.axes[0]
        """(3,) m, place before the ``square`` where the feet land if the jump is shorter than requested."""
        self._feet = sole_shares(stance.body, stance.ground, stance.standing)

    @property
    def expected_time(self) -> float:
        """Expected duration of the jump, s."""
        return self.jump.expected_time

    @property
    def is_at_rest(self) -> bool:
        """True if the body has landed and is at rest, or is balanced and another hop follows."""
        return self.jump.is_at_rest

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the jump."""
        return self.jump.objectives(state, report, dt)

    def plan_record(self) -> JumpPlan:
        """Return the plan of the jump."""
        return self.jump.plan

    def planned_com(self, elapsed: float) -> np.ndarray:
        """Return the planned displacement of the jump; see ``Jump.planned_com``."""
        return self.jump.planned_com(elapsed)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> HopOutcome:
        """Measure the error of the landing."""
        return HopOutcome(self.miss(trajectory.positions[last]) / self._distance)

    def notes(self) -> list[str]:
        """Return messages for the user about phases that took too long."""
        return self.jump.notes()

    def miss(self, positions: np.ndarray) -> float:
        """Return the distance in metres along the ground from the middle of the feet to the target."""
        off = self._feet @ positions - self.square
        up = self.jump.ground.axes[2]
        return float(np.linalg.norm(off - (off @ up) * up))


class HopTargets:
    """Series of targets relative to the stance of the first hop, so that errors of the hops do not accumulate. After a
    hop that is planned shorter than requested, the targets continue from its planned landing."""

    def __init__(
        self, distance: float, height: float, count: int, values: Mapping[str, float], *, pauses: bool = False
    ) -> None:
        """Create the targets.

        Args:
            distance: distance between consecutive targets, m.
            height: height of each jump, m.
            count: number of targets.
            values: requested values by name, for the report.
            pauses: True if the body comes to rest between two hops. Otherwise, the crouch of the next hop begins as
                soon as the landed body is balanced.
        """
        self.distance, self.height, self.count, self.values = distance, height, count, values
        self._pauses = pauses
        self._first: np.ndarray | None = None
        self._direction = np.zeros(3)
        self._clearance = 0.0
        self._previous: Hop | None = None

    def parts(self) -> list[MotionTask]:
        """Return the hops as tasks of a sequence."""
        return [
            MotionTask("hop", {**self.values, "square": float(k)}, lambda stance, k=k: self._begin(stance, k))
            for k in range(1, self.count + 1)
        ]

    def _begin(self, stance: Stance, number: int) -> Hop:
        if self._first is None:
            share = sole_shares(stance.body, stance.ground, stance.standing)
            self._first = share @ stance.standing
            self._direction = stance.ground.axes[0]
            # The middle of the feet is a little above the ground; the targets keep this clearance.
            self._clearance = -stance.surface_height_above(self._first)
        elif self._previous is not None:
            self._first = self._first + self._previous.planned_square - self._previous.square
        assert self._first is not None
        square = self._first + number * self.distance * self._direction
        rise = stance.surface_height_above(square) + self._clearance
        is_followed = number < self.count and not self._pauses
        square = square + rise * stance.ground.axes[2]
        self._previous = None
        self._previous = Hop(stance, square, self.height, is_followed=is_followed)
        return self._previous
