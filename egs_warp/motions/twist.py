"""Twist: a jump that turns, its spin built by friction under the feet while the muscles thrust.

See docs/concepts/motions.md.
"""

from __future__ import annotations

import numpy as np

from egs_warp.motions.free_turn import spin_for_rotation
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import BalanceController, Measurement

AIRBORNE_SHARE = 0.88
"""Of the planned time of flight the body is off the ground: it stretches before it leaves it and before it lands."""
SPARE_SPIN = 1.15
"""Spin is built with this factor in hand: the muscles fall short of what is asked, and wide in the air the body is
slowed."""
SLIDE = np.radians(5.0)
"""By this angle the feet slide on while friction stops the spin on landing."""
WIDEST = 1.15
"""How much wider or narrower than standing the body makes itself in the air."""


def twist(place: Stance, target: JumpTarget, turn: float) -> Jump:
    """A jump that lands facing ``turn`` radians, counter-clockwise from above, from where it faced at the start."""
    return Jump(place, place.landing(target), facing=TurnHeading(place, turn))


class TurnHeading:
    """The ``Facing`` of a jump that turns."""

    def __init__(self, place: Stance, turn: float) -> None:
        self.body, self.target_heading, self.heading, self.predicted_heading = place.body, turn, 0.0, 0.0
        self._standing_inertia = place.body.inertia(place.standing)

    def update(self, heading: float) -> None:
        """Follows the turn from step to step, so that whole turns count."""
        self.heading += float(np.remainder(heading - self.heading + np.pi, 2.0 * np.pi) - np.pi)

    def thrust_momentum(
        self, pose: BalanceController, seen: Measurement, upright: np.ndarray, *, left: float, flight_time: float
    ) -> np.ndarray:
        """(3,) kg m^2/s with which the body, once in the air, turns upright and by what is left.

        It flies in about the shape in which it stands, so its inertia then, not the one now, says how.
        """
        up, rotation = pose.ground.axes[2], seen.rotation
        inertia = rotation @ self._standing_inertia @ rotation.T
        momentum = float(up @ seen.angular_momentum)
        spinning = momentum / float(up @ inertia @ up)
        airborne = AIRBORNE_SHARE * flight_time + 0.5 * left
        turn = SPARE_SPIN * self._left_to_turn() - 0.5 * left * spinning
        return inertia @ spin_for_rotation(inertia, upright, turn * up, airborne)

    def airborne_pose(self, pose: np.ndarray, momentum: np.ndarray, up: np.ndarray, left: float) -> np.ndarray:
        """Arms in, arms out: as wide as makes, with the spin that there is, the turn that is left."""
        to_turn, turning = self._left_to_turn(), float(up @ momentum) * left / float(up @ self._standing_inertia @ up)
        self.predicted_heading = self.heading + turning
        ratio = turning / to_turn if turning * to_turn > 0.0 else np.inf
        width = float(np.sqrt(np.clip(ratio, 1.0 / WIDEST**2, WIDEST**2)))
        return pose @ (width * np.eye(3) + (1.0 - width) * np.outer(up, up))

    def landed_heading(self, pose: BalanceController, positions: np.ndarray) -> float:
        """As the feet stand, so shall the body: what it was turned too little is not made up by standing twisted."""
        return pose.sole_heading(positions)

    def _left_to_turn(self) -> float:
        """Radians until the feet should touch down; they slide on by some more."""
        return self.target_heading - np.sign(self.target_heading) * min(SLIDE, abs(self.target_heading)) - self.heading
