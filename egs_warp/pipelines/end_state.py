"""End state of a run and of each of its motions: ``state`` of the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from egs_warp.locomotion.rollout import are_supporting
from egs_warp.locomotion.trajectory import MotionOutcome, Trajectory
from egs_warp.motions.act import ActOutcome
from egs_warp.motions.fall_monitor import FALLEN_TIME, tips_body
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.follow import Follow
from egs_warp.motions.sequence import JudgedOutcome, MotionRecord

MAX_END_TILT = 30.0
"""Tilt at the end of a motion above which the body is considered fallen, degrees."""
MAX_END_STRETCH = 2.5
"""Maximum stretch or compression of an element at the end of a run that ends at rest. Bodies at rest reach 1.5, a body
that leans against another one 1.8."""
MAX_SLIP = 0.1
"""Maximum slip of a foot, as a fraction of the stride."""
_TOLERANCES = {"distance": (0.1, 0.1), "height": (0.05, 0.15), "heading_degrees": (10.0, 0.0)}
"""Maximum error of each target; the larger of two values applies: an absolute one, in body heights or degrees, and one
relative to the target."""
_MIN_SUPPORT = 0.5
"""Minimum mean upward contact force on a supported body, relative to its weight."""
_MIN_PUSH = 0.01
"""Minimum force with which another body pushes a body, relative to the weight of the pushed body."""
_UNITS = {"distance": "body heights", "height": "body heights", "heading_degrees": "degrees"}


class State(Enum):
    """End state of a motion, from best to worst; a run has the worst state of its motions."""

    DONE = "done"
    CUT_OFF = "cut off"
    """The requested number of frames was reached before the motion ended."""
    GOT_UP = "got up"
    """The body fell in a run with pushes, or after another body had pushed it, which ended the motion, but it got up
    again."""
    NOT_AS_REQUESTED = "not as requested"
    """The body ended upright, but missed its target or its time limit, its feet slid, or it fell without a push and got
    up again."""
    FALLEN = "fallen"
    STOPPED = "stopped"
    """A step could not be solved."""

    @property
    def is_failure(self) -> bool:
        """True if the exit status reports this state as a failure."""
        return self in (State.NOT_AS_REQUESTED, State.FALLEN, State.STOPPED)

    @classmethod
    def worst(cls, states: tuple[State, ...]) -> State:
        """Return the worst of ``states``, ``DONE`` if there are none."""
        return max(states, key=list(cls).index, default=cls.DONE)


@dataclass(frozen=True)
class EndCause:
    """Cause that ended the last motion early, if any, and criteria by which the motions are judged."""

    fallen: str | None = None
    """Description of a fall; None if the body has not fallen."""
    stopped: bool = False
    """True if a step could not be solved."""
    has_time_limit: bool = False
    """True if no number of frames was requested, so that each motion has to come to rest within its time limit."""
    is_pushed: bool = False
    """True if pushes, or another body, have acted, which may be intended to topple the body."""
    base: SupportKind | None = None
    """Support of the body; None if tilt and slip are not judged."""
    unsupported: str | None = None
    """Reason why nothing supports the body at the end of the run; None if something does."""
    end_stretch: float = 1.0
    """Largest stretch or compression of an element at the end of the run (``audit.end_stretch``); infinite if one has
    collapsed."""

    def __repr__(self) -> str:
        if self.stopped:
            return "EndCause(a step could not be solved)"
        if self.fallen is not None:
            return f"EndCause(fallen: {self.fallen})"
        return "EndCause(not ended early)"

    def of(
        self, entry: MotionRecord, reached: MotionOutcome, also_reached: object = None, *, last: bool
    ) -> tuple[State, list[str]]:
        """Return the state of a motion and notes for the user.

        Args:
            entry: Record of a motion that has started.
            reached: Measured outcome of the motion.
            also_reached: Measured values that only this kind of motion has.
            last: True for the last motion of the run.
        """
        if last and self.stopped:
            return State.STOPPED, ["stopped: the next step could not be solved, however short; the run ends before it"]
        if entry.fall_note is not None:
            if not entry.got_up:
                return State.FALLEN, [f"fallen: {entry.fall_note}; it did not get up"]
            state = State.GOT_UP if self.is_pushed else State.NOT_AS_REQUESTED
            return state, [f"fallen: {entry.fall_note}; it got up again"]
        if last and self.fallen is not None:
            return State.FALLEN, [f"fallen: {self.fallen}"]
        has_upright = self.base is not None and has_upright_pose(self.base) and not tips_body(entry.motion)
        if has_upright and reached.tilt_degrees > MAX_END_TILT:
            return State.FALLEN, [f"fallen: at the end it is tilted by {reached.tilt_degrees:.0f} degrees"]
        missed = missed_targets(entry.asked, reached) if entry.motion.is_at_rest else []
        if not entry.motion.is_at_rest:
            if not self.has_time_limit:
                return State.CUT_OFF, []
            missed = ["not at rest within the time limit of the motion"]
        if last and self.unsupported is not None:
            missed.append(self.unsupported)
        if last and not self.end_stretch <= MAX_END_STRETCH and not isinstance(entry.motion, Follow):
            by = f"parts of the body end stretched or compressed by a factor of {self.end_stretch:.1f}"
            missed.append(by if np.isfinite(self.end_stretch) else "a part of the body has collapsed")
        outcome = also_reached
        while isinstance(outcome, ActOutcome):
            missed += [gesture.text for gesture in outcome.gestures if gesture.is_missed]
            outcome = outcome.below
        if isinstance(outcome, JudgedOutcome) and entry.motion.is_at_rest:
            missed += outcome.failures
        slip = getattr(also_reached, "slip", 0.0)
        if self.base is SupportKind.FEET and slip > MAX_SLIP:
            missed.append(f"feet slide by {100.0 * slip:.0f} % of a stride")
        return (State.NOT_AS_REQUESTED, [f"not as requested: {', '.join(missed)}"]) if missed else (State.DONE, [])


def falls_at_end(trajectory: Trajectory) -> bool:
    """Return True if nothing supports the body in the last ``FALLEN_TIME`` of ``trajectory``, or in all of it if it is
    shorter: contacts and joints carry less than ``_MIN_SUPPORT`` of its weight."""
    t = trajectory
    gravity = float(np.linalg.norm(t.gravity))
    if len(t.dt) == 0 or gravity == 0.0:
        return False
    ends = t.time[1:]
    is_late = ends > ends[-1] - FALLEN_TIME * np.sqrt(t.height / gravity)
    steps = np.concatenate([t.contact_step, t.joint_step])
    upward = -(np.concatenate([t.contact_force, t.joint_force]) @ t.gravity) / gravity
    impulse = (np.bincount(steps, upward, len(t.dt)) * t.dt)[is_late].sum()
    return bool(impulse < _MIN_SUPPORT * t.node_mass.sum() * gravity * t.dt[is_late].sum())


def first_push(trajectory: Trajectory) -> int | None:
    """Return the first step in which another body that is not below the body exerts a force of at least ``_MIN_PUSH``
    of its weight on it; None if there is none."""
    t = trajectory
    is_support = are_supporting(t.contact_plane, t.contact_normal, t.gravity, t.world_index)
    force = np.linalg.norm(t.contact_force, axis=1)
    is_push = ~(is_support | t.is_self_contact) & (force >= _MIN_PUSH * t.node_mass.sum() * np.linalg.norm(t.gravity))
    return int(t.contact_step[is_push].min()) if is_push.any() else None


def has_upright_pose(base: SupportKind) -> bool:
    """Return True if a body on ``base`` has an upright pose; a ball has none."""
    return base is not SupportKind.ROUND_BASE


def missed_targets(requested: Mapping[str, float], reached: MotionOutcome) -> list[str]:
    """Return a description of each target that was missed.

    Args:
        requested: Targets by name, in body heights and degrees.
        reached: Measured outcome.
    """
    missed = []
    for name, (absolute, relative) in _TOLERANCES.items():
        if name not in requested:
            continue
        target, value = requested[name], getattr(reached, name)
        # A jump onto a step may rise higher than requested.
        error = target - value if name == "height" else abs(target - value)
        if error > max(absolute, relative * abs(target)):
            text = f"{value:.0f}" if name == "heading_degrees" else f"{value:.2g}"
            missed.append(f"{name.partition('_')[0]} {text} of {target:g} {_UNITS[name]}")
    return missed
