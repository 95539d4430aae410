"""End state of a run and of each of its motions: ``state`` of the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from egs_warp.locomotion.trajectory import MotionOutcome
from egs_warp.motions.sequence import MotionRecord

MIN_PROGRESS = 0.1
"""Minimum fraction of the requested distance or heading: a motion that ends with less has failed."""


class State(Enum):
    """End state of a motion, from best to worst; a run has the worst state of its motions."""

    DONE = "done"
    CUT_OFF = "cut off"
    """The requested number of frames, or the maximum time of the motion, was reached first."""
    GOT_UP = "got up"
    """The body fell, which ended it, and has got up."""
    FALLEN = "fallen"
    STOPPED = "stopped"
    """A step could not be solved."""

    @property
    def is_failure(self) -> bool:
        """True if the exit status reports it."""
        return self in (State.FALLEN, State.STOPPED)

    @classmethod
    def worst(cls, states: tuple[State, ...]) -> State:
        """Return the worst of ``states``, ``DONE`` if there are none."""
        return max(states, key=list(cls).index, default=cls.DONE)


@dataclass(frozen=True)
class EndCause:
    """Cause that ended the last motion early, if any."""

    fallen: str | None = None
    """Description of a fall; None if the body has not fallen."""
    stopped: bool = False
    """True if a step could not be solved."""

    def of(self, entry: MotionRecord, reached: MotionOutcome, *, last: bool) -> tuple[State, list[str]]:
        """Return the state of a motion and notes for the user.

        Args:
            entry: Record of a motion that has started.
            reached: Its measured outcome.
            last: True for the last motion of the run.
        """
        if last and self.stopped:
            return State.STOPPED, ["stopped: the next step could not be solved, however short; the run ends before it"]
        if entry.fall_note is not None:
            state, outcome = (State.GOT_UP, "got up again") if entry.got_up else (State.FALLEN, "did not get up")
            return state, [f"fallen: {entry.fall_note}; it {outcome}"]
        if last and self.fallen is not None:
            return State.FALLEN, [f"fallen: {self.fallen}"]
        if not entry.motion.is_at_rest:
            return State.CUT_OFF, []
        failure = no_progress(entry.asked, reached)
        return (State.FALLEN, [f"fallen: {failure}"]) if failure is not None else (State.DONE, [])


def no_progress(requested: Mapping[str, float], reached: MotionOutcome) -> str | None:
    """Return a description of a target that was not approached, None if there is none.

    Args:
        requested: Targets by name, body heights and degrees.
        reached: Measured outcome.
    """
    for name, unit in (("distance", "body heights"), ("heading_degrees", "degrees")):
        target, value = requested.get(name, 0.0), getattr(reached, name)
        if abs(target) > 0.0 and abs(value) < MIN_PROGRESS * abs(target):
            return f"no progress, {name.partition('_')[0]} {value:.2g} of {target:g} {unit}"
    return None
