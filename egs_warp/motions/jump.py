"""Motions as closed-loop state machines that write objectives from the measured state (DESIGN 9)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import Enum

import numpy as np

from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.locomotion.objectives import Objective, SpinObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.stance import Ground, Measurement, PoseFamily, Weights

RISE = 0.92
"""A thrust ends when the centre of mass would reach this share of the asked height in free flight:
one step more is too much.
"""
CARRIED = 2.0
"""Speed ahead at the end of a crouch, in leans over its time: 2 is a steady acceleration, 0 a stop."""
FULL_RISE = 0.99
"""What a thrust aims at, clear of ``RISE``, so that a speed that is nearly followed ends it."""


class JumpPhase(Enum):
    """Phases of a jump in their order."""

    SETTLE = "settle"
    CROUCH = "crouch"
    THRUST = "thrust"
    FLIGHT = "flight"
    LAND = "land"
    REST = "rest"


@dataclass(frozen=True)
class JumpTarget:
    """What is asked, in metres."""

    distance: float
    height: float
    rise: float = 0.0
    """How much higher the landing is than the start."""


@dataclass(frozen=True)
class JumpPlan:
    """Numbers a jump is planned with; metres, seconds, m/s."""

    crouch_depth: float
    extension: float
    crouch_time: float
    thrust_time: float
    flight_time: float
    speed_up: float
    speed_forward: float
    lean: float
    """How far the centre of mass moves ahead while crouching."""
    landing_lag: float
    """How far it is behind its place over the base at touch-down."""
    landing_rate: float
    """1/s of the critically damped descent on landing."""


def plan_jump(
    target: JumpTarget,
    *,
    height: float,
    com_height: float,
    support_behind: float,
    support_ahead: float,
    gravity: float,
    step: float,
    lean: float | None = None,
) -> JumpPlan:
    """Stroke, times and take-off velocity for a jump of ``target`` by a body of ``height`` H (DESIGN 9).

    ``lean`` (metres) replaces the choice made here.
    """
    time_unit = np.sqrt(height / gravity)
    extension = min(0.04 * height, 0.25 * target.height)
    rise = target.height - extension
    speed_up = np.sqrt(2.0 * gravity * rise) + 0.5 * gravity * step
    acceleration = 1.6 * gravity
    stroke = max(speed_up**2 / (2.0 * acceleration), extension + 0.02 * height)
    thrust_time = 2.0 * stroke / speed_up
    # Every step goes its whole way at the speed of its end: half a step's way more than steady acceleration takes.
    stroke += 0.5 * speed_up * step
    flight_time = np.sqrt(2.0 * rise / gravity) + np.sqrt(2.0 * max(rise - target.rise, 0.0) / gravity)
    if lean is None:
        lean = min(0.3 * support_ahead, 0.05 * height, 0.2 * target.distance)
    # A body that comes in with speed v stops over its base if that is ahead by v sqrt(h/g) (the capture point); the
    # front of the footprint helps.
    capture_time = np.sqrt(com_height / (1.3 * gravity))
    footprint_help = min(0.3 * support_ahead, 0.5 * target.distance * capture_time / flight_time)
    speed_forward = (target.distance - lean + footprint_help) / (flight_time + capture_time + 0.5 * thrust_time)
    landing_lag = speed_forward * capture_time - footprint_help
    return JumpPlan(
        crouch_depth=stroke - extension,
        extension=extension,
        crouch_time=1.1 * time_unit,
        thrust_time=thrust_time,
        flight_time=flight_time,
        speed_up=speed_up,
        speed_forward=speed_forward,
        lean=lean,
        landing_lag=landing_lag,
        landing_rate=4.0 / time_unit,
    )


class Jump:
    """Settle, crouch, thrust until the measured speed suffices, fly, land, come to rest."""

    def __init__(
        self,
        body: SoftBody,
        ground: Ground,
        standing: np.ndarray,
        target: JumpTarget,
        *,
        touching: np.ndarray,
        step: float,
        weights: Weights | None = None,
        lean: float | None = None,
    ) -> None:
        self.body, self.ground, self.target = body, ground, target
        self.weights = weights or Weights()
        self.pose = PoseFamily(body, ground, standing, touching)
        self.gravity = float(np.linalg.norm(body.gravity))
        self.plan = plan_jump(
            target,
            height=body.height,
            com_height=self.pose.standing_height,
            support_behind=float(-self.pose.support_low[0]),
            support_ahead=float(self.pose.support_high[0]),
            gravity=self.gravity,
            step=step,
            lean=lean,
        )
        self.phase = JumpPhase.SETTLE
        self._entered = 0.0
        local = ground.local(standing)
        self._start_com = body.centre_of_mass(local)
        self._start_base = self._start_com[:2] + self.pose.base_offset
        self._goal_base = self._start_base + [target.distance, 0.0]
        self._pose = np.eye(3)
        self._time_unit = float(np.sqrt(body.height / self.gravity))
        self._follow = 6.0 / self._time_unit
        self._flew = False
        self._overran: list[JumpPhase] = []

    def planned(self) -> dict[str, float]:
        """What the jump aims at, after re-planning: metres, seconds, m/s."""
        return {name: float(value) for name, value in asdict(self.plan).items()}

    def notes(self) -> list[str]:
        """What kept the jump from its target, for the user."""
        named = {
            JumpPhase.THRUST: "the muscles could not reach the take-off speed within the time of a thrust",
            JumpPhase.FLIGHT: "the body never came back to the ground",
        }
        return [f"{phase.value} took too long: {named[phase]}" for phase in self._overran]

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[Objective | SpinObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        seen = self.pose.measure(state, report)
        self._advance_phase(seen, state.time, dt)
        elapsed = state.time - self._entered + dt
        if self.phase is JumpPhase.FLIGHT:
            return self._fly(state, seen, dt)
        if self.phase in (JumpPhase.SETTLE, JumpPhase.CROUCH, JumpPhase.THRUST):
            position, velocity = self._stance_reference(elapsed)
            rate = 6.0 / self._time_unit
            com_velocity = velocity + rate * (position - velocity * dt - seen.com)
            com_velocity = self._balanced(seen, com_velocity, dt)
            if self.phase is JumpPhase.THRUST:
                com_velocity = self._thrust_velocity(com_velocity, seen, position, dt)
            return self._stand(state, com_velocity, position, self._start_base, dt)
        return self._land(state, seen, dt)

    def _thrust_velocity(
        self, com_velocity: np.ndarray, seen: Measurement, position: np.ndarray, dt: float
    ) -> np.ndarray:
        """``com_velocity`` (3,) m/s, no faster than free flight to the target needs;
        ``position`` (3,) is the reference's.
        """
        forward = (self._landing_com(position)[0] - seen.com[0]) / self.plan.flight_time
        speed_up = min(com_velocity[2], self._sufficient_speed(seen, dt))
        return np.array([min(com_velocity[0], max(forward, 0.0)), com_velocity[1], speed_up])

    def _advance_phase(self, seen: Measurement, time: float, dt: float) -> None:
        elapsed, plan = time - self._entered, self.plan
        following = {
            JumpPhase.SETTLE: elapsed >= 0.3 * self._time_unit,
            JumpPhase.CROUCH: elapsed >= plan.crouch_time,
            JumpPhase.THRUST: self._risen(seen, dt),
            JumpPhase.FLIGHT: self._flew and self._landed(seen),
            JumpPhase.LAND: elapsed >= 9.0 * self._time_unit,
            JumpPhase.REST: False,
        }
        if self.phase is JumpPhase.FLIGHT and not seen.touching:
            self._flew = True
        limits = {JumpPhase.THRUST: 3.0 * plan.thrust_time, JumpPhase.FLIGHT: 3.0 * plan.flight_time}
        if not following[self.phase] and elapsed > limits.get(self.phase, np.inf):
            self._overran.append(self.phase)
            following[self.phase] = True
        if following[self.phase]:
            self.phase = list(JumpPhase)[list(JumpPhase).index(self.phase) + 1]
            self._entered = time

    def _landed(self, seen: Measurement) -> bool:
        """Whether the body stands on the ground again; the first foot to brush it is too little to balance on."""
        low = seen.com[2] < self._start_com[2] + 0.06 * self.body.height
        return seen.touching and seen.velocity[2] < 0.0 and (low or seen.load > 1.0)

    def _sufficient_speed(self, seen: Measurement, dt: float) -> float:
        """Speed up, m/s, at the end of this step from which free flight reaches the asked height."""
        rise = self._start_com[2] + FULL_RISE * self.target.height - seen.com[2]
        step_gain = self.gravity * dt  # v dt + (v - g dt/2)^2 / 2g = rise, solved for v
        return float(max(-0.5 * step_gain + np.sqrt(max(2.0 * self.gravity * rise, 0.0)), 0.0))

    def _risen(self, seen: Measurement, dt: float) -> bool:
        """Whether the centre of mass, in free flight from here, would reach the asked height."""
        speed = max(seen.velocity[2] - 0.5 * self.gravity * dt, 0.0)
        apex = seen.com[2] + speed**2 / (2.0 * self.gravity)
        return bool(apex >= self._start_com[2] + RISE * self.target.height)

    def _stance_reference(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity (3,) of the centre of mass, ground coordinates, ``elapsed`` seconds into the phase."""
        plan, start = self.plan, self._start_com
        if self.phase is JumpPhase.SETTLE:
            return start, np.zeros(3)
        down = np.array([plan.lean, 0.0, -plan.crouch_depth])
        # The crouch ends at rest over the ground but already on the way ahead: friction has little left to give during
        # the thrust.
        onset = np.array([min(CARRIED * plan.lean / plan.crouch_time, plan.speed_forward), 0.0, 0.0])
        if self.phase is JumpPhase.CROUCH:
            s = min(elapsed / plan.crouch_time, 1.0)
            blend, slope = s * s * (3 - 2 * s), 6 * s * (1 - s) / plan.crouch_time
            carried, rate = s * s * (s - 1) * plan.crouch_time, s * (3 * s - 2)
            return start + blend * down + carried * onset, slope * down + rate * onset
        take_off = np.array([plan.speed_forward, 0.0, plan.speed_up])
        position = start + down + onset * elapsed + 0.5 * (take_off - onset) * elapsed**2 / plan.thrust_time
        return position, onset + (take_off - onset) * elapsed / plan.thrust_time

    def _stand(
        self, state: BodyState, com_velocity: np.ndarray, position: np.ndarray, base: np.ndarray, dt: float
    ) -> list[Objective | SpinObjective]:
        pose = self.pose.over_base(position, base)
        spin = self.pose.turn_towards(state, pose) * 4.0 / self._time_unit
        if self.phase is JumpPhase.THRUST:
            landing = self.pose.over_base(self._landing_com(position), self._goal_base)
            spin = self.pose.turn_towards(state, landing) / self.plan.flight_time
        return self._write(state, com_velocity, pose, spin, dt)

    def _balanced(self, seen: Measurement, velocity: np.ndarray, dt: float) -> np.ndarray:
        """``velocity`` (3,) with its horizontal change kept within what the feet can give."""
        acceleration = (velocity - seen.velocity) / dt
        level = self.pose.balanced_acceleration(seen, acceleration[:2], float(acceleration[2]), self.gravity)
        return np.array([*(seen.velocity[:2] + dt * level), velocity[2]])

    def _landing_com(self, position: np.ndarray) -> np.ndarray:
        ahead = self._goal_base[0] - self.pose.base_offset[0] - self.plan.landing_lag
        return np.array([ahead, position[1], self._start_com[2]])

    def _fly(self, state: BodyState, seen: Measurement, dt: float) -> list[Objective | SpinObjective]:
        touch_down, _, velocity = self._falling(seen, dt)
        pose = self.pose.over_base(touch_down, self._goal_base)
        # Nothing turns a body in the air; a foot that lags on the ground must not push for the sake of it.
        momentum = self.body.angular_momentum(state.positions, state.velocities)
        spin = np.linalg.solve(self.body.inertia(state.positions), momentum)
        return self._write(state, velocity, pose, spin, dt)

    def _falling(self, seen: Measurement, dt: float) -> tuple[np.ndarray, float, np.ndarray]:
        """Where the centre of mass (3,) will touch down, the seconds left until then,
        and its velocity (3,) after this step.
        """
        drop = max(seen.com[2] - self._start_com[2], 0.0)
        speed = seen.velocity[2]
        left = (speed + np.sqrt(max(speed**2 + 2.0 * self.gravity * drop, 0.0))) / self.gravity
        left = max(left, dt)
        touch_down = seen.com + np.array([*(seen.velocity[:2] * left), 0.0])
        touch_down[2] = self._start_com[2]
        return touch_down, left, seen.velocity - np.array([0.0, 0.0, self.gravity * dt])

    def _land(self, state: BodyState, seen: Measurement, dt: float) -> list[Objective | SpinObjective]:
        rate = self.plan.landing_rate
        goal = np.array([*(seen.base - self.pose.base_offset), self._start_com[2]])
        acceleration = rate**2 * (goal - seen.com) - 2.0 * rate * seen.velocity
        acceleration[2] = max(acceleration[2], -0.8 * self.gravity)
        # Sideways the capture point com + v sqrt(h/g) is steered to its place over the base.
        pendulum = self.gravity / seen.com[2]
        capture = seen.com[:2] + seen.velocity[:2] / np.sqrt(pendulum)
        acceleration[:2] = -2.0 * pendulum * (capture - goal[:2]) + pendulum * (seen.com[:2] - goal[:2])
        velocity = self._balanced(seen, seen.velocity + dt * acceleration, dt)
        return self._stand(state, velocity, seen.com + dt * velocity, seen.base, dt)

    def _write(
        self, state: BodyState, com_velocity: np.ndarray, pose: np.ndarray, spin: np.ndarray, dt: float
    ) -> list[Objective | SpinObjective]:
        rate = (pose - self._pose) / dt
        if np.abs(rate).max() > 5.0 / self._time_unit:
            rate = np.zeros((3, 3))
        self._pose = pose
        return self.pose.objectives(
            state,
            com_velocity=com_velocity,
            pose=pose,
            pose_rate=rate,
            spin=spin,
            follow=self._follow,
            weights=self.weights,
        )
