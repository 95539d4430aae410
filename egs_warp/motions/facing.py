"""Which way a jump faces on its way; ``twist`` has the one that turns."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from egs_warp.motions.stance import BalanceController, Measurement


class HeadingPolicy(Protocol):
    """What a jump asks about its turning; angles in radians about up, counter-clockwise from above."""

    target_heading: float
    """From the start to the landing."""
    heading: float
    """From the start until now, counted beyond whole turns."""
    predicted_heading: float
    """What ``turned`` will be at touch-down, as the body flies; told by ``airborne_pose``."""

    def update(self, heading: float) -> None:
        """Told before each step: how the body faces, from the start, whole turns apart."""
        ...

    def thrust_momentum(
        self, pose: BalanceController, seen: Measurement, upright: np.ndarray, *, left: float, flight_time: float
    ) -> np.ndarray:
        """(3,) kg m^2/s to leave the ground with, ``left`` seconds from now, so that a flight of ``flight_time``
        seconds ends upright and turned; ``upright`` (3,) is the rotation vector to the landing without its turn."""
        ...

    def airborne_pose(self, pose: np.ndarray, momentum: np.ndarray, up: np.ndarray, left: float) -> np.ndarray:
        """(3, 3) ``pose`` (3, 3) for a body with angular ``momentum`` (3,), ``left`` seconds before it lands."""
        ...

    def landed_heading(self, pose: BalanceController, positions: np.ndarray) -> float:
        """How the body that has landed with its nodes at ``positions`` (N, 3) shall face, from the landing of
        ``pose``."""
        ...


class KeepHeading:
    """Lands facing as it stood."""

    target_heading = 0.0
    heading = 0.0
    predicted_heading = 0.0

    def update(self, heading: float) -> None:
        """Nothing depends on it."""

    def thrust_momentum(
        self, pose: BalanceController, seen: Measurement, upright: np.ndarray, *, left: float, flight_time: float
    ) -> np.ndarray:
        """Upright alone."""
        return seen.inertia @ (upright / flight_time)

    def airborne_pose(self, pose: np.ndarray, momentum: np.ndarray, up: np.ndarray, left: float) -> np.ndarray:
        """``pose`` as it is."""
        return pose

    def landed_heading(self, pose: BalanceController, positions: np.ndarray) -> float:
        """Straight ahead."""
        return 0.0
