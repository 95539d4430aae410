"""Dance: small jumps that leave the ground and land again on the beats of a piece of music (docs/motions/dance.md)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.beats import Span, next_span
from egs_warp.motions.gestures import Gesture
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget, height_of_flight, level_flight
from egs_warp.motions.layer import Layer
from egs_warp.motions.poses import beat_accents
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import heading_between, sole_shares
from egs_warp.motions.stand import Stand
from egs_warp.motions.turn import MAX_TURN_FRACTION, largest_turn

MIN_HEIGHT, MAX_HEIGHT = 0.1, 0.6
"""Minimum and maximum height of the jumps of a dance, in body heights."""
PREFERRED_HEIGHT = 0.3
"""Preferred height of a jump, in body heights."""
HOP_LENGTH = 0.15
"""Length of a small hop, in body heights."""
MIN_TWIST_ANGLE, MAX_TWIST_ANGLE = np.radians(20.0), np.radians(35.0)
"""Limits of the angle of a small twist to either side of the front, in radians. Within them, it is the largest one with
which one jump can turn from one side to the other."""
BEAT_TOLERANCE = 0.04
"""Maximum timing error, in seconds, of an event that is considered on the beat."""
_MIN_DISTANCE = 0.02
"""Distance in body heights below which a jump is considered a jump on the spot."""
_MIN_CONTACT_FORCE = 1e-6
"""Normal force, as a share of the weight, above which the body touches the ground."""


@dataclass(frozen=True)
class _Landing:
    """Move of the dance: position and heading in which a jump ends."""

    move: str
    forward: float = 0.0
    """Distance from the start of the dance, in units of the length of a small hop."""
    left: float = 0.0
    """Distance to the left of the start, in the same unit."""
    turned: float = 0.0
    """Heading relative to the front, in units of the angle of a small twist."""
    twists: bool = False
    """True if the jump turns; other jumps keep their heading."""


_SIDEWAYS = (_Landing("hop left", left=1.0), _Landing("hop right", left=-1.0))
_BACK = _Landing("hop back")
MOVES = (
    *_SIDEWAYS,
    _Landing("twist left", turned=1.0, twists=True),
    _Landing("twist right", turned=-1.0, twists=True),
    _Landing("twist ahead", forward=1.0, twists=True),
    _BACK,
)
"""Moves of the dance, repeated in a cycle. Each jump has an absolute target, so that errors do not accumulate."""
MOVES_WITHOUT_TWISTS = (*_SIDEWAYS, _Landing("hop ahead", forward=1.0), _BACK)
"""Moves of the dance of a body that friction does not allow to twist."""


@dataclass(frozen=True)
class Event:
    """Take-off or touch-down of a jump; times are in seconds from the start of the dance."""

    event: str
    """``take-off``, the end of the last time step with a contact force, or ``touch-down``, the end of the first one
    with a contact force again."""
    move: str
    asked: float
    """Target time: a beat, or a half, a quarter or an eighth of an interval before a beat."""
    reached: float
    error: float
    """``reached`` minus ``asked``."""


@dataclass(frozen=True)
class DanceOutcome:
    """Timing errors of a dance, in seconds."""

    events: tuple[Event, ...]
    worst_error: float
    """Largest error, early or late; 0 if there are no events."""
    skipped: tuple[float, ...]
    """Beats before the end of the dance without take-off or touch-down, because they were too close to other beats or
    to the last one."""
    after_end: tuple[float, ...] = ()
    """Beats without take-off or touch-down because the dance ended before them."""


@dataclass(frozen=True)
class DancePlan:
    """Planned quantities of a dance."""

    beats: float
    """Number of beats."""
    duration: float
    """Time of the last beat, s."""
    shortest_flight: float
    longest_flight: float
    turn_degrees: float
    """Angle of a small twist; 0 if friction does not allow a visible one."""


@dataclass
class _Step:
    """One jump of the dance and its measured contact times."""

    span: Span
    move: str
    jump: Jump
    began: float
    """Start of the jump, in seconds from the start of the dance."""
    start: np.ndarray
    """(3,) m, centre of mass at the time ``began``."""

    def __post_init__(self) -> None:
        self._airborne: list[tuple[float, float]] = []
        """Flights as pairs of times, s: end of the last step with contact, and end of the next step with contact."""
        self._left: float | None = None
        self._touched = self.began

    def update(self, now: float, *, touching: bool) -> None:
        """Record the contact at the end of a time step; ``now`` is in seconds from the start of the dance."""
        if not touching:
            self._left = self._touched if self._left is None else self._left
            return
        if self._left is not None:
            self._airborne.append((self._left, now))
        self._left, self._touched = None, now

    def flight(self) -> tuple[float, float] | None:
        """Return the times of take-off and touch-down of the longest flight, because a brief contact with the ground is
        not a landing. Return None if the body has not been in the air."""
        return max(self._airborne, key=lambda span: span[1] - span[0], default=None)

    def events(self) -> list[Event]:
        """Return the take-off and the touch-down with their target and measured times."""
        reached = self.flight()
        if reached is None:
            return []
        targets = (("take-off", self.span.take_off), ("touch-down", self.span.touch_down))
        return [
            Event(name, self.move, time, now, now - time) for (name, time), now in zip(targets, reached, strict=True)
        ]


class Dance:
    """Dance on the beats: stand until the next jump is due, jump so high that the body lands on a beat, and plan the
    next jump. Head and free branches move on all beats (``beat_accents``)."""

    def __init__(self, stance: Stance, beats: Sequence[float]) -> None:
        """Plan the first jump; ``beats`` are times in seconds from the start of the dance, increasing.

        Raises:
            UserError: if no beat can be reached.
        """
        body = stance.body
        self._start_stance, self._beats, self._step = stance, tuple(beats), stance.step
        self._share = sole_shares(body, stance.ground, stance.standing)
        self._gravity = float(np.linalg.norm(body.gravity))
        # A landing is recorded at the end of its time step, which is on average half a step late.
        self._lead_error, self._flight_error = 0.0, 0.5 * stance.step
        self._trial_jump = self._jump(stance, _Landing("jump"), PREFERRED_HEIGHT * body.height, turn=0.0)
        turn = 0.5 * MAX_TURN_FRACTION * largest_turn(self._trial_jump, stance)
        self._turn = min(turn, MAX_TWIST_ANGLE) if turn >= MIN_TWIST_ANGLE else 0.0
        accents = beat_accents(stance, self._beats)
        self._set_accents(accents)
        self._moves = MOVES if self._turn > 0.0 else MOVES_WITHOUT_TWISTS
        self.gesture_turn = np.zeros(3)
        """(3,) rad, rotation of the body that the gestures on top of the dance cause, as in ``Jump``."""
        self._stand: Stand | None = Stand(stance)
        self._finished_steps: list[_Step] = []
        self._current_step: _Step | None = None
        self._started: float | None = None
        self._end = 0.0
        """End of the last step, in seconds from the start of the dance."""
        self._next = self._aim(0.0)
        if self._next is None:
            shortest, longest = self._flights()
            raise UserError(
                f"dance: none of the {len(beats)} beats can be reached: the first take-off is possible after "
                f"{self._lead(PREFERRED_HEIGHT * body.height):.2f} s, "
                f"and a flight takes {shortest:.2f} to {longest:.2f} s; give later beats, or a slower tempo"
            )
        self._plan = DancePlan(
            float(len(beats)), self._beats[-1], *self._flights(), turn_degrees=float(np.degrees(self._turn))
        )

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds; the body dances until the last beat."""
        body = self._start_stance.body
        return self._beats[-1] + float(np.sqrt(body.height / self._gravity))

    @property
    def is_at_rest(self) -> bool:
        """True if no beat is left and the body is at rest."""
        return (
            self._is_over
            and self._next is None
            and self._current_step is None
            and (self._stand is None or self._stand.is_at_rest)
        )

    def plan_record(self) -> DancePlan:
        """Return the planned quantities of the motion."""
        return self._plan

    def planned_com(self, elapsed: float) -> np.ndarray:
        """Return the planned displacement (3,) of the centre of mass in the current jump, m; NaN before the first
        jump."""
        for step in reversed(self._steps()):
            if elapsed >= step.began:
                return step.start - self._steps()[0].start + step.jump.planned_com(elapsed - step.began)
        return np.full(3, np.nan)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> DanceOutcome:
        """Return the timing errors."""
        events = tuple(event for step in self._steps() for event in step.events())
        worst = max((abs(event.error) for event in events), default=0.0)
        return DanceOutcome(events, worst, *self._beats_without_jump())

    def notes(self) -> list[str]:
        """Return messages for the user about the timing and about skipped beats."""
        steps = self._steps()
        events = [event for step in steps for event in step.events()]
        notes = [f"{step.move} to {step.span.touch_down:.2f} s: {note}" for step in steps for note in step.jump.notes()]
        if events:
            worst = max(events, key=lambda event: abs(event.error))
            notes.append(
                f"{len(events)} take-offs and touch-downs, the worst {1000.0 * abs(worst.error):.0f} ms off its time"
                f" ({worst.event} at {worst.asked:.2f} s)"
            )
        between = sum(step.span.parts > 1 for step in steps)
        if between:
            notes.append(f"{between} jumps take off between two beats that are further apart than the longest jump")
        skipped, after_end = self._beats_without_jump()
        if skipped:
            named = ", ".join(f"{beat:.2f}" for beat in skipped[:10]) + (", ..." if len(skipped) > 10 else "")
            notes.append(
                f"{len(skipped)} of {len(self._beats)} beats skipped, "
                f"too close to other beats or to the last one: {named} s"
            )
        if after_end:
            notes.append(
                f"{len(after_end)} of {len(self._beats)} beats come after the dance ended ({self._end:.2f} s after its"
                " start)"
            )
        return notes

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        self._started = state.time if self._started is None else self._started
        now = state.time - self._started
        self._end = now + dt
        step = self._current_step
        if step is not None and report is not None:
            step.update(
                now, touching=bool(report.forces[:, 0].sum() > _MIN_CONTACT_FORCE * self._start_stance.body.weight)
            )
        if step is not None and step.jump.is_at_rest:
            self._correct_timing(step)
            self._finished_steps.append(step)
            stance = self._start_stance.moved_to(state.positions)
            self._current_step, self._stand, self._next = None, Stand(stance), self._aim(now)
        if self._next is not None and self._current_step is None:
            span = self._next
            height = self._height(span.flight)
            # Start at the time step that is nearest to the planned start.
            if now + 0.5 * dt >= span.take_off - self._lead(height):
                self._begin(state, now, span, height)
        moving = self._stand if self._current_step is None else self._current_step.jump
        assert moving is not None
        accents = self._accents
        if accents is None or now >= accents.end - 0.5 * dt:
            self._is_over, moving.gesture_turn = True, self.gesture_turn
            return moving.objectives(state, report, dt)
        moving.gesture_turn = self.gesture_turn + accents.turn(now + dt)
        return [*moving.objectives(state, report, dt), *accents.objectives(state, now, dt, [accents])]

    def drop_accents(self, parts: Collection[str]) -> None:
        """Leave the ``parts`` with these names to gestures on top of the dance: they do not move on its beats."""
        if self._accents is not None:
            self._set_accents(self._accents.gesture.without(parts))

    def _set_accents(self, accents: Gesture | None) -> None:
        has_channels = accents is not None and bool(accents.channels)
        self._accents = Layer(self._start_stance, accents, 0.0) if accents is not None and has_channels else None
        self._is_over = not has_channels

    def _beats_without_jump(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the beats that are no target of a jump: those that the dance skipped, and, if a fall or the end of the
        run ended the dance, those after its end."""
        met = {time for step in self._steps() for time in (step.span.take_off, step.span.touch_down)}
        others = [beat for beat in self._beats if beat not in met]
        is_unfinished = self._next is not None or self._current_step is not None
        skipped = tuple(beat for beat in others if beat <= self._end or not is_unfinished)
        return skipped, tuple(others[len(skipped) :])

    def _steps(self) -> list[_Step]:
        return self._finished_steps if self._current_step is None else [*self._finished_steps, self._current_step]

    def _begin(self, state: BodyState, now: float, span: Span, height: float) -> None:
        landing = self._moves[len(self._finished_steps) % len(self._moves)]
        stance = self._start_stance.moved_to(state.positions)
        turned = heading_between(self._start_stance.standing, state.positions, self._share, self._start_stance.ground)
        jump = self._jump(stance, landing, height, turn=landing.turned * self._turn - turned)
        com = stance.body.centre_of_mass(state.positions)
        self._current_step, self._next = _Step(span, landing.move, jump, now, com), None

    def _jump(self, stance: Stance, landing: _Landing, height: float, *, turn: float) -> Jump:
        """Return the jump from ``stance`` to the pose ``landing``; it is ``height`` metres high and turns by ``turn``
        radians."""
        start_stance, body = self._start_stance, stance.body
        goal = (
            self._share @ start_stance.standing
            + HOP_LENGTH * body.height * np.array([landing.forward, landing.left]) @ start_stance.ground.axes[:2]
        )
        offset = goal - self._share @ stance.standing
        distance = float(np.linalg.norm(start_stance.ground.axes[:2] @ offset))
        if distance > _MIN_DISTANCE * body.height:
            stance = stance.with_forward(offset)
        else:
            distance = 0.0
        target = JumpTarget(distance, height)
        straight = Jump(stance, target, skips_settling=True, stays_at_edges=True)
        if not landing.twists:
            return straight
        max_turn = MAX_TURN_FRACTION * largest_turn(straight, stance)
        turn = float(np.clip(turn, -max_turn, max_turn))
        return Jump(stance, target, skips_settling=True, turn=turn, stays_at_edges=True)

    def _aim(self, now: float) -> Span | None:
        """Return the times of take-off and touch-down of the next jump of a body that stands at time ``now``; None if
        no jump follows."""
        return next_span(
            self._beats,
            now,
            earliest=lambda flight: now + self._lead(self._height(flight)) - 0.5 * self._step,
            flights=self._flights(),
            easiest=self._flight(PREFERRED_HEIGHT * self._start_stance.body.height),
        )

    def _lead(self, height: float) -> float:
        """Return the time in seconds from the first time step of a jump of ``height`` metres to its take-off."""
        return self._trial_jump.take_off_time(height) + self._lead_error

    def _flights(self) -> tuple[float, float]:
        """Return the minimum and maximum flight time, s."""
        return self._flight(MIN_HEIGHT * self._start_stance.body.height), self._flight(
            MAX_HEIGHT * self._start_stance.body.height
        )

    def _flight(self, height: float) -> float:
        """Return the flight time in seconds of a jump of ``height`` metres."""
        return level_flight(height, self._start_stance.body.height, self._gravity) + self._flight_error

    def _height(self, flight: float) -> float:
        """Return the height in metres of the jump with the given flight time in seconds."""
        return height_of_flight(flight - self._flight_error, self._start_stance.body.height, self._gravity)

    def _correct_timing(self, step: _Step) -> None:
        """Correct the lead time and the flight time of later jumps by half of the errors of this jump."""
        reached = step.flight()
        if reached is None:
            return
        took_off, landed = reached
        self._lead_error += 0.5 * (took_off - step.span.take_off)
        self._flight_error += 0.5 * (landed - took_off - step.span.flight)
