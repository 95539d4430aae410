"""Turn by an asked angle: a twist, and smaller ones after it while the body faces more than a little off (DESIGN 9)."""

from __future__ import annotations

import numpy as np

from egs_warp.body import BodyState
from egs_warp.locomotion import StepReport
from egs_warp.motions import JumpPhase, JumpTarget
from egs_warp.objectives import Objective, SpinObjective
from egs_warp.sequence import Place
from egs_warp.twist import Twist

TOLERANCE = np.radians(8.0)
"""A body that has landed this near to its angle stays."""
MOST_JUMPS = 4


class Turn:
    """A twist by ``turn`` radians that ends ``target.distance`` ahead; what one jump leaves, the next ones make up."""

    def __init__(self, place: Place, target: JumpTarget, turn: float) -> None:
        self._place, self._height = place, target.height
        self._left = turn
        self._goal = place.ground.origin + target.distance * place.ground.axes[0]
        self.jumps = [Twist(place, target, turn)]

    @property
    def phase(self) -> JumpPhase:
        """That of the present jump."""
        return self.jumps[-1].phase

    @property
    def pose(self):
        """The family of poses of the present jump."""
        return self.jumps[-1].pose

    @property
    def ground(self):
        """The frame of the present jump."""
        return self.jumps[-1].ground

    def planned(self) -> dict[str, float]:
        """What the first jump aims at, and how many there were."""
        return {**self.jumps[0].planned(), "jumps": float(len(self.jumps))}

    def notes(self) -> list[str]:
        """What kept the turn from its target, for the user."""
        notes = [note for jump in self.jumps for note in jump.notes()]
        if len(self.jumps) > 1:
            notes.append(f"turned in {len(self.jumps)} jumps: the first was {np.degrees(self._left):.0f} degrees short")
        return notes

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[Objective | SpinObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        result = self.jumps[-1].objectives(state, report, dt)
        if self.phase is JumpPhase.REST and len(self.jumps) < MOST_JUMPS:
            left = self.jumps[-1].left(state)
            if abs(left) > TOLERANCE:
                if len(self.jumps) == 1:
                    self._left = left
                self.jumps.append(self._again(state, left))
                result = self.jumps[-1].objectives(state, report, dt)
        return result

    def _again(self, state: BodyState, left: float) -> Twist:
        place = self._place.now(state.positions)
        way = self._goal - place.ground.origin
        distance = float(np.linalg.norm(place.ground.axes[:2] @ way))
        if distance > 0.02 * place.body.height:
            place = place.facing(way)
        else:
            distance = 0.0
        return Twist(place, JumpTarget(distance, self._height), left)
