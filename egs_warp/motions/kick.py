"""Kick: a jump that passes so close to another body that the base of the jumper strikes the upper part of the body and
knocks it over (docs/guide/worlds.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPlan, JumpTarget
from egs_warp.motions.landing import landing_of
from egs_warp.motions.other_body import OtherBody
from egs_warp.motions.sequence import JudgedOutcome, Stance, TargetError

_OVERLAP = 0.8
"""Distance from the path to the middle of the other body, relative to the distance at which its top and the base of the
jumper would just touch. On a path through the middle, the jumper would carry the other body along and land on it."""
_TOP = 0.6
"""Fraction of the other body's height above which its points belong to its upper part."""
_HIT_TILT, _HIT_DISTANCE = 5.0, 0.02
"""Tilt in degrees, or displacement in body heights of the jumper, from which the other body counts as hit."""


@dataclass(frozen=True)
class KickOutcome(JudgedOutcome):
    """Measured result of a kick."""

    tilt_of_other_degrees: float
    """Tilt of the other body at the end."""
    displacement_of_other: float
    """Displacement of the other body, in body heights of the jumper."""


class Kick:
    """Jump past another body and strike it on the way."""

    def __init__(self, stance: Stance, other: OtherBody, name: str, target: JumpTarget) -> None:
        """Create the kick of the body that stands at ``stance``.

        Args:
            stance: stance at the start.
            other: the body to strike.
            name: name of that body, for messages.
            target: distance and height of the jump, m.

        Raises:
            TargetError: if the other body is out of reach of the jump, or the ground ends where the body
                would land.
        """
        self.body, self._other, self._name = stance.body, other, name
        ground = stance.ground
        centre = other.centre(stance)
        points = ground.local(other.points())
        low, high = points[:, 2].min(), points[:, 2].max()
        top = points[points[:, 2] > low + _TOP * (high - low), :2] - centre
        own = ground.local(stance.contact_points)[:, :2]
        own_radius = float(np.linalg.norm(own - own.mean(axis=0), axis=1).max())
        offset = _OVERLAP * (own_radius + float(np.linalg.norm(top, axis=1).max()))
        distance, height = float(np.linalg.norm(centre)), stance.body.height

        def check_reach(reach: float) -> None:
            if not offset < distance < reach:
                raise TargetError(
                    f"kick: {name} is {distance / height:.2f} body heights away; walk or jump to a distance between"
                    f" {offset / height:.2f} and {reach / height:.2f}"
                )

        check_reach(target.distance)
        # The path passes to the right of the other body.
        angle = float(np.arctan2(centre[1], centre[0])) - float(np.arcsin(offset / distance))
        forward = np.array([np.cos(angle), np.sin(angle)]) @ ground.axes[:2]
        turned = stance.with_forward(forward)
        self.jump = Jump(turned, landing_of(turned, target))
        # The jump is shorter than requested if the body could not stop.
        check_reach(self.jump.target.distance)
        self._before = other.state().positions
        self._after = self._before
        self._tilt = 0.0

    @property
    def expected_time(self) -> float:
        """Expected duration of the jump, s."""
        return self.jump.expected_time

    @property
    def is_at_rest(self) -> bool:
        """True if the body has landed and is at rest."""
        return self.jump.is_at_rest

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the jump."""
        self._after, self._tilt = self._other.state().positions, self._other.tilt_from(self._before)
        return self.jump.objectives(state, report, dt)

    def plan_record(self) -> JumpPlan:
        """Return the plan of the jump."""
        return self.jump.plan

    def planned_com(self, elapsed: float) -> np.ndarray:
        """Return the planned displacement of the jump; see ``Jump.planned_com``."""
        return self.jump.planned_com(elapsed)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> KickOutcome:
        """Measure the tilt and the displacement of the other body."""
        moved = self._other.body.centre_of_mass(self._after) - self._other.body.centre_of_mass(self._before)
        displacement = float(np.linalg.norm(moved)) / self.body.height
        is_hit = self._tilt > _HIT_TILT or displacement > _HIT_DISTANCE
        return KickOutcome(() if is_hit else (f"{self._name} was not hit",), self._tilt, displacement)

    def notes(self) -> list[str]:
        """Return messages for the user about phases that took too long."""
        return self.jump.notes()
