"""Heading policies of a jump: the interface, and the policy that keeps the heading. See also ``motions.twist``."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from egs_warp.motions.stance import BalanceController, Measurement


class HeadingPolicy(Protocol):
    """Heading policy of a jump; angles in radians about the up axis, counterclockwise as seen from above."""

    target_heading: float
    """Heading change from the start to the landing."""
    heading: float
    """Heading change from the start until now, without wrapping."""
    predicted_heading: float
    """Predicted ``heading`` at touch-down; ``airborne_pose`` updates it."""

    def update(self, heading: float) -> None:
        """Update ``heading`` before a time step from the measured heading, which is known up to whole turns."""
        ...

    def thrust_momentum(
        self,
        controller: BalanceController,
        measurement: Measurement,
        upright: np.ndarray,
        *,
        left: float,
        flight_time: float,
    ) -> np.ndarray:
        """Return the angular momentum (3,) in kg m^2/s for take-off.

        Args:
            controller: controller of the body.
            measurement: measured body.
            upright: (3,) rotation vector to the landing pose without the heading change.
            left: time until take-off, s.
            flight_time: duration of the flight, s; at its end the body is upright and has turned.
        """
        ...

    def airborne_pose(self, pose: np.ndarray, momentum: np.ndarray, up: np.ndarray, left: float) -> np.ndarray:
        """Return the target pose in the air, adapted to the rotation of the body.

        Args:
            pose: (3, 3) pose to adapt.
            momentum: (3,) kg m^2/s, angular momentum, world axes.
            up: (3,) unit up axis.
            left: time until the landing, s.
        """
        ...

    def landed_heading(self, controller: BalanceController, positions: np.ndarray) -> float:
        """Return the target heading in radians of the landed body with its nodes at ``positions`` (N, 3), relative to
        the landing frame of ``controller``."""
        ...


class KeepHeading:
    """Heading policy that keeps the heading of the start."""

    target_heading = 0.0
    heading = 0.0
    predicted_heading = 0.0

    def update(self, heading: float) -> None:
        """Do nothing: the heading does not change."""

    def thrust_momentum(
        self,
        controller: BalanceController,
        measurement: Measurement,
        upright: np.ndarray,
        *,
        left: float,
        flight_time: float,
    ) -> np.ndarray:
        """Return the angular momentum (3,) in kg m^2/s that brings the body upright without a turn."""
        return measurement.inertia @ (upright / flight_time)

    def airborne_pose(self, pose: np.ndarray, momentum: np.ndarray, up: np.ndarray, left: float) -> np.ndarray:
        """Return ``pose`` unchanged."""
        return pose

    def landed_heading(self, controller: BalanceController, positions: np.ndarray) -> float:
        """Return 0."""
        return 0.0
