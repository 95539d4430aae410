"""Walk, crawl or roll under commands that can change at every time step.

Each step of a walk is planned when it begins, from the command at that moment. When the command is zero, the feet come
together and the body returns to its standing pose.
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

_PLANNED_STEPS = 4
"""Number of future steps that a walk plans, assuming a constant command."""
_MAX_SPEED_FACTOR = 1.6
"""Maximum speed of a walk, relative to the nominal speed of the gait."""


def integrate_command(
    planar_pose: np.ndarray, command: Drive, time: float, limits: StepLimits, *, unit: float, height: float
) -> np.ndarray:
    """Return the planar pose (3,) that is reached ``time`` seconds after ``planar_pose`` (3,) under ``command``, at
    most one step away.

    Args:
        planar_pose: (3,) x and y in metres, heading in radians.
        command: velocity command.
        time: duration, s.
        limits: limits of the displacement and rotation in one step.
        unit: time unit sqrt(H / g), s.
        height: body height H, m.
    """
    duration = time / unit
    share = 1.0 / max(duration * _effort(command, limits, height), 1.0)
    turn = share * duration * command.turn
    # The body moves along an arc; ``middle`` is the direction of its chord.
    middle = planar_pose[2] + 0.5 * turn
    ahead, left = (
        share * duration * height * np.array([command.forward, command.sideways * (limits.side_fraction > 0.0)])
    )
    cos, sin = np.cos(middle), np.sin(middle)
    return planar_pose + [cos * ahead - sin * left, sin * ahead + cos * left, turn]


def _effort(command: Drive, limits: StepLimits, height: float) -> float:
    """Return the number of steps of maximum length per sqrt(H / g) that ``command`` requires."""
    aside = command.sideways / limits.side_fraction if limits.side_fraction > 0.0 else 0.0
    return height * float(np.hypot(command.forward, aside)) / limits.length + abs(command.turn) / limits.turn


class DrivenWalk(Walk):
    """Walk whose route is extended while it runs."""

    def __init__(self, stance: Stance, command: Drive) -> None:
        self.command = command
        super().__init__(stance, lambda _: np.zeros((2, 3)), stance.body.height)
        self._nominal_gait = self.gait
        self._lay_places(0)

    def _plan_swing(self, swing: int, local: np.ndarray) -> None:
        if self._mean_lag(local) > MAX_LAG:
            # Correct the position of the body for the slip of the feet.
            self.planar_poses[min(swing, self.gait.step_count), :2] -= self._foothold_error(local).mean(axis=0)
        self._lay_places(swing)

    def _lay_places(self, swing: int) -> None:
        """Plan the planar poses after the index ``swing``; the pose with this index has already been reached."""
        places_so_far = list(self.planar_poses[: swing + 1])
        places_so_far += [places_so_far[-1]] * (swing + 1 - len(places_so_far))
        if self.command.is_zero:
            if swing >= self.gait.step_count and swing > 0:
                return  # Plan nothing: the feet are already being brought together.
            planar_poses = places_so_far if swing > 0 else [*places_so_far, places_so_far[-1]]
        else:
            time = self._nominal_gait.swing_time + self._nominal_gait.double_time
            rate = self._speed_factor(time)
            self.gait = replace(
                self._nominal_gait,
                swing_time=self._nominal_gait.swing_time / rate,
                double_time=self._nominal_gait.double_time / rate,
            )
            planar_poses = places_so_far
            for _ in range(_PLANNED_STEPS):
                planar_poses.append(self._next_pose(planar_poses[-1], time / rate))
        self.planar_poses = np.array(planar_poses)
        self.gait = replace(self.gait, step_count=len(planar_poses) - 1)

    def _next_pose(self, planar_pose: np.ndarray, time: float) -> np.ndarray:
        unit, height = self.body.time_unit, self.body.height
        return integrate_command(planar_pose, self.command, time, self._step_limits, unit=unit, height=height)

    def _speed_factor(self, time: float) -> float:
        """Return the speed, relative to the nominal speed, at which steps of maximum length satisfy the command."""
        effort = _effort(self.command, self._step_limits, self.body.height)
        return float(np.clip(time / self.body.time_unit * effort, 1.0, _MAX_SPEED_FACTOR))


class DrivenCrawl(Crawl):
    """Crawl whose rounds are planned from the current command."""

    def __init__(self, stance: Stance, command: Drive) -> None:
        self.command = command
        super().__init__(stance, lambda _: np.zeros((2, 3)))

    def _aim(self) -> tuple[np.ndarray, bool]:
        unit, height = self.body.time_unit, self.body.height
        aim = integrate_command(self._from, self.command, self._round, self.step_limits, unit=unit, height=height)
        return aim, self.command.is_zero


class DrivenRoll(Roll):
    """Roll at the commanded velocity; a ball does not turn."""

    def __init__(self, stance: Stance, command: Drive) -> None:
        self.command = command
        super().__init__(stance, lambda _: np.zeros((2, 3)))
        self._velocity, self._target = np.zeros(2), self._start

    def _profile_sample(self, com: np.ndarray, elapsed: float, dt: float) -> ProfileSample:
        unit = self.body.speed_unit
        target = unit * np.array([self.command.forward, self.command.sideways])
        max_change = self.top_push * dt
        change = target - self._velocity
        change *= min(1.0, max_change / max(float(np.linalg.norm(change)), 1e-12))
        self._velocity = self._velocity + change
        self._target = self._target + dt * self._velocity
        # Keep the target near the body, so that a delayed body does not accelerate to catch up with it.
        off = self._target - com[:2]
        self._target = com[:2] + off * min(1.0, 0.1 * self.body.height / max(float(np.linalg.norm(off)), 1e-12))
        return ProfileSample(self._target - self._start, self._velocity, change / dt)

    def _is_over(self, com: np.ndarray, elapsed: float) -> bool:
        return self.command.is_zero and not self._velocity.any()


@dataclass(frozen=True)
class DrivePlanRecord:
    """Planned quantities of a drive."""

    seconds: float
    """Start time of the last command, which is a zero command, s."""


@dataclass(frozen=True)
class DriveOutcome:
    """Displacement along the ground during a drive, forward and to the left, in body heights."""

    ahead: float
    left: float


class LiveDrive:
    """Follow ``command``, which may be set at any time."""

    def __init__(self, stance: Stance) -> None:
        """Create the motion of the body that stands at ``stance``.

        Raises:
            UserError: if the body cannot move at all.
        """
        self._stance = stance
        self.command = Drive()
        start_drive(stance, self.command)
        self._motion: DrivenWalk | DrivenCrawl | DrivenRoll | Stand = Stand(stance)

    @property
    def is_at_rest(self) -> bool:
        """True if the command is zero and the body stands at rest."""
        return self.command.is_zero and self._motion.is_at_rest

    def notes(self) -> list[str]:
        """Return no messages: the body moves as fast as it can."""
        return []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        motion = self._motion
        if isinstance(motion, Stand):
            if not self.command.is_zero and motion.is_at_rest:
                self._stance = self._stance.next_stance(state.positions, report)
                self._motion = start_drive(self._stance, self.command)
        else:
            motion.command = self.command
            if motion.is_at_rest:
                self._stance = self._stance.next_stance(state.positions, report)
                self._motion = Stand(self._stance)
        return self._motion.objectives(state, report, dt)


def start_drive(stance: Stance, command: Drive) -> DrivenWalk | DrivenCrawl | DrivenRoll:
    """Return the motion of a body that starts at ``stance`` with ``command``; the class of the motion depends on the
    body's support."""
    base = stance.base()
    if base is SupportKind.LYING:
        return DrivenCrawl(stance, command)
    if base is SupportKind.ROUND_BASE:
        return DrivenRoll(stance, command)
    return DrivenWalk(stance, command)


class ScriptedDrive:
    """Drive with a prescribed sequence of commands."""

    def __init__(self, stance: Stance, plan: DrivePlan) -> None:
        self._stance, self._plan, self._drive = stance, plan, LiveDrive(stance)
        self._start_time: float | None = None
        self._is_done = False

    @property
    def is_at_rest(self) -> bool:
        """True if all commands are completed and the body stands at rest."""
        return self._is_done and self._drive.is_at_rest

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds, including the time to bring the feet together."""
        return self._plan.seconds + 6.0 * self._stance.body.time_unit

    def plan_record(self) -> DrivePlanRecord:
        """Return the planned quantities of the motion."""
        return DrivePlanRecord(self._plan.seconds)

    def planned_com(self, elapsed: float) -> None:
        """Return None: each step starts from the measured body."""

    def notes(self) -> list[str]:
        """Return no messages."""
        return []

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> DriveOutcome:
        """Measure the displacement between two states of the trajectory."""
        ends = trajectory.positions[[first, last]]
        body = self._stance.body
        moved = self._stance.ground.axes @ (body.centre_of_mass(ends[1]) - body.centre_of_mass(ends[0]))
        return DriveOutcome(float(moved[0]) / body.height, float(moved[1]) / body.height)

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        self._start_time = state.time if self._start_time is None else self._start_time
        elapsed = state.time - self._start_time
        self._is_done = elapsed >= self._plan.seconds - 1e-9
        self._drive.command = self._plan.at(elapsed)
        return self._drive.objectives(state, report, dt)
