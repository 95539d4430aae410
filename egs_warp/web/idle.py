"""States of an idle live body, which is relaxed after a fall or stands still; and the tilt of a body."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.sequence import Stance

_MAX_STILL_SPEED = 2e-3
"""Root mean square speed of the nodes below which an idle body is still, sqrt(g H); a still body is not simulated."""
_MIN_STILL_TIME = 0.3
"""Time for which the speed must be below ``_MAX_STILL_SPEED``, s."""


class RelaxMuscles:
    """Motion of a fallen body: all muscles are relaxed."""

    @property
    def is_at_rest(self) -> bool:
        """True: a relaxed body has no task to complete."""
        return True

    def notes(self) -> list[str]:
        """Return no notes: the motion has no target."""
        return []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return no objectives."""
        return []


class StillnessDetector:
    """Detector of bodies that have been still for some time."""

    def __init__(self) -> None:
        self._since: float | None = None

    def update(self, body: SoftBody, state: BodyState) -> None:
        """Update the detector with the state after a step."""
        speed = np.sqrt(body.node_mass @ (state.velocities**2).sum(axis=1) / body.mass)
        if speed > _MAX_STILL_SPEED * body.speed_unit:
            self._since = None
        elif self._since is None:
            self._since = state.time

    def is_still(self, state: BodyState) -> bool:
        """Return True if, at the time of ``state``, the body has been still for ``_MIN_STILL_TIME``."""
        return self._since is not None and state.time - self._since >= _MIN_STILL_TIME

    def reset(self) -> None:
        """Restart the detection."""
        self._since = None


def tilt_degrees(place: Stance, positions: np.ndarray) -> float:
    """Return the angle between the up axes of the body and of its stance ``place``, degrees.

    Args:
        place: upright stance.
        positions: (N, 3) m, nodes of the tilted body.
    """
    rotation = place.body.best_fit_rotation(positions) @ place.body.best_fit_rotation(place.standing).T
    up = place.ground.axes[2]
    return float(np.degrees(np.arccos(np.clip(up @ rotation @ up, -1.0, 1.0))))
