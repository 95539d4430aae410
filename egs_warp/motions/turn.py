"""Turn by an asked angle in as few twists as friction allows (docs/concepts/motions.md)."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPhase, JumpPlan, JumpTarget
from egs_warp.motions.sequence import Stance
from egs_warp.motions.twist import AIRBORNE_SHARE, twist

TOLERANCE = np.radians(8.0)
"""A body that has landed this near to its angle stays."""
MOST_JUMPS = 5
USUAL_JUMPS = 4.0 / 3.0
"""Expected for what one should do: so often is a landing further off than ``TOLERANCE``, which takes another."""
PYRAMID = 0.79
"""Mean over all directions of what a friction pyramid of four edges gives of Coulomb's cone."""
RESERVE = 0.8
"""Part of what friction could do at most that one jump is asked for."""


@dataclass(frozen=True)
class TurnPlan(JumpPlan):
    """The plan of the first jump of a turn, and how many there were."""

    jumps: float


class Turn:
    """Twists by ``turn`` radians in all that end ``target.distance`` ahead; what one leaves, the next ones make up."""

    def __init__(self, place: Stance, target: JumpTarget, turn: float) -> None:
        self._place, self._height = place, target.height
        self._goal = place.ground.origin + target.distance * place.ground.axes[0]
        self._left = turn
        self._missing: float | None = None
        """Radians that the present jump, once it is in the air, leaves of the turn."""
        first = twist(place, target, turn)
        self.most_in_a_jump = RESERVE * largest_turn(first, place)
        self._one_jump = abs(turn) <= self.most_in_a_jump
        self.jumps = [first if self._one_jump else twist(place, target, self._share())]

    @property
    def expected_time(self) -> float:
        """Seconds, of the jumps so far and of those that what is left of the turn takes."""
        before, at_once = len(self.jumps) - 1, self.most_in_a_jump
        if self._missing is None:
            # What makes up for a landing is a small turn, and hits.
            count = before + (1.0 if before else USUAL_JUMPS) * max(abs(self._left) / at_once, 1.0)
        else:
            further = np.ceil(abs(self._missing) / at_once)
            count = before + 1 + further * self._chance_of_another(abs(self._missing))
        return float(min(count, MOST_JUMPS)) * self.jumps[0].expected_time

    def _chance_of_another(self, missing: float) -> float:
        """Chance of another jump, by what is ``missing``; in the air, where it will land is not certain."""
        if self.jumps[-1].phase is JumpPhase.FLIGHT:
            return min(missing / (2.0 * TOLERANCE), 1.0)
        return float(missing > TOLERANCE)

    @property
    def is_at_rest(self) -> bool:
        """Whether the present jump is at rest."""
        return self.jumps[-1].resting

    def plan_record(self) -> TurnPlan:
        """What the first jump aims at, and how many there were."""
        return TurnPlan(**asdict(self.jumps[0].plan), jumps=float(len(self.jumps)))

    def planned_com(self, elapsed: float) -> np.ndarray:
        """That of the first jump; what the next ones make up is not known before."""
        return self.jumps[0].planned_com(elapsed)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> None:
        """Nothing beside what is measured of all motions."""

    def notes(self) -> list[str]:
        """What kept the turn from its target, for the user."""
        notes = [note for jump in self.jumps for note in jump.notes()]
        if not self._one_jump:
            notes.append(f"friction gives a turn of {np.degrees(self.most_in_a_jump):.0f} degrees a jump")
        if len(self.jumps) > 1:
            notes.append(f"turned in {len(self.jumps)} jumps")
        return notes

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        result = self.jumps[-1].objectives(state, report, dt)
        jump = self.jumps[-1]
        self._missing = self._left - jump.facing.predicted_heading if jump.phase is JumpPhase.FLIGHT else None
        if jump.phase in (JumpPhase.LAND, JumpPhase.REST):
            # The frame of a landed jump is turned by what was asked of it, so its feet tell what it fell short by.
            self._missing = self._left - jump.facing.target_heading - jump.pose.sole_heading(state.positions)
            if jump.resting and len(self.jumps) < MOST_JUMPS and abs(self._missing) > TOLERANCE:
                self._left, self._missing = self._missing, None
                self.jumps.append(self._again(state))
                result = self.jumps[-1].objectives(state, report, dt)
        return result

    def _share(self) -> float:
        """One of the equal jumps that what is left takes, radians."""
        return self._left / float(np.ceil(abs(self._left) / self.most_in_a_jump))

    def _again(self, state: BodyState) -> Jump:
        place = self._place.moved_to(state.positions)
        way = self._goal - place.ground.origin
        distance = float(np.linalg.norm(place.ground.axes[:2] @ way))
        if distance > 0.02 * place.body.height:
            place = place.with_forward(way)
        else:
            distance = 0.0
        return twist(place, JumpTarget(distance, self._height), self._share())


def largest_turn(jump: Jump, place: Stance) -> float:
    """Radians that friction under the feet could turn the body by in one jump as planned (docs/concepts/motions.md).

    Its impulse is mu r_eff times that of the normal forces, m (v_z + g t), r_eff the mean distance of the feet from
    their middle.
    """
    plan, body, up = jump.plan, place.body, place.ground.axes[2]
    arms = (place.contact_points - place.contact_points.mean(axis=0)) @ place.ground.axes[:2].T
    # Points are denser at the rim of a sole; over a disc the mean distance is 2/3 of the radius.
    lever = min(float(np.linalg.norm(arms, axis=1).mean()), 2.0 / 3.0 * float(np.linalg.norm(arms, axis=1).max()))
    impulse = body.mass * (plan.speed_up + jump.gravity * plan.thrust_time)
    rate = PYRAMID * place.friction * lever * impulse / float(up @ body.inertia(place.standing) @ up)
    return rate * AIRBORNE_SHARE * plan.flight_time
