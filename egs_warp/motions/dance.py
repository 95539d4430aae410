"""Dance: small jumps that leave the ground and come back to it on the beats of a music (docs/motions/dance.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.beats import Span, next_span
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget, height_of_flight, level_flight
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import heading_between, sole_shares
from egs_warp.motions.stand import Stand
from egs_warp.motions.turn import RESERVE, largest_turn
from egs_warp.motions.twist import TurnHeading

LOWEST, HIGHEST = 0.1, 0.6
"""Body heights: the jumps of a dance."""
EASIEST = 0.3
"""Body heights: the jump that is liked best."""
AHEAD = 0.15
"""Body heights: a small hop."""
TURN = np.radians(20.0)
"""A small twist, to either side of the front."""
IN_TIME = 0.04
"""Seconds: what lies no further from its beat is on it."""
_ON_THE_SPOT = 0.02
"""Body heights: a way that is no way."""
_TOUCHING = 1e-6
"""Of the weight: what the ground bears of a body that touches it."""


@dataclass(frozen=True)
class _Stance:
    """Where a jump of the dance ends."""

    move: str
    ahead: float = 0.0
    """Small hops from where the dance began."""
    turned: float = 0.0
    """Small twists from the front."""
    twists: bool = False
    """Whether the jump turns; others land facing as they started."""


FIGURE = (
    _Stance("jump"),
    _Stance("hop ahead", ahead=1.0),
    _Stance("hop back"),
    _Stance("twist left", turned=1.0, twists=True),
    _Stance("twist right", turned=-1.0, twists=True),
    _Stance("twist ahead", twists=True),
)
"""Again and again. Each jump aims at its own stance, so that errors do not add up."""


@dataclass(frozen=True)
class Event:
    """The ground left or met again; seconds from the start of the dance."""

    event: str
    """``take-off``, the end of the last step in which the ground bears the body, or ``touch-down``, that of the first
    one in which it does again."""
    move: str
    asked: float
    """The beat, or a half, a quarter or an eighth of the way to it."""
    reached: float
    error: float
    """Reached less asked."""


@dataclass(frozen=True)
class DanceOutcome:
    """How well a dance kept time; seconds."""

    events: tuple[Event, ...]
    worst_error: float
    """The largest, early or late; 0 if there are no events."""
    skipped: tuple[float, ...]
    """Beats on which there was neither take-off nor touch-down, too near to the others."""


@dataclass(frozen=True)
class DancePlan:
    """What a dance aims at."""

    beats: float
    """How many there are."""
    duration: float
    """Seconds until the last one."""
    shortest_flight: float
    longest_flight: float
    turn_degrees: float
    """Of a small twist; 0 where friction gives none that would be seen."""


@dataclass
class _Step:
    """A jump of the dance."""

    span: Span
    move: str
    jump: Jump
    began: float
    """Seconds from the start of the dance."""
    start: np.ndarray
    """(3,) metres: the centre of mass then."""

    def __post_init__(self) -> None:
        self._airborne: list[tuple[float, float]] = []
        """From the last step on the ground to the first one on it again."""
        self._left: float | None = None
        self._touched = self.began

    def see(self, now: float, *, touching: bool) -> None:
        """To be told at the end of every step."""
        if not touching:
            self._left = self._touched if self._left is None else self._left
            return
        if self._left is not None:
            self._airborne.append((self._left, now))
        self._left, self._touched = None, now

    def flight(self) -> tuple[float, float] | None:
        """Seconds at which it left the ground and met it: what is brushed on the way is no landing."""
        return max(self._airborne, key=lambda span: span[1] - span[0], default=None)

    def events(self) -> list[Event]:
        """Asked and reached."""
        reached = self.flight()
        if reached is None:
            return []
        asked = (("take-off", self.span.take_off), ("touch-down", self.span.touch_down))
        return [Event(name, self.move, time, now, now - time) for (name, time), now in zip(asked, reached, strict=True)]


class Dance:
    """Stands until it is time for the next jump, jumps so high that it lands on a beat, and aims anew from there."""

    def __init__(self, place: Stance, beats: Sequence[float]) -> None:
        """``beats``: seconds from the start of the dance, in their order.

        Raises ``UserError`` where it could not begin with any of them.
        """
        body = place.body
        self._home, self._beats, self._step = place, tuple(beats), place.step
        self._share = sole_shares(body, place.ground, place.standing)
        self._gravity = float(np.linalg.norm(body.gravity))
        # A landing is noted at the end of its step.
        self._late, self._long = 0.0, 0.5 * place.step
        self._trial = self._jump(place, _Stance("jump"), EASIEST * body.height, turn=0.0)
        self._turn = TURN if RESERVE * largest_turn(self._trial, place) >= 2.0 * TURN else 0.0
        self._figure = tuple(stance for stance in FIGURE if self._turn > 0.0 or not stance.twists)
        self._stand: Stand | None = Stand(place)
        self._done: list[_Step] = []
        self._dancing: _Step | None = None
        self._started: float | None = None
        self._next = self._aim(0.0)
        if self._next is None:
            shortest, longest = self._flights()
            raise UserError(
                f"dance: none of the {len(beats)} beats can be reached: before the first jump it takes "
                f"{self._lead(EASIEST * body.height):.2f} s, and a jump spans {shortest:.2f} to {longest:.2f} s;"
                " give later beats, or a slower tempo"
            )
        self._plan = DancePlan(
            float(len(beats)), self._beats[-1], *self._flights(), turn_degrees=float(np.degrees(self._turn))
        )

    @property
    def expected_time(self) -> float:
        """Seconds until it is at rest: it jumps as long as there are beats."""
        body = self._home.body
        return self._beats[-1] + float(np.sqrt(body.height / self._gravity))

    @property
    def is_at_rest(self) -> bool:
        """Whether there is no beat left, and the body calm."""
        return self._next is None and self._dancing is None and (self._stand is None or self._stand.resting)

    def plan_record(self) -> DancePlan:
        """What it aims at."""
        return self._plan

    def planned_com(self, elapsed: float) -> np.ndarray:
        """(3,) metres from where the centre of mass stood: that of each jump, NaN in between."""
        for step in reversed(self._steps()):
            if elapsed >= step.began:
                return step.start - self._steps()[0].start + step.jump.planned_com(elapsed - step.began)
        return np.full(3, np.nan)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> DanceOutcome:
        """How well it kept time."""
        events = tuple(event for step in self._steps() for event in step.events())
        worst = max((abs(event.error) for event in events), default=0.0)
        return DanceOutcome(events, worst, self._skipped())

    def notes(self) -> list[str]:
        """How well it kept time, and what kept it from a beat, for the user."""
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
            notes.append(f"{between} jumps leave the ground between two beats, which are further apart than a jump")
        skipped = [f"{beat:.2f}" for beat in self._skipped()]
        if skipped:
            named = ", ".join(skipped[:10]) + (", ..." if len(skipped) > 10 else "")
            notes.append(
                f"{len(skipped)} of {len(self._beats)} beats skipped, too near to the others or the last: {named} s"
            )
        return notes

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        self._started = state.time if self._started is None else self._started
        now = state.time - self._started
        step = self._dancing
        if step is not None and report is not None:
            step.see(now, touching=bool(report.forces[:, 0].sum() > _TOUCHING * self._home.body.weight))
        if step is not None and step.jump.resting:
            self._learn(step)
            self._done.append(step)
            place = self._home.moved_to(state.positions)
            self._dancing, self._stand, self._next = None, Stand(place), self._aim(now)
        if self._next is not None and self._dancing is None:
            span = self._next
            height = self._height(span.flight)
            # To the nearest step.
            if now + 0.5 * dt >= span.take_off - self._lead(height):
                self._begin(state, now, span, height)
        if self._dancing is not None:
            return self._dancing.jump.objectives(state, report, dt)
        assert self._stand is not None
        return self._stand.objectives(state, report, dt)

    def _skipped(self) -> tuple[float, ...]:
        met = {time for step in self._steps() for time in (step.span.take_off, step.span.touch_down)}
        return tuple(beat for beat in self._beats if beat not in met)

    def _steps(self) -> list[_Step]:
        return self._done if self._dancing is None else [*self._done, self._dancing]

    def _begin(self, state: BodyState, now: float, span: Span, height: float) -> None:
        stance = self._figure[len(self._done) % len(self._figure)]
        place = self._home.moved_to(state.positions)
        turned = heading_between(self._home.standing, state.positions, self._share, self._home.ground)
        jump = self._jump(place, stance, height, turn=stance.turned * self._turn - turned)
        com = place.body.centre_of_mass(state.positions)
        self._dancing, self._next = _Step(span, stance.move, jump, now, com), None

    def _jump(self, place: Stance, stance: _Stance, height: float, *, turn: float) -> Jump:
        """From ``place`` to the ``stance``, ``height`` metres high, turning by ``turn`` radians."""
        home, body = self._home, place.body
        goal = self._share @ home.standing + stance.ahead * AHEAD * body.height * home.ground.axes[0]
        way = goal - self._share @ place.standing
        distance = float(np.linalg.norm(home.ground.axes[:2] @ way))
        if distance > _ON_THE_SPOT * body.height:
            place = place.with_forward(way)
        else:
            distance = 0.0
        target = JumpTarget(distance, height)
        straight = Jump(place, target, settled=True)
        if not stance.twists:
            return straight
        most = RESERVE * largest_turn(straight, place)
        return Jump(place, target, settled=True, facing=TurnHeading(place, float(np.clip(turn, -most, most))))

    def _aim(self, now: float) -> Span | None:
        """The next jump of a body that stands ``now``."""
        return next_span(
            self._beats,
            now,
            earliest=lambda flight: now + self._lead(self._height(flight)) - 0.5 * self._step,
            flights=self._flights(),
            easiest=self._flight(EASIEST * self._home.body.height),
        )

    def _lead(self, height: float) -> float:
        """Seconds from the first step of a jump of ``height`` metres to its take-off."""
        return self._trial.take_off_time(height) + self._late

    def _flights(self) -> tuple[float, float]:
        """The shortest and the longest, seconds."""
        return self._flight(LOWEST * self._home.body.height), self._flight(HIGHEST * self._home.body.height)

    def _flight(self, height: float) -> float:
        """Seconds that a jump of ``height`` metres is off the ground."""
        return level_flight(height, self._home.body.height, self._gravity) + self._long

    def _height(self, flight: float) -> float:
        """Metres: the jump that is off the ground for so many seconds."""
        return height_of_flight(flight - self._long, self._home.body.height, self._gravity)

    def _learn(self, step: _Step) -> None:
        """What a jump was late by and flew longer than its plan, half of it, goes into the next one's."""
        reached = step.flight()
        if reached is None:
            return
        took_off, landed = reached
        self._late += 0.5 * (took_off - step.span.take_off)
        self._long += 0.5 * (landed - took_off - step.span.flight)
