"""Jump to a target: a closed-loop state machine that computes objectives from the measured state
(docs/concepts/motions.md).

After take-off, quantities are relative to the frame of the landing, which may be rotated, higher or lower.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.airborne_soles import AirborneSoles
from egs_warp.motions.facing import HeadingPolicy, KeepHeading
from egs_warp.motions.jump_plan import (
    LANDING_TIME,
    LEAN_FRACTION,
    MAX_LEAN,
    SETTLE_TIME,
    JumpPhase,
    JumpPlan,
    JumpTarget,
    plan_jump,
    stopping_time,
    sufficient_speed,
)
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import BalanceController, GroundFrame, Measurement, RestDetector, Weights
from egs_warp.motions.support import nearest_in_half_planes
from egs_warp.motions.walk_posture import LeggedPosture, select_posture

STOP_RISE_FRACTION = 0.94
"""Fraction of the requested height that the centre of mass would reach in free flight when a thrust ends. One more time
step would exceed the requested height."""
AIM_RISE_FRACTION = 0.99
"""Target of a thrust, as a fraction of the requested height. It exceeds ``STOP_RISE_FRACTION``, so that the thrust also
ends if its speed falls slightly short of the target."""
FORWARD_TIME_FRACTION = 0.7
"""Fraction of the time of a thrust in which the forward speed is reached."""
MAX_FOOTHOLD_OFFSET = 0.4
"""Maximum offset of the foothold from the capture point towards the target, as a fraction of the footprint."""
NARROW_SUPPORT, WIDE_SUPPORT = np.tan(np.radians([8.0, 17.0]))
"""Distances to the edge of the footprint, relative to the height of the centre of mass: up to the first, the foothold
must equal the capture point; from the second on, it may differ by ``MAX_FOOTHOLD_OFFSET``."""
STEP_CLEARANCE = 0.15
"""Clearance of the feet above a step, as a fraction of its height, before they swing forward."""
APPROACH_RATE = 2.5
"""Product of the rate at which the pose of the landing is approached and the remaining time in the air. The approach is
therefore slow at first."""
TOUCH_DOWN_HEIGHT = 0.06
"""Height of the centre of mass above its standing height, in body heights, below which the first contact is considered
the landing."""
MAX_LANDING_TIME = 9.0
"""Maximum duration of a landing in sqrt(H / g), after which the body is considered at rest."""
LANDING_RAMP_TIME = 0.5
"""Time in sqrt(H / g) from touch-down until the objectives of balance and upright posture have their full weight."""
LANDING_LEAN_FRACTION = 0.7
"""Fraction of the lean at landing that the target rotation at touch-down omits. With the full lean, the body would land
on its heels and topple over them."""
FLAT_SOLE_SPEED = 0.1
"""Speed towards the feet, in sqrt(g H), above which the soles must be flat; at lower speeds, they are flattened
partially."""
POSE_BLEND_TIME = 0.3
"""Time in sqrt(H / g) for the transition from the pose of one phase to the pose of the next."""
TAKE_OFF_RELEASE_TIME = 0.6
"""Time in sqrt(H / g) after take-off in which the pose of the landing is adopted."""
URGENT_CAPTURE_MARGIN = 0.5
"""Distance of the capture point from the middle of the feet, as a fraction of the distance to their edge. Beyond it, a
landing body is balanced with increased weights."""
AIRBORNE_POSE_WEIGHT, BASE_AIRBORNE_POSE_WEIGHT = 2.0, 0.3
"""Weights of the pose in the air. The first is for bodies on legs, and for bodies that turn in the air, whose rotation
depends on their width. The second is for a single base without a turn: with a weight of 2, the muscles of a pawn do
0.76 m g H of work in the air; with 0.3, they do 0.30 m g H, and the pawn lands equally well."""


class Jump:
    """Jump: settle, crouch, thrust until the measured speed suffices, fly, land ``target.distance`` ahead, and come to
    rest."""

    def __init__(
        self,
        stance: Stance,
        target: JumpTarget,
        *,
        facing: HeadingPolicy | None = None,
        weights: Weights | None = None,
        skips_settling: bool = False,
    ) -> None:
        """Create the jump of the body that stands at ``stance``.

        Args:
            stance: stance at the start.
            target: target of the jump.
            facing: heading policy; None keeps the heading.
            weights: weights of the objectives.
            skips_settling: True starts the crouch at the first time step.
        """
        body, ground = stance.body, stance.ground
        self.body, self.target, self.facing = body, target, facing or KeepHeading()
        self.weights = weights or Weights()
        self.gravity = float(np.linalg.norm(body.gravity))
        landing = GroundFrame(
            ground.axes @ ground.rotation_about_up(self.facing.target_heading).T,
            ground.origin + target.distance * ground.axes[0] + target.rise * ground.axes[2],
            ground.surface_normal,
        )
        self.controller = BalanceController(body, ground, stance.standing, stance.contact_points, stance.friction)
        self._landing = BalanceController(
            body,
            landing,
            landing.world(ground.local(stance.standing)),
            landing.world(ground.local(stance.contact_points)),
            stance.friction,
        )
        feet, posture = select_posture(stance)
        on_legs = posture is LeggedPosture
        self._airborne = AIRBORNE_POSE_WEIGHT if on_legs or self.facing.target_heading else BASE_AIRBORNE_POSE_WEIGHT
        self._soles = AirborneSoles.of(stance, feet, on_legs=on_legs)
        self._time_unit = float(np.sqrt(body.height / self.gravity))
        # Feet on legs do not move after touch-down while the fall is stopped.
        self._landing_time = LANDING_TIME * self._time_unit if on_legs else 0.0
        self._support_ahead = self.controller.footprint.extent(np.array([1.0, 0.0]))
        self._style, self._step, self._max_lean = stance.style, stance.step, MAX_LEAN * self._support_ahead
        self.plan = self._plan_for(target)
        self._skips_settling = skips_settling
        self.phase, self._entered = JumpPhase.SETTLE, 0.0
        local = ground.local(stance.standing)
        self._start_com = body.centre_of_mass(local)
        self.landing_height = float(self._start_com[2])
        """Height in metres at which the centre of mass of the landed body comes to rest."""
        self._start_base = self._start_com[:2] + self.controller.base_offset
        self._last_pose = self._pose_before = np.eye(3)
        self._requested_velocity: np.ndarray | None = None
        self._flew = False
        self._rest_detector = RestDetector(body)
        self._overran: list[JumpPhase] = []

    @property
    def ground(self) -> GroundFrame:
        """Reference frame of the motion: the frame of the start until take-off, the frame of the landing afterwards."""
        return self.controller.ground

    @property
    def is_airborne(self) -> bool:
        """True from take-off on: the reference frame is the frame of the landing."""
        return self.controller is self._landing

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds until the body is at rest."""
        return self.plan.expected_duration(abs(self.target.distance) / self.body.height, self._time_unit)

    def _plan_for(self, target: JumpTarget) -> JumpPlan:
        return plan_jump(
            target,
            height=self.body.height,
            com_height=self.controller.standing_height,
            support_ahead=self._support_ahead,
            gravity=self.gravity,
            step=self._step,
            lean=min(LEAN_FRACTION * target.distance, self._max_lean),
            friction=self.controller.friction,
            landing_time=self._landing_time,
            style=self._style,
        )

    def take_off_time(self, height: float) -> float:
        """Return the planned time in seconds from the start of the crouch to the end of the thrust, for a jump on the
        spot, ``height`` metres high. Crouch and thrust take whole numbers of time steps."""
        return self._plan_for(JumpTarget(0.0, height)).take_off_time(self._step)

    @property
    def is_at_rest(self) -> bool:
        """True if the body has landed and is at rest."""
        return self.phase is JumpPhase.REST

    def plan_record(self) -> JumpPlan:
        """Return the plan of the jump."""
        return self.plan

    def planned_com(self, elapsed: float) -> np.ndarray:
        """Return the planned displacement (3,) in metres of the centre of mass ``elapsed`` seconds after the motion
        began; NaN after touch-down."""
        plan, ground = self.plan, self.ground
        axes = ground.axes @ ground.rotation_about_up(self.facing.target_heading) if self.is_airborne else ground.axes
        return plan.planned_displacement(max(elapsed - SETTLE_TIME * self._time_unit, 0.0), self.gravity) @ axes

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> None:
        """Return None: a jump has no quantities of its own beyond those measured for all motions."""

    def notes(self) -> list[str]:
        """Return messages for the user about phases that took too long."""
        named = {
            JumpPhase.THRUST: "the muscles could not reach the take-off speed within the time of a thrust",
            JumpPhase.FLIGHT: "the body never came back to the ground",
        }
        return [f"{phase.value} took too long: {named[phase]}" for phase in self._overran]

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the time step of ``dt`` seconds from ``state``; ``report`` is the report of
        the previous step."""
        measurement = self.controller.measure(state, report)
        self.facing.update(measurement.heading + (self.facing.target_heading if self.is_airborne else 0.0))
        self._advance_phase(measurement, state.time, dt)
        elapsed = state.time - self._entered + dt
        if self.phase is JumpPhase.FLIGHT:
            return self._flight_objectives(state, measurement, dt)
        if self.phase is JumpPhase.THRUST:
            return self._thrust(state, measurement, elapsed, dt)
        if self.phase in (JumpPhase.SETTLE, JumpPhase.CROUCH):
            return self._crouch(state, measurement, elapsed, dt)
        return self._land(state, measurement, dt)

    def _advance_phase(self, measurement: Measurement, time: float, dt: float) -> None:
        # Contacts while the body still rises are not a landing.
        measurement = replace(measurement, in_contact=measurement.in_contact and measurement.velocity[2] < 0.0)
        elapsed, plan = time - self._entered + 1e-9, self.plan
        following = {
            JumpPhase.SETTLE: self._skips_settling or elapsed >= SETTLE_TIME * self._time_unit,
            JumpPhase.CROUCH: elapsed >= plan.crouch_time,
            JumpPhase.THRUST: self._is_thrust_done(measurement, dt),
            JumpPhase.FLIGHT: self._flew and self._has_landed(measurement),
            JumpPhase.LAND: elapsed >= MAX_LANDING_TIME * self._time_unit,
            JumpPhase.REST: False,
        }
        if self.phase is JumpPhase.FLIGHT and not measurement.in_contact:
            self._flew = True
        limits = {JumpPhase.THRUST: 3.0 * plan.thrust_time, JumpPhase.FLIGHT: 3.0 * plan.flight_time}
        if not following[self.phase] and elapsed > limits.get(self.phase, np.inf):
            self._overran.append(self.phase)
            following[self.phase] = True
        if following[self.phase]:
            self.phase = list(JumpPhase)[list(JumpPhase).index(self.phase) + 1]
            self._entered, self._pose_before = time, self._last_pose
        if self.phase is JumpPhase.FLIGHT and not self.is_airborne:
            # Poses are stored relative to the standing pose. The landing frame is rotated against the take-off frame,
            # so rotate the stored poses into it.
            rotation = self.ground.rotation_about_up(self.facing.target_heading)
            self._last_pose, self._pose_before = self._last_pose @ rotation.T, self._pose_before @ rotation.T
            self.controller = self._landing
        elif self.phase is JumpPhase.LAND and self._rest_detector.update(measurement.velocity, time):
            self.phase = JumpPhase.REST

    def _is_thrust_done(self, measurement: Measurement, dt: float) -> bool:
        """Return True if the thrust is over: the centre of mass would reach ``STOP_RISE_FRACTION`` of the requested
        height in free flight, or the body has left the ground."""
        speed = max(measurement.velocity[2] - 0.5 * self.gravity * dt, 0.0)
        apex = measurement.com[2] + speed**2 / (2.0 * self.gravity)
        enough = bool(apex >= self._start_com[2] + STOP_RISE_FRACTION * self.target.height)
        # The thrust of a body in the air has ended, whatever its speed: the feet must be steered from then on.
        return enough or not (measurement.in_contact or measurement.sole_height <= 0.0)

    def _has_landed(self, measurement: Measurement) -> bool:
        """Return True if the body stands on the ground again. While it is still high, only contacts that carry more
        than the weight are considered a landing."""
        low = measurement.com[2] < self._start_com[2] + TOUCH_DOWN_HEIGHT * self.body.height
        return measurement.in_contact and measurement.velocity[2] < 0.0 and (low or measurement.normal_load > 1.0)

    def _crouch(self, state: BodyState, measurement: Measurement, elapsed: float, dt: float) -> list[AnyObjective]:
        is_down = self.phase is JumpPhase.CROUCH
        position, velocity = self.plan.crouch(self._start_com, elapsed) if is_down else (self._start_com, np.zeros(3))
        velocity = self._following(measurement, position, velocity, dt)
        pose = self.controller.bent_over_base(position, self._start_base)
        velocity, spin = self.controller.balance_targets(measurement, velocity, self._upright(measurement, pose), dt)
        return self._body_objectives(state, measurement, velocity, pose, spin, dt)

    def _thrust(self, state: BodyState, measurement: Measurement, elapsed: float, dt: float) -> list[AnyObjective]:
        """Return the objectives of the thrust. The target speed along the ground takes the centre of mass from its
        measured position to its target position at touch-down."""
        plan, (position, velocity) = self.plan, self.plan.thrust(self._start_com, elapsed)
        # Limit the upward speed to that which free flight to the requested height requires.
        up = min(self._following(measurement, position, velocity, dt)[2], self._sufficient_speed(measurement, dt))
        left = max((plan.speed_up - measurement.velocity[2]) / plan.speed_up * plan.thrust_time, dt)
        landing = self._landing_com(position)
        goal = np.array([landing[0], self._start_com[1]])
        needed = (goal - measurement.com[:2] - 0.5 * left * measurement.velocity[:2]) / (plan.flight_time + 0.5 * left)
        # The ground forces lag behind the objectives. Therefore the forward speed leads the upward speed, and the
        # shortfall of the last time step is added, up to doubling the change.
        change = (needed - measurement.velocity[:2]) * dt / max(FORWARD_TIME_FRACTION * left, dt)
        short = (
            self._requested_velocity - measurement.velocity[:2] if self._requested_velocity is not None else np.zeros(2)
        )
        max_change = np.linalg.norm(change)
        short *= min(1.0, max_change / max(float(np.linalg.norm(short)), 1e-12))
        velocity = np.array([*(measurement.velocity[:2] + change + short), up])
        flat = self._base_of_landing() - LANDING_LEAN_FRACTION * np.array([self.plan.landing_lag, 0.0])
        upright = self.controller.over_base(landing, flat, self.facing.heading)
        standing = self.controller.bent_over_base(position, self._start_base, self.facing.heading)
        spin = self._thrust_spin(measurement, upright, standing, elapsed, left, dt)
        velocity, spin = self.controller.balance_targets(measurement, velocity, spin, dt)
        self._requested_velocity = velocity[:2]
        return self._body_objectives(state, measurement, velocity, standing, spin, dt)

    def _thrust_spin(
        self,
        measurement: Measurement,
        landing: np.ndarray,
        standing: np.ndarray,
        elapsed: float,
        left: float,
        dt: float,
    ) -> np.ndarray:
        """Return the target spin (3,) in rad/s, ``left`` seconds before take-off.

        It changes gradually from the spin that keeps the body in the pose ``standing`` (3, 3) to the spin that takes it
        to the pose ``landing`` (3, 3). The spin about the up axis grows with the speed, because friction grows with the
        load.
        """
        up, inertia = self.ground.axes[2], measurement.inertia
        upright = self.controller.turn_towards(measurement, landing)
        target_momentum = self.facing.thrust_momentum(
            self.controller, measurement, upright, left=left, flight_time=self.plan.flight_time
        )
        share = min(elapsed / self.plan.thrust_time, 1.0)
        momentum = share * target_momentum + (1.0 - share) * (inertia @ self._upright(measurement, standing))
        if self.facing.target_heading:
            now = up @ measurement.angular_momentum
            about_up = now + dt / max(FORWARD_TIME_FRACTION * left, dt) * (up @ target_momentum - now)
            momentum += (about_up - up @ momentum) * up
        return np.linalg.solve(inertia, momentum)

    def _flight_objectives(self, state: BodyState, measurement: Measurement, dt: float) -> list[AnyObjective]:
        touch_down, left = self._touch_down(measurement, dt)
        heading = self.facing.heading - self.facing.target_heading
        pose = self.controller.over_base(touch_down, self._foothold(state, measurement, touch_down, left), heading)
        # The target is the current spin, because no torque acts on a body in the air, and a foot that is still on the
        # ground must not push.
        spin = np.linalg.solve(measurement.inertia, measurement.angular_momentum)
        pose = self.facing.airborne_pose(pose, measurement.angular_momentum, self.ground.axes[2], left)
        velocity = measurement.velocity - np.array([0.0, 0.0, self.gravity * dt])
        # Increase the weights gradually, so that the strain of the thrust is released first.
        share = self._ramp_or_full(state.time + dt, TAKE_OFF_RELEASE_TIME)
        objectives = self._body_objectives(state, measurement, velocity, pose, spin, dt, left=left, share=share)
        rate = min(APPROACH_RATE / left, 6.0 / self._time_unit)
        return [*objectives, *self._soles.objectives(self.controller, state, pose, rate, share)]

    def _land(self, state: BodyState, measurement: Measurement, dt: float) -> list[AnyObjective]:
        rate = self.plan.landing_rate
        goal = np.array([*(measurement.foot_centre - self.controller.base_offset), self.landing_height])
        damping = 2.0 * self.plan.landing_damping * rate
        acceleration = rate**2 * (goal - measurement.com) - damping * measurement.velocity
        acceleration[2] = max(acceleration[2], -0.8 * self.gravity)
        acceleration[:2] = self.controller.capture_acceleration(measurement, goal[:2])
        velocity = measurement.velocity + dt * acceleration
        heading = self.facing.landed_heading(self.controller, state.positions)
        # The pose is upright for every position of the centre of mass: a pose that leans with it would not return it.
        pose = self.controller.over_base(
            np.array([*goal[:2], measurement.com[2] + dt * velocity[2]]), measurement.foot_centre, heading
        )
        # While the body still moves towards its feet, rotate it until the soles are flat, because a body on its heels
        # cannot brake. If its mean rotation were upright while it is sheared backward, the sole would be tilted up by
        # half of the shear.
        ahead = goal[:2] - measurement.com[:2]
        closing = float(ahead @ measurement.velocity[:2]) / max(float(np.linalg.norm(ahead)), 1e-9 * self.body.height)
        approach = min(max(closing / (FLAT_SOLE_SPEED * self.body.speed_unit), 0.0), 1.0)
        flat = self.controller.over_base(
            np.array([*(goal[:2] - approach * ahead), measurement.com[2]]), measurement.foot_centre, heading
        )
        upright = self._ramp(state.time + dt, LANDING_RAMP_TIME) * self._upright(measurement, flat)
        velocity, spin = self.controller.balance_targets(measurement, velocity, upright, dt)
        # After the ground has stopped the fall, low weights suffice for a body that comes to rest by itself.
        urgent = (self.controller.capture_margin(measurement) - URGENT_CAPTURE_MARGIN) / (1.0 - URGENT_CAPTURE_MARGIN)
        share = self._ramp_or_full(state.time + dt, LANDING_RAMP_TIME) * max(self.weights.landing, min(urgent, 1.0))
        return self._body_objectives(state, measurement, velocity, pose, spin, dt, share=share)

    def _ramp_or_full(self, time: float, unit: float) -> float:
        """Return the fraction of the full weight of ``_ramp``; 1 for a jump that turns."""
        return 1.0 if self.facing.target_heading else self._ramp(time, unit)

    def _ramp(self, time: float, unit: float) -> float:
        """Return the fraction of the full weight at ``time`` s; it grows to 1 within ``unit`` sqrt(H / g) after the
        start of the phase."""
        share = min((time - self._entered) / (unit * self._time_unit), 1.0)
        return share * share * (3.0 - 2.0 * share)

    def _following(self, measurement: Measurement, position: np.ndarray, velocity: np.ndarray, dt: float) -> np.ndarray:
        """Return the velocity (3,) in m/s that follows a reference ``position`` (3,) with its ``velocity`` (3,)."""
        rate = 6.0 / self._time_unit
        return velocity + rate * (position - velocity * dt - measurement.com)

    def _upright(self, measurement: Measurement, pose: np.ndarray) -> np.ndarray:
        """Return the spin (3,) in rad/s that turns a standing body to ``pose`` (3, 3)."""
        return self.controller.turn_towards(measurement, pose) * 4.0 / self._time_unit

    def _sufficient_speed(self, measurement: Measurement, dt: float) -> float:
        """Return the upward speed in m/s at the end of this time step with which free flight reaches the target
        height."""
        rise = self._start_com[2] + AIM_RISE_FRACTION * self.target.height - measurement.com[2]
        return sufficient_speed(rise, self.gravity, dt)

    def _base_of_landing(self) -> np.ndarray:
        """Return the target (2,) of the middle of the feet, in the frame of the start."""
        return self._start_base + [self.target.distance, 0.0]

    def _landing_com(self, position: np.ndarray) -> np.ndarray:
        """Return the target (3,) of the centre of mass at touch-down, in the frame of the start."""
        ahead = self._base_of_landing()[0] - self.controller.base_offset[0] - self.plan.landing_lag
        return np.array([ahead, position[1], self._start_com[2]])

    def _touch_down(self, measurement: Measurement, dt: float) -> tuple[np.ndarray, float]:
        """Predict the touch-down, when the feet have fallen by their present height: the position (3,) of the centre of
        mass, m, and the time until then, s."""
        speed, gap = measurement.velocity[2], max(measurement.sole_height, 0.0)
        drop = max(measurement.com[2] - self._start_com[2], 0.0)
        latest = max((speed + np.sqrt(max(speed**2 + 2.0 * self.gravity * drop, 0.0))) / self.gravity, dt)
        left = min(max((speed + np.sqrt(speed**2 + 2.0 * self.gravity * gap)) / self.gravity, dt), latest)
        return np.array([*(measurement.com[:2] + measurement.velocity[:2] * left), self._start_com[2]]), left

    def _foothold(self, state: BodyState, measurement: Measurement, touch_down: np.ndarray, left: float) -> np.ndarray:
        """Return the foothold (2,) for a landing in ``left`` seconds: the target if the body can come to rest over it,
        otherwise the nearest point over which it can."""
        if (
            measurement.velocity[2] > 0.0
            and self.ground.local(state.positions)[:, 2].min() < STEP_CLEARANCE * self.target.rise
        ):
            # Feet that swing forward before they are higher than the step in the ground would strike it.
            return touch_down[:2] + measurement.foot_centre - measurement.com[:2]
        falling = max(left * self.gravity - measurement.velocity[2], 0.0)
        capture_time = stopping_time(self.controller.standing_height, falling, self.gravity, self._landing_time)
        capture = touch_down[:2] + measurement.velocity[:2] * capture_time + self.controller.base_offset
        # Limit the offset of the capture point from the foothold to this part of the footprint.
        return capture - nearest_in_half_planes(
            self.controller.footprint.normals, self._max_foothold_offsets(), capture - self._start_base
        )

    def _max_foothold_offsets(self) -> np.ndarray:
        """Return the largest offsets (m,) in metres of the capture point towards the edges of the footprint."""
        away = self.controller.footprint.offsets
        width = away / self.controller.standing_height
        return (
            MAX_FOOTHOLD_OFFSET * np.clip((width - NARROW_SUPPORT) / (WIDE_SUPPORT - NARROW_SUPPORT), 0.0, 1.0) * away
        )

    def _body_objectives(
        self,
        state: BodyState,
        measurement: Measurement,
        com_velocity: np.ndarray,
        pose: np.ndarray,
        spin: np.ndarray,
        dt: float,
        *,
        left: float | None = None,
        share: float = 1.0,
    ) -> list[AnyObjective]:
        """Return the objectives of the body.

        Args:
            state: current state.
            measurement: measured body.
            com_velocity: (3,) m/s, target velocity of the centre of mass, ground axes.
            pose: (3, 3) target pose.
            spin: (3,) rad/s, target spin, world axes.
            dt: time step, s.
            left: time until the landing of a body in the air, s; None on the ground.
            share: factor on the weights of balance during the landing, and on the weight of the pose in the air.
        """
        # If a phase begins with another pose than the last phase, the poses are blended over several time steps.
        pose = self._pose_before + self._ramp(state.time + dt, POSE_BLEND_TIME) * (pose - self._pose_before)
        rate = (pose - self._last_pose) / dt
        if np.abs(rate).max() > 5.0 / self._time_unit:
            rate = np.zeros((3, 3))
        self._last_pose = pose
        # The ground must stop the fall; with free fall as the objective, the muscles would pull the feet away from it.
        falling = self.phase is JumpPhase.FLIGHT and float(com_velocity[2]) < 0.0
        follow, weights = 6.0 / self._time_unit, self.weights
        if self.phase is JumpPhase.LAND or falling:
            factor = 0.0 if falling else share
            weights = replace(weights, com=factor * weights.com, up=factor * weights.up, spin=factor * weights.spin)
        if left is not None:
            follow, weights = min(APPROACH_RATE / left, follow), replace(weights, pose=share * self._airborne)
        return self.controller.objectives(
            state,
            measurement,
            com_velocity=com_velocity,
            pose=pose,
            pose_rate=rate,
            spin=spin,
            follow=follow,
            weights=weights,
        )
