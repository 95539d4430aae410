"""Crawl: a long body without feet goes by a wave of strides that runs along it, as a worm does.

Each slice of it stands for most of a round and is then carried to its next place, a little after the slice before it.
What is carried is unloaded, what stands holds the ground for it. See docs/concepts/motions.md.
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

_ROUND = 3.0
"""Of sqrt(H / g): how long a slice takes from one stride to the next."""
_CARRIED = 0.4
"""Part of a round in which a slice is carried; in the rest it stands."""
STRAIN = 0.12
"""The most that a stride stretches the body by."""
_ASIDE, _GENTLE = 0.25, 0.3
"""Body heights of a stride to the side, or of its ends in a turn, and the acceleration, in g, that it may take: harder,
a round body would roll over."""
_BEND = 5.77
"""Largest second derivative of that way."""
_STEEPEST = 1.875
"""Largest slope of the way from 0 to 1 that a slice is carried in a time of 1."""
_LIFT = 0.02
"""Body heights by which a slice is lifted that is carried."""
_THERE = 0.2
"""Rounds: what is nearer than this to the end of the way is there."""
_NEXT = 0.5
"""Rounds from a place of the way at which it goes for the next."""
_GAIN, _FRUITLESS = 0.2, 4
"""Rounds: a round that brings the end of its way no nearer than this is fruitless; after so many in a row it gives
up."""


@dataclass(frozen=True)
class CrawlPlan:
    """Numbers of a crawl; metres, seconds."""

    rounds: float
    stride: float
    """The longest of a slice."""
    seconds: float


@dataclass(frozen=True)
class CrawlOutcome:
    """How a body crawled."""

    rounds: float
    """Waves that ran along it."""
    stride: float
    """Body heights that its middle came on in a round, in the mean."""


@dataclass(frozen=True)
class CrawlControl:
    """Weights of the objectives; speeds are compared in sqrt(g H)."""

    com: float = 100.0
    spin: float = 2000.0
    pose: float = 20.0
    unload: float = 30.0
    hold: float = 50.0
    turn_rate: float = 4.0
    follow: float = 8.0
    """Of the pose, in sqrt(g / H)."""


class Crawl:
    """Goes by rounds, each planned from where the last one has ended, until it is there."""

    def __init__(self, place: Stance, route: Route, *, speed: float = 1.0, control: CrawlControl | None = None) -> None:
        """The body lies at ``place``; ``speed`` over the usual."""
        body = place.body
        self.body, self.ground, self.control = body, place.ground, control or CrawlControl()
        normal = place.ground.axes @ place.ground.surface_normal
        self._slope = -normal[:2] / normal[2]
        self._standing = place.ground.local(place.standing)
        self._centre = body.centre_of_mass(self._standing)
        along = _slices(self._standing[:, :2])
        length = float(np.ptp(along))
        self._behind = (along.max() - along) / length
        """(N,) from 0 at the front end to 1 at the back."""
        stride = STRAIN * length * _CARRIED / (_STEEPEST * (1.0 - _CARRIED))
        aside = _ASIDE * body.height
        self.pace = StepLimits(stride, 2.0 * aside / length, side_fraction=min(aside / stride, 1.0), faces_travel=False)
        self.places = route(self.pace)
        check_route(place, self.places)
        self._next, self._from, self._to = 1, np.zeros(3), self.places[1]
        """Of ``places`` the one it goes to; the body's place before and after this round."""
        self._speed, self._length = speed, length
        self._round = self._duration()
        """Seconds."""
        self._nearest, self._fruitless = np.inf, 0
        self._began: float | None = None
        self.rounds = 0
        self._over = False
        self._calm = RestDetector(body)
        self._resting = False

    @property
    def seconds(self) -> float:
        """That all rounds take where none slides back."""
        return self._round * (len(self.places) - 1)

    @property
    def expected_time(self) -> float:
        """Seconds, with what coming to rest takes."""
        return self.seconds + self.body.time_unit

    @property
    def is_at_rest(self) -> bool:
        """Whether it lies still at the end of its way."""
        return self._resting

    def plan_record(self) -> CrawlPlan:
        """What it aims at."""
        return CrawlPlan(float(len(self.places) - 1), self.pace.length, self.seconds)

    def planned_com(self, elapsed: float) -> None:
        """Nothing: it goes on from where it has come to."""

    def notes(self) -> list[str]:
        """What kept it from its target, for the user."""
        if not self._over or self._missing(self._to) <= _THERE:
            return []
        return [f"it slid back as far as it came on, and gave up after {self.rounds} rounds"]

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> CrawlOutcome:
        """What a round came to between two states of the trajectory."""
        ends = trajectory.positions[[first, last]]
        gone = (self.body.centre_of_mass(ends[1]) - self.body.centre_of_mass(ends[0])) @ self.ground.axes[:2].T
        return CrawlOutcome(float(self.rounds), float(np.linalg.norm(gone)) / self.body.height / max(self.rounds, 1))

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        body, axes, control, unit = self.body, self.ground.axes, self.control, self.body.time_unit
        local = self.ground.local(state.positions)
        if not self._over and (self._began is None or state.time - self._began >= self._round - 1e-9):
            self._plan_round(local, state.time)
        assert self._began is not None
        elapsed = state.time - self._began
        self._note_rest(axes @ body.centre_of_mass(state.velocities), state.time)
        before, after = self._pose(elapsed), self._pose(elapsed + dt)
        follow = min(control.follow / unit, 0.7 / dt)
        carried = self._carried(elapsed + dt)
        swings = (carried > 0.0) & (carried < 1.0)
        com = body.centre_of_mass(local)
        com_velocity = body.centre_of_mass(after - before) / dt + follow * (body.centre_of_mass(before) - com)
        spin = control.turn_rate / unit * self._turn(local, before) + self._turn(before, after) / dt
        pose = (after - before) / dt + follow * (before - local)
        return [
            centre_of_mass_velocity(body, com_velocity @ axes, control.com),
            AngularMomentumObjective(body.inertia(state.positions) @ (spin @ axes), control.spin),
            node_velocities(body, pose @ axes, control.pose),
            *([LoadObjective(np.flatnonzero(swings), control.unload)] if swings.any() else []),
            *([self._hold(report, swings)] if report is not None else []),
        ]

    def _plan_round(self, local: np.ndarray, time: float) -> None:
        self._from = self._place_of(local)
        self._to, self._over = self._aim()
        self._began, self._round = time, self._duration()
        self.rounds += not self._over

    def _duration(self) -> float:
        """Seconds of this round: longer where slices go aside."""
        change, half = self._to - self._from, 0.5 * self._length
        aside = abs(np.cos(self._from[2]) * change[1] - np.sin(self._from[2]) * change[0]) + half * abs(change[2])
        gentle = np.sqrt(_BEND * aside / (_GENTLE * np.linalg.norm(self.body.gravity))) / _CARRIED
        return max(_ROUND * self.body.time_unit, float(gentle)) / self._speed

    def _aim(self) -> tuple[np.ndarray, bool]:
        """(3,) where the body is to be after this round, and whether it is there for good."""
        while self._next < len(self.places) - 1 and self._paces(self.places[self._next] - self._from) < _NEXT:
            self._next += 1
        missing = self._paces(self.places[self._next] - self._from)
        left = missing + len(self.places) - 1 - self._next
        if left < self._nearest - _GAIN:
            self._nearest, self._fruitless = left, 0
        else:
            self._fruitless += 1
        over = (self._next == len(self.places) - 1 and missing <= _THERE) or self._fruitless > _FRUITLESS
        share = 0.0 if over else min(1.0, 1.0 / max(missing, 1e-12))
        return self._from + share * (self.places[self._next] - self._from), over

    def _paces(self, change: np.ndarray) -> float:
        """That a ``change`` of place (3,) takes."""
        cos, sin = np.cos(self._from[2]), np.sin(self._from[2])
        ahead, aside = cos * change[0] + sin * change[1], cos * change[1] - sin * change[0]
        way = float(np.hypot(ahead, aside / self.pace.side_fraction)) / self.pace.length
        return way + abs(float(change[2])) / self.pace.turn

    def _missing(self, place: np.ndarray) -> float:
        """Paces from ``place`` (3,) to the end of the way."""
        return self._paces(self.places[-1] - place)

    def _place_of(self, local: np.ndarray) -> np.ndarray:
        """(3,) where the nodes at ``local`` (N, 3) have the body, its heading by whole turns as near to the last as may
        be."""
        com = self.body.centre_of_mass(local)
        turn = kabsch_rotation(self.body.node_mass, self._standing - self._centre, local - com)
        heading = float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
        heading += 2.0 * np.pi * round((self._to[2] - heading) / (2.0 * np.pi))
        return np.array([*(com - self._centre)[:2], heading])

    def _note_rest(self, moving: np.ndarray, time: float) -> None:
        calm = self._calm.update(moving, time)
        slow = bool(np.linalg.norm(moving) <= REST_SPEED * self.body.speed_unit)
        self._resting = (self._over and calm) or (self._resting and slow)

    def _carried(self, elapsed: float) -> np.ndarray:
        """(N,) part of its stride that each node has been carried ``elapsed`` seconds into a round."""
        parts = (elapsed / self._round - (1.0 - _CARRIED) * self._behind) / _CARRIED
        return np.array([smooth(part) for part in parts])

    def _pose(self, elapsed: float) -> np.ndarray:
        """(N, 3) where the nodes should be ``elapsed`` seconds into a round."""
        carried = self._carried(elapsed)[:, None]
        pose = (1.0 - carried) * self._placed(self._from) + carried * self._placed(self._to)
        pose[:, 2:] += _LIFT * self.body.height * 4.0 * carried * (1.0 - carried)
        return pose

    def _placed(self, place: np.ndarray) -> np.ndarray:
        """(N, 3) the nodes as they lay, with the body at ``place`` (3,): see ``motions.route``."""
        turn = Rotation.from_rotvec([0.0, 0.0, place[2]]).as_matrix()
        moved = np.array([*place[:2], self._slope @ place[:2]])
        return self._centre + moved + (self._standing - self._centre) @ turn.T

    def _hold(self, report: StepReport, swings: np.ndarray) -> Objective:
        """What stands does not slide."""
        contacts = report.contacts
        stands = ~swings[contacts.nearest_nodes]
        loads = np.where(stands, report.forces[:, 0], 0.0) / self.body.weight
        return no_slip_contacts(contacts, loads, self.control.hold)

    def _turn(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """(3,) rotation vector that best carries ``before`` (N, 3) to ``after`` (N, 3)."""
        arms, aims = (x - self.body.centre_of_mass(x) for x in (before, after))
        return Rotation.from_matrix(kabsch_rotation(self.body.node_mass, arms, aims)).as_rotvec()


def _slices(flat: np.ndarray) -> np.ndarray:
    """(N,) metres along the length of points (N, 2) on the ground, growing ahead or, where it lies across, to the
    left."""
    middle = flat - flat.mean(axis=0)
    axis = np.linalg.svd(middle, full_matrices=False)[2][0]
    return middle @ (axis if axis.sum() > 0.0 else -axis)
