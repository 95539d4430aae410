"""Twist: a jump that turns, its spin built by friction under the feet while the muscles thrust (DESIGN 9)."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import Objective, SpinObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.jump import JumpPhase, JumpTarget
from egs_warp.motions.leap import Leap
from egs_warp.motions.sequence import Place
from egs_warp.motions.stance import Measurement, Weights

AIRBORNE_SHARE = 0.88
"""Of the planned time of flight the body is off the ground: it stretches before it leaves it and before it lands."""
SPARE_SPIN = 1.27
"""Spin is built with this factor in hand:
the muscles fall short of what is asked, and wide in the air the body is slowed.
"""
SLIDE = np.radians(5.0)
"""By this angle the feet slide on while friction stops the spin on landing."""
WIDEST = 1.15
"""How much wider or narrower than standing the body makes itself in the air."""


class Twist(Leap):
    """A jump that lands facing ``turn`` radians, counter-clockwise from above, from where it faced at the start."""

    def __init__(self, place: Place, target: JumpTarget, turn: float, *, weights: Weights | None = None) -> None:
        super().__init__(place, target, turn=turn, weights=weights)
        self._turned = 0.0
        up = place.ground.axes[2]
        self._standing_inertia = float(up @ place.body.inertia(place.standing) @ up)

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[Objective | SpinObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        facing = self.pose.measure(state, report).heading + (self.turn if self.left_ground else 0.0)
        self._turned += float(np.remainder(facing - self._turned + np.pi, 2.0 * np.pi) - np.pi)
        return super().objectives(state, report, dt)

    def left(self, state: BodyState) -> float:
        """Radians by which the feet of the body that has landed are short of the asked turn."""
        return -self.pose.sole_heading(state.positions)

    def _stand(
        self, state: BodyState, com_velocity: np.ndarray, position: np.ndarray, base: np.ndarray, dt: float
    ) -> list[Objective | SpinObjective]:
        if self.left_ground:
            # As the feet stand, so shall the body: what it was turned too little is not made up by standing twisted.
            pose = self.pose.over_base(position, base, self.pose.sole_heading(state.positions))
            return self._write(
                state, com_velocity, pose, self.pose.turn_towards(state, pose) * 4.0 / self._time_unit, dt
            )
        if self.phase is not JumpPhase.THRUST:
            return super()._stand(state, com_velocity, position, base, dt)
        landing = self.pose.over_base(self._landing_com(position), self._goal_base, self._turned)
        tilt = self.pose.turn_towards(state, landing) / self.plan.flight_time
        # The body flies in about the shape in which it stands, so its inertia then, not the one now, says what spin it
        # needs.
        yaw = SPARE_SPIN * self._left_to_turn() / (AIRBORNE_SHARE * self.plan.flight_time)
        spin = self._with_yaw(tilt, yaw * self._standing_inertia / self._inertia(state))
        return self._write(state, com_velocity, self.pose.over_base(position, base, self._turned), spin, dt)

    def _fly(self, state: BodyState, seen: Measurement, dt: float) -> list[Objective | SpinObjective]:
        touch_down, left, velocity = self._falling(seen, dt)
        to_turn = self._left_to_turn()
        momentum = self.body.angular_momentum(state.positions, state.velocities)
        yaw = float(self.ground.axes[2] @ momentum)
        # Arms in, arms out: the inertia with which the spin that there is makes the turn that is left.
        ratio = yaw * left / (self._standing_inertia * to_turn) if yaw * to_turn > 0.0 else np.inf
        width = float(np.sqrt(np.clip(ratio, 1.0 / WIDEST**2, WIDEST**2)))
        pose = self.pose.over_base(touch_down, self._foothold(state, seen, touch_down), self._turned - self.turn)
        pose = pose @ (width * np.eye(3) + (1.0 - width) * np.outer(self.ground.axes[2], self.ground.axes[2]))
        # A foot that lags on the ground must not push any more.
        spin = np.linalg.solve(self.body.inertia(state.positions), momentum)
        return self._write(state, velocity, pose, spin, dt)

    def _left_to_turn(self) -> float:
        """Radians until the feet should touch down; they slide on by some more."""
        return self.turn - np.sign(self.turn) * min(SLIDE, abs(self.turn)) - self._turned

    def _inertia(self, state: BodyState) -> float:
        return float(self.ground.axes[2] @ self.body.inertia(state.positions) @ self.ground.axes[2])

    def _with_yaw(self, rate: np.ndarray, yaw: float) -> np.ndarray:
        up = self.ground.axes[2]
        return rate + (yaw - rate @ up) * up
