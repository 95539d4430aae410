"""What a live creature does next: motions that were asked for, a way to a point, or nothing but standing.

A motion that has begun is done to its end; what is asked for meanwhile takes the place of what was to come, and begins
as soon as the body is calm.
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
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.get_up import GetUp
from egs_warp.motions.repertoire import MOTIONS, parts_of
from egs_warp.motions.request import MotionRequest
from egs_warp.motions.script import Script, motion
from egs_warp.motions.sequence import MotionRecord, MotionTask, Stance
from egs_warp.motions.stance import sole_shares
from egs_warp.motions.stand import Stand
from egs_warp.motions.style import Style
from egs_warp.motions.walk_posture import select_posture
from egs_warp.web.idle import RelaxMuscles, tilt_degrees

ARRIVAL_DISTANCE = 0.12
"""Body heights from the middle of the feet to the point that it was sent to."""
MAX_HEADING_ERROR = 15.0
"""Degrees: what lies further to the side is turned towards first."""
_MIN_TURN_DISTANCE = 0.25
"""Body heights: for so short a way it does not turn."""
_MAX_JUMP_DISTANCE, _JUMP_HEIGHT = 0.5, 0.2
"""Body heights."""
_MAX_WALK_DISTANCE = 0.8
"""Body heights, after which it looks where it has come to."""
_MAX_FAILED_LEGS = 3
"""Legs that bring it no nearer, after which it gives up."""
FALLEN_TILT = 60.0
"""Degrees from upright beyond which no motion begins."""
_FALL_TIME = 1.0
"""Of sqrt(H / g): for how long it is so tilted before it counts as fallen."""


@dataclass(frozen=True)
class Task:
    """A motion to come, and how a script asks for it."""

    part: MotionTask
    request: MotionRequest


class BodyStatus(Enum):
    """What a body is about."""

    STANDING = "standing"
    MOVING = "moving"
    LYING = "lying"


class _Steered(Protocol):
    """A motion, as far as it is steered."""

    @property
    def is_at_rest(self) -> bool: ...

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]: ...

    def notes(self) -> list[str]: ...


@dataclass(frozen=True)
class _ActiveMotion:
    """What it does now."""

    name: str
    """As the user reads it."""
    motion: _Steered
    posture: BodyStatus


def tasks_of(script: Script, height: float) -> list[Task]:
    """Of a body of ``height`` metres, in their order."""
    tasks = []
    for request in script.requests:
        once = replace(request, repeat=1)
        tasks += [Task(part, once) for part in parts_of(request, height)]
    return tasks


class PointNavigation:
    """The way to a point: walk there, or turn towards it and jump; each leg is planned from where the last one
    ended."""

    def __init__(self, goal: np.ndarray, *, walks: bool) -> None:
        """``goal`` (2,) metres; ``walks``: whether the body can walk."""
        self.goal = goal
        self._walks = walks
        self._nearest, self._failed_legs = np.inf, 0

    def next_part(self, place: Stance) -> Task | None:
        """What brings the body that stands at ``place`` nearer; None where it has arrived.

        Raises ``UserError`` where several legs did not.
        """
        height = place.body.height
        feet = sole_shares(place.body, place.ground, place.standing) @ place.standing
        way = np.array([*(self.goal - feet[:2]), 0.0])
        distance = float(np.linalg.norm(way)) / height
        if distance <= ARRIVAL_DISTANCE:
            return None
        if distance < self._nearest - 0.05:
            self._nearest, self._failed_legs = distance, 0
        else:
            self._failed_legs += 1
        if self._failed_legs > _MAX_FAILED_LEGS:
            raise UserError(f"go: it comes no nearer than {self._nearest:.2f} body heights; choose another point")
        x, y = place.ground.axes[:2] @ way
        if self._walks:
            ahead, left = min(1.0, _MAX_WALK_DISTANCE / distance) / height * np.array([x, y])
            return self._task(f"walk to {ahead:.3f},{left:.3f}", height)
        aside = float(np.degrees(np.arctan2(y, x)))
        if abs(aside) > MAX_HEADING_ERROR and distance > _MIN_TURN_DISTANCE:
            return self._task(f"twist {aside:.1f} 0 {_JUMP_HEIGHT}", height)
        leap = distance / np.ceil(distance / _MAX_JUMP_DISTANCE)
        task = self._task(f"jump {leap:.3f} {_JUMP_HEIGHT}", height)
        begin = task.part.begin
        return replace(task, part=replace(task.part, begin=lambda at: begin(at.facing(way))))

    @staticmethod
    def _task(text: str, height: float) -> Task:
        return tasks_of(motion(text), height)[0]


class MotionScheduler:
    """Holds the motion of a body and chooses the next; itself a motion."""

    def __init__(self, place: Stance, tell: Callable[[str], object]) -> None:
        """``place``: where the body stands at first; ``tell`` is given each line for the user."""
        self.begun: list[MotionRecord] = []
        self.requests: list[MotionRequest] = []
        """Of ``begun``."""
        self._send_line = tell
        self._tasks: deque[Task] = deque()
        self._journey: PointNavigation | None = None
        self._drive = Drive()
        """How it is to go."""
        self.driven: list[float] = []
        """Seconds at which it began to be driven."""
        self.style = Style()
        """Of the next motion that begins."""
        self.stand(place)
        self.walks = _walks(place)

    def stand(self, place: Stance) -> None:
        """Stand at ``place``, and drop all else."""
        self.cancel()
        self.place = place
        self._is_ball = place.base() is SupportKind.ROUND_BASE
        self._active: _ActiveMotion = _ActiveMotion("stand", Stand(place), BodyStatus.STANDING)
        self._tilted_since: float | None = None

    def perform(self, script: Script) -> None:
        """Do its motions next."""
        self.cancel()
        self._tasks.extend(tasks_of(script, self.place.body.height))

    def go(self, goal: np.ndarray) -> None:
        """Go to ``goal`` (2,) next, metres."""
        self.cancel()
        self._journey = PointNavigation(goal, walks=self.walks)

    def drive(self, command: Drive) -> None:
        """Go so from now on, once what it does is done; until another command, or anything else that is asked."""
        self.cancel()
        self._drive = command

    def cancel(self) -> None:
        """Drop what was to come; what is driven stops."""
        self._drive = Drive()
        self._tasks.clear()
        self._journey = None

    @property
    def doing(self) -> str:
        """Name of the motion."""
        return self._active.name

    @property
    def queued(self) -> str | None:
        """Name of what comes next."""
        if self._tasks:
            return self._tasks[0].part.name
        if self._journey:
            return "go"
        return None if self._drive.is_zero or isinstance(self._active.motion, LiveDrive) else "drive"

    @property
    def idle(self) -> bool:
        """Whether it stands or lies, and nothing is to come."""
        return self._active.posture is not BodyStatus.MOVING and self._active.motion.is_at_rest and self.queued is None

    @property
    def goal(self) -> np.ndarray | None:
        """(2,) metres, where it is going."""
        return self._journey.goal if self._journey else None

    def facing(self, positions: np.ndarray) -> np.ndarray:
        """(2,) unit vector of its way forward, with its nodes at ``positions`` (N, 3)."""
        place = self.place if self._is_ball else self.place.moved_to(positions)
        forward = place.ground.axes[0, :2]
        return forward / max(float(np.linalg.norm(forward)), 1e-12)

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``, from the motion whose turn it is."""
        if self._has_fallen(state):
            self._lie(state, report)
        elif self._active.motion.is_at_rest and not (isinstance(self._active.motion, LiveDrive) and not self._drive.is_zero):
            self._begin_next(state, report)
        if isinstance(self._active.motion, LiveDrive):
            self._active.motion.command = self._drive
        return self._active.motion.objectives(state, report, dt)

    def _lie(self, state: BodyState, report: StepReport | None) -> None:
        """It lies, but for getting up where that is asked."""
        if isinstance(self._active.motion, GetUp) and not self._active.motion.is_at_rest:
            return
        if self._tasks and self._tasks[0].part.name == "get up":
            self._begin_next(state, report)
            return
        if self._active.posture is not BodyStatus.LYING:
            self._active = _ActiveMotion("fallen", RelaxMuscles(), BodyStatus.LYING)
            self._send_line("it has fallen; tell it to get up, or Backspace stands it up again")
        self.cancel()

    def _begin_next(self, state: BodyState, report: StepReport | None) -> None:
        place = replace(self.place.next_stance(state.positions, report), style=self.style)
        if self._is_ball:
            self.place = place
        try:
            task = self._tasks.popleft() if self._tasks else self._journey.next_part(place) if self._journey else None
            begun = task.part.begin(place) if task is not None else None
        except UserError as error:
            self.cancel()
            self._send_line(str(error))
            task = begun = None
        if task is None and not self._drive.is_zero and self._begin_drive(place, state.time):
            return
        if task is None or begun is None:
            self._journey = None
            if self._active.posture is not BodyStatus.STANDING:
                self._say_notes()
                self._active = _ActiveMotion("stand", Stand(place), BodyStatus.STANDING)
            return
        self._say_notes()
        self._active = _ActiveMotion(task.part.name, begun, BodyStatus.MOVING)
        self.begun.append(MotionRecord(task.part.name, task.part.asked, begun, state.time))
        styled = MOTIONS[task.request.name].jumps and self.style != Style()
        self.requests.append(replace(task.request, style=self.style) if styled else task.request)

    def _begin_drive(self, place: Stance, time: float) -> bool:
        try:
            driven = LiveDrive(place)
        except UserError as error:
            self.cancel()
            self._send_line(str(error))
            return False
        self._say_notes()
        self._active = _ActiveMotion("drive", driven, BodyStatus.MOVING)
        self.driven.append(time)
        return True

    def _say_notes(self) -> None:
        for note in self._active.motion.notes():
            self._send_line(f"{self.doing}: {note}")

    def _has_fallen(self, state: BodyState) -> bool:
        # A ball cannot fall.
        if self._is_ball or tilt_degrees(self.place, state.positions) <= FALLEN_TILT:
            self._tilted_since = None
            return False
        if self._tilted_since is None:
            self._tilted_since = state.time
        body = self.place.body
        longest = _FALL_TIME * float(np.sqrt(body.height / np.linalg.norm(body.gravity)))
        return state.time - self._tilted_since > longest


def _walks(place: Stance) -> bool:
    return place.base() in (SupportKind.LYING, SupportKind.ROUND_BASE) or len(select_posture(place)[0]) > 0
