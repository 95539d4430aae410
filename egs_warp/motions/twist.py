"""Twist: a jump that turns; friction under the feet produces the spin during the thrust.

See docs/concepts/motions.md.
"""

from __future__ import annotations

import numpy as np

from egs_warp.motions.free_turn import spin_for_rotation
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import BalanceController, Measurement

AIRBORNE_FRACTION = 0.88
"""Fraction of the planned flight time in which the body is off the ground; it is below 1 because the body stretches
before take-off and before landing."""
SPIN_FACTOR = 1.15
"""Factor on the spin of the thrust, because the muscles do not fully reach their objective, and the body is wider and
turns more slowly in the air."""
LANDING_SLIDE_ANGLE = np.radians(5.0)
"""Angle in radians by which the feet continue to slide while friction stops the spin on landing."""
MAX_WIDTH = 1.15
"""Maximum width of the body in the air relative to standing; the minimum is 1 / ``MAX_WIDTH``."""


def twist(stance: Stance, target: JumpTarget, turn: float) -> Jump:
    """Return a jump that lands with its heading changed by ``turn`` radians, counterclockwise as seen from above."""
    return Jump(stance, stance.landing(target), facing=TurnHeading(stance, turn))


class TurnHeading:
    """Heading policy of a jump that turns."""

    def __init__(self, stance: Stance, turn: float) -> None:
        self.body, self.target_heading, self.heading, self.predicted_heading = stance.body, turn, 0.0, 0.0
        self._standing_inertia = stance.body.inertia(stance.standing)

    def update(self, heading: float) -> None:
        """Update the heading without wrapping, so that full turns are included."""
        self.heading += float(np.remainder(heading - self.heading + np.pi, 2.0 * np.pi) - np.pi)

    def thrust_momentum(
        self,
        controller: BalanceController,
        measurement: Measurement,
        upright: np.ndarray,
        *,
        left: float,
        flight_time: float,
    ) -> np.ndarray:
        """Return the angular momentum (3,) in kg m^2/s with which the body becomes upright in the air and turns by the
        remaining heading change.

        In the air, the body has approximately its standing shape. Therefore the inertia of the standing body applies,
        not the inertia of the crouched one.
        """
        up, rotation = controller.ground.axes[2], measurement.rotation
        inertia = rotation @ self._standing_inertia @ rotation.T
        momentum = float(up @ measurement.angular_momentum)
        spinning = momentum / float(up @ inertia @ up)
        airborne = AIRBORNE_FRACTION * flight_time + 0.5 * left
        turn = SPIN_FACTOR * self._remaining_turn() - 0.5 * left * spinning
        return inertia @ spin_for_rotation(inertia, upright, turn * up, airborne)

    def airborne_pose(self, pose: np.ndarray, momentum: np.ndarray, up: np.ndarray, left: float) -> np.ndarray:
        """Widen or narrow ``pose`` so that the present spin completes the remaining turn, as skaters do with their
        arms."""
        to_turn, turning = self._remaining_turn(), float(up @ momentum) * left / float(up @ self._standing_inertia @ up)
        self.predicted_heading = self.heading + turning
        ratio = turning / to_turn if turning * to_turn > 0.0 else np.inf
        width = float(np.sqrt(np.clip(ratio, 1.0 / MAX_WIDTH**2, MAX_WIDTH**2)))
        return pose @ (width * np.eye(3) + (1.0 - width) * np.outer(up, up))

    def landed_heading(self, controller: BalanceController, positions: np.ndarray) -> float:
        """Return the heading of the feet, because the landed body does not correct a missing turn by twisting over its
        feet."""
        return controller.sole_heading(positions)

    def _remaining_turn(self) -> float:
        """Return the remaining turn in radians until touch-down, after which the feet still slide by
        ``LANDING_SLIDE_ANGLE``."""
        return (
            self.target_heading
            - np.sign(self.target_heading) * min(LANDING_SLIDE_ANGLE, abs(self.target_heading))
            - self.heading
        )
