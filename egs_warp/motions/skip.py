"""Skip: small jumps in quick succession, turned alternately to the left and to the right (docs/motions/gestures.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import heading_between, sole_shares
from egs_warp.motions.turn import HEADING_TOLERANCE, MAX_TURN_FRACTION, Turn, largest_turn

_MAX_LENGTH = 0.3
"""Largest length of one jump, in body heights."""
TURN_HEIGHT = 0.2
"""Height, in body heights, of the jumps in which a body turns to face its target."""
_TURN = np.radians(12.0)
"""Angle in radians by which the body is turned to either side of its direction."""


@dataclass(frozen=True)
class SkipPlan:
    """Planned quantities of a skip, in metres and degrees."""

    jumps: float
    length: float
    """Length of one jump, m."""
    height: float
    """Height of one jump, m."""
    turn_degrees: float
    """Angle by which the body is turned to either side."""


class Skip:
    """Move ahead in short, low jumps; each starts as soon as the body is balanced after the previous one."""

    def __init__(self, stance: Stance, distance: float, height: float, *, message: str = "") -> None:
        """Create the motion of the body that stands at ``stance``.

        Args:
            stance: stance at the start.
            distance: distance ahead, m.
            height: height of one jump, m.
            message: message for the user, the first of ``notes``; none if it is empty.
        """
        body = stance.body
        self._start, self._height, self._message = stance, height, message
        self._count = max(2, int(np.ceil(distance / (_MAX_LENGTH * body.height) - 1e-9)))
        self._length = distance / self._count
        self._share = sole_shares(body, stance.ground, stance.standing)
        self._time_unit = float(np.sqrt(body.height / np.linalg.norm(body.gravity)))
        straight = Jump(stance, JumpTarget(self._length, height))
        self._turn = min(_TURN, 0.5 * MAX_TURN_FRACTION * largest_turn(straight, stance))
        self.jumps = [self._next(stance, stance.standing, 1)]

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds until the body is at rest."""
        plan, length = self.jumps[0].plan, self._length / self._start.body.height
        once = plan.expected_duration(length, self._time_unit, is_followed=True)
        return plan.expected_duration(length, self._time_unit) + (self._count - 1) * once

    @property
    def is_at_rest(self) -> bool:
        """True if the body is at rest after the last jump."""
        return len(self.jumps) == self._count and self.jumps[-1].is_at_rest

    def plan_record(self) -> SkipPlan:
        """Return the planned quantities of the motion."""
        return SkipPlan(float(self._count), self._length, self._height, float(np.degrees(self._turn)))

    def planned_com(self, elapsed: float) -> None:
        """Return None: each jump starts from the measured landing of the previous one."""

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> None:
        """Return None: a skip has no quantities of its own beyond those measured for all motions."""

    def notes(self) -> list[str]:
        """Return messages for the user about phases that took too long."""
        return [self._message] * bool(self._message) + [note for jump in self.jumps for note in jump.notes()]

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        result = self.jumps[-1].objectives(state, report, dt)
        if len(self.jumps) < self._count and self.jumps[-1].is_at_rest:
            stance = self._start.moved_to(state.positions)
            self.jumps.append(self._next(stance, state.positions, len(self.jumps) + 1))
            return self.jumps[-1].objectives(state, report, dt)
        return result

    def _next(self, stance: Stance, positions: np.ndarray, number: int) -> Jump:
        """Return jump ``number``, counted from 1, of the body at ``stance`` with nodes at ``positions`` (N, 3)."""
        start = self._start
        goal = self._share @ start.standing + number * self._length * start.ground.axes[0]
        offset = goal - self._share @ positions
        target = JumpTarget(float(np.linalg.norm(start.ground.axes[:2] @ offset)), self._height)
        turned = heading_between(start.standing, positions, self._share, start.ground)
        side = 0.0 if number == self._count else self._turn * (-1.0) ** number
        is_followed = number < self._count
        return Jump(
            stance.with_forward(offset),
            target,
            turn=side - turned,
            skips_settling=number > 1,
            is_followed=is_followed,
            stays_at_edges=number > 1,
        )


class SkipTo:
    """Turn on the spot in jumps to face a goal, and skip to it."""

    def __init__(self, stance: Stance, goal: np.ndarray, height: float, *, message: str = "") -> None:
        """Create the motion of the body that stands at ``stance``.

        Args:
            stance: stance at the start.
            goal: (2,) m, goal forward and to the left of the start.
            height: height of one jump of the skip, m.
            message: message for the user, the first of ``notes``; none if it is empty.
        """
        self._start, self._height, self._message = stance, height, message
        self._goal = stance.ground.origin + goal @ stance.ground.axes[:2]
        self._skip = self._skip_from(stance)
        angle = float(np.arctan2(goal[1], goal[0]))
        faces_goal = abs(angle) <= HEADING_TOLERANCE
        turn = Turn(stance, JumpTarget(0.0, TURN_HEIGHT * stance.body.height), angle)
        self.parts: list[Turn | Skip] = [self._skip if faces_goal else turn]
        self._expected_time = self._skip.expected_time + (0.0 if faces_goal else turn.expected_time)

    def _skip_from(self, stance: Stance) -> Skip:
        offset = self._goal - stance.ground.origin
        distance = float(np.linalg.norm(stance.ground.axes[:2] @ offset))
        return Skip(stance.with_forward(offset), distance, self._height)

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds until the body is at rest."""
        return self._expected_time

    @property
    def is_at_rest(self) -> bool:
        """True if the body is at rest after the skip."""
        return isinstance(self.parts[-1], Skip) and self.parts[-1].is_at_rest

    def plan_record(self) -> SkipPlan:
        """Return the planned quantities of the skip."""
        return self._skip.plan_record()

    def planned_com(self, elapsed: float) -> None:
        """Return None: each jump starts from the measured landing of the previous one."""

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> None:
        """Return None: a skip has no quantities of its own beyond those measured for all motions."""

    def notes(self) -> list[str]:
        """Return messages for the user about phases that took too long."""
        return [self._message] * bool(self._message) + [note for part in self.parts for note in part.notes()]

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        result = self.parts[-1].objectives(state, report, dt)
        if isinstance(self.parts[-1], Turn) and self.parts[-1].is_at_rest:
            self.parts.append(self._skip_from(self._start.moved_to(state.positions)))
            return self.parts[-1].objectives(state, report, dt)
        return result
