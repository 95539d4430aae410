"""A body stands where its feet are, upright: for a while, or between two motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import REST_SPEED, BalanceController, RestDetector, Weights, sole_shares

_RATE = 4.0
"""Over sqrt(H / g): how fast the centre of mass comes back over the feet."""


@dataclass(frozen=True)
class StandPlan:
    """What a body that stands aims at."""

    seconds: float


@dataclass(frozen=True)
class StandOutcome:
    """How a body stood; body heights."""

    sole_shift: float
    """Longest way along the ground that the middle of a sole was from where it stood."""
    lean: float
    """Longest way along the ground that the centre of mass was from where it stood."""


class Stand:
    """Balances over the feet where they are, as a landed jump does, however long."""

    def __init__(self, place: Stance, *, at_rest: bool = True, crouch: float = 1.0) -> None:
        """``at_rest``: it begins as the motion before has ended, calm; ``crouch``: of the height of the centre of mass
        of a body that stands straight, how high it is held."""
        self.body = place.body
        self.pose = BalanceController(place.body, place.ground, place.standing, place.contact_points, place.friction)
        self._gravity = float(np.linalg.norm(place.body.gravity))
        self._time_unit = float(np.sqrt(place.body.height / self._gravity))
        self._height = crouch * self.pose.standing_height
        self._calm = RestDetector(place.body)
        self._resting = at_rest

    @property
    def is_at_rest(self) -> bool:
        """Whether it stands calmly."""
        return self._resting

    def notes(self) -> list[str]:
        """None: it has no target."""
        return []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        seen = self.pose.measure(state, report)
        slow = bool(np.linalg.norm(seen.velocity) <= REST_SPEED * np.sqrt(self._gravity * self.body.height))
        self._resting = self._calm.update(seen.velocity, state.time) or (self._resting and slow)
        rate = _RATE / self._time_unit
        goal = np.array([*(seen.foot_centre - self.pose.base_offset), self._height])
        acceleration = rate**2 * (goal - seen.com) - 2.0 * rate * seen.velocity
        acceleration[:2] = self.pose.capture_acceleration(seen, goal[:2])
        acceleration[2] = max(acceleration[2], -0.8 * self._gravity)
        velocity = seen.velocity + dt * acceleration
        heading = self.pose.sole_heading(state.positions)
        pose = self.pose.over_base(seen.com + dt * velocity, seen.foot_centre, heading)
        upright = self.pose.turn_towards(seen, pose) * 4.0 / self._time_unit
        velocity, spin = self.pose.balance_targets(seen, velocity, upright, dt)
        return self.pose.objectives(
            state,
            seen,
            com_velocity=velocity,
            pose=pose,
            pose_rate=np.zeros((3, 3)),
            spin=spin,
            follow=6.0 / self._time_unit,
            weights=Weights(),
        )


class StandFor:
    """Stands for some seconds, and then until it is calm."""

    def __init__(self, place: Stance, seconds: float) -> None:
        self.seconds, self._stand, self._place = seconds, Stand(place), place
        self._started: float | None = None
        self._over = False

    @property
    def is_at_rest(self) -> bool:
        """Whether the time is over and the body calm."""
        return self._over and self._stand.resting

    @property
    def expected_time(self) -> float:
        """Seconds until it is at rest."""
        return self.seconds

    def plan_record(self) -> StandPlan:
        """For how long."""
        return StandPlan(self.seconds)

    def planned_com(self, elapsed: float) -> np.ndarray:
        """(3,) where it stood."""
        return np.zeros(3)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> StandOutcome:
        """How far soles and centre of mass went meanwhile."""
        t, place = trajectory, self._place
        states = t.positions[first : last + 1]
        base = np.flatnonzero(sole_shares(place.body, place.ground, place.standing))
        soles = [foot.sole for foot in place.feet()] or [base]
        points = [states[:, sole].mean(axis=1) for sole in soles]
        points.append(np.einsum("n,fni->fi", t.node_mass, states) / t.node_mass.sum())
        along = place.ground.axes[:2].T
        *shifts, lean = (float(np.linalg.norm((way - way[0]) @ along, axis=1).max()) / t.height for way in points)
        return StandOutcome(max(shifts), lean)

    def notes(self) -> list[str]:
        """None: it has no target."""
        return []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        self._started = state.time if self._started is None else self._started
        self._over = state.time - self._started >= self.seconds - 1e-9
        return self._stand.objectives(state, report, dt)
