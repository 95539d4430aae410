"""Roll: a ball is driven by its centre of mass, held ahead of the centre of pressure that its soft sole can give.

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

_STEP = 0.1
"""Body heights between two places of the way."""
_SPEED, _PUSH = 0.3, 0.05
"""The usual speed, in sqrt(g H), and how it is gathered and lost, in g."""
_RATE = 1.5
"""Over sqrt(H / g): how fast what it is off the way is made up for."""
_ARRIVED = 0.03
"""Body heights from the end of the way."""
_MARGIN = 0.8
"""Part of what it stands on over which the centre of pressure may be."""


@dataclass(frozen=True)
class RollPlan:
    """Numbers of a roll; metres, seconds."""

    way: float
    seconds: float
    top_speed: float


@dataclass(frozen=True)
class RollOutcome:
    """How a ball rolled."""

    rolled_degrees: float
    """All that it turned about level axes, whichever way."""


@dataclass(frozen=True)
class RollControl:
    """Weights of the objectives; speeds are compared in sqrt(g H)."""

    com: float = 600.0
    spin: float = 100.0
    pose: float = 0.3
    follow: float = 4.0
    """Of the shape, in sqrt(g / H)."""


class Roll:
    """Rolls along a route, and comes to rest at its end."""

    def __init__(self, place: Stance, route: Route, *, speed: float = 1.0, control: RollControl | None = None) -> None:
        """``speed`` over the usual. The ball stands at ``place``."""
        body = place.body
        self.body, self.ground, self.control = body, place.ground, control or RollControl()
        self._gravity = float(np.linalg.norm(body.gravity))
        normal = place.ground.axes @ place.ground.surface_normal
        self._slope = -normal[:2] / normal[2]
        """Metres that the ground rises for each metre forward and to the left."""
        self._rest = body.mesh.nodes - body.centre_of_mass(body.mesh.nodes)
        com = place.ground.local(body.centre_of_mass(place.standing))
        self._start = com[:2]
        self._sunk = self._radius(place.standing) - self._over_ground(com)
        self.places = route(StepLimits(_STEP * body.height, np.pi, side_fraction=1.0, faces_travel=False))
        check_route(place, self.places)
        self.top_push = speed * _PUSH * self._gravity
        """m/s^2."""
        self.table = VelocityProfile.of(
            self.places[:, :2], speed=speed * _SPEED * body.speed_unit, acceleration=self.top_push
        )
        self._began: float | None = None
        self._calm = RestDetector(body)
        self._resting = False

    @property
    def is_at_rest(self) -> bool:
        """Whether it lies still at the end of its way."""
        return self._resting

    @property
    def expected_time(self) -> float:
        """Seconds, with what coming to rest takes."""
        return self.table.seconds + 2.0 * self.body.time_unit

    def plan_record(self) -> RollPlan:
        """What it aims at."""
        return RollPlan(self.table.length, self.table.seconds, self.table.top_speed)

    def planned_com(self, elapsed: float) -> np.ndarray:
        """(3,) metres from where it stood."""
        x, y = self.table.at(elapsed).place
        return np.array([x, y, self._slope @ [x, y]]) @ self.ground.axes

    def notes(self) -> list[str]:
        """None."""
        return []

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> RollOutcome:
        """How far it turned between two states of the trajectory."""
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
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        body, axes, control = self.body, self.ground.axes, self.control
        self._began = state.time if self._began is None else self._began
        local = self.ground.local(state.positions)
        com, moving = body.centre_of_mass(local), axes @ body.centre_of_mass(state.velocities)
        elapsed = state.time - self._began
        ahead = self._ahead(com, elapsed, dt)
        calm = self._calm.update(moving, state.time)
        slow = bool(np.linalg.norm(moving) <= REST_SPEED * body.speed_unit)
        self._resting = (calm and self._is_over(com, elapsed)) or (self._resting and slow)
        rate = _RATE / body.time_unit
        off = self._start + ahead.place - com[:2]
        wanted = ahead.acceleration + 2.0 * rate * (ahead.velocity - moving[:2]) + rate**2 * off
        inertia = body.inertia(state.positions)
        level = moving[:2] + dt * self._given(wanted, com, inertia, local, report)
        radius = self._radius(state.positions) - self._sunk
        climb = self._slope @ level + 6.0 / body.time_unit * (radius - self._over_ground(com))
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

    def _ahead(self, com: np.ndarray, elapsed: float, dt: float) -> ProfileSample:
        """Where the centre of mass, now at ``com`` (3,), is to be at the end of the step; the way from its start."""
        return self.table.at(elapsed + dt)

    def _is_over(self, com: np.ndarray, elapsed: float) -> bool:
        """Whether there is nowhere left to go."""
        missed = float(np.linalg.norm(self._start + self.table.at(np.inf).place - com[:2]))
        return elapsed >= self.table.seconds and missed <= _ARRIVED * self.body.height

    def _given(
        self, wanted: np.ndarray, com: np.ndarray, inertia: np.ndarray, local: np.ndarray, report: StepReport | None
    ) -> np.ndarray:
        """(2,) m/s^2 along the ground, of what is ``wanted`` (2,), that the ground can give.

        A ball that rolls without slipping gathers speed and spin at once, m r (1 + I / (m r^2)) a, by its weight times
        the way from the centre of pressure to its centre of mass.
        """
        height = max(self._over_ground(com), 0.2 * self.body.height)
        lever = height + 0.5 * (np.trace(inertia) - self.ground.axes[2] @ inertia @ self.ground.axes[2]) / (
            self.body.mass * height
        )
        if report is None or report.contacts.count == 0:
            return np.zeros(2)
        contacts = report.contacts
        points = np.einsum("cw,cwi->ci", contacts.weights, local[contacts.nodes])[:, :2]
        middle, reach = 0.5 * (points.max(axis=0) + points.min(axis=0)), 0.5 * _MARGIN * np.ptp(points, axis=0)
        uphill = height * self._slope
        pressed = com[:2] - uphill - lever / self._gravity * wanted
        return (com[:2] - uphill - np.clip(pressed, middle - reach, middle + reach)) * self._gravity / lever

    def _over_ground(self, com: np.ndarray) -> float:
        """Metres from the ground to ``com`` (3,), ground coordinates."""
        return float(com[2] - self._slope @ com[:2])

    def _radius(self, positions: np.ndarray) -> float:
        """Metres from the centre of mass to the ground, of the body at rest turned as the nodes at ``positions`` (N, 3)
        are."""
        turn = kabsch_rotation(self.body.node_mass, self._rest, positions - self.body.centre_of_mass(positions))
        normal, up = self.ground.surface_normal, self.ground.axes[2]
        return float(-(self._rest @ (turn.T @ normal)).min() / (normal @ up))
