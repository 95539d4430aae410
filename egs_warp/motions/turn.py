"""Turn by an asked angle in as few twists as friction allows (DESIGN 9)."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import Objective, SpinObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.jump import JumpPhase, JumpTarget
from egs_warp.motions.sequence import Place
from egs_warp.motions.stance import Ground, PoseFamily
from egs_warp.motions.twist import AIRBORNE_SHARE, Twist

TOLERANCE = np.radians(8.0)
"""A body that has landed this near to its angle stays."""
MOST_JUMPS = 5
PYRAMID = 0.79
"""Mean over all directions of what a friction pyramid of four edges gives of Coulomb's cone."""
RESERVE = 0.8
"""Part of what friction could do at most that one jump is asked for."""


class Turn:
    """Twists by ``turn`` radians in all that end ``target.distance`` ahead; what one leaves, the next ones make up."""

    def __init__(self, place: Place, target: JumpTarget, turn: float) -> None:
        self._place, self._height = place, target.height
        self._goal = place.ground.origin + target.distance * place.ground.axes[0]
        self._left = turn
        first = Twist(place, target, turn)
        self.most_in_a_jump = RESERVE * largest_turn(first, place)
        self._one_jump = abs(turn) <= self.most_in_a_jump
        self.jumps = [first if self._one_jump else Twist(place, target, self._share())]

    @property
    def phase(self) -> JumpPhase:
        """That of the present jump."""
        return self.jumps[-1].phase

    @property
    def pose(self) -> PoseFamily:
        """The family of poses of the present jump."""
        return self.jumps[-1].pose

    @property
    def ground(self) -> Ground:
        """The frame of the present jump."""
        return self.jumps[-1].ground

    def planned(self) -> dict[str, float]:
        """What the first jump aims at, and how many there were."""
        return {**self.jumps[0].planned(), "jumps": float(len(self.jumps))}

    def notes(self) -> list[str]:
        """What kept the turn from its target, for the user."""
        notes = [note for jump in self.jumps for note in jump.notes()]
        if not self._one_jump:
            notes.append(f"friction gives a turn of {np.degrees(self.most_in_a_jump):.0f} degrees a jump")
        if len(self.jumps) > 1:
            notes.append(f"turned in {len(self.jumps)} jumps")
        return notes

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[Objective | SpinObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        result = self.jumps[-1].objectives(state, report, dt)
        if self.phase is JumpPhase.REST and len(self.jumps) < MOST_JUMPS:
            jump = self.jumps[-1]
            left = self._left - jump.turn + jump.left(state)
            if abs(left) > TOLERANCE:
                self._left = left
                self.jumps.append(self._again(state))
                result = self.jumps[-1].objectives(state, report, dt)
        return result

    def _share(self) -> float:
        """One of the equal jumps that what is left takes, radians."""
        return self._left / float(np.ceil(abs(self._left) / self.most_in_a_jump))

    def _again(self, state: BodyState) -> Twist:
        place = self._place.now(state.positions)
        way = self._goal - place.ground.origin
        distance = float(np.linalg.norm(place.ground.axes[:2] @ way))
        if distance > 0.02 * place.body.height:
            place = place.facing(way)
        else:
            distance = 0.0
        return Twist(place, JumpTarget(distance, self._height), self._share())


def largest_turn(twist: Twist, place: Place) -> float:
    """Radians that friction under the feet could turn the body by in one jump as planned (DESIGN 9).

    Its impulse is mu r_eff times that of the normal forces, m (v_z + g t), r_eff the mean distance of the feet from
    their middle.
    """
    plan, body, up = twist.plan, place.body, place.ground.axes[2]
    arms = (place.touching - place.touching.mean(axis=0)) @ place.ground.axes[:2].T
    # Points are denser at the rim of a sole; over a disc the mean distance is 2/3 of the radius.
    lever = min(float(np.linalg.norm(arms, axis=1).mean()), 2.0 / 3.0 * float(np.linalg.norm(arms, axis=1).max()))
    impulse = body.mass * (plan.speed_up + twist.gravity * plan.thrust_time)
    rate = PYRAMID * place.friction * lever * impulse / float(up @ body.inertia(place.standing) @ up)
    return rate * AIRBORNE_SHARE * plan.flight_time
