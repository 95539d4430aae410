"""Crawl: a long body without feet moves by a wave of strides that runs along it, like a worm.

Each cross-section stands for most of a round and is then carried to its next position, shortly after the section in
front of it has been carried. Carried nodes are unloaded; friction at the standing nodes holds the body in place. See
docs/concepts/motions.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.fem.body import BodyState
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.locomotion.objectives import (
    AngularMomentumObjective,
    AnyObjective,
    LoadObjective,
    Objective,
    centre_of_mass_velocity,
    no_slip_contacts,
    node_velocities,
)
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.gait import smooth
from egs_warp.motions.route import Route, StepLimits
from egs_warp.motions.route_check import check_route
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import REST_SPEED, RestDetector

_ROUND_TIME = 3.0
"""Duration of a round, in sqrt(H / g): the time from one stride of a section to its next stride."""
_CARRIED_FRACTION = 0.4
"""Fraction of a round in which a section is carried; it stands for the rest of the round."""
MAX_STRAIN = 0.12
"""Largest strain of the body in a stride."""
_SIDE_STRIDE, _SIDE_ACCELERATION = 0.25, 0.3
"""Limits of sideways motion, beyond which a round body would roll over: sideways stride, or displacement of an end in a
turn, in body heights; and acceleration, in g."""
_MAX_CURVATURE = 5.77
"""Maximum second derivative of ``smooth``."""
_MAX_SLOPE = 1.875
"""Maximum slope of ``smooth``."""
_LIFT = 0.02
"""Height to which a carried section is lifted, in body heights."""
_ARRIVAL_TOLERANCE = 0.2
"""Distance from the end of the route, in strides, within which the body has arrived."""
_ADVANCE_DISTANCE = 0.5
"""Distance from a waypoint, in strides, within which the body turns to the next waypoint."""
_MIN_PROGRESS, _MAX_FRUITLESS_ROUNDS = 0.2, 4
"""Minimum progress of a round, in strides, and maximum number of consecutive rounds with less progress; after more such
rounds, the crawl ends."""


@dataclass(frozen=True)
class CrawlPlan:
    """Planned quantities of a crawl, in metres and seconds."""

    rounds: float
    stride: float
    """Longest stride of a section, m."""
    seconds: float


@dataclass(frozen=True)
class CrawlOutcome:
    """Measured result of a crawl."""

    rounds: float
    """Number of waves that ran along the body."""
    stride: float
    """Mean displacement of the centre of mass per round, in body heights."""


@dataclass(frozen=True)
class CrawlControl:
    """Weights of the objectives; speeds are measured in units of sqrt(g H)."""

    com: float = 100.0
    spin: float = 2000.0
    pose: float = 20.0
    unload: float = 30.0
    hold: float = 50.0
    turn_rate: float = 4.0
    follow: float = 8.0
    """Rate in sqrt(g / H) at which the pose is approached."""


class Crawl:
    """Crawl along a route in rounds, each planned from the measured end of the previous one."""

    def __init__(
        self, stance: Stance, route: Route, *, speed: float = 1.0, control: CrawlControl | None = None
    ) -> None:
        """Create the motion of the body that lies at ``stance``; ``speed`` is relative to the nominal speed."""
        body = stance.body
        self.body, self.ground, self.control = body, stance.ground, control or CrawlControl()
        normal = stance.ground.axes @ stance.ground.surface_normal
        self._slope = -normal[:2] / normal[2]
        self._standing = stance.ground.local(stance.standing)
        self._centre = body.centre_of_mass(self._standing)
        along = _slices(self._standing[:, :2])
        length = float(np.ptp(along))
        self._behind = (along.max() - along) / length
        """(N,) relative position of each node along the body, from 0 at the front end to 1 at the back end."""
        stride = MAX_STRAIN * length * _CARRIED_FRACTION / (_MAX_SLOPE * (1.0 - _CARRIED_FRACTION))
        aside = _SIDE_STRIDE * body.height
        self.step_limits = StepLimits(
            stride, 2.0 * aside / length, side_fraction=min(aside / stride, 1.0), faces_travel=False
        )
        self.planar_poses = route(self.step_limits)
        check_route(stance, self.planar_poses)
        self._next, self._from, self._to = 1, np.zeros(3), self.planar_poses[1]
        """Index of the current goal in ``planar_poses``; planar poses (3,) of the body before and after this round."""
        self._speed, self._length = speed, length
        self._round = self._duration()
        """Duration of a round, s."""
        self._nearest, self._fruitless = np.inf, 0
        self._round_start: float | None = None
        self.rounds = 0
        self._is_over = False
        self._rest_detector = RestDetector(body)
        self._is_resting = False

    @property
    def seconds(self) -> float:
        """Duration in seconds of all rounds, if the body does not slide back."""
        return self._round * (len(self.planar_poses) - 1)

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds, including the time to come to rest."""
        return self.seconds + self.body.time_unit

    @property
    def is_at_rest(self) -> bool:
        """True if the last round is over and the body lies still."""
        return self._is_resting

    def plan_record(self) -> CrawlPlan:
        """Return the planned quantities of the motion."""
        return CrawlPlan(float(len(self.planar_poses) - 1), self.step_limits.length, self.seconds)

    def planned_com(self, elapsed: float) -> None:
        """Return None: each round starts from the measured body."""

    def notes(self) -> list[str]:
        """Return messages for the user about targets that were missed."""
        if not self._is_over or self._remaining_strides(self._to) <= _ARRIVAL_TOLERANCE:
            return []
        return [f"the body slid back as far as it moved forward, and gave up after {self.rounds} rounds"]

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> CrawlOutcome:
        """Measure the mean displacement per round between two states of the trajectory."""
        ends = trajectory.positions[[first, last]]
        displacement = (self.body.centre_of_mass(ends[1]) - self.body.centre_of_mass(ends[0])) @ self.ground.axes[:2].T
        return CrawlOutcome(
            float(self.rounds), float(np.linalg.norm(displacement)) / self.body.height / max(self.rounds, 1)
        )

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        body, axes, control, unit = self.body, self.ground.axes, self.control, self.body.time_unit
        local = self.ground.local(state.positions)
        if not self._is_over and (self._round_start is None or state.time - self._round_start >= self._round - 1e-9):
            self._plan_round(local, state.time)
        assert self._round_start is not None
        elapsed = state.time - self._round_start
        self._note_rest(axes @ body.centre_of_mass(state.velocities), state.time)
        before, after = self._pose(elapsed), self._pose(elapsed + dt)
        follow = min(control.follow / unit, 0.7 / dt)
        carried = self._carried(elapsed + dt)
        swings = (carried > 0.0) & (carried < 1.0)
        com = body.centre_of_mass(local)
        com_velocity = body.centre_of_mass(after - before) / dt + follow * (body.centre_of_mass(before) - com)
        spin = (
            control.turn_rate / unit * self._best_fit_rotation(local, before)
            + self._best_fit_rotation(before, after) / dt
        )
        pose = (after - before) / dt + follow * (before - local)
        return [
            centre_of_mass_velocity(body, com_velocity @ axes, control.com),
            AngularMomentumObjective(body.inertia(state.positions) @ (spin @ axes), control.spin),
            node_velocities(body, pose @ axes, control.pose),
            *([LoadObjective(np.flatnonzero(swings), control.unload)] if swings.any() else []),
            *([self._no_slip_objective(report, swings)] if report is not None else []),
        ]

    def _plan_round(self, local: np.ndarray, time: float) -> None:
        self._from = self._planar_pose(local)
        self._to, self._is_over = self._aim()
        self._round_start, self._round = time, self._duration()
        self.rounds += not self._is_over

    def _duration(self) -> float:
        """Return the duration of this round in seconds; the round takes longer if sections move sideways."""
        change, half = self._to - self._from, 0.5 * self._length
        aside = abs(np.cos(self._from[2]) * change[1] - np.sin(self._from[2]) * change[0]) + half * abs(change[2])
        gentle = (
            np.sqrt(_MAX_CURVATURE * aside / (_SIDE_ACCELERATION * np.linalg.norm(self.body.gravity)))
            / _CARRIED_FRACTION
        )
        return max(_ROUND_TIME * self.body.time_unit, float(gentle)) / self._speed

    def _aim(self) -> tuple[np.ndarray, bool]:
        """Return the target planar pose (3,) at the end of this round, and True if the crawl is over."""
        while (
            self._next < len(self.planar_poses) - 1
            and self._stride_count(self.planar_poses[self._next] - self._from) < _ADVANCE_DISTANCE
        ):
            self._next += 1
        missing = self._stride_count(self.planar_poses[self._next] - self._from)
        left = missing + len(self.planar_poses) - 1 - self._next
        if left < self._nearest - _MIN_PROGRESS:
            self._nearest, self._fruitless = left, 0
        else:
            self._fruitless += 1
        over = (
            self._next == len(self.planar_poses) - 1 and missing <= _ARRIVAL_TOLERANCE
        ) or self._fruitless > _MAX_FRUITLESS_ROUNDS
        share = 0.0 if over else min(1.0, 1.0 / max(missing, 1e-12))
        return self._from + share * (self.planar_poses[self._next] - self._from), over

    def _stride_count(self, change: np.ndarray) -> float:
        """Return the number of strides that are needed for a ``change`` (3,) of the planar pose."""
        cos, sin = np.cos(self._from[2]), np.sin(self._from[2])
        ahead, aside = cos * change[0] + sin * change[1], cos * change[1] - sin * change[0]
        strides = float(np.hypot(ahead, aside / self.step_limits.side_fraction)) / self.step_limits.length
        return strides + abs(float(change[2])) / self.step_limits.turn

    def _remaining_strides(self, planar_pose: np.ndarray) -> float:
        """Return the number of strides from ``planar_pose`` (3,) to the end of the route."""
        return self._stride_count(self.planar_poses[-1] - planar_pose)

    def _planar_pose(self, local: np.ndarray) -> np.ndarray:
        """Return the planar pose (3,) of the body with its nodes at ``local`` (N, 3); the heading is unwrapped relative
        to the previous one."""
        com = self.body.centre_of_mass(local)
        turn = kabsch_rotation(self.body.node_mass, self._standing - self._centre, local - com)
        heading = float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
        heading += 2.0 * np.pi * round((self._to[2] - heading) / (2.0 * np.pi))
        return np.array([*(com - self._centre)[:2], heading])

    def _note_rest(self, velocity: np.ndarray, time: float) -> None:
        calm = self._rest_detector.update(velocity, time)
        slow = bool(np.linalg.norm(velocity) <= REST_SPEED * self.body.speed_unit)
        self._is_resting = (self._is_over and calm) or (self._is_resting and slow)

    def _carried(self, elapsed: float) -> np.ndarray:
        """Return the fraction (N,) of its stride that each node has completed ``elapsed`` seconds into a round."""
        parts = (elapsed / self._round - (1.0 - _CARRIED_FRACTION) * self._behind) / _CARRIED_FRACTION
        return np.array([smooth(part) for part in parts])

    def _pose(self, elapsed: float) -> np.ndarray:
        """Return the target positions (N, 3) of the nodes ``elapsed`` seconds into a round, ground coordinates."""
        carried = self._carried(elapsed)[:, None]
        pose = (1.0 - carried) * self._posed_nodes(self._from) + carried * self._posed_nodes(self._to)
        pose[:, 2:] += _LIFT * self.body.height * 4.0 * carried * (1.0 - carried)
        return pose

    def _posed_nodes(self, planar_pose: np.ndarray) -> np.ndarray:
        """Return the nodes (N, 3) of the resting body moved to ``planar_pose`` (3,), see ``motions.route``."""
        turn = Rotation.from_rotvec([0.0, 0.0, planar_pose[2]]).as_matrix()
        moved = np.array([*planar_pose[:2], self._slope @ planar_pose[:2]])
        return self._centre + moved + (self._standing - self._centre) @ turn.T

    def _no_slip_objective(self, report: StepReport, swings: np.ndarray) -> Objective:
        """Return the objective of zero sliding velocity at standing contacts."""
        contacts = report.contacts
        stands = ~swings[contacts.nearest_nodes]
        loads = np.where(stands, report.forces[:, 0], 0.0) / self.body.weight
        return no_slip_contacts(contacts, loads, self.control.hold)

    def _best_fit_rotation(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return the (3,) best-fit rotation (Kabsch) from ``before`` (N, 3) to ``after`` (N, 3) as a rotation
        vector."""
        arms, aims = (x - self.body.centre_of_mass(x) for x in (before, after))
        return Rotation.from_matrix(kabsch_rotation(self.body.node_mass, arms, aims)).as_rotvec()


def _slices(flat: np.ndarray) -> np.ndarray:
    """Return the coordinate (N,) in metres of points (N, 2) on the ground along their longest axis.

    It increases forward or, if the body lies across the forward direction, to the left.
    """
    middle = flat - flat.mean(axis=0)
    axis = np.linalg.svd(middle, full_matrices=False)[2][0]
    return middle @ (axis if axis.sum() > 0.0 else -axis)
