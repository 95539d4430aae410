"""Twist: a jump that turns. Friction under the feet produces the spin during the thrust.

See docs/concepts/motions.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.fem.batched import BatchedRecord
from egs_warp.geometry.frames import dots, times
from egs_warp.motions.balance import Measurement
from egs_warp.motions.free_turn import spin_for_rotation

AIRBORNE_FRACTION = 0.88
"""Fraction of the planned flight time in which the body is off the ground. It is below 1, because the body stretches
before take-off and before landing."""
SPIN_FACTOR = 1.15
"""Factor on the spin of the thrust. It compensates that the muscles do not fully reach their objective, and that the
body is wider in the air, so it turns more slowly."""
LANDING_SLIDE_ANGLE = np.radians(5.0)
"""Angle in radians by which the feet continue to slide while friction stops the spin on landing."""
MAX_WIDTH = 1.15
"""Maximum width of the body in the air, relative to its width when standing; the minimum is 1 / ``MAX_WIDTH``."""


@dataclass(frozen=True)
class Heading(BatchedRecord):
    """Headings of the jumps of c worlds, in radians about the up axis, counterclockwise as seen from above."""

    turns: np.ndarray
    """(c,) bool, True for jumps that control their heading; the others keep it at 0."""
    target: np.ndarray
    """(c,) heading change from the start to the landing."""
    standing_inertia: np.ndarray
    """(c, 3, 3) kg m^2, inertia of the body at rest, world axes."""
    now: np.ndarray
    """(c,) heading change from the start until now, without wrapping."""
    predicted: np.ndarray
    """(c,) predicted ``now`` at touch-down; ``airborne_pose`` updates it."""

    def update(self, heading: np.ndarray) -> None:
        """Update the heading without wrapping from the measured ``heading`` (c,), which is known up to whole turns."""
        change = np.remainder(heading - self.now + np.pi, 2.0 * np.pi) - np.pi
        self.now[:] += np.where(self.turns, change, 0.0)

    def thrust_momentum(
        self,
        up: np.ndarray,
        measurement: Measurement,
        upright: np.ndarray,
        *,
        left: np.ndarray,
        flight_time: np.ndarray,
    ) -> np.ndarray:
        """Return the angular momentum (c, 3) in kg m^2/s for take-off, with which the body becomes upright in the air
        and turns by the remaining heading change.

        In the air, a body that turns has approximately its standing shape. Therefore the inertia of the standing body
        applies, not the inertia of the crouched one.

        Args:
            up: (c, 3) unit up axis.
            measurement: measured body.
            upright: (c, 3) rotation vector to the landing pose without the heading change.
            left: (c,) s, time until take-off.
            flight_time: (c,) s, duration of the flight, at whose end the body is upright and has turned.
        """
        momenta = times(measurement.inertia, upright / flight_time[:, None])
        rows = np.flatnonzero(self.turns)
        if len(rows) == 0:
            return momenta
        part, up, left = self.gather(rows), up[rows], left[rows]
        rotation = measurement.rotation[rows]
        inertia = rotation @ part.standing_inertia @ rotation.swapaxes(1, 2)
        spinning = dots(up, measurement.angular_momentum[rows]) / dots(up, times(inertia, up))
        airborne = AIRBORNE_FRACTION * flight_time[rows] + 0.5 * left
        turn = SPIN_FACTOR * part._remaining_turn() - 0.5 * left * spinning
        spin = spin_for_rotation(inertia, upright[rows], turn[:, None] * up, airborne)
        momenta[rows] = times(inertia, spin)
        return momenta

    def airborne_pose(self, pose: np.ndarray, momentum: np.ndarray, up: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Widen or narrow the pose of bodies that turn, as skaters do with their arms, so that the present spin
        completes the remaining turn.

        Args:
            pose: (c, 3, 3) pose to adapt.
            momentum: (c, 3) kg m^2/s, angular momentum, world axes.
            up: (c, 3) unit up axis.
            left: (c,) s, time until the landing.
        """
        to_turn = self._remaining_turn()
        turning = dots(up, momentum) * left / dots(up, times(self.standing_inertia, up))
        self.predicted[:] = np.where(self.turns, self.now + turning, 0.0)
        is_reachable = turning * to_turn > 0.0
        ratio = np.where(is_reachable, turning / np.where(is_reachable, to_turn, 1.0), np.inf)
        width = np.where(self.turns, np.sqrt(np.clip(ratio, 1.0 / MAX_WIDTH**2, MAX_WIDTH**2)), 1.0)[:, None, None]
        return pose @ (width * np.eye(3) + (1.0 - width) * up[:, :, None] * up[:, None])

    def landed(self, measurement: Measurement) -> np.ndarray:
        """Return the target heading (c,) of landed bodies relative to the landing frame. It is the heading of the feet,
        because a body does not correct a missing turn by twisting over its feet; it is 0 for jumps that keep their
        heading."""
        return np.where(self.turns, measurement.sole_heading, 0.0)

    def _remaining_turn(self) -> np.ndarray:
        """Return the turn (c,), in radians, that remains until touch-down. After touch-down, the feet still slide by
        ``LANDING_SLIDE_ANGLE``."""
        slide = np.sign(self.target) * np.minimum(LANDING_SLIDE_ANGLE, np.abs(self.target))
        return self.target - slide - self.now
