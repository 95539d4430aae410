"""How a run and each of its motions ended: ``state`` of the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from egs_warp.locomotion.trajectory import MotionOutcome
from egs_warp.motions.sequence import MotionRecord

NO_PROGRESS = 0.1
"""Of the asked distance or heading: a motion that has come to rest with less than a tenth has not done what it is for,
whatever the reason."""


class State(Enum):
    """How a motion ended; a run ends in the worst of those of its motions, these being in order."""

    DONE = "done"
    CUT_OFF = "cut off"
    """The frames that were asked for, or that a motion may take, were over first."""
    GOT_UP = "got up"
    """The body fell, which ended it, and has got up."""
    FALLEN = "fallen"
    STOPPED = "stopped"
    """A step could not be solved."""

    @property
    def is_failure(self) -> bool:
        """Whether it is told by the exit status."""
        return self in (State.FALLEN, State.STOPPED)

    @classmethod
    def worst(cls, states: tuple[State, ...]) -> State:
        """The last of them in the order above."""
        return max(states, key=list(cls).index, default=cls.DONE)


@dataclass(frozen=True)
class EndCause:
    """What ended the last motion before its time."""

    fallen: str | None = None
    """How a fall was told."""
    stopped: bool = False
    """Whether a step could not be solved."""

    def of(self, entry: MotionRecord, reached: MotionOutcome, *, last: bool) -> tuple[State, list[str]]:
        """State of one of the motions that were begun, and why, for the user; ``last``: whether it was the last."""
        if last and self.stopped:
            return State.STOPPED, ["stopped: the next step could not be solved, however short; this is all before it"]
        if entry.fell is not None:
            state, then = (State.GOT_UP, "got up again") if entry.got_up else (State.FALLEN, "did not get up")
            return state, [f"fallen: {entry.fell}; it {then}"]
        if last and self.fallen is not None:
            return State.FALLEN, [f"fallen: {self.fallen}"]
        if not entry.motion.is_at_rest:
            return State.CUT_OFF, []
        missed = no_progress(entry.asked, reached)
        return (State.FALLEN, [f"fallen: {missed}"]) if missed is not None else (State.DONE, [])


def no_progress(asked: Mapping[str, float], reached: MotionOutcome) -> str | None:
    """What was ``asked`` (body heights, degrees) and next to nothing was ``reached`` of."""
    for name, unit in (("distance", "body heights"), ("heading_degrees", "degrees")):
        wanted, got = asked.get(name, 0.0), getattr(reached, name)
        if abs(wanted) > 0.0 and abs(got) < NO_PROGRESS * abs(wanted):
            return f"no progress, {name.partition('_')[0]} {got:.2g} of {wanted:g} {unit}"
    return None
