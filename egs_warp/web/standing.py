"""Between two motions: a body lies where it fell, or tells how it stands."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.sequence import Place


class Lie:
    """Relaxes its muscles."""

    @property
    def resting(self) -> bool:
        """Always."""
        return True

    def notes(self) -> list[str]:
        """None: it has no target."""
        return []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """None."""
        return []


def tilt_degrees(place: Place, positions: np.ndarray) -> float:
    """How far nodes at ``positions`` (N, 3) are from upright, as the body stands at ``place``."""
    turn = place.body.best_fit_rotation(positions) @ place.body.best_fit_rotation(place.standing).T
    up = place.ground.axes[2]
    return float(np.degrees(np.arccos(np.clip(up @ turn @ up, -1.0, 1.0))))
