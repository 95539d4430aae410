"""A jump to a place: from take-off on it is told in the frame of the landing, which may be turned, higher or lower."""

from __future__ import annotations

import numpy as np

from egs_warp.motions import Jump, JumpPhase, JumpTarget
from egs_warp.sequence import Place
from egs_warp.stance import Ground, Measurement, PoseFamily, Weights

CALM = 0.03
"""Speed of the centre of mass, in sqrt(g H), below which a body that has landed is at rest."""


class Leap(Jump):
    """A jump that lands ``target.distance`` ahead, turned by ``turn`` radians, and rests as soon as the body is calm."""

    def __init__(
        self,
        place: Place,
        target: JumpTarget,
        *,
        turn: float = 0.0,
        lean: float | None = None,
        weights: Weights | None = None,
    ) -> None:
        super().__init__(
            place.body,
            place.ground,
            place.standing,
            target,
            touching=place.touching,
            step=place.step,
            weights=weights,
            lean=lean,
        )
        self.turn = turn
        ground = place.ground
        self._landing = Ground(
            ground.axes @ ground.turn(turn).T,
            ground.origin + target.distance * ground.axes[0] + target.rise * ground.axes[2],
            ground.surface_normal,
        )
        self._landing_pose = PoseFamily(
            place.body,
            self._landing,
            self._landing.world(ground.local(place.standing)),
            self._landing.world(ground.local(place.touching)),
        )
        self._calm_since: float | None = None

    @property
    def left_ground(self) -> bool:
        """Whether the motion is told in the frame of the landing."""
        return self.pose is self._landing_pose

    def _advance_phase(self, seen: Measurement, time: float, dt: float) -> None:
        super()._advance_phase(seen, time, dt)
        if self.phase is JumpPhase.FLIGHT and not self.left_ground:
            self.pose, self.ground = self._landing_pose, self._landing
            self._goal_base = self._start_base
        if self.phase is JumpPhase.LAND:
            if np.linalg.norm(seen.velocity) > CALM * np.sqrt(self.gravity * self.body.height):
                self._calm_since = None
            elif self._calm_since is None:
                self._calm_since = time
            elif time - self._calm_since > 0.3 * self._time_unit:
                self.phase = JumpPhase.REST
