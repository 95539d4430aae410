"""A jump to a place, as a closed-loop state machine that writes objectives from the measured state
(docs/concepts/motions.md).

From take-off on it is told in the frame of the landing, which may be turned, higher or lower.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective, BodyPart, Coordinates, part_velocity
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
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
from egs_warp.motions.stance import BalanceController, GroundFrame, Measurement, RestDetector, Weights, sole_shares
from egs_warp.motions.walk_posture import LeggedPosture, select_posture

STOP_RISE_FRACTION = 0.94
"""A thrust ends when the centre of mass would reach this share of the asked height in free flight: one step more is too
much."""
AIM_RISE_FRACTION = 0.99
"""What a thrust aims at, clear of ``RISE``, so that a speed that is nearly followed ends it."""
FORWARD_TIME_FRACTION = 0.7
"""Part of the time of a thrust in which the speed forward is to be reached."""
MAX_FOOTHOLD_OFFSET = 0.4
"""Of the footprint: how far from the capture point the feet may be put down for the sake of the target."""
CLEARANCE = 0.15
"""Of the height of a step: how far above it the feet are before they swing ahead."""
APPROACH_RATE = 2.5
"""Over the time left in the air: the rate at which the pose of the landing is approached, gently at first."""
TOUCH_DOWN_HEIGHT = 0.06
"""Body heights: a centre of mass that has come down to so little above where it stood has landed with the first
foot."""
MAX_LANDING_TIME = 9.0
"""Of sqrt(H / g): a body that is not calm by then counts as at rest."""
LANDING_RAMP_TIME = 0.5
"""Of sqrt(H / g): the time from touch-down until balance and upright are asked for in full."""
LANDING_LEAN_FRACTION = 0.7
"""Of the lean of the landing: what the body is not to be turned by at touch-down. It shears by so much less than its
feet are ahead, and on its heels it would be thrown over them.
"""
FLAT_SOLE_SPEED = 0.1
"""Of sqrt(g H): what comes up to its feet as fast has soles to be flat at all costs, what is slower in part."""
POSE_BLEND_TIME = 0.3
"""Of sqrt(H / g): the time in which a phase's pose takes over from the last one's."""
TAKE_OFF_RELEASE_TIME = 0.6
"""Of sqrt(H / g): the time after take-off in which the pose of the landing is taken up."""
URGENT_CAPTURE_MARGIN = 0.5
"""Of the way from the middle of the feet to their edge: with its capture point beyond, a body that lands is balanced
with more than the usual share of the weights."""
SWING_WEIGHT, BASE_SWING = 5.0, 1.0
"""Weights of the soles in the air, of feet on legs and of a base: they swing ahead under a body that keeps its shape.
Told by the pose alone they come down 0.03 body heights short, and a body with little in front of it falls over them. A
base is stiff: with 5 a monkey's jump takes half as much work again, and lands no better."""
AIRBORNE_POSE_WEIGHT, BASE_AIRBORNE = 2.0, 0.3
"""Weights of the pose in the air, where nothing else can be steered and the feet have to get to their place: on legs
and of what turns as it flies, by how wide it makes itself; and on a base, straight ahead: with 2 muscles of a pawn give
0.76 m g H in the air, with 0.3 they give 0.30, and it lands as well."""


class Jump:
    """Settle, crouch, thrust until the measured speed suffices, fly, land ``target.distance`` ahead, rest as soon as it
    is calm."""

    def __init__(
        self,
        place: Stance,
        target: JumpTarget,
        *,
        facing: HeadingPolicy | None = None,
        weights: Weights | None = None,
        settled: bool = False,
    ) -> None:
        """``facing``: which way it lands; straight ahead if not given. ``settled``: it crouches from its first step
        on."""
        body, ground = place.body, place.ground
        self.body, self.target, self.facing = body, target, facing or KeepHeading()
        self.weights = weights or Weights()
        self.gravity = float(np.linalg.norm(body.gravity))
        landing = GroundFrame(
            ground.axes @ ground.rotation_about_up(self.facing.target_heading).T,
            ground.origin + target.distance * ground.axes[0] + target.rise * ground.axes[2],
            ground.surface_normal,
        )
        self.pose = BalanceController(body, ground, place.standing, place.contact_points, place.friction)
        self._landing = BalanceController(
            body,
            landing,
            landing.world(ground.local(place.standing)),
            landing.world(ground.local(place.contact_points)),
            place.friction,
        )
        feet, carriage = select_posture(place)
        on_legs = carriage is LeggedPosture
        self._swing = SWING_WEIGHT if on_legs else BASE_SWING
        self._airborne = AIRBORNE_POSE_WEIGHT if on_legs or self.facing.target_heading else BASE_AIRBORNE
        base = np.flatnonzero(sole_shares(body, ground, place.standing))
        self._soles = [
            BodyPart.of(body, "sole", sole) for sole in ([foot.sole for foot in feet] if on_legs else [base])
        ]
        self._time_unit = float(np.sqrt(body.height / self.gravity))
        # Feet on legs are put down where they are asked to be, and stay there.
        self._landing_time = LANDING_TIME * self._time_unit if on_legs else 0.0
        ahead = ground.axes[0] @ (place.contact_points - body.centre_of_mass(place.standing)).T
        self._style = place.style
        self._step, self._furthest_lean = place.step, MAX_LEAN * float(ahead.max())
        self.plan = self._planned(target)
        self._settled = settled
        self.phase = JumpPhase.SETTLE
        self._entered = 0.0
        local = ground.local(place.standing)
        self._start_com = body.centre_of_mass(local)
        self._start_base = self._start_com[:2] + self.pose.base_offset
        self._last_pose = self._pose_before = np.eye(3)
        self._asked: np.ndarray | None = None
        self._flew = False
        self._calm = RestDetector(body)
        self._overran: list[JumpPhase] = []

    @property
    def ground(self) -> GroundFrame:
        """The frame in which the motion is told: of the start, from take-off on of the landing."""
        return self.pose.ground

    @property
    def is_airborne(self) -> bool:
        """Whether the motion is told in the frame of the landing."""
        return self.pose is self._landing

    @property
    def expected_time(self) -> float:
        """Seconds until it is at rest."""
        return self.plan.expected_duration(abs(self.target.distance) / self.body.height, self._time_unit)

    def _planned(self, target: JumpTarget) -> JumpPlan:
        return plan_jump(
            target,
            height=self.body.height,
            com_height=self.pose.standing_height,
            support_ahead=float(self.pose.support_high[0]),
            gravity=self.gravity,
            step=self._step,
            lean=min(LEAN_FRACTION * target.distance, self._furthest_lean),
            friction=self.pose.friction,
            landing_time=self._landing_time,
            style=self._style,
        )

    def take_off_time(self, height: float) -> float:
        """Seconds from the crouch of a jump on the spot, ``height`` metres high, until its thrust ends as planned;
        both take whole steps."""
        return self._planned(JumpTarget(0.0, height)).take_off_time(self._step)

    @property
    def is_at_rest(self) -> bool:
        """Whether the body has landed and is calm."""
        return self.phase is JumpPhase.REST

    def plan_record(self) -> JumpPlan:
        """What the jump aims at."""
        return self.plan

    def planned_com(self, elapsed: float) -> np.ndarray:
        """(3,) metres from where the centre of mass stood, ``elapsed`` seconds after the motion began; NaN after
        touch-down."""
        plan, ground = self.plan, self.ground
        axes = ground.axes @ ground.rotation_about_up(self.facing.target_heading) if self.is_airborne else ground.axes
        return plan.planned_displacement(max(elapsed - SETTLE_TIME * self._time_unit, 0.0), self.gravity) @ axes

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> None:
        """Nothing beside what is measured of all motions."""

    def notes(self) -> list[str]:
        """What kept the jump from its target, for the user."""
        named = {
            JumpPhase.THRUST: "the muscles could not reach the take-off speed within the time of a thrust",
            JumpPhase.FLIGHT: "the body never came back to the ground",
        }
        return [f"{phase.value} took too long: {named[phase]}" for phase in self._overran]

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        seen = self.pose.measure(state, report)
        self.facing.update(seen.heading + (self.facing.target_heading if self.is_airborne else 0.0))
        self._advance_phase(seen, state.time, dt)
        elapsed = state.time - self._entered + dt
        if self.phase is JumpPhase.FLIGHT:
            return self._flight_objectives(state, seen, dt)
        if self.phase is JumpPhase.THRUST:
            return self._thrust(state, seen, elapsed, dt)
        if self.phase in (JumpPhase.SETTLE, JumpPhase.CROUCH):
            return self._crouch(state, seen, elapsed, dt)
        return self._land(state, seen, dt)

    def _advance_phase(self, seen: Measurement, time: float, dt: float) -> None:
        # What a foot brushes on its way up is no landing.
        seen = replace(seen, in_contact=seen.in_contact and seen.velocity[2] < 0.0)
        elapsed, plan = time - self._entered + 1e-9, self.plan
        following = {
            JumpPhase.SETTLE: self._settled or elapsed >= SETTLE_TIME * self._time_unit,
            JumpPhase.CROUCH: elapsed >= plan.crouch_time,
            JumpPhase.THRUST: self._is_thrust_done(seen, dt),
            JumpPhase.FLIGHT: self._flew and self._has_landed(seen),
            JumpPhase.LAND: elapsed >= MAX_LANDING_TIME * self._time_unit,
            JumpPhase.REST: False,
        }
        if self.phase is JumpPhase.FLIGHT and not seen.in_contact:
            self._flew = True
        limits = {JumpPhase.THRUST: 3.0 * plan.thrust_time, JumpPhase.FLIGHT: 3.0 * plan.flight_time}
        if not following[self.phase] and elapsed > limits.get(self.phase, np.inf):
            self._overran.append(self.phase)
            following[self.phase] = True
        if following[self.phase]:
            self.phase = list(JumpPhase)[list(JumpPhase).index(self.phase) + 1]
            self._entered, self._pose_before = time, self._last_pose
        if self.phase is JumpPhase.FLIGHT and not self.is_airborne:
            # Poses are told from how the body stands, which is turned where it lands.
            turned = self.ground.rotation_about_up(self.facing.target_heading)
            self._last_pose, self._pose_before = self._last_pose @ turned.T, self._pose_before @ turned.T
            self.pose = self._landing
        elif self.phase is JumpPhase.LAND and self._calm.update(seen.velocity, time):
            self.phase = JumpPhase.REST

    def _is_thrust_done(self, seen: Measurement, dt: float) -> bool:
        """Whether the centre of mass, in free flight from here, would reach the asked height."""
        speed = max(seen.velocity[2] - 0.5 * self.gravity * dt, 0.0)
        apex = seen.com[2] + speed**2 / (2.0 * self.gravity)
        enough = bool(apex >= self._start_com[2] + STOP_RISE_FRACTION * self.target.height)
        # A body in the air has thrust, however fast it goes; waiting for the asked speed there would lose the steering
        # of the feet.
        return enough or not (seen.in_contact or seen.sole_height <= 0.0)

    def _has_landed(self, seen: Measurement) -> bool:
        """Whether the body stands on the ground again; the first foot to brush it is too little to balance on."""
        low = seen.com[2] < self._start_com[2] + TOUCH_DOWN_HEIGHT * self.body.height
        return seen.in_contact and seen.velocity[2] < 0.0 and (low or seen.normal_load > 1.0)

    def _crouch(self, state: BodyState, seen: Measurement, elapsed: float, dt: float) -> list[AnyObjective]:
        position, velocity = self._start_com, np.zeros(3)
        if self.phase is JumpPhase.CROUCH:
            position, velocity = self.plan.crouch(self._start_com, elapsed)
        velocity = self._following(seen, position, velocity, dt)
        pose = self.pose.bent_over_base(position, self._start_base)
        velocity, spin = self.pose.balance_targets(seen, velocity, self._upright(seen, pose), dt)
        return self._body_objectives(state, seen, velocity, pose, spin, dt)

    def _thrust(self, state: BodyState, seen: Measurement, elapsed: float, dt: float) -> list[AnyObjective]:
        """Along the ground the speed that brings the centre of mass from where it is to where it shall touch down."""
        plan = self.plan
        position, velocity = plan.thrust(self._start_com, elapsed)
        # No faster up than free flight to the asked height needs.
        up = min(self._following(seen, position, velocity, dt)[2], self._sufficient_speed(seen, dt))
        left = max((plan.speed_up - seen.velocity[2]) / plan.speed_up * plan.thrust_time, dt)
        landing = self._landing_com(position)
        goal = np.array([landing[0], self._start_com[1]])
        needed = (goal - seen.com[:2] - 0.5 * left * seen.velocity[:2]) / (plan.flight_time + 0.5 * left)
        # What the ground gives lags behind what is asked: the speed forward is asked for ahead of the speed up, and
        # with what the last step fell short by, at most twice over.
        change = (needed - seen.velocity[:2]) * dt / max(FORWARD_TIME_FRACTION * left, dt)
        short = self._asked - seen.velocity[:2] if self._asked is not None else np.zeros(2)
        most = np.linalg.norm(change)
        short *= min(1.0, most / max(float(np.linalg.norm(short)), 1e-12))
        velocity = np.array([*(seen.velocity[:2] + change + short), up])
        flat = self._base_of_landing() - LANDING_LEAN_FRACTION * np.array([self.plan.landing_lag, 0.0])
        upright = self.pose.over_base(landing, flat, self.facing.heading)
        standing = self.pose.bent_over_base(position, self._start_base, self.facing.heading)
        spin = self._thrust_spin(seen, upright, standing, elapsed, left, dt)
        velocity, spin = self.pose.balance_targets(seen, velocity, spin, dt)
        self._asked = velocity[:2]
        return self._body_objectives(state, seen, velocity, standing, spin, dt)

    def _thrust_spin(
        self, seen: Measurement, landing: np.ndarray, standing: np.ndarray, elapsed: float, left: float, dt: float
    ) -> np.ndarray:
        """(3,) rad/s to ask for ``left`` seconds before take-off: from what keeps the body in the pose ``standing``
        (3, 3) to what brings it to that of the ``landing`` (3, 3). The spin of a turn grows as the speed does, since
        friction does with the load."""
        up, inertia = self.ground.axes[2], seen.inertia
        upright = self.pose.turn_towards(seen, landing)
        wanted = self.facing.thrust_momentum(self.pose, seen, upright, left=left, flight_time=self.plan.flight_time)
        share = min(elapsed / self.plan.thrust_time, 1.0)
        momentum = share * wanted + (1.0 - share) * (inertia @ self._upright(seen, standing))
        if self.facing.target_heading:
            now = up @ seen.angular_momentum
            about_up = now + dt / max(FORWARD_TIME_FRACTION * left, dt) * (up @ wanted - now)
            momentum += (about_up - up @ momentum) * up
        return np.linalg.solve(inertia, momentum)

    def _flight_objectives(self, state: BodyState, seen: Measurement, dt: float) -> list[AnyObjective]:
        touch_down, left = self._touch_down(seen, dt)
        heading = self.facing.heading - self.facing.target_heading
        pose = self.pose.over_base(touch_down, self._foothold(state, seen, touch_down, left), heading)
        # Nothing turns a body in the air; a foot that lags on the ground must not push any more.
        spin = np.linalg.solve(seen.inertia, seen.angular_momentum)
        pose = self.facing.airborne_pose(pose, seen.angular_momentum, self.ground.axes[2], left)
        velocity = seen.velocity - np.array([0.0, 0.0, self.gravity * dt])
        # What was strained by the thrust is let go of first.
        share = self._ramp_or_full(state.time + dt, TAKE_OFF_RELEASE_TIME)
        held = self._body_objectives(state, seen, velocity, pose, spin, dt, left=left, share=share)
        return [*held, *self._swing_objectives(state, pose, left, share)]

    def _swing_objectives(self, state: BodyState, pose: np.ndarray, left: float, share: float) -> list[AnyObjective]:
        """Soles go to where the ``pose`` (3, 3) of the landing has them, in ``left`` s, for a ``share`` of their
        weight."""
        rate = min(APPROACH_RATE / left, 6.0 / self._time_unit)
        com, about = self.body.centre_of_mass(state.positions), Coordinates(np.eye(3), True)

        def swung(sole: BodyPart) -> AnyObjective:
            way = pose @ sole.centre(self.pose.arms) - (sole.centre(state.positions) - com)
            return part_velocity(self.body, sole, rate * way, share * self._swing, about)

        return [swung(sole) for sole in self._soles]

    def _land(self, state: BodyState, seen: Measurement, dt: float) -> list[AnyObjective]:
        rate = self.plan.landing_rate
        goal = np.array([*(seen.foot_centre - self.pose.base_offset), self._start_com[2]])
        acceleration = rate**2 * (goal - seen.com) - 2.0 * rate * seen.velocity
        acceleration[2] = max(acceleration[2], -0.8 * self.gravity)
        acceleration[:2] = self.pose.capture_acceleration(seen, goal[:2])
        velocity = seen.velocity + dt * acceleration
        heading = self.facing.landed_heading(self.pose, state.positions)
        # Upright, wherever the centre of mass is now: a body that leans with it is never called back.
        pose = self.pose.over_base(np.array([*goal[:2], seen.com[2] + dt * velocity[2]]), seen.foot_centre, heading)
        # What still comes up to its feet is turned until these are flat, for whoever stands on his heels cannot brake:
        # upright in the mean while it is sheared back, its sole would point up by half of that.
        ahead = goal[:2] - seen.com[:2]
        closing = float(ahead @ seen.velocity[:2]) / max(float(np.linalg.norm(ahead)), 1e-9 * self.body.height)
        coming = min(max(closing / (FLAT_SOLE_SPEED * self.body.speed_unit), 0.0), 1.0)
        flat = self.pose.over_base(np.array([*(goal[:2] - coming * ahead), seen.com[2]]), seen.foot_centre, heading)
        upright = self._ramp(state.time + dt, LANDING_RAMP_TIME) * self._upright(seen, flat)
        velocity, spin = self.pose.balance_targets(seen, velocity, upright, dt)
        # The ground catches what comes down; then little is asked of what comes to rest by itself.
        urgent = (self.pose.capture_margin(seen) - URGENT_CAPTURE_MARGIN) / (1.0 - URGENT_CAPTURE_MARGIN)
        share = self._ramp_or_full(state.time + dt, LANDING_RAMP_TIME) * max(self.weights.landing, min(urgent, 1.0))
        return self._body_objectives(state, seen, velocity, pose, spin, dt, share=share)

    def _ramp_or_full(self, time: float, unit: float) -> float:
        """As ``_grown``, at once of what has a turn to steer."""
        return 1.0 if self.facing.target_heading else self._ramp(time, unit)

    def _ramp(self, time: float, unit: float) -> float:
        """Share of the weight at ``time`` s of what grows to all of it over ``unit`` sqrt(H / g) of a phase."""
        share = min((time - self._entered) / (unit * self._time_unit), 1.0)
        return share * share * (3.0 - 2.0 * share)

    def _following(self, seen: Measurement, position: np.ndarray, velocity: np.ndarray, dt: float) -> np.ndarray:
        """(3,) m/s that follows a reference ``position`` (3,) with its ``velocity`` (3,)."""
        rate = 6.0 / self._time_unit
        return velocity + rate * (position - velocity * dt - seen.com)

    def _upright(self, seen: Measurement, pose: np.ndarray) -> np.ndarray:
        """(3,) rad/s that turns a standing body to ``pose`` (3, 3)."""
        return self.pose.turn_towards(seen, pose) * 4.0 / self._time_unit

    def _sufficient_speed(self, seen: Measurement, dt: float) -> float:
        """Speed up, m/s, at the end of this step from which free flight reaches the asked height."""
        rise = self._start_com[2] + AIM_RISE_FRACTION * self.target.height - seen.com[2]
        return sufficient_speed(rise, self.gravity, dt)

    def _base_of_landing(self) -> np.ndarray:
        """(2,) where the middle of the feet shall land, in the frame of the start."""
        return self._start_base + [self.target.distance, 0.0]

    def _landing_com(self, position: np.ndarray) -> np.ndarray:
        """(3,) where the centre of mass shall touch down, in the frame of the start."""
        ahead = self._base_of_landing()[0] - self.pose.base_offset[0] - self.plan.landing_lag
        return np.array([ahead, position[1], self._start_com[2]])

    def _touch_down(self, seen: Measurement, dt: float) -> tuple[np.ndarray, float]:
        """Where the centre of mass (3,) will be when the feet have fallen by their distance to the ground now, and in
        how many s."""
        drop = max(seen.com[2] - self._start_com[2], 0.0)
        speed, gap = seen.velocity[2], max(seen.sole_height, 0.0)
        latest = max((speed + np.sqrt(max(speed**2 + 2.0 * self.gravity * drop, 0.0))) / self.gravity, dt)
        left = min(max((speed + np.sqrt(speed**2 + 2.0 * self.gravity * gap)) / self.gravity, dt), latest)
        return np.array([*(seen.com[:2] + seen.velocity[:2] * left), self._start_com[2]]), left

    def _foothold(self, state: BodyState, seen: Measurement, touch_down: np.ndarray, left: float) -> np.ndarray:
        """(2,) where to put the feet in ``left`` s: the target, if the body that comes in so can stop over it."""
        if seen.velocity[2] > 0.0 and self.ground.local(state.positions)[:, 2].min() < CLEARANCE * self.target.rise:
            # Feet that swing ahead before they are higher than the step would strike it.
            return touch_down[:2] + seen.foot_centre - seen.com[:2]
        falling = max(left * self.gravity - seen.velocity[2], 0.0)
        capture_time = stopping_time(self.pose.standing_height, falling, self.gravity, self._landing_time)
        capture = touch_down[:2] + seen.velocity[:2] * capture_time + self.pose.base_offset
        low, high = self.pose.support_low, self.pose.support_high
        # The capture point stays within their share of the feet, wherever these are.
        return np.clip(self._start_base, capture - MAX_FOOTHOLD_OFFSET * high, capture - MAX_FOOTHOLD_OFFSET * low)

    def _body_objectives(
        self,
        state: BodyState,
        seen: Measurement,
        com_velocity: np.ndarray,
        pose: np.ndarray,
        spin: np.ndarray,
        dt: float,
        *,
        left: float | None = None,
        share: float = 1.0,
    ) -> list[AnyObjective]:
        """``left``: seconds before the landing, of a body in the air; ``share``: of their weight with which one that
        lands is balanced, and the pose of one in the air held."""
        # Where a phase begins with another pose than the last ended with, the way between them is gone in some steps.
        pose = self._pose_before + self._ramp(state.time + dt, POSE_BLEND_TIME) * (pose - self._pose_before)
        rate = (pose - self._last_pose) / dt
        if np.abs(rate).max() > 5.0 / self._time_unit:
            rate = np.zeros((3, 3))
        self._last_pose = pose
        # What comes down is to be stopped by the ground: asked for free fall, muscles would pull the feet away.
        falling = self.phase is JumpPhase.FLIGHT and float(com_velocity[2]) < 0.0
        follow, weights = 6.0 / self._time_unit, self.weights
        if self.phase is JumpPhase.LAND or falling:
            asked = 0.0 if falling else share
            weights = replace(weights, com=asked * weights.com, up=asked * weights.up, spin=asked * weights.spin)
        if left is not None:
            follow, weights = min(APPROACH_RATE / left, follow), replace(weights, pose=share * self._airborne)
        return self.pose.objectives(
            state,
            seen,
            com_velocity=com_velocity,
            pose=pose,
            pose_rate=rate,
            spin=spin,
            follow=follow,
            weights=weights,
        )
