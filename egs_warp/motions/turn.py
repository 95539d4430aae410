"""Turn by a given angle, in as few jumps as friction allows (docs/concepts/motions.md)."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPhase, JumpPlan, JumpTarget
from egs_warp.motions.landing import landing_of
from egs_warp.motions.sequence import Stance, TargetError
from egs_warp.motions.twist import AIRBORNE_FRACTION

HEADING_TOLERANCE = np.radians(8.0)
"""Maximum heading error in radians of a landing after which no further jump follows."""
MAX_JUMPS = 5
CORRECTION_RATE = 1.0 / 3.0
"""Fraction of the jumps with the largest turn after which another jump is needed, because the heading error exceeds
``HEADING_TOLERANCE``."""
PYRAMID_FRICTION_RATIO = 0.79
"""Ratio of the maximum tangential force of a friction pyramid with four edges to that of Coulomb's cone, averaged over
all directions."""
MAX_TURN_FRACTION = 0.8
"""Fraction of the largest possible turn that is requested from one jump."""


@dataclass(frozen=True)
class TurnPlan(JumpPlan):
    """Plan of the first jump of a turn, and the number of jumps so far."""

    jumps: float


class Turn:
    """Turn by ``turn`` radians in jumps, of which the last lands ``target.distance`` ahead of the start; each jump
    corrects the errors of the previous ones. ``message`` is a message for the user, the first of ``notes``; none if it
    is empty."""

    def __init__(self, stance: Stance, target: JumpTarget, turn: float, *, message: str = "") -> None:
        self._stance, self._height, self._message = stance, target.height, message
        self._goal = stance.ground.origin + target.distance * stance.ground.axes[0]
        self._remaining_turn = turn
        self._remaining_after_jump: float | None = None
        """Predicted or measured turn, in radians, that remains after the current jump; None before the body is in the
        air."""
        first = Jump(stance, landing_of(stance, target), turn=turn)
        self.max_turn_per_jump = MAX_TURN_FRACTION * largest_turn(first, stance)
        self._one_jump = abs(turn) <= self.max_turn_per_jump
        self.jumps = [first if self._one_jump else self._twist(stance, target)]

    @property
    def expected_time(self) -> float:
        """Expected duration, in seconds, of the jumps so far and of further jumps for the remaining turn."""
        before, at_once = len(self.jumps) - 1, self.max_turn_per_jump
        if self._remaining_after_jump is None:
            # A small turn, such as the correction of a landing, needs no further correction.
            share = abs(self._remaining_turn) / at_once
            count = before + np.ceil(share) + CORRECTION_RATE * min(share, 1.0)
        else:
            further = np.ceil(abs(self._remaining_after_jump) / at_once)
            count = before + 1 + further * self._chance_of_another(abs(self._remaining_after_jump))
        return float(min(count, MAX_JUMPS)) * self.jumps[0].expected_time

    def _chance_of_another(self, missing: float) -> float:
        """Return the probability of another jump if a turn of ``missing`` radians is predicted to remain. The
        prediction is uncertain while the body is in the air, and less so while the feet slide after the landing."""
        jump, share = self.jumps[-1], missing / HEADING_TOLERANCE
        if jump.phase is JumpPhase.FLIGHT:
            return min(0.5 * share, 1.0)
        if jump.phase is JumpPhase.LAND and 0.5 < share < 1.5:
            return CORRECTION_RATE
        return float(missing > HEADING_TOLERANCE)

    @property
    def is_at_rest(self) -> bool:
        """True if the body has landed from the current jump and is at rest."""
        return self.jumps[-1].is_at_rest

    def plan_record(self) -> TurnPlan:
        """Return the plan of the first jump, and the number of jumps."""
        return TurnPlan(**asdict(self.jumps[0].plan), jumps=float(len(self.jumps)))

    def planned_com(self, elapsed: float) -> np.ndarray:
        """Return the planned displacement of the first jump; later jumps depend on its error."""
        return self.jumps[0].planned_com(elapsed)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> None:
        """Return None: a jump has no quantities of its own beyond those measured for all motions."""

    def notes(self) -> list[str]:
        """Return messages for the user about missed targets and the number of jumps."""
        notes = [self._message] * bool(self._message) + [note for jump in self.jumps for note in jump.notes()]
        if not self._one_jump:
            most = np.degrees(self.max_turn_per_jump)
            notes.append(f"one jump turns the body by at most {most:.0f} degrees, or the feet would slip")
        if len(self.jumps) > 1:
            notes.append(f"turned in {len(self.jumps)} jumps")
        return notes

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        result = self.jumps[-1].objectives(state, report, dt)
        jump = self.jumps[-1]
        self._remaining_after_jump = (
            self._remaining_turn - jump.predicted_heading if jump.phase is JumpPhase.FLIGHT else None
        )
        if jump.phase in (JumpPhase.LAND, JumpPhase.REST):
            # The frame of a landed jump is rotated by the requested turn, so the heading of the feet relative to this
            # frame is the error.
            self._remaining_after_jump = (
                self._remaining_turn - jump.target_heading - jump.controller.sole_heading(state.positions)
            )
            if jump.is_at_rest and len(self.jumps) < MAX_JUMPS and abs(self._remaining_after_jump) > HEADING_TOLERANCE:
                self._remaining_turn, self._remaining_after_jump = self._remaining_after_jump, None
                self.jumps.append(self._next_jump(state))
                result = self.jumps[-1].objectives(state, report, dt)
        return result

    def _next_turn(self) -> float:
        """Return the turn in radians of the next jump; the remaining turn is divided equally among as few jumps as
        possible."""
        return self._remaining_turn / float(np.ceil(abs(self._remaining_turn) / self.max_turn_per_jump))

    def _twist(self, stance: Stance, target: JumpTarget) -> Jump:
        return Jump(stance, landing_of(stance, target), turn=self._next_turn())

    def _next_jump(self, state: BodyState) -> Jump:
        stance = self._stance.moved_to(state.positions)
        offset = self._goal - stance.ground.origin
        distance = float(np.linalg.norm(stance.ground.axes[:2] @ offset))
        if distance > 0.02 * stance.body.height:
            # At an edge of the ground, the rotated base may lack support at the goal; in this case, jump on the spot.
            with suppress(TargetError):
                return self._twist(stance.with_forward(offset), JumpTarget(distance, self._height))
        return self._twist(stance, JumpTarget(0.0, self._height))


def largest_turn(jump: Jump, stance: Stance) -> float:
    """Return the largest turn in radians that friction under the feet allows in the planned jump
    (docs/concepts/motions.md).

    The angular impulse of friction about the up axis is mu r_eff times the impulse of the normal forces, m (v_z + g t);
    r_eff is the mean distance of the contact points from their middle.
    """
    plan, body, up = jump.plan, stance.body, stance.ground.axes[2]
    arms = (stance.contact_points - stance.contact_points.mean(axis=0)) @ stance.ground.axes[:2].T
    # Contact points are denser at the rim of a sole, so limit the mean distance to that of a disc, 2/3 of the radius.
    lever = min(float(np.linalg.norm(arms, axis=1).mean()), 2.0 / 3.0 * float(np.linalg.norm(arms, axis=1).max()))
    impulse = body.mass * (plan.speed_up + jump.gravity * plan.thrust_time)
    rate = PYRAMID_FRICTION_RATIO * stance.friction * lever * impulse / float(up @ body.inertia(stance.standing) @ up)
    return rate * AIRBORNE_FRACTION * plan.flight_time
