"""Driven by commands that can change at every step: a walk, a crawl or a roll whose way is made as it goes.

Each pace is planned when it begins, from the command of that moment; when the command is to stand, the feet close and
the body gathers itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.command import Drive, DrivePlan
from egs_warp.motions.crawl import Crawl
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.roll import Roll
from egs_warp.motions.route import StepLimits
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stand import Stand
from egs_warp.motions.velocity_profile import ProfileSample
from egs_warp.motions.walk import MAX_LAG, Walk

_AHEAD = 4
"""Paces to come that a walk plans for, as if the command stayed."""
_QUICKEST = 1.6
"""Of the usual speed of a gait: as quick as a walk may be told to be."""


def integrate_command(
    place: np.ndarray, command: Drive, time: float, pace: StepLimits, *, unit: float, height: float
) -> np.ndarray:
    """(3,) the place ``time`` seconds after ``place`` (3,) under ``command``, no further than one ``pace``."""
    spell = time / unit
    share = 1.0 / max(spell * _effort(command, pace, height), 1.0)
    turn = share * spell * command.turn
    # Along the arc that it goes on: by its chord.
    middle = place[2] + 0.5 * turn
    ahead, left = share * spell * height * np.array([command.forward, command.sideways * (pace.side_fraction > 0.0)])
    cos, sin = np.cos(middle), np.sin(middle)
    return place + [cos * ahead - sin * left, sin * ahead + cos * left, turn]


def _effort(command: Drive, pace: StepLimits, height: float) -> float:
    """The longest paces in sqrt(H / g) that a ``command`` takes."""
    aside = command.sideways / pace.side_fraction if pace.side_fraction > 0.0 else 0.0
    return height * float(np.hypot(command.forward, aside)) / pace.length + abs(command.turn) / pace.turn


class DrivenWalk(Walk):
    """A walk whose places are made as it goes."""

    def __init__(self, place: Stance, command: Drive) -> None:
        self.command = command
        super().__init__(place, lambda _: np.zeros((2, 3)), place.body.height)
        self._usual = self.gait
        self._lay_places(0)

    def _plan_swing(self, swing: int, local: np.ndarray) -> None:
        if self._mean_lag(local) > MAX_LAG:
            # It goes on from where slipping feet have left it.
            self.places[min(swing, self.gait.step_count), :2] -= self._foothold_error(local).mean(axis=0)
        self._lay_places(swing)

    def _lay_places(self, swing: int) -> None:
        """Where the body goes from swing ``swing`` on; it has got as far as the place of that number."""
        kept = list(self.places[: swing + 1])
        kept += [kept[-1]] * (swing + 1 - len(kept))
        if self.command.is_zero:
            if swing >= self.gait.step_count and swing > 0:
                return  # It closes its feet already.
            places = kept if swing > 0 else [*kept, kept[-1]]
        else:
            time = self._usual.swing_time + self._usual.double_time
            rate = self._quickness(time)
            self.gait = replace(
                self._usual, swing_time=self._usual.swing_time / rate, double_time=self._usual.double_time / rate
            )
            places = kept
            for _ in range(_AHEAD):
                places.append(self._next(places[-1], time / rate))
        self.places = np.array(places)
        self.gait = replace(self.gait, step_count=len(places) - 1)

    def _next(self, place: np.ndarray, time: float) -> np.ndarray:
        unit, height = self.body.time_unit, self.body.height
        return integrate_command(place, self.command, time, self._pace, unit=unit, height=height)

    def _quickness(self, time: float) -> float:
        """Over the usual, that the command takes at the longest pace."""
        effort = _effort(self.command, self._pace, self.body.height)
        return float(np.clip(time / self.body.time_unit * effort, 1.0, _QUICKEST))


class DrivenCrawl(Crawl):
    """A crawl whose rounds are planned as it goes."""

    def __init__(self, place: Stance, command: Drive) -> None:
        self.command = command
        super().__init__(place, lambda _: np.zeros((2, 3)))

    def _aim(self) -> tuple[np.ndarray, bool]:
        unit, height = self.body.time_unit, self.body.height
        aim = integrate_command(self._from, self.command, self._round, self.pace, unit=unit, height=height)
        return aim, self.command.is_zero


class DrivenRoll(Roll):
    """A roll at the speed that it is told; a ball does not turn."""

    def __init__(self, place: Stance, command: Drive) -> None:
        self.command = command
        super().__init__(place, lambda _: np.zeros((2, 3)))
        self._wanted, self._aimed = np.zeros(2), self._start

    def _ahead(self, com: np.ndarray, elapsed: float, dt: float) -> ProfileSample:
        unit = self.body.speed_unit
        told = unit * np.array([self.command.forward, self.command.sideways])
        most = self.top_push * dt
        change = told - self._wanted
        change *= min(1.0, most / max(float(np.linalg.norm(change)), 1e-12))
        self._wanted = self._wanted + change
        self._aimed = self._aimed + dt * self._wanted
        # What it is held back by is not made up for.
        off = self._aimed - com[:2]
        self._aimed = com[:2] + off * min(1.0, 0.1 * self.body.height / max(float(np.linalg.norm(off)), 1e-12))
        return ProfileSample(self._aimed - self._start, self._wanted, change / dt)

    def _is_over(self, com: np.ndarray, elapsed: float) -> bool:
        return self.command.is_zero and not self._wanted.any()


@dataclass(frozen=True)
class DrivePlanRecord:
    """What a drive aims at."""

    seconds: float
    """Until it is told to stand for good."""


@dataclass(frozen=True)
class DriveOutcome:
    """What became of a drive; body heights along the ground, degrees."""

    ahead: float
    left: float


class LiveDrive:
    """Does as the command says, from one step to the next: ``command`` may be set at any time."""

    def __init__(self, place: Stance) -> None:
        """The body stands at ``place``. Raises ``UserError`` for one that cannot go at all."""
        self._place = place
        self.command = Drive()
        start_drive(place, self.command)
        self._motion: DrivenWalk | DrivenCrawl | DrivenRoll | Stand = Stand(place)

    @property
    def is_at_rest(self) -> bool:
        """Whether it stands, as it is told to."""
        return self.command.is_zero and self._motion.resting

    def notes(self) -> list[str]:
        """None: it goes as fast as it can."""
        return []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        motion = self._motion
        if isinstance(motion, Stand):
            if not self.command.is_zero and motion.resting:
                self._place = self._place.next_stance(state.positions, report)
                self._motion = start_drive(self._place, self.command)
        else:
            motion.command = self.command
            if motion.resting:
                self._place = self._place.next_stance(state.positions, report)
                self._motion = Stand(self._place)
        return self._motion.objectives(state, report, dt)


def start_drive(place: Stance, command: Drive) -> DrivenWalk | DrivenCrawl | DrivenRoll:
    """What a body at ``place`` does under commands, by what it stands on."""
    base = place.base()
    if base is SupportKind.LYING:
        return DrivenCrawl(place, command)
    if base is SupportKind.ROUND_BASE:
        return DrivenRoll(place, command)
    return DrivenWalk(place, command)


class ScriptedDrive:
    """A drive by commands known before."""

    def __init__(self, place: Stance, plan: DrivePlan) -> None:
        self._place, self._plan, self._driven = place, plan, LiveDrive(place)
        self._began: float | None = None
        self._over = False

    @property
    def is_at_rest(self) -> bool:
        """Whether it stands at the end."""
        return self._over and self._driven.resting

    @property
    def expected_time(self) -> float:
        """Seconds, with what closing the feet takes."""
        return self._plan.seconds + 6.0 * self._place.body.time_unit

    def plan_record(self) -> DrivePlanRecord:
        """What it aims at."""
        return DrivePlanRecord(self._plan.seconds)

    def planned_com(self, elapsed: float) -> None:
        """Nothing: it goes on from the measured body."""

    def notes(self) -> list[str]:
        """None."""
        return []

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> DriveOutcome:
        """Where it has come to."""
        ends = trajectory.positions[[first, last]]
        body = self._place.body
        moved = self._place.ground.axes @ (body.centre_of_mass(ends[1]) - body.centre_of_mass(ends[0]))
        return DriveOutcome(float(moved[0]) / body.height, float(moved[1]) / body.height)

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        self._began = state.time if self._began is None else self._began
        elapsed = state.time - self._began
        self._over = elapsed >= self._plan.seconds - 1e-9
        self._driven.command = self._plan.at(elapsed)
        return self._driven.objectives(state, report, dt)
