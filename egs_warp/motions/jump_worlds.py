"""Jumps of many worlds: the state machine that computes objectives from the measured states (docs/concepts/motions.md).

All arrays have a leading world axis; ``jump.Jump`` is one world. After take-off, quantities are relative to the frame
of the landing, which may be rotated, higher or lower.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.fem.batched import BatchedRecord
from egs_warp.geometry.frames import dots, times
from egs_warp.locomotion.reduced_objectives import AffineObjectives, ReducedObjectives
from egs_warp.motions.airborne_soles import AirborneSoles
from egs_warp.motions.balance import Balance, Measurement, Weights, solved
from egs_warp.motions.foothold import nearest_foothold
from egs_warp.motions.free_turn import rotations_of
from egs_warp.motions.joined_motion import MotionWorlds
from egs_warp.motions.jump_plan import MIN_CONTACT_TIME, SETTLE_TIME, JumpPhase, JumpPlan, sufficient_speed
from egs_warp.motions.moments import ReducedState
from egs_warp.motions.stance import update_rest
from egs_warp.motions.twist import Heading

STOP_RISE_FRACTION = 0.94
"""Fraction of the requested height that must be reached in free flight for a thrust to end. After one more time step,
the body would exceed the requested height."""
AIM_RISE_FRACTION = 0.99
"""Target height of a thrust, as a fraction of the requested height. It exceeds ``STOP_RISE_FRACTION``, so that a thrust
also ends if its speed falls slightly short of the target."""
FORWARD_TIME_FRACTION = 0.7
"""Fraction of the remaining time of a thrust in which the forward speed is reached."""
STEP_CLEARANCE = 0.15
"""Clearance of the feet above a step in the ground, as a fraction of its height, before they swing forward."""
APPROACH_RATE = 2.5
"""Product of the rate at which the landing pose is approached and the remaining time in the air. Since the product is
constant, the approach is slow at first."""
TOUCH_DOWN_HEIGHT = 0.06
"""Height of the centre of mass above standing, in body heights, below which the first contact is the landing."""
MAX_LANDING_TIME = 9.0
"""Maximum duration of a landing in sqrt(H / g), after which the body is considered at rest."""
MAX_LANDING_FALL = 0.8
"""Largest downward acceleration that is requested of the centre of mass after touch-down, in g."""
LANDING_RAMP_TIME = 0.5
"""Time in sqrt(H / g) from touch-down until the objectives of balance and upright posture have their full weight."""
LANDING_LEAN_FRACTION = 0.7
"""Fraction of the lean at landing that the target rotation at touch-down omits. With the full lean, the body would land
on its heels and tip over backward."""
FLAT_SOLE_SPEED = 0.1
"""Speed towards the feet, in sqrt(g H), above which the soles must be flat; at lower speeds, they are less flat."""
POSE_BLEND_TIME = 0.3
"""Time in sqrt(H / g) for the transition from the pose of one phase to the pose of the next."""
TAKE_OFF_RELEASE_TIME = 0.6
"""Time in sqrt(H / g) after take-off in which the pose of the landing is adopted."""
URGENT_CAPTURE_MARGIN = 0.5
"""Distance of the capture point from the middle of the feet, as a fraction of the distance to their edge. If the
capture point is farther away, a landing body is balanced with increased weights."""
MAX_FOLLOWED_MARGIN = 0.5
"""Largest capture margin (``Balance.capture_margin``) of a landed body at which the jump that follows starts."""

PHASES = tuple(JumpPhase)
"""Phases in the order of their numbers in ``JumpWorlds.phase``."""
_SETTLE, _CROUCH, _THRUST, _FLIGHT, _LAND, _REST = range(len(PHASES))


@dataclass(frozen=True)
class Targets(BatchedRecord):
    """Targets of a step, before the poses are blended."""

    velocity: np.ndarray
    """(c, 3) m/s, velocity of the centre of mass, ground axes."""
    pose: np.ndarray
    """(c, 3, 3) target pose, world axes."""
    spin: np.ndarray
    """(c, 3) rad/s, target spin, world axes."""
    left: np.ndarray
    """(c,) s, time until the landing of a body in the air; infinite on the ground."""
    share: np.ndarray
    """(c,) factor on the weights of balance during the landing, and on the weight of the pose in the air."""
    turning: np.ndarray
    """(c, 3) rad/s, angular velocity of the pose of a body in the air, world axes."""


@dataclass(frozen=True)
class JumpWorlds(MotionWorlds):
    """Jumps of c worlds with the same body. The balance is in the frame of the start until take-off, and in the frame
    of the landing afterwards. The fields from ``is_airborne`` on are updated in place in every step."""

    speed_unit: float
    """sqrt(g H), m/s."""
    time_unit: float
    """sqrt(H / g), s."""
    landing: Balance
    """Balance in the frame of the landing."""
    bending: np.ndarray
    """(c, 2, 3, 3) derivatives of the pose with respect to lean by bending; see ``BalanceController.bending``."""
    soles: AirborneSoles
    airborne_weight: np.ndarray
    """(c,) weight of the pose in the air."""
    landing_time: np.ndarray
    """(c,) s, time after touch-down in which the feet do not move while the fall is stopped."""
    distance: np.ndarray
    """(c,) m, requested distance."""
    height: np.ndarray
    """(c,) m, requested height."""
    rise: np.ndarray
    """(c,) m, height of the landing above the start."""
    plan: JumpPlan
    weights: Weights
    start_com: np.ndarray
    """(c, 3) m, standing position of the centre of mass in the frame of the start."""
    start_base: np.ndarray
    """(c, 2) m, position of the middle of the feet in the frame of the start."""
    skips_settling: np.ndarray
    """(c,) bool, True if the crouch starts at the first time step."""
    is_followed: np.ndarray
    """(c,) bool, True if another jump follows at once: the motion ends as soon as the landed body is balanced."""
    settle_time: np.ndarray
    """(c,) s, time from the first time step to the crouch; NaN before it. A body settles only as a run starts."""
    landing_height: np.ndarray
    """(c,) m, height at which the centre of mass of the landed body comes to rest."""
    is_airborne: np.ndarray
    """(c,) bool, True from take-off on."""
    heading: Heading
    phase: np.ndarray
    """(c,) int, index in ``PHASES``."""
    entered: np.ndarray
    """(c,) s, time at which the phase began."""
    crouch_offset: np.ndarray
    """(c, 3) m, position of the centre of mass at the start of the crouch, relative to ``start_com``."""
    crouch_velocity: np.ndarray
    """(c, 3) m/s, velocity of the centre of mass at the start of the crouch."""
    last_pose: np.ndarray
    """(c, 3, 3) target pose of the last step."""
    pose_before: np.ndarray
    """(c, 3, 3) target pose at the end of the previous phase."""
    requested_velocity: np.ndarray
    """(c, 2) m/s, velocity along the ground requested in the last step of a thrust; NaN before."""
    speed_offset: np.ndarray
    """(c,) m/s, upward speed at the end of the last step minus the mean speed during the step, in a continuous motion.
    The measured speed is the mean one, because a step moves with the velocity at its end."""
    off_ground: np.ndarray
    """(c,) bool, True from the lift-off until the ground carries the body again."""
    slow_since: np.ndarray
    """(c,) s, time since which the body has been slow; see ``update_rest``."""
    overran: np.ndarray
    """(c, phases) bool, True for phases that took too long."""

    @property
    def is_resting(self) -> np.ndarray:
        """(c,) bool, True for bodies that have landed and are at rest, or balanced if another jump follows."""
        return self.phase == _REST

    def step(self, state: ReducedState, dt: float) -> ReducedObjectives:
        """Return the objectives of the time step of ``dt`` s that starts at ``state`` and advance the state
        machines."""
        measurement = self.current.measure(state)
        heading = self.heading
        heading.update(measurement.heading + np.where(self.is_airborne, heading.target, 0.0))
        self._advance_phase(measurement, state.time, dt)
        elapsed = state.time - self.entered + dt
        targets, methods = None, (self._crouch, self._crouch, self._thrust, self._fly, self._land, self._land)
        for phase in np.unique(self.phase):
            rows = np.flatnonzero(self.phase == phase)
            if len(rows) == len(self.phase):
                targets = methods[phase](state, measurement, elapsed, dt)
                break
            part = self.gather(rows)
            operands = state.gather(rows), measurement.gather(rows), elapsed[rows], dt
            made = getattr(part, methods[phase].__name__)(*operands)
            self.requested_velocity[rows] = part.requested_velocity
            self.speed_offset[rows] = part.speed_offset
            self.heading.predicted[rows] = part.heading.predicted
            if targets is None:
                shapes = ((name, (len(self.phase), *value.shape[1:])) for name, value in made.batched_fields())
                targets = Targets(**{name: np.empty(shape) for name, shape in shapes})
            targets.scatter(rows, made)
        assert targets is not None
        return self._objectives(state, measurement, targets, dt)

    def _advance_phase(self, measurement: Measurement, time: np.ndarray, dt: float) -> None:
        # Contacts while the body still moves away from the ground are not a landing.
        in_contact = measurement.in_contact & (dots(measurement.velocity, self.current.normal) < 0.0)
        is_first = np.isnan(self.settle_time)
        settling = np.where(self.skips_settling, 0.0, np.maximum(SETTLE_TIME * self.time_unit - time, 0.0))
        self.settle_time[is_first] = settling[is_first]
        elapsed, plan, phase = time - self.entered + 1e-9, self.plan, self.phase
        is_over = np.select(
            [phase == each for each in range(_REST)],
            [
                self.skips_settling | (elapsed >= SETTLE_TIME * self.time_unit),
                elapsed >= plan.crouch_time,
                self._is_thrust_done(measurement, dt),
                self.off_ground & (self._has_landed(measurement, in_contact) | self._touches_down(measurement, dt)),
                elapsed >= MAX_LANDING_TIME * self.time_unit,
            ],
            False,
        )
        self.off_ground[:] |= (phase == _FLIGHT) & ~in_contact
        limit = 3.0 * np.select([phase == _THRUST, phase == _FLIGHT], [plan.thrust_time, plan.flight_time], np.inf)
        overran = ~is_over & (elapsed > limit)
        self.overran[overran, phase[overran]] = True
        is_over |= overran
        self.phase[is_over] += 1
        self.entered[is_over] = time[is_over]
        self._begin_crouch(measurement, is_over & (self.phase == _CROUCH))
        self.pose_before[is_over] = self.last_pose[is_over]
        rows = np.flatnonzero((self.phase == _FLIGHT) & ~self.is_airborne)
        if len(rows) > 0:
            self._take_off(rows)
        since, at_rest = update_rest(self.slow_since, measurement.velocity, time, self.speed_unit, self.time_unit)
        lands = self.phase == _LAND
        self.slow_since[lands] = since[lands]
        self.off_ground[lands & measurement.in_contact] = False
        if self.is_followed.any():
            is_balanced = self.current.capture_margin(measurement) <= MAX_FOLLOWED_MARGIN
            has_stood = time - self.entered >= MIN_CONTACT_TIME * self.time_unit
            at_rest = at_rest | (self.is_followed & has_stood & is_balanced)
        self.phase[lands & at_rest] = _REST

    def _begin_crouch(self, measurement: Measurement, begins: np.ndarray) -> None:
        """Start the crouches of the mask ``begins`` (c,) from the measured state, or from rest after settling."""
        begins = begins & (self.settle_time == 0.0)
        if not begins.any():
            return
        self.crouch_offset[begins] = (measurement.com - self.start_com)[begins]
        self.crouch_velocity[begins] = measurement.velocity[begins]
        pose = self._crouching_pose(measurement, measurement.com, 0.0)
        self.last_pose[begins] = pose[begins]

    def _take_off(self, rows: np.ndarray) -> None:
        """Change to the frame of the landing in the worlds with indices ``rows`` (k,)."""
        # Poses are stored relative to the standing pose. The landing frame is rotated relative to the take-off frame,
        # so rotate the stored poses into it.
        up = self.current.axes[rows, 2]
        back = rotations_of(-self.heading.target[rows, None] * up)
        self.last_pose[rows], self.pose_before[rows] = self.last_pose[rows] @ back, self.pose_before[rows] @ back
        self.current.scatter(rows, self.landing.gather(rows))
        self.is_airborne[rows] = True

    def _is_thrust_done(self, measurement: Measurement, dt: float) -> np.ndarray:
        """Return the mask (c,) bool of bodies whose thrust is over: in free flight, the centre of mass would reach
        ``STOP_RISE_FRACTION`` of the requested height, or the body has left the ground."""
        gravity = self.current.gravity
        speed = np.maximum(measurement.velocity[:, 2] - 0.5 * gravity * dt, 0.0)
        apex = measurement.com[:, 2] + speed**2 / (2.0 * gravity)
        enough = apex >= self.start_com[:, 2] + STOP_RISE_FRACTION * self.height
        # The thrust of a body in the air is over at any speed, because the feet must be steered from then on.
        return enough | ~(measurement.in_contact | (measurement.sole_height <= 0.0))

    def _has_landed(self, measurement: Measurement, in_contact: np.ndarray) -> np.ndarray:
        """Return the mask (c,) bool of bodies that have landed. While a body is still high, only contacts that carry
        more than its weight are considered a landing."""
        is_landing = self._is_low(measurement.com[:, 2]) | (measurement.normal_load > 1.0)
        return in_contact & is_landing

    def _touches_down(self, measurement: Measurement, dt: float) -> np.ndarray:
        """Return the mask (c,) bool of bodies whose feet reach the ground in this step, near the standing height.
        The objectives of the flight would keep the shape."""
        velocity = measurement.velocity - np.array([0.0, 0.0, self.current.gravity * dt])
        speed = dots(velocity, self.current.normal)
        touches = (speed < 0.0) & (measurement.sole_height + speed * dt <= 0.0)
        return touches & self._is_low(measurement.com[:, 2] + velocity[:, 2] * dt)

    def _is_low(self, height: np.ndarray) -> np.ndarray:
        """Return the mask (c,) bool of bodies with the centre of mass at ``height`` (c,) m near or below standing."""
        return height < self.start_com[:, 2] + TOUCH_DOWN_HEIGHT * self.current.height

    def _crouch(self, state: ReducedState, measurement: Measurement, elapsed: np.ndarray, dt: float) -> Targets:
        is_down = (self.phase == _CROUCH)[:, None]
        position, velocity = self.plan.crouch(self.start_com, elapsed, self.crouch_offset, self.crouch_velocity)
        position, velocity = np.where(is_down, position, self.start_com), np.where(is_down, velocity, 0.0)
        velocity = self._following(measurement, position, velocity, dt)
        pose = self._crouching_pose(measurement, position, dt)
        velocity, spin = self.current.balance_targets(measurement, velocity, self._upright(measurement, pose), dt)
        return self._on_ground(velocity, pose, spin)

    def _crouching_pose(self, measurement: Measurement, position: np.ndarray, dt: float) -> np.ndarray:
        """Return the pose (c, 3, 3) of a crouch for the planned ``position`` (c, 3). A body that lags behind the plan
        leans only as far as its measured motion leads: a lean that it does not have would rotate it instead."""
        reached = measurement.com[:, :1] + dt * measurement.velocity[:, :1]
        com = np.concatenate([np.minimum(reached, position[:, :1]), position[:, 1:]], axis=1)
        return self.current.leaning_pose(com, self.start_base, leans=self.bending)

    def _thrust(self, state: ReducedState, measurement: Measurement, elapsed: np.ndarray, dt: float) -> Targets:
        """Return the targets of the thrust. The target speed along the ground takes the centre of mass from its
        measured position to its target position at touch-down."""
        plan, (position, velocity) = self.plan, self.plan.thrust(self.start_com, elapsed)
        # Limit the upward speed to that with which free flight after this time step reaches the target height.
        rise = self.start_com[:, 2] + AIM_RISE_FRACTION * self.height - measurement.com[:, 2]
        enough = sufficient_speed(rise, self.current.gravity, dt)
        up = np.minimum(self._following(measurement, position, velocity, dt)[:, 2], enough)
        left = np.maximum((plan.speed_up - measurement.velocity[:, 2]) / plan.speed_up * plan.thrust_time, dt)
        landing, level, half = self._landing_com(), measurement.velocity[:, :2], 0.5 * left[:, None]
        needed = (landing[:, :2] - measurement.com[:, :2] - half * level) / (plan.flight_time[:, None] + half)
        # The ground forces lag behind the objectives. Therefore the forward speed leads the upward speed, and the
        # shortfall of the last time step is added, limited to the size of the change itself.
        lead = dt / np.maximum(FORWARD_TIME_FRACTION * left, dt)
        change = (needed - level) * lead[:, None]
        short = np.where(np.isnan(self.requested_velocity), 0.0, self.requested_velocity - level)
        size = np.maximum(np.linalg.norm(short, axis=1), 1e-12)
        short *= np.minimum(1.0, np.linalg.norm(change, axis=1) / size)[:, None]
        velocity = np.concatenate([level + change + short, up[:, None]], axis=1)
        flat = self._base_of_landing()
        flat[:, 0] -= LANDING_LEAN_FRACTION * plan.landing_lag
        upright = self.current.leaning_pose(landing, flat, self.heading.now)
        standing = self.current.leaning_pose(position, self.start_base, self.heading.now, self.bending)
        spin = self._thrust_spin(measurement, upright, standing, elapsed, left, lead)
        velocity, spin = self.current.balance_targets(measurement, velocity, spin, dt)
        self.requested_velocity[:] = velocity[:, :2]
        return self._on_ground(velocity, standing, spin)

    def _thrust_spin(
        self,
        measurement: Measurement,
        landing: np.ndarray,
        standing: np.ndarray,
        elapsed: np.ndarray,
        left: np.ndarray,
        lead: np.ndarray,
    ) -> np.ndarray:
        """Return the target spin (c, 3) in rad/s, ``left`` (c,) seconds before take-off.

        It changes gradually from the spin that keeps the body in the pose ``standing`` (c, 3, 3) to the spin that takes
        it to the pose ``landing`` (c, 3, 3). The spin about the up axis grows with the speed by the fraction ``lead``
        (c,) of the missing spin, because friction grows with the load.
        """
        up, inertia = self.current.axes[:, 2], measurement.inertia
        upright = self.current.turn_towards(measurement, landing)
        target = self.heading.thrust_momentum(up, measurement, upright, left=left, flight_time=self.plan.flight_time)
        share = np.minimum(elapsed / self.plan.thrust_time, 1.0)[:, None]
        momentum = share * target + (1.0 - share) * times(inertia, self._upright(measurement, standing))
        now = dots(up, measurement.angular_momentum)
        about_up = now + lead * (dots(up, target) - now)
        turning = np.where(self.heading.target != 0.0, about_up - dots(up, momentum), 0.0)
        return solved(inertia, momentum + turning[:, None] * up)

    def _fly(self, state: ReducedState, measurement: Measurement, elapsed: np.ndarray, dt: float) -> Targets:
        touch_down, left = self._touch_down(measurement, dt)
        heading, up = self.heading, self.current.axes[:, 2]
        pose = self.current.leaning_pose(
            touch_down, self.foothold(state, measurement, touch_down, left), heading.now - heading.target
        )
        # The target is the current spin: no torque acts on a body in the air, and a foot that is still on the ground
        # must not push.
        spin = solved(measurement.inertia, measurement.angular_momentum)
        pose = heading.airborne_pose(pose, measurement.angular_momentum, up, left)
        velocity = measurement.velocity - np.array([0.0, 0.0, self.current.gravity * dt])
        self.speed_offset[:] = -0.5 * self.current.gravity * dt
        # Increase the weights gradually, so that the strain of the thrust is released first.
        share = self._ramp_or_full(state.time + dt, TAKE_OFF_RELEASE_TIME)
        return Targets(velocity, pose, spin, left, share, np.zeros_like(spin))

    def _land(self, state: ReducedState, measurement: Measurement, elapsed: np.ndarray, dt: float) -> Targets:
        balance, feet = self.current, measurement.foot_centre
        goal = np.concatenate([feet - balance.base_offset, self.landing_height[:, None]], axis=1)
        level = measurement.velocity[:, :2] + dt * balance.capture_acceleration(measurement, goal[:, :2])
        velocity = np.concatenate([level, self._landing_speed(measurement, dt)[:, None]], axis=1)
        heading = self.heading.landed(measurement)
        # The pose is upright for every position of the centre of mass: with a pose that leans with the centre of mass,
        # the body would not return to upright.
        com = measurement.com.copy()
        com[:, :2], com[:, 2] = goal[:, :2], com[:, 2] + dt * velocity[:, 2]
        pose = balance.leaning_pose(com, feet, heading)
        # While the body still moves towards its feet, rotate it until the soles are flat, because a body on its heels
        # cannot brake. If its mean rotation were upright while it is sheared backward, the sole would be tilted up by
        # half of the shear.
        ahead = goal[:, :2] - measurement.com[:, :2]
        closing = dots(ahead, measurement.velocity[:, :2]) / np.maximum(
            np.linalg.norm(ahead, axis=1), 1e-9 * balance.height
        )
        approach = np.clip(closing / (FLAT_SOLE_SPEED * self.speed_unit), 0.0, 1.0)
        over_feet = np.concatenate([goal[:, :2] - approach[:, None] * ahead, measurement.com[:, 2:]], axis=1)
        flat = balance.leaning_pose(over_feet, feet, heading)
        upright = self._ramp(state.time + dt, LANDING_RAMP_TIME)[:, None] * self._upright(measurement, flat)
        velocity, spin = balance.balance_targets(measurement, velocity, upright, dt)
        # After the ground has stopped the fall, low weights suffice for a body that comes to rest by itself.
        urgent = (balance.capture_margin(measurement) - URGENT_CAPTURE_MARGIN) / (1.0 - URGENT_CAPTURE_MARGIN)
        share = np.maximum(self.weights.landing, np.minimum(urgent, 1.0))
        share = self._ramp_or_full(state.time + dt, LANDING_RAMP_TIME) * share
        return replace(self._on_ground(velocity, pose, spin), share=share)

    def _landing_speed(self, measurement: Measurement, dt: float) -> np.ndarray:
        """Return the upward speed (c,) in m/s of a step of the landing, such that the centre of mass at its end is on
        the exact solution from the measured state. Before the touch-down, the body falls freely."""
        velocity = measurement.velocity + self.speed_offset[:, None] * np.array([0.0, 0.0, 1.0])
        height, gravity = measurement.com[:, 2] - self.landing_height, self.current.gravity
        gap = np.where(measurement.in_contact, 0.0, np.maximum(measurement.sole_height, 0.0))
        falling = np.minimum(self.current.fall_time(velocity, gap), dt) * (gap > 0.0)
        below, after = self.plan.landing(height, velocity[:, 2], falling, dt, gravity)
        # Part of the weight stays on the feet while the body moves down from above its standing height.
        slowest = measurement.velocity[:, 2] - np.where(gap > 0.0, 1.0, MAX_LANDING_FALL) * gravity * dt
        mean = np.maximum((below - height) / dt, slowest)
        self.speed_offset[:] = np.maximum(after - mean, -0.5 * gravity * dt)
        return mean

    def _on_ground(self, velocity: np.ndarray, pose: np.ndarray, spin: np.ndarray) -> Targets:
        return Targets(velocity, pose, spin, np.full(len(spin), np.inf), np.ones(len(spin)), np.zeros_like(spin))

    def _ramp_or_full(self, time: np.ndarray, unit: float) -> np.ndarray:
        """Return the value (c,) of ``_ramp`` for jumps that keep their heading, and 1 for jumps that turn."""
        return np.where(self.heading.target != 0.0, 1.0, self._ramp(time, unit))

    def _ramp(self, time: np.ndarray, unit: float) -> np.ndarray:
        """Return the fraction (c,) of the full weight at ``time`` (c,) s; it grows to 1 within ``unit`` sqrt(H / g)
        after the start of the phase."""
        share = np.minimum((time - self.entered) / (unit * self.time_unit), 1.0)
        return share * share * (3.0 - 2.0 * share)

    def _following(self, measurement: Measurement, position: np.ndarray, velocity: np.ndarray, dt: float) -> np.ndarray:
        """Return the velocity (c, 3) in m/s that follows a reference of ``position`` and ``velocity`` (c, 3)."""
        return velocity + 6.0 / self.time_unit * (position - velocity * dt - measurement.com)

    def _upright(self, measurement: Measurement, pose: np.ndarray) -> np.ndarray:
        """Return the spin (c, 3) in rad/s that turns a standing body to ``pose`` (c, 3, 3)."""
        return self.current.turn_towards(measurement, pose) * 4.0 / self.time_unit

    def _base_of_landing(self) -> np.ndarray:
        """Return the target (c, 2) of the middle of the feet, in the frame of the start."""
        return self.start_base + np.stack([self.distance, np.zeros_like(self.distance)], axis=1)

    def _landing_com(self) -> np.ndarray:
        """Return the target (c, 3) of the centre of mass at touch-down, in the frame of the start."""
        ahead = self._base_of_landing()[:, 0] - self.current.base_offset[:, 0] - self.plan.landing_lag
        return np.concatenate([ahead[:, None], self.start_com[:, 1:]], axis=1)

    def _touch_down(self, measurement: Measurement, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Predict the touch-down, at which the feet have fallen by their present height: the position (c, 3) of the
        centre of mass, m, and the time (c,) until then, s."""
        gap, speed, gravity = np.maximum(measurement.sole_height, 0.0), measurement.velocity[:, 2], self.current.gravity
        drop = np.maximum(measurement.com[:, 2] - self.start_com[:, 2], 0.0)
        latest = np.maximum((speed + np.sqrt(np.maximum(speed**2 + 2.0 * gravity * drop, 0.0))) / gravity, dt)
        left = np.clip(self.current.fall_time(measurement.velocity, gap), dt, latest)
        level = measurement.com[:, :2] + measurement.velocity[:, :2] * left[:, None]
        return np.concatenate([level, self.start_com[:, 2:]], axis=1), left

    def foothold(
        self, state: ReducedState, measurement: Measurement, touch_down: np.ndarray, left: np.ndarray
    ) -> np.ndarray:
        """Return the foothold (c, 2) for a landing with the centre of mass at ``touch_down`` (c, 3) in ``left`` (c,)
        seconds: the target if the body can come to rest over it, otherwise the nearest point over which it can."""
        balance, level = self.current, touch_down[:, :2]
        falling = np.maximum(left * balance.gravity - measurement.velocity[:, 2], 0.0)
        operands = self.start_base, level, measurement.velocity[:, :2], falling, self.landing_time
        foothold = nearest_foothold(balance, *operands)
        # Feet that swung forward before they are higher than the step in the ground would strike the step.
        lowest = state.lowest - dots(balance.origin, balance.axes[:, 2])
        is_below_step = (measurement.velocity[:, 2] > 0.0) & (lowest < STEP_CLEARANCE * self.rise)
        below_body = level + measurement.foot_centre - measurement.com[:, :2]
        return np.where(is_below_step[:, None], below_body, foothold)

    def _objectives(
        self, state: ReducedState, measurement: Measurement, targets: Targets, dt: float
    ) -> ReducedObjectives:
        """Return the objectives of the ``targets``."""
        # If a phase begins with a pose that differs from the last pose, the two are blended over several time steps.
        blend = self._ramp(state.time + dt, POSE_BLEND_TIME)[:, None, None]
        pose = self.pose_before + blend * (targets.pose - self.pose_before)
        rate = (pose - self.last_pose) / dt
        rate[np.abs(rate).max(axis=(1, 2)) > 5.0 / self.time_unit] = 0.0
        self.last_pose[:] = pose
        flies, lands, share = self.phase == _FLIGHT, (self.phase == _LAND) & self.off_ground, targets.share
        # The ground must stop the fall: if the objective were free fall, the muscles would pull the feet away from the
        # ground.
        factor = np.where(self.phase == _LAND, share, 1.0)
        factor = np.where(flies & (targets.velocity[:, 2] < 0.0), 0.0, factor)
        weights = self.weights
        weights = Weights(
            com=factor * weights.com,
            up=factor * weights.up,
            spin=factor * weights.spin,
            pose=np.where(flies, share * self.airborne_weight, weights.pose),
        )
        follow = np.where(flies, np.minimum(APPROACH_RATE / targets.left, 6.0 / self.time_unit), 6.0 / self.time_unit)
        objectives = self.current.objectives(
            state.moments,
            measurement,
            com_velocity=targets.velocity,
            pose=pose,
            pose_rate=rate,
            spin=targets.spin,
            follow=follow,
            weights=weights,
        )
        # Soles have objectives until the ground carries them: without, feet spring back if the touch-down is predicted
        # a step too early.
        rows = np.flatnonzero(flies | lands)
        if len(rows) == 0:
            return objectives
        soles = self.soles.gather(rows).objectives(
            self.current.gather(rows),
            state.moments.gather(rows),
            np.where(lands[:, None, None], self.pose_before, targets.pose)[rows],
            follow[rows],
            np.where(lands, 1.0, share)[rows],
            targets.turning[rows],
        )
        both = AffineObjectives.combined([objectives.affine, soles.expanded(rows, len(flies))])
        return replace(objectives, affine=both)
