"""Jump that lands in a low crouch and holds it, with the head up, before the body stands up
(docs/motions/gestures.md)."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.act import Act, ActOutcome
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPlan, JumpTarget
from egs_warp.motions.landing import landing_of
from egs_warp.motions.poses import landed_pose
from egs_warp.motions.sequence import Stance

_MIN_DEPTH, _MAX_DEPTH, _DEPTH_PER_LENGTH = 0.1, 0.3, 0.5
"""Limits of the depth of the crouch, as fractions of the height of the centre of mass, and the ratio of this fraction
to the length of the feet in body heights. A crouching body on short feet has no reserve of balance: a robot, whose feet
are 0.16 body heights long, falls with 0.2, and a monkey (0.39) with 0.24."""


class LandAndPose:
    """Jump, then hold the pose of the landing for ``seconds``, then stand up."""

    def __init__(self, stance: Stance, target: JumpTarget, seconds: float) -> None:
        """Create the motion of the body that stands at ``stance``.

        Raises:
            UserError: for a body that lies along the ground or rolls.
        """
        self._stance, self._seconds = stance, seconds
        self.jump = Jump(stance, landing_of(stance, target))
        share = float(np.clip(_DEPTH_PER_LENGTH * self.jump.support_length, _MIN_DEPTH, _MAX_DEPTH))
        self._depth = share * self.jump.landing_height
        self.jump.landing_height -= self._depth
        self._pose: Act | None = None
        self._length = landed_pose(stance, self._depth, seconds).duration

    @property
    def is_at_rest(self) -> bool:
        """True if the body stands at rest again."""
        return self._pose is not None and self._pose.is_at_rest

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds until the body is at rest."""
        return self.jump.expected_time + self._length

    def plan_record(self) -> JumpPlan:
        """Return the plan of the jump."""
        return self.jump.plan

    def planned_com(self, elapsed: float) -> np.ndarray:
        """Return the planned displacement of the jump; see ``Jump.planned_com``."""
        return self.jump.planned_com(elapsed)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> ActOutcome | None:
        """Return the measured pose; None if the body has not landed."""
        return None if self._pose is None else self._pose.outcome_record(trajectory, first, last)

    def notes(self) -> list[str]:
        """Return messages for the user about phases that took too long."""
        return self.jump.notes()

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        if self._pose is None and self.jump.is_at_rest:
            stance = self._stance.next_stance(state.positions, report)
            self._pose = Act(stance, [(0.0, landed_pose(stance, self._depth, self._seconds))])
        return (self.jump if self._pose is None else self._pose).objectives(state, report, dt)
