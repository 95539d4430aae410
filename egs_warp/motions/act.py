"""Gestures on top of another motion or of standing (docs/motions/gestures.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective, BodyPart, part_nodes
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.dance import Dance
from egs_warp.motions.flip import Flip
from egs_warp.motions.gestures import WHOLE_BODY, Gesture, GestureOutcome
from egs_warp.motions.jump import Jump
from egs_warp.motions.layer import CORRECTION_RATE, Layer
from egs_warp.motions.sequence import BodyMotion, Stance
from egs_warp.motions.skip import Skip, SkipTo
from egs_warp.motions.stand import PostureTarget, Stand
from egs_warp.motions.turn import Turn
from egs_warp.motions.walk import Walk

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_BASE_WEIGHT = 5.0
"""Weight of zero velocity of the base while the body above it moves."""


@dataclass(frozen=True)
class ActPlan:
    """Planned quantities of gestures."""

    duration: float
    """Time of the last key, s."""


@dataclass(frozen=True)
class ActOutcome:
    """Measured gestures, and measured quantities of the motion on top of which they are performed."""

    gestures: tuple[GestureOutcome, ...]
    below: DataclassInstance | None
    """Measured quantities of the underlying motion (``BodyMotion.outcome_record``); None if it has none."""

    @property
    def slip(self) -> float:
        """Largest slip of a foot in the underlying motion, as a fraction of its stride."""
        return float(getattr(self.below, "slip", 0.0))


class Act:
    """Perform gestures on top of another motion or of standing.

    A gesture of the whole body replaces the upright posture of a standing body. Where gestures of one part overlap,
    their values are added. A part that a gesture moves does not also move on the beats of a dance below.
    """

    def __init__(
        self, stance: Stance, gestures: Sequence[tuple[float, Gesture]], below: BodyMotion | None = None
    ) -> None:
        """Create the motion of the body that stands at ``stance``.

        Args:
            stance: stance at the start.
            gestures: start time in seconds and gesture, for each gesture.
            below: underlying motion of the rest of the body; None for standing.

        Raises:
            UserError: for a gesture of the whole body on top of a motion other than standing, and for any gesture on
                top of a somersault.
        """
        if isinstance(below, Flip):
            raise UserError(f"{gestures[0][1].name}: a somersault allows no gesture; give one after the other")
        self.below, self._stance = below, stance
        if below is not None:
            gestures = [
                (begin, gesture.without([WHOLE_BODY]) if gesture.body_follows else gesture)
                for begin, gesture in gestures
            ]
        self._layers = [Layer(stance, gesture, begin) for begin, gesture in gestures]
        whole = [gesture.name for _, gesture in gestures if gesture.moves_whole_body]
        if below is not None and whole:
            raise UserError(
                f"{whole[0]}: it and the motion below it both move the whole body; give one after the other"
            )
        if isinstance(below, Dance):
            below.drop_accents({part.name for _, gesture in gestures for part in gesture.parts})
        self._end = max(layer.end for layer in self._layers)
        self._stand: Stand | None = None
        self._base: tuple[BodyPart, np.ndarray] | None = None
        self._started: float | None = None
        self._is_over = False
        self._time_unit = float(np.sqrt(stance.body.height / np.linalg.norm(stance.body.gravity)))

    @property
    def is_at_rest(self) -> bool:
        """True if the underlying motion and the gestures have ended and the body is at rest."""
        if self.below is not None and not self.below.is_at_rest:
            return False
        return self._is_over and (self._stand is None or self._stand.is_at_rest)

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds until the body is at rest."""
        return max(self._end + self._time_unit, self.below.expected_time if self.below is not None else 0.0)

    def plan_record(self) -> DataclassInstance:
        """Return the plan of the underlying motion, or the duration of the gestures if the body stands."""
        return ActPlan(self._end) if self.below is None else self.below.plan_record()

    def planned_com(self, elapsed: float) -> np.ndarray | None:
        """Return the planned displacement of the underlying motion; None if it has no plan."""
        return None if self.below is None else self.below.planned_com(elapsed)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> ActOutcome:
        """Return the measured gestures, and the measured quantities of the underlying motion."""
        below = None if self.below is None else self.below.outcome_record(trajectory, first, last)
        return ActOutcome(tuple(layer.outcome() for layer in self._layers), below)

    def notes(self) -> list[str]:
        """Return the messages of the underlying motion and of the gestures."""
        below = [] if self.below is None else self.below.notes()
        return [*below, *dict.fromkeys(note for layer in self._layers for note in layer.gesture.notes)]

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        self._started = state.time if self._started is None else self._started
        elapsed = state.time - self._started
        active = [layer for layer in self._layers if layer.begin - 0.5 * dt <= elapsed < layer.end - 0.5 * dt]
        self._is_over = elapsed >= self._end - 0.5 * dt
        for layer in self._layers:
            layer.measure(state, elapsed)
        turn = np.sum([np.zeros(3), *(layer.turn(elapsed - layer.begin + dt) for layer in active)], axis=0)
        if isinstance(self.below, Walk):
            self.below.with_gestures = partial(self._with_gestures, active, elapsed + dt)
        elif (jumping := _jumping_motion(self.below)) is not None:
            jumping.gesture_turn = turn
        if self.below is not None and not self.below.is_at_rest:
            rules = list(self.below.objectives(state, report, dt))
        else:
            rules = self._standing(state, report, active, turn, elapsed, dt)
        return [*rules, *(rule for layer in active for rule in layer.objectives(state, elapsed, dt, active))]

    @staticmethod
    def _with_gestures(active: Sequence[Layer], elapsed: float, nodes: np.ndarray) -> np.ndarray:
        for layer in active:
            nodes = layer.pose(elapsed - layer.begin, nodes)
        return nodes

    def _standing(
        self,
        state: BodyState,
        report: StepReport | None,
        active: Sequence[Layer],
        turn: np.ndarray,
        elapsed: float,
        dt: float,
    ) -> list[AnyObjective]:
        if self._stand is None:
            stance = self._stance if self.below is None else self._stance.next_stance(state.positions, report)
            self._stand = Stand(stance)
            heights = (stance.standing - stance.ground.origin) @ stance.ground.surface_normal
            base = BodyPart.base(stance.body, heights)
            self._base = base, stance.standing[base.nodes]
        postures = [layer.posture(elapsed - layer.begin + dt) for layer in active if layer.gesture.moves_whole_body]
        self._stand.set_posture(sum_postures(postures) if postures else None)
        self._stand.gesture_turn = turn
        rules = self._stand.objectives(state, report, dt)
        if not active or self._base is None:
            return rules
        base, places = self._base
        speed = CORRECTION_RATE / self._time_unit * (places - state.positions[base.nodes])
        return [*rules, part_nodes(self._stance.body, base, speed, _BASE_WEIGHT)]


def sum_postures(postures: Sequence[PostureTarget]) -> PostureTarget:
    """Return the sum of two postures; rotation vectors are added, which is valid for small rotations."""
    fields = ("offset", "velocity", "acceleration", "turn")
    return PostureTarget(*(sum((getattr(one, field) for one in postures), np.zeros(3)) for field in fields))


def _jumping_motion(motion: BodyMotion | None) -> Jump | Dance | None:
    """Return the jump of which the motion consists, or the last one that it has started, or the dance; None for other
    motions."""
    if isinstance(motion, SkipTo):
        motion = motion.parts[-1]
    if isinstance(motion, Skip | Turn):
        motion = motion.jumps[-1]
    return motion if isinstance(motion, Jump | Dance) else None
