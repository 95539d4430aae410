"""Somersaults of many worlds: jumps whose ground force passes beside the centre of mass, so that the body turns over
(docs/concepts/motions.md).

The x axis of the ground frame is the direction of travel, backward for a backflip. In this frame every somersault turns
forward, by a positive angle about the y axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.geometry.frames import dots, nearest_rotation, times
from egs_warp.locomotion.reduced_objectives import ReducedObjectives
from egs_warp.motions.balance import Measurement, solved
from egs_warp.motions.free_turn import spin_for_rotation
from egs_warp.motions.jump_plan import JumpPhase, stopping_time
from egs_warp.motions.jump_worlds import PHASES, JumpWorlds, Targets
from egs_warp.motions.moments import ReducedState
from egs_warp.motions.pendulum import momentum_as_velocity

WHOLE_TURN = 2.0 * np.pi
TUCK_INERTIA = 0.8
"""Expected inertia of the body in the air about the left axis, relative to its inertia when standing."""
MIN_LENGTH, MAX_LENGTH = 0.5, 1.1
"""Limits of the target length of the body in the air, relative to its standing length. Muscles do not reach the first
one: the inertia of a pawn decreases to 0.6 of its standing inertia."""
LANDING_ANGLE = 0.1
"""Angle in radians by which the rotation for which the take-off is planned exceeds a whole turn."""
REMAINING_TIME_FRACTION = 0.9
"""Fraction of the remaining time in the air in which the rotation is completed, because the shape lags behind its
target."""
POSE_TIME = 0.4
"""Time in sqrt(H / g) in which the pose in the air is approached."""
LEAN_TIME = 0.8
"""Time before touch-down in sqrt(H / g) at which the body begins to lean towards its foothold, until ``POSE_TIME``
before it. A sheared body has a larger inertia: a pawn that leaned during the whole flight touched down after 320 of 360
degrees."""
INERTIA_GAIN = 1.0
"""Correction of the target inertia in the air, relative to the excess of the measured inertia over the required one.
Without it, the inertia of a plush dog stays at 0.8 of its standing inertia where 0.55 is required."""
THRUST_PRIORITY, THRUST_COM_FACTOR = 10.0, 0.1
"""Factors on the weights in a thrust: of angular momentum and upward speed, and of the velocity along the ground. With
equal weights, a pawn takes off with half of the angular momentum."""
LANDING_UPRIGHT_FACTOR = 0.35
"""Factor on the rate at which a landed body becomes upright, also at rest. At the usual rate, the body turns beyond
upright, because its capture point is far from the middle of its feet, where balance has priority over the rotation."""

_THRUST, _LAND = PHASES.index(JumpPhase.THRUST), PHASES.index(JumpPhase.LAND)


@dataclass(frozen=True)
class FlipWorlds(JumpWorlds):
    """Somersaults of c worlds with the same body."""

    turned: np.ndarray
    """(c,) rad, rotation about the left axis since the start, without wrapping."""
    landed: np.ndarray
    """(c,) rad, a whole turn minus ``_remaining_turn`` at touch-down; NaN before."""

    def step(self, state: ReducedState, dt: float) -> ReducedObjectives:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``, advance the state machines, and
        record the rotation at touch-down."""
        objectives = super().step(state, dt)
        touches = (self.phase == _LAND) & np.isnan(self.landed)
        if touches.any():
            measurement = self.current.measure(state)
            touch_down, left = self._touch_down(measurement, dt)
            foothold = self.foothold(state, measurement, touch_down, left)
            landed = WHOLE_TURN - self._remaining_turn(state, measurement, touch_down, foothold)
            self.landed[touches] = landed[touches]
        return objectives

    def _advance_phase(self, measurement: Measurement, time: np.ndarray, dt: float) -> None:
        super()._advance_phase(measurement, time, dt)
        axes = self.current.axes
        angle = angle_about_left(axes @ measurement.rotation @ axes.swapaxes(-1, -2))
        self.turned[:] += np.remainder(angle - self.turned + np.pi, WHOLE_TURN) - np.pi
        # The soles turn with the body until they touch the ground; their last objectives would stop this.
        self.off_ground[self.phase == _LAND] = False

    def _crouching_pose(self, measurement: Measurement, position: np.ndarray, dt: float) -> np.ndarray:
        """Return the pose (c, 3, 3) for the planned ``position`` (c, 3), also if the body lags behind it: the lean that
        it does not have rotates it, in the direction of the somersault."""
        return self.current.leaning_pose(position, self.start_base, leans=self.bending)

    def _thrust_spin(
        self,
        measurement: Measurement,
        landing: np.ndarray,
        standing: np.ndarray,
        elapsed: np.ndarray,
        left: np.ndarray,
        lead: np.ndarray,
    ) -> np.ndarray:
        """Return the target spin (c, 3) in rad/s, ``left`` (c,) seconds before take-off, for the arguments of
        ``JumpWorlds._thrust_spin``: that of a free body that turns over once during the flight. The angular momentum
        about the left axis grows by the fraction ``lead`` (c,) of the missing one in each step."""
        axis = self.current.axes[:, 1]
        inertia = TUCK_INERTIA * self._standing_inertia(measurement)
        upright = self.current.turn_towards(measurement, landing)
        about_axis = dots(axis, measurement.angular_momentum)
        spinning = about_axis / dots(axis, times(inertia, axis))
        turn = WHOLE_TURN + LANDING_ANGLE - 0.5 * left * spinning
        spin = spin_for_rotation(inertia, upright, turn[:, None] * axis, self.plan.flight_time)
        target = times(inertia, spin)
        share = np.minimum(elapsed / self.plan.thrust_time, 1.0)[:, None]
        upright_momentum = times(measurement.inertia, self._upright(measurement, standing))
        momentum = share * target + (1.0 - share) * upright_momentum
        about_axis = about_axis + lead * (dots(axis, target) - about_axis)
        momentum = momentum + (about_axis - dots(axis, momentum))[:, None] * axis
        return solved(measurement.inertia, momentum)

    def _standing_inertia(self, measurement: Measurement) -> np.ndarray:
        """Return the inertia (c, 3, 3) of the standing shape in the present orientation, world axes."""
        rotation = measurement.rotation
        return rotation @ self.heading.standing_inertia @ rotation.swapaxes(1, 2)

    def _best_fit(self, shape: np.ndarray) -> np.ndarray:
        """Return the best-fit rotation (c, 3, 3) to the affine ``shape`` (c, 3, 3) of the standing body."""
        return nearest_rotation(shape @ self.current.standing.second[:, 0])

    def _touch_down(self, measurement: Measurement, dt: float) -> tuple[np.ndarray, np.ndarray]:
        speed, gravity = measurement.velocity[:, 2], self.current.gravity
        drop = np.maximum(measurement.com[:, 2] - self.start_com[:, 2], 0.0)
        left = np.maximum((speed + np.sqrt(np.maximum(speed**2 + 2.0 * gravity * drop, 0.0))) / gravity, dt)
        level = measurement.com[:, :2] + measurement.velocity[:, :2] * left[:, None]
        return np.concatenate([level, self.start_com[:, 2:]], axis=1), left

    def foothold(
        self, state: ReducedState, measurement: Measurement, touch_down: np.ndarray, left: np.ndarray
    ) -> np.ndarray:
        """Return the foothold (c, 2) under the capture point, which includes the angular momentum; the place of the
        landing is not controlled."""
        balance = self.current
        momentum = times(balance.axes, measurement.angular_momentum)
        turning = momentum_as_velocity(momentum, balance.mass, balance.standing_height)
        falling = np.maximum(left * balance.gravity - measurement.velocity[:, 2], 0.0)
        stop = stopping_time(balance.standing_height, falling, balance.gravity, self.landing_time)
        return touch_down[:, :2] + (measurement.velocity[:, :2] + turning) * stop[:, None] + balance.base_offset

    def _remaining_turn(
        self, state: ReducedState, measurement: Measurement, touch_down: np.ndarray, foothold: np.ndarray
    ) -> np.ndarray:
        """Return the angle (c,) in radians by which the body must still turn until the centre of mass is at
        ``touch_down`` (c, 3): the mean of the angle after which the soles are flat and the one after which the feet,
        seen from the centre of mass, are in the direction of ``foothold`` (c, 2).

        They differ as long as the body does not have its target shape. With the first angle, a monkey lands behind its
        foothold; with the second one, the base of a pawn lands on its rear edge, which accelerates the rotation."""
        balance = self.current
        shape = balance.leaning_pose(touch_down, foothold)
        leaning = angle_about_left(balance.axes @ self._best_fit(shape) @ balance.axes.swapaxes(-1, -2))
        feet = times(balance.axes, state.moments.centres[:, 1] - balance.origin) - measurement.com
        goal = foothold - touch_down[:, :2]
        standing = _leg_angle(balance.base_offset[:, 0], -balance.standing_height)
        # The line of a bent body deviates from the rotation by less than half a turn.
        deviation = _leg_angle(feet[:, 0], feet[:, 2]) - standing - self.turned
        deviation = np.remainder(deviation + np.pi, WHOLE_TURN) - np.pi
        leg = _leg_angle(goal[:, 0], -balance.standing_height) - standing - deviation
        return WHOLE_TURN + 0.5 * (leaning + leg) - self.turned

    def _fly(self, state: ReducedState, measurement: Measurement, elapsed: np.ndarray, dt: float) -> Targets:
        balance, axis = self.current, self.current.axes[:, 1]
        touch_down, left = self._touch_down(measurement, dt)
        foothold = self.foothold(state, measurement, touch_down, left)
        remaining = np.maximum(self._remaining_turn(state, measurement, touch_down, foothold), 1e-3)
        lean = np.clip((LEAN_TIME - left / self.time_unit) / (LEAN_TIME - POSE_TIME), 0.0, 1.0)[:, None]
        below = touch_down[:, :2] + balance.base_offset
        shape = balance.leaning_pose(touch_down, below + lean * (foothold - below))
        inertia = dots(axis, times(self._standing_inertia(measurement), axis))
        needed = dots(axis, measurement.angular_momentum) * REMAINING_TIME_FRACTION * left / (inertia * remaining)
        measured = dots(axis, times(measurement.inertia, axis)) / inertia
        needed = needed - INERTIA_GAIN * (measured - needed)
        length = np.sqrt(np.clip(needed, MIN_LENGTH**2, MAX_LENGTH**2))[:, None, None]
        up = balance.axes[:, 2]
        along = up[:, :, None] * up[:, None]
        shape = shape @ (length * along + length**-0.25 * (np.eye(3) - along))
        # The shape is that of a body that stands upright; it turns with the measured body.
        pose = measurement.rotation @ self._best_fit(shape).swapaxes(-1, -2) @ shape
        velocity = measurement.velocity - np.array([0.0, 0.0, balance.gravity * dt])
        self.speed_offset[:] = -0.5 * balance.gravity * dt
        spin = solved(measurement.inertia, measurement.angular_momentum)
        approach = np.minimum(left, POSE_TIME * self.time_unit)
        return Targets(velocity, pose, spin, approach, np.ones(len(left)), spin)

    def _land(self, state: ReducedState, measurement: Measurement, elapsed: np.ndarray, dt: float) -> Targets:
        """Return the targets of the landing, with the full weights: with the low weights of the landing of a jump, the
        body keeps the angular momentum with which it extends, and turns beyond upright."""
        return replace(super()._land(state, measurement, elapsed, dt), share=np.ones(len(elapsed)))

    def _objectives(
        self, state: ReducedState, measurement: Measurement, targets: Targets, dt: float
    ) -> ReducedObjectives:
        """Return the objectives of the ``targets``. In a thrust, angular momentum and upward speed have priority."""
        pushes, weights = self.phase == _THRUST, self.weights
        priority = np.where(pushes, THRUST_PRIORITY, 1.0)
        weights = replace(
            weights,
            com=np.where(pushes, THRUST_COM_FACTOR, 1.0) * weights.com,
            up=priority * weights.up,
            spin=priority * weights.spin,
        )
        return JumpWorlds._objectives(replace(self, weights=weights), state, measurement, targets, dt)

    def _upright(self, measurement: Measurement, pose: np.ndarray) -> np.ndarray:
        return np.where(self.phase >= _LAND, LANDING_UPRIGHT_FACTOR, 1.0)[:, None] * super()._upright(measurement, pose)

    def _ramp_or_full(self, time: np.ndarray, unit: float) -> np.ndarray:
        return np.ones(len(time))


def angle_about_left(rotation: np.ndarray) -> np.ndarray:
    """Return the best-fit angle (...,) in radians about the y axis to the ``rotation`` (..., 3, 3)."""
    return np.arctan2(rotation[..., 0, 2] - rotation[..., 2, 0], rotation[..., 0, 0] + rotation[..., 2, 2])


def _leg_angle(ahead: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the angle (...,) in radians about the y axis by which the direction (``ahead``, ``up``) is rotated from
    straight down."""
    return np.arctan2(-ahead, -up)
