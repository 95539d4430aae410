"""Walks that are steered at every time step: towards, behind or away from other bodies, avoiding bodies and obstacles.

Positions are metres in the ground frame in which the motion starts: forward and to the left. The direction is chosen
among samples by the predicted clearance (the dynamic window approach of Fox, Burgard and Thrun, 1997).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.command import Drive
from egs_warp.motions.drive import LiveDrive
from egs_warp.motions.other_body import OtherBody, radius_of
from egs_warp.motions.route_check import MAX_STEP_HEIGHT
from egs_warp.motions.sequence import JudgedOutcome, Stance

SPEED = 0.12
"""Commanded speed in sqrt(g H). A body that cannot reach it walks as fast as it can."""
_TURN_GAIN, _MAX_TURN = 1.5, 0.4
"""Ratio of the turning rate to the heading error, in units of 1 / sqrt(H / g), and maximum turning rate, in radians per
sqrt(H / g)."""
_TURN_ON_SPOT = np.radians(50.0)
"""Heading error, in radians, above which the body turns on the spot."""
_MARGIN = 0.08
"""Clearance that is kept from other bodies and obstacles, body heights."""
_HORIZON = 12.0
"""Time for which the motion of other bodies is extrapolated, sqrt(H / g)."""
_LOOKAHEAD = 0.8
"""Distance ahead within which obstacles are searched for, body heights."""
_ANGLES = np.radians(np.arange(-150.0, 151.0, 10.0))
"""Directions that are compared, relative to the direction of the goal."""
_LEFT_COST = 0.15
"""Additional cost of a direction to the left of the goal, so that two bodies that approach each other both keep to the
right."""
_DEFICIT_COST = 30.0
"""Cost of a clearance that is one body height too small."""
_MEMORY = 1.5
"""Time over which the velocities of other bodies are averaged, sqrt(H / g)."""


@dataclass(frozen=True)
class View:
    """Time since the start of a motion, and position and heading of the body."""

    time: float
    """Time since the start of the motion, s."""
    position: np.ndarray
    """(2,) m, centre of mass."""
    heading: float
    """Rotation about the up axis since the start, radians."""


class Policy(Protocol):
    """Policy that defines the target of a steered walk."""

    def goal(self, view: View) -> np.ndarray | None:
        """Return the point (2,) m to walk to; None to stand."""
        ...

    def is_over(self, view: View) -> bool:
        """Return True if the motion has ended."""
        ...

    def ignored(self) -> Sequence[str] | None:
        """Return the names of the bodies that need not be avoided at present; None to walk straight to the goal,
        avoiding nothing."""
        ...

    def failures(self, view: View) -> tuple[str, ...]:
        """Return a description of each target that was missed, for the report."""
        ...


class Neighbours:
    """Positions, velocities and radii of the other bodies, in the ground frame of a stance."""

    def __init__(self, stance: Stance, others: Mapping[str, OtherBody]) -> None:
        self._stance, self._others = stance, others
        self.touching = {name: other.place(stance)[1] for name, other in others.items()}
        """Distance in metres between the centres of the body and of each other body at which the two touch."""
        self._tracks: dict[str, deque[tuple[float, np.ndarray]]] = {name: deque() for name in others}

    def update(self, time: float) -> None:
        """Measure the positions at ``time`` s."""
        for name, other in self._others.items():
            track = self._tracks[name]
            track.append((time, other.centre(self._stance)))
            while track[-1][0] - track[0][0] > _MEMORY * self._stance.body.time_unit:
                track.popleft()

    def motion(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the position (2,) m and the mean velocity (2,) m/s of a body."""
        (start, before), (end, now) = self._tracks[name][0], self._tracks[name][-1]
        return now, (now - before) / max(end - start, 1e-9)


def free_direction(
    position: np.ndarray,
    goal: np.ndarray,
    discs: Sequence[tuple[np.ndarray, np.ndarray, float]],
    blocked: Callable[[np.ndarray], bool],
    *,
    speed: float,
    height: float,
    horizon: float,
) -> np.ndarray:
    """Return the direction (2,) in which to walk.

    Args:
        position: (2,) m, position of the body.
        goal: (2,) m, point to walk to.
        discs: position (2,) m, velocity (2,) m/s and required distance in metres for each other body.
        blocked: function that returns True if the body cannot stand at a point (2,) m.
        speed: own speed, m/s.
        height: body height, m.
        horizon: time for which others are extrapolated, s.
    """
    arm = goal - position
    left = float(np.linalg.norm(arm))
    angles = np.arctan2(arm[1], arm[0]) + _ANGLES
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    costs = np.abs(_ANGLES) + _LEFT_COST * (_ANGLES > 0.0)
    for centre, velocity, apart in discs:
        relative, offset = speed * directions - velocity, centre - position
        times = relative @ offset / np.maximum((relative**2).sum(axis=1), 1e-12)
        times = np.clip(times, 0.0, min(horizon, left / speed))
        nearest = np.linalg.norm(offset - times[:, None] * relative, axis=1)
        # If a body is already too close, only a further approach has a cost.
        required = min(apart, float(np.linalg.norm(offset)))
        costs += _DEFICIT_COST * np.maximum(required - nearest, 0.0) / height
    # Compute the cost of obstacles only for directions that can still turn out best.
    for index in np.argsort(costs, kind="stable"):
        obstacle = _obstacle_cost(position, directions[index], min(_LOOKAHEAD * height, left), blocked)
        costs[index] += obstacle
        if obstacle == 0.0:
            break
    return directions[int(np.argmin(costs))]


def _obstacle_cost(
    position: np.ndarray, direction: np.ndarray, length: float, blocked: Callable[[np.ndarray], bool]
) -> float:
    """Return the cost of walking ``length`` m in ``direction`` (2,); the cost increases with the proximity of an
    obstacle."""
    for share in (0.25, 0.5, 0.75, 1.0):
        if blocked(position + share * length * direction):
            return _DEFICIT_COST * (1.25 - share) * _LOOKAHEAD
    return 0.0


@dataclass(frozen=True)
class SteeringPlan:
    """Planned quantities of a steered walk."""

    goal_distance: float
    """Distance of the first goal, body heights."""


@dataclass(frozen=True)
class SteeringOutcome(JudgedOutcome):
    """Measured result of a steered walk; lengths in body heights."""

    ahead: float
    left: float
    """Displacement forward and to the left."""
    min_clearance: float
    """Minimum, over time, of the distance to another body minus the distance at which both touch."""


class Steered:
    """Walk that pursues the goal of a policy and avoids other bodies and obstacles."""

    def __init__(
        self, stance: Stance, others: Mapping[str, OtherBody], policy: Policy, *, expected_time: float
    ) -> None:
        """Create the motion of the body that stands at ``stance``.

        Args:
            stance: stance at the start.
            others: the other bodies by name.
            policy: policy that defines the target.
            expected_time: expected duration, s.

        Raises:
            UserError: if the body cannot walk.
        """
        self.body, self.expected_time = stance.body, expected_time
        self._stance, self._policy = stance, policy
        self._drive = LiveDrive(stance)
        self.neighbours = Neighbours(stance, others)
        self._start_time: float | None = None
        self._is_over = False
        self._view = View(0.0, self._centre(stance.standing), 0.0)
        self._start = self._view.position
        self._radius = radius_of(stance.ground.local(stance.standing))
        self._minimum = np.inf
        self.neighbours.update(0.0)
        first = policy.goal(self._view)
        self._plan = SteeringPlan(
            0.0 if first is None else float(np.linalg.norm(first - self._start)) / stance.body.height
        )

    def _centre(self, positions: np.ndarray) -> np.ndarray:
        return self.body.centre_of_mass(self._stance.ground.local(positions))[:2]

    @property
    def is_at_rest(self) -> bool:
        """True if the policy has ended and the body stands at rest."""
        return self._is_over and self._drive.is_at_rest

    def plan_record(self) -> SteeringPlan:
        """Return the planned quantities of the motion."""
        return self._plan

    def planned_com(self, elapsed: float) -> None:
        """Return None: each step starts from the measured body."""

    def notes(self) -> list[str]:
        """Return no messages."""
        return []

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> SteeringOutcome:
        """Measure the displacement and the clearance, and judge the target."""
        ahead, left = (self._view.position - self._start) / self.body.height
        minimum = self._minimum / self.body.height
        return SteeringOutcome(self._policy.failures(self._view), float(ahead), float(left), float(minimum))

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        self._start_time = state.time if self._start_time is None else self._start_time
        self._view = view = self._look(state, state.time - self._start_time)
        self.neighbours.update(view.time)
        for name, touching in self.neighbours.touching.items():
            distance = float(np.linalg.norm(self.neighbours.motion(name)[0] - view.position))
            self._minimum = min(self._minimum, distance - touching)
        self._is_over = self._is_over or self._policy.is_over(view)
        self._drive.command = Drive() if self._is_over else self._command(view)
        return self._drive.objectives(state, report, dt)

    def _look(self, state: BodyState, time: float) -> View:
        turn = self.body.best_fit_rotation(state.positions) @ self.body.best_fit_rotation(self._stance.standing).T
        turn = self._stance.ground.axes @ turn @ self._stance.ground.axes.T
        return View(time, self._centre(state.positions), float(np.arctan2(turn[1, 0], turn[0, 0])))

    def _command(self, view: View) -> Drive:
        goal = self._policy.goal(view)
        if goal is None or np.linalg.norm(goal - view.position) < 1e-6 * self.body.height:
            return Drive()
        height, unit = self.body.height, self.body.time_unit
        ignored = self._policy.ignored()
        if ignored is None:
            return steering_command(view.heading, goal - view.position)
        discs = [
            (*self.neighbours.motion(name), touching + _MARGIN * height)
            for name, touching in self.neighbours.touching.items()
            if name not in ignored
        ]
        direction = free_direction(
            view.position,
            goal,
            discs,
            self._is_blocked,
            speed=SPEED * self.body.speed_unit,
            height=height,
            horizon=_HORIZON * unit,
        )
        return steering_command(view.heading, direction)

    def _is_blocked(self, point: np.ndarray) -> bool:
        return is_blocked(self._stance, point, self._radius)


def steering_command(heading: float, direction: np.ndarray) -> Drive:
    """Return the command for a body with ``heading`` radians that is to walk in ``direction`` (2,)."""
    error = (float(np.arctan2(direction[1], direction[0])) - heading + np.pi) % (2.0 * np.pi) - np.pi
    turn = float(np.clip(_TURN_GAIN * error, -_MAX_TURN, _MAX_TURN))
    return Drive(SPEED * float(np.cos(error)) if abs(error) < _TURN_ON_SPOT else 0.0, 0.0, turn)


def is_blocked(stance: Stance, point: np.ndarray, radius: float) -> bool:
    """Return True if a step up or down in the ground is within ``radius`` m of ``point`` (2,) m, ground frame of
    ``stance``."""
    ground = stance.ground
    normal = ground.axes @ ground.surface_normal
    slope = -normal[:2] / normal[2]
    angles = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    around = np.concatenate([[point], point + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)])
    for x, y in around:
        rise = stance.surface_height_above(ground.world(np.array([x, y, slope @ (x, y)])))
        if abs(rise) > MAX_STEP_HEIGHT * stance.body.height:
            return True
    return False
