"""Pushes and gusts that act on a body during its motion.

A text lists pushes, separated by commas: ``0.5 0.1 left, 1.2 0.3 back 0.8``. Each push has a time in seconds, an
impulse in m sqrt(g H), a direction and, optionally, the height in body heights around which it acts. A push without a
height acts on all nodes alike. A push with a time interval is a gust: ``0.5-1.5 0.4 left``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np

from egs_warp.checked_calls import Fraction, Range, checked_constructor
from egs_warp.errors import ArgumentError, UserError, did_you_mean
from egs_warp.motions.sequence import Stance
from egs_warp.short_repr import short_repr

DIRECTIONS: Mapping[str, tuple[float, float, float]] = {
    "ahead": (1.0, 0.0, 0.0),
    "back": (-1.0, 0.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}
MAX_IMPULSE = 10.0
"""Largest impulse, m sqrt(g H); larger values are rejected as typing errors."""
MAX_TIME = 600.0
"""Largest time or duration, s."""
PushTime: TypeAlias = Annotated[float, Range(0.0, MAX_TIME)]
"""Time or duration of a push, s."""
HIT_HALF_HEIGHT = 0.25
"""Half of the height, in body heights, of the region of a body on which a push acts."""
_EXAMPLE = "such as 0.5 0.1 left; append 0.8 to hit at 0.8 of the height, or write 0.5-1.5 instead of 0.5 for a gust"


@checked_constructor
@dataclass(frozen=True)
class Push:
    """Impulse at a time, or spread evenly over an interval.

    Raises:
        ArgumentError: for a value that is negative or too large.
    """

    __repr__ = short_repr

    time: PushTime
    """Time of the push, or start of the gust, in seconds from the start of the run."""
    impulse: Annotated[np.ndarray, 3]
    """(3,) m sqrt(g H), forward, left and up relative to the body at the start."""
    height: Fraction | None = None
    """Height above the sole, in body heights, around which the push acts; None for all nodes alike."""
    duration: PushTime = 0.0
    """Duration of a gust, s; 0 for a push at a single time."""

    def __post_init__(self) -> None:
        impulse = float(np.linalg.norm(self.impulse))
        if not impulse <= MAX_IMPULSE:
            raise ArgumentError("impulse", f"give a number from 0 to {MAX_IMPULSE:g}", value=f"{impulse:g}")

    def unapplied_note(self, end: float) -> str | None:
        """Return a message for the user about the part of the push that did not act before the run ended at ``end`` s;
        None if the push acted completely."""
        if self.time > end - _ROUNDING:
            return f"the push at {self.time:g} s did not act: the run ended earlier"
        over = self.time + self.duration
        return (
            f"the gust until {over:g} s did not act in full: the run ended earlier" if over > end + _ROUNDING else None
        )

    def share(self, time: float, dt: float) -> float:
        """Return the fraction of the impulse that acts in the time step of ``dt`` s that starts at ``time`` s."""
        start, end = self.time - time, self.time + self.duration - time
        if self.duration == 0.0:
            return float(-_ROUNDING <= start < dt - _ROUNDING)
        return max(min(end, dt) - max(start, 0.0), 0.0) / self.duration


_ROUNDING = 1e-9
"""Tolerance of comparisons of times, s."""


class PushKicks:
    """Velocity changes of the nodes due to the pushes on one body."""

    def __init__(self, stance: Stance, pushes: Sequence[Push]) -> None:
        self._pushes = tuple(pushes)
        self._velocities = [kick_of(stance, push.impulse @ stance.ground.axes, push.height) for push in pushes]

    def __call__(self, time: float, dt: float) -> np.ndarray | None:
        """Return the velocity change (N, 3) in m/s of the nodes in the time step of ``dt`` s that starts at ``time`` s;
        None without a push."""
        shares = [push.share(time, dt) for push in self._pushes]
        if not any(shares):
            return None
        return np.sum([share * kick for share, kick in zip(shares, self._velocities, strict=True)], axis=0)


def kick_of(stance: Stance, impulse: np.ndarray, height: float | None) -> np.ndarray:
    """Return the velocity change (N, 3) in m/s of the nodes from an impulse.

    Args:
        stance: stance of the body.
        impulse: (3,) m sqrt(g H), world axes.
        height: height above the sole, in body heights, around which the impulse acts; None for all nodes alike.
    """
    body = stance.body
    near = np.ones(len(body.node_mass))
    if height is not None:
        heights = (stance.standing - stance.ground.origin) @ stance.ground.surface_normal / body.height
        away = np.abs(heights - height)
        # In a coarse cage, there may be no node within this distance.
        near = np.maximum(1.0 - (away / max(HIT_HALF_HEIGHT, 1.5 * float(away.min()))) ** 2, 0.0) ** 2
    return near[:, None] / (body.node_mass @ near) * (body.mass * body.speed_unit * impulse)


def read_pushes(text: str) -> tuple[Push, ...]:
    """Parse pushes such as ``0.5 0.1 left, 1.2 0.3 back 0.8``; the module's docstring describes the syntax.

    Raises:
        UserError: for the first mistake.
    """
    return tuple(_push(piece.strip(), f"push {number}") for number, piece in enumerate(text.split(","), start=1))


def _push(piece: str, where: str) -> Push:
    where = f"{where} ({piece!r})"
    words = piece.split()
    if len(words) not in (3, 4):
        raise UserError(f"{where}: give a time, an impulse and a direction, {_EXAMPLE}")
    times = re.fullmatch(r"([0-9.]+)(?:-([0-9.]+))?", words[0])
    if times is None:
        raise UserError(f"{where}: time {words[0]!r}: give seconds, {_EXAMPLE}")
    start = _number(times[1], "time", "seconds", 0.0, MAX_TIME, where)
    end = start if times[2] is None else _number(times[2], "time", "seconds", start, MAX_TIME, where)
    if words[2] not in DIRECTIONS:
        near = did_you_mean(words[2], DIRECTIONS)
        raise UserError(f"{where}: unknown direction {words[2]!r}{near}; give one of {', '.join(DIRECTIONS)}")
    size = _number(words[1], "impulse", "m sqrt(g H)", 0.0, MAX_IMPULSE, where)
    height = _number(words[3], "height", "body heights", 0.0, 1.0, where) if len(words) == 4 else None
    return Push(start, size * np.array(DIRECTIONS[words[2]]), height, end - start)


def _number(text: str, name: str, unit: str, minimum: float, maximum: float, where: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not minimum <= number <= maximum:
        raise UserError(f"{where}: {name} {text}: give {unit} from {minimum:g} to {maximum:g}")
    return number
