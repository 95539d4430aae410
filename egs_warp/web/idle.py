"""Between two motions: a body lies where it fell, or tells how it stands."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.sequence import Stance

_MAX_STILL_SPEED = 2e-3
"""sqrt(g H): a body whose nodes move no faster, root mean square, and that has nothing to do, is left at rest, without
steps."""
_MIN_STILL_TIME = 0.3
"""Seconds for which that holds first."""


class RelaxMuscles:
    """Relaxes its muscles."""

    @property
    def is_at_rest(self) -> bool:
        """Always."""
        return True

    def notes(self) -> list[str]:
        """None: it has no target."""
        return []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """None."""
        return []


class StillnessDetector:
    """Since when a body has been still."""

    def __init__(self) -> None:
        self._since: float | None = None

    def update(self, body: SoftBody, state: BodyState) -> None:
        """The state after a step."""
        speed = np.sqrt(body.node_mass @ (state.velocities**2).sum(axis=1) / body.mass)
        if speed > _MAX_STILL_SPEED * body.speed_unit:
            self._since = None
        elif self._since is None:
            self._since = state.time

    def is_still(self, state: BodyState) -> bool:
        """Whether it has been still long enough, at the time of ``state``, to be left at rest."""
        return self._since is not None and state.time - self._since >= _MIN_STILL_TIME

    def reset(self) -> None:
        """It begins anew."""
        self._since = None


def tilt_degrees(place: Stance, positions: np.ndarray) -> float:
    """How far nodes at ``positions`` (N, 3) are from upright, as the body stands at ``place``."""
    turn = place.body.best_fit_rotation(positions) @ place.body.best_fit_rotation(place.standing).T
    up = place.ground.axes[2]
    return float(np.degrees(np.arccos(np.clip(up @ turn @ up, -1.0, 1.0))))
