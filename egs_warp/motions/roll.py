"""Roll: gravity drives a ball whose centre of mass is held ahead of the centre of pressure under its soft sole.

See docs/concepts/motions.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.locomotion.objectives import (
    AngularMomentumObjective,
    AnyObjective,
    centre_of_mass_velocity,
    node_velocities,
)
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.route import Route, StepLimits
from egs_warp.motions.route_check import check_route
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import REST_SPEED, RestDetector
from egs_warp.motions.velocity_profile import ProfileSample, VelocityProfile

_ROUTE_STEP = 0.1
"""Distance, in body heights, between two consecutive planar poses of the route."""
_SPEED, _ACCELERATION = 0.3, 0.05
"""Nominal speed in sqrt(g H), and acceleration and deceleration in g."""
_RATE = 1.5
"""Rate in sqrt(g / H) at which position errors are corrected."""
_ARRIVAL_TOLERANCE = 0.03
"""Distance from the end of the route, in body heights, within which the ball has arrived."""
_SUPPORT_FRACTION = 0.8
"""Fraction of the support within which the centre of pressure stays."""


@dataclass(frozen=True)
class RollPlan:
    """Planned quantities of a roll, in metres, seconds and m/s."""

    way: float
    seconds: float
    top_speed: float


@dataclass(frozen=True)
class RollOutcome:
    """Measured result of a roll."""

    rolled_degrees: float
    """Total rotation about horizontal axes, in any direction, degrees."""


@dataclass(frozen=True)
class RollControl:
    """Weights of the objectives; speeds are in units of sqrt(g H)."""

    com: float = 600.0
    spin: float = 100.0
    pose: float = 0.3
    follow: float = 4.0
    """Rate in sqrt(g / H) at which the shape is approached."""


class Roll:
    """Roll along a route and come to rest at its end."""

    def __init__(self, stance: Stance, route: Route, *, speed: float = 1.0, control: RollControl | None = None) -> None:
        """Create the motion of the ball that stands at ``stance``; ``speed`` is relative to the nominal speed."""
        body = stance.body
        self.body, self.ground, self.control = body, stance.ground, control or RollControl()
        self._gravity = float(np.linalg.norm(body.gravity))
        normal = stance.ground.axes @ stance.ground.surface_normal
        self._slope = -normal[:2] / normal[2]
        """(2,) slope of the ground: metres of rise per metre forward and to the left."""
        self._rest = body.mesh.nodes - body.centre_of_mass(body.mesh.nodes)
        com = stance.ground.local(body.centre_of_mass(stance.standing))
        self._start = com[:2]
        self._compression = self._radius(stance.standing) - self._height_above_ground(com)
        self.planar_poses = route(StepLimits(_ROUTE_STEP * body.height, np.pi, side_fraction=1.0, faces_travel=False))
        check_route(stance, self.planar_poses)
        self.top_push = speed * _ACCELERATION * self._gravity
        """m/s^2, acceleration and deceleration."""
        self.table = VelocityProfile.from_path(
            self.planar_poses[:, :2], speed=speed * _SPEED * body.speed_unit, acceleration=self.top_push
        )
        self._start_time: float | None = None
        self._rest_detector = RestDetector(body)
        self._is_resting = False

    @property
    def is_at_rest(self) -> bool:
        """True if the body lies still at the end of its route."""
        return self._is_resting

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds, including the time to come to rest."""
        return self.table.seconds + 2.0 * self.body.time_unit

    def plan_record(self) -> RollPlan:
        """Return the planned quantities of the motion."""
        return RollPlan(self.table.length, self.table.seconds, self.table.top_speed)

    def planned_com(self, elapsed: float) -> np.ndarray:
        """Return the planned displacement (3,) in metres of the centre of mass."""
        x, y = self.table.at(elapsed).position
        return np.array([x, y, self._slope @ [x, y]]) @ self.ground.axes

    def notes(self) -> list[str]:
        """Return no messages."""
        return []

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> RollOutcome:
        """Measure the rotation about horizontal axes between two states of the trajectory."""
        mass, angle = self.body.node_mass, 0.0
        states = trajectory.positions[first : last % len(trajectory.time) + 1]
        arms = [x - mass @ x / mass.sum() for x in states]
        for before, after in zip(arms[:-1], arms[1:], strict=True):
            turn = kabsch_rotation(mass, before, after)
            level = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
            level -= (level @ self.ground.axes[2]) * self.ground.axes[2]
            angle += float(np.arcsin(min(0.5 * np.linalg.norm(level), 1.0)))
        return RollOutcome(float(np.degrees(angle)))

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        body, axes, control = self.body, self.ground.axes, self.control
        self._start_time = state.time if self._start_time is None else self._start_time
        local = self.ground.local(state.positions)
        com, moving = body.centre_of_mass(local), axes @ body.centre_of_mass(state.velocities)
        elapsed = state.time - self._start_time
        sample = self._profile_sample(com, elapsed, dt)
        calm = self._rest_detector.update(moving, state.time)
        slow = bool(np.linalg.norm(moving) <= REST_SPEED * body.speed_unit)
        self._is_resting = (calm and self._is_over(com, elapsed)) or (self._is_resting and slow)
        rate = _RATE / body.time_unit
        off = self._start + sample.position - com[:2]
        desired = sample.acceleration + 2.0 * rate * (sample.velocity - moving[:2]) + rate**2 * off
        inertia = body.inertia(state.positions)
        level = moving[:2] + dt * self._feasible_acceleration(desired, com, inertia, local, report)
        radius = self._radius(state.positions) - self._compression
        climb = self._slope @ level + 6.0 / body.time_unit * (radius - self._height_above_ground(com))
        velocity = np.array([*level, climb]) @ axes
        turning = np.cross(self.ground.surface_normal, velocity) / radius
        arms = state.positions - body.centre_of_mass(state.positions)
        shape = self._rest @ kabsch_rotation(body.node_mass, self._rest, arms).T
        pose = velocity + np.cross(turning, arms) + control.follow / body.time_unit * (shape - arms)
        return [
            centre_of_mass_velocity(body, velocity, control.com),
            AngularMomentumObjective(inertia @ turning, control.spin),
            node_velocities(body, pose, control.pose),
        ]

    def _profile_sample(self, com: np.ndarray, elapsed: float, dt: float) -> ProfileSample:
        """Return the target of the centre of mass at the end of the time step, relative to the start of the motion. The
        centre of mass is now at ``com`` (3,)."""
        return self.table.at(elapsed + dt)

    def _is_over(self, com: np.ndarray, elapsed: float) -> bool:
        """Return True if the planned time has passed and the centre of mass is near the end of the route."""
        error = float(np.linalg.norm(self._start + self.table.at(np.inf).position - com[:2]))
        return elapsed >= self.table.seconds and error <= _ARRIVAL_TOLERANCE * self.body.height

    def _feasible_acceleration(
        self, desired: np.ndarray, com: np.ndarray, inertia: np.ndarray, local: np.ndarray, report: StepReport | None
    ) -> np.ndarray:
        """Limit a desired acceleration along the ground to what the contact forces can produce.

        A ball that rolls without slipping gains speed and spin together: m r (1 + I / (m r^2)) a equals the weight
        times the distance from the centre of pressure to the centre of mass.

        Args:
            desired: (2,) m/s^2, desired acceleration.
            com: (3,) m, centre of mass, ground coordinates.
            inertia: (3, 3) kg m^2, world axes.
            local: (N, 3) m, nodes, ground coordinates.
            report: report of the previous time step.

        Returns:
            (2,) m/s^2, feasible acceleration.
        """
        height = max(self._height_above_ground(com), 0.2 * self.body.height)
        lever = height + 0.5 * (np.trace(inertia) - self.ground.axes[2] @ inertia @ self.ground.axes[2]) / (
            self.body.mass * height
        )
        if report is None or report.contacts.count == 0:
            return np.zeros(2)
        contacts = report.contacts
        points = np.einsum("cw,cwi->ci", contacts.weights, local[contacts.nodes])[:, :2]
        middle, reach = (
            0.5 * (points.max(axis=0) + points.min(axis=0)),
            0.5 * _SUPPORT_FRACTION * np.ptp(points, axis=0),
        )
        uphill = height * self._slope
        pressed = com[:2] - uphill - lever / self._gravity * desired
        return (com[:2] - uphill - np.clip(pressed, middle - reach, middle + reach)) * self._gravity / lever

    def _height_above_ground(self, com: np.ndarray) -> float:
        """Return the height in metres above the ground of ``com`` (3,), given in ground coordinates."""
        return float(com[2] - self._slope @ com[:2])

    def _radius(self, positions: np.ndarray) -> float:
        """Return the distance in metres from the centre of mass to the ground for the undeformed body in the best-fit
        orientation of nodes at ``positions`` (N, 3)."""
        turn = kabsch_rotation(self.body.node_mass, self._rest, positions - self.body.centre_of_mass(positions))
        normal, up = self.ground.surface_normal, self.ground.axes[2]
        return float(-(self._rest @ (turn.T @ normal)).min() / (normal @ up))
