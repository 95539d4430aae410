"""Scheduling of the motions of a live creature: requested motions, navigation to a point, driving, or standing.

A motion that has started is completed. A new request replaces the queued motions and starts as soon as the body is at
rest.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Protocol

import numpy as np

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.command import Drive
from egs_warp.motions.drive import LiveDrive
from egs_warp.motions.fall_monitor import LyingDetector
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.get_up import GetUp
from egs_warp.motions.repertoire import MOTIONS, tasks_of_request
from egs_warp.motions.request import MotionRequest
from egs_warp.motions.script import Script, motion
from egs_warp.motions.sequence import MotionRecord, MotionTask, Stance
from egs_warp.motions.stance import sole_shares
from egs_warp.motions.stand import Stand
from egs_warp.motions.style import Style
from egs_warp.motions.walk_posture import select_posture
from egs_warp.web.idle import RelaxMuscles

ARRIVAL_DISTANCE = 0.12
"""Distance between the centre of the feet and the goal within which the goal is reached, body heights."""
MAX_HEADING_ERROR = 15.0
"""Angle between the heading and the direction to the goal above which the body turns before it moves, degrees."""
_MIN_TURN_DISTANCE = 0.25
"""Distance to the goal below which the body does not turn, body heights."""
_MAX_JUMP_DISTANCE, _JUMP_HEIGHT = 0.5, 0.2
"""Maximum length and height of a jump towards the goal, body heights."""
_MAX_WALK_DISTANCE = 0.8
"""Maximum length of a walk before the next one is planned, body heights."""
_MAX_FAILED_LEGS = 3
"""Maximum number of consecutive legs of a navigation without progress; after more, the navigation stops."""
_GET_UP = "get up"
"""Name of the only motion that a body that lies can begin."""
_LYING = "the body lies on the ground: it must get up first, or be put back at its start"
"""Answer to a request for another motion of a body that lies."""


@dataclass(frozen=True)
class Task:
    """A queued motion and its request."""

    part: MotionTask
    """The motion that is to be performed."""
    request: MotionRequest
    """The request from which the motion was built, for a script."""


class BodyStatus(Enum):
    """State of a body between and during motions."""

    STANDING = "standing"
    MOVING = "moving"
    LYING = "lying"
    """Fallen, with relaxed muscles, until the body is to get up or is put back at its start."""


class _SchedulableMotion(Protocol):
    """Interface of the motions that the scheduler runs."""

    @property
    def is_at_rest(self) -> bool: ...

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]: ...

    def notes(self) -> list[str]: ...


@dataclass(frozen=True)
class _ActiveMotion:
    """The motion that is being performed."""

    name: str
    """Name of the motion, for the user."""
    motion: _SchedulableMotion
    """The motion itself."""
    posture: BodyStatus
    """State of the body during the motion."""


def tasks_of(script: Script, height: float) -> list[Task]:
    """Return the motions of ``script`` in order, for a body of ``height`` m."""
    tasks = []
    for request in script.requests:
        once = replace(request, repeat=1)
        tasks += [Task(part, once) for part in tasks_of_request(request, height)]
    return tasks


class PointNavigation:
    """Navigation to a point by walking, or by turns and jumps. Each leg is planned from the position that the body has
    reached in the previous leg."""

    def __init__(self, goal: np.ndarray, *, walks: bool) -> None:
        """Create a navigation to ``goal`` (2,) m; ``walks`` is True if the body can walk."""
        self.goal = goal
        self._walks = walks
        self._nearest, self._failed_legs = np.inf, 0

    def next_part(self, place: Stance) -> Task | None:
        """Return the next motion of a body at ``place``; None if the goal is reached.

        Raises ``UserError`` after too many legs without progress.
        """
        height = place.body.height
        feet = sole_shares(place.body, place.ground, place.standing) @ place.standing
        to_goal = np.array([*(self.goal - feet[:2]), 0.0])
        distance = float(np.linalg.norm(to_goal)) / height
        if distance <= ARRIVAL_DISTANCE:
            return None
        if distance < self._nearest - 0.05:
            self._nearest, self._failed_legs = distance, 0
        else:
            self._failed_legs += 1
        if self._failed_legs > _MAX_FAILED_LEGS:
            raise UserError(
                f"go: the body gets no nearer to it than {self._nearest:.2f} body heights; choose another point"
            )
        x, y = place.ground.axes[:2] @ to_goal
        if self._walks:
            ahead, left = min(1.0, _MAX_WALK_DISTANCE / distance) / height * np.array([x, y])
            return self._task(f"walk to {ahead:.3f},{left:.3f}", height)
        aside = float(np.degrees(np.arctan2(y, x)))
        if abs(aside) > MAX_HEADING_ERROR and distance > _MIN_TURN_DISTANCE:
            return self._task(f"twist {aside:.1f} 0 {_JUMP_HEIGHT}", height)
        leap = distance / np.ceil(distance / _MAX_JUMP_DISTANCE)
        task = self._task(f"jump {leap:.3f} {_JUMP_HEIGHT}", height)
        begin = task.part.begin
        return replace(task, part=replace(task.part, begin=lambda at: begin(at.facing(to_goal))))

    @staticmethod
    def _task(text: str, height: float) -> Task:
        return tasks_of(motion(text), height)[0]


class MotionScheduler:
    """Scheduler that performs the requested motions of a body one after the other."""

    def __init__(self, place: Stance, send_line: Callable[[str], object]) -> None:
        """Create a scheduler of a body that stands at ``place``; ``send_line`` sends one line of text to the user."""
        self.records: list[MotionRecord] = []
        """Motions that have been started."""
        self.requests: list[MotionRequest] = []
        """Request of each entry in ``records``."""
        self._send_line = send_line
        self._tasks: deque[Task] = deque()
        self._journey: PointNavigation | None = None
        self._drive = Drive()
        """Requested speeds."""
        self.drive_starts: list[float] = []
        """Times in s at which the user started to drive the body."""
        self.style = Style()
        """Style of the next motion."""
        self.stand(place)
        self.walks = _walks(place)

    def stand(self, place: Stance) -> None:
        """Stand at ``place`` and cancel everything else."""
        self.cancel()
        self.change_place(place)
        self._is_ball = place.base() is SupportKind.ROUND_BASE
        self._active: _ActiveMotion = _ActiveMotion("stand", Stand(place), BodyStatus.STANDING)

    def change_place(self, place: Stance) -> None:
        """Use the stance ``place`` of a body that has been rebuilt; the active motion continues."""
        self.place = place
        self._lying = LyingDetector(place)

    def perform(self, script: Script) -> None:
        """Queue the motions of ``script``; they replace the queued ones. A body that lies has to get up first."""
        self.cancel()
        tasks = tasks_of(script, self.place.body.height)
        if self._can_begin(tasks[0].part.name if tasks else ""):
            self._tasks.extend(tasks)

    def go(self, goal: np.ndarray) -> None:
        """Go to ``goal`` (2,) m next; this request replaces the queued motions."""
        self.cancel()
        if self._can_begin("go"):
            self._journey = PointNavigation(goal, walks=self.walks)

    def drive(self, command: Drive) -> None:
        """Move at the speeds of ``command``, from the end of the active motion until the next request."""
        self.cancel()
        if command.is_zero or self._can_begin("drive"):
            self._drive = command

    def _can_begin(self, name: str) -> bool:
        """Return True if the body stands or moves, or if it lies and ``name`` is getting up; otherwise, tell the user
        why not."""
        if self._active.posture is not BodyStatus.LYING or name == _GET_UP:
            return True
        self._send_line(_LYING)
        return False

    def cancel(self) -> None:
        """Cancel the queued motions, the navigation and the driving."""
        self._drive = Drive()
        self._tasks.clear()
        self._journey = None

    @property
    def doing(self) -> str:
        """Name of the active motion."""
        return self._active.name

    @property
    def queued(self) -> str | None:
        """Name of the next motion; None if there is none."""
        if self._tasks:
            return self._tasks[0].part.name
        if self._journey:
            return "go"
        return None if self._drive.is_zero or isinstance(self._active.motion, LiveDrive) else "drive"

    @property
    def idle(self) -> bool:
        """True if the body stands or lies, and no motion is queued."""
        return self._active.posture is not BodyStatus.MOVING and self._active.motion.is_at_rest and self.queued is None

    @property
    def goal(self) -> np.ndarray | None:
        """(2,) m, goal of the navigation; None if there is none."""
        return self._journey.goal if self._journey else None

    def facing(self, positions: np.ndarray) -> np.ndarray:
        """Return the unit vector (2,) of the forward direction, for nodes at ``positions`` (N, 3) m."""
        place = self.place if self._is_ball else self.place.moved_to(positions)
        forward = place.ground.axes[0, :2]
        return forward / max(float(np.linalg.norm(forward)), 1e-12)

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Start the next motion if it is due, and return the objectives of the active motion.

        Args:
            state: state at the start of the step.
            report: report of the last step; None if there is none.
            dt: step size, s.
        """
        if self._has_fallen(state, report, dt):
            self._lie()
        is_driven = isinstance(self._active.motion, LiveDrive) and not self._drive.is_zero
        if self._active.posture is BodyStatus.LYING:
            if self._tasks:
                self._begin_next(state, report)
        elif self._active.motion.is_at_rest and not is_driven:
            self._begin_next(state, report)
        if isinstance(self._active.motion, LiveDrive):
            self._active.motion.command = self._drive
        return self._active.motion.objectives(state, report, dt)

    def _lie(self) -> None:
        """Relax the muscles of a fallen body, and cancel the queued motions."""
        self._send_notes()
        if self.queued is not None:
            self._send_line(f"the body has fallen; the next motion ({self.queued}) is cancelled")
        self.cancel()
        self._lying.reset()
        self._active = _ActiveMotion("fallen", RelaxMuscles(), BodyStatus.LYING)

    def _begin_next(self, state: BodyState, report: StepReport | None) -> None:
        """Start the next motion: a queued motion, a leg of the navigation, driving, or else standing."""
        place = replace(self.place.next_stance(state.positions, report), style=self.style)
        if self._is_ball:
            self.place = place
        try:
            task = self._tasks.popleft() if self._tasks else self._journey.next_part(place) if self._journey else None
            next_motion = task.part.begin(place) if task is not None else None
        except UserError as error:
            self.cancel()
            self._send_line(str(error))
            task = next_motion = None
        if task is None and not self._drive.is_zero and self._begin_drive(place, state.time):
            return
        if task is None or next_motion is None:
            self._journey = None
            if self._active.posture is BodyStatus.MOVING:
                self._send_notes()
                self._active = _ActiveMotion("stand", Stand(place), BodyStatus.STANDING)
            return
        self._send_notes()
        self._active = _ActiveMotion(task.part.name, next_motion, BodyStatus.MOVING)
        com = place.body.centre_of_mass(place.standing)
        self.records.append(MotionRecord(task.part.name, task.part.asked, next_motion, state.time, com))
        has_style = MOTIONS[task.request.name].jumps and self.style != Style()
        self.requests.append(replace(task.request, style=self.style) if has_style else task.request)

    def _begin_drive(self, place: Stance, time: float) -> bool:
        """Start driving. If the body cannot be driven, send a line to the user and return False."""
        try:
            drive = LiveDrive(place)
        except UserError as error:
            self.cancel()
            self._send_line(str(error))
            return False
        self._send_notes()
        self._active = _ActiveMotion("drive", drive, BodyStatus.MOVING)
        self.drive_starts.append(time)
        return True

    def _send_notes(self) -> None:
        """Send the notes of the active motion to the user."""
        for note in self._active.motion.notes():
            self._send_line(f"{self.doing}: {note}")

    def _has_fallen(self, state: BodyState, report: StepReport | None, dt: float) -> bool:
        """Return True if the body now counts as fallen: it has been lying on the ground, or has failed to get up."""
        motion = self._active.motion
        if isinstance(motion, GetUp):
            return motion.is_at_rest and not motion.is_up
        if report is None or self._active.posture is BodyStatus.LYING:
            return False
        return self._lying.update(self._lying.note(state, report) is not None, report, dt)


def _walks(place: Stance) -> bool:
    """Return True if a body at ``place`` can walk, crawl or roll."""
    return place.base() in (SupportKind.LYING, SupportKind.ROUND_BASE) or len(select_posture(place)[0]) > 0
