"""Which way a jump faces on its way; ``twist`` has the one that turns."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.motions.stance import PoseFamily


class Facing(Protocol):
    """What a jump asks about its turning; angles in radians about up, counter-clockwise from above."""

    turn: float
    """From the start to the landing."""
    turned: float
    """From the start until now, counted beyond whole turns."""
    lands_at: float
    """What ``turned`` will be at touch-down, as the body flies; told by ``airborne_pose``."""

    def see(self, heading: float) -> None:
        """Told before each step: how the body faces, from the start, whole turns apart."""
        ...

    def thrust_spin(self, tilt: np.ndarray, state: BodyState, up: np.ndarray, flight_time: float) -> np.ndarray:
        """(3,) rad/s to ask for during the thrust, where ``tilt`` (3,) is what an upright landing takes after
        ``flight_time`` s."""
        ...

    def airborne_pose(self, pose: np.ndarray, momentum: np.ndarray, up: np.ndarray, left: float) -> np.ndarray:
        """(3, 3) ``pose`` (3, 3) for a body with angular ``momentum`` (3,), ``left`` seconds before it lands."""
        ...

    def landed_heading(self, pose: PoseFamily, positions: np.ndarray) -> float:
        """How the body that has landed with its nodes at ``positions`` (N, 3) shall face, from the landing of
        ``pose``."""
        ...


class Straight:
    """Lands facing as it stood."""

    turn = 0.0
    turned = 0.0
    lands_at = 0.0

    def see(self, heading: float) -> None:
        """Nothing depends on it."""

    def thrust_spin(self, tilt: np.ndarray, state: BodyState, up: np.ndarray, flight_time: float) -> np.ndarray:
        """``tilt`` alone."""
        return tilt

    def airborne_pose(self, pose: np.ndarray, momentum: np.ndarray, up: np.ndarray, left: float) -> np.ndarray:
        """``pose`` as it is."""
        return pose

    def landed_heading(self, pose: PoseFamily, positions: np.ndarray) -> float:
        """Straight ahead."""
        return 0.0
