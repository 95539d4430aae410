"""What hits a body, or blows at it, while it moves.

A line tells pushes, separated by commas: when, in seconds; how much, in m sqrt(g H); which way; and around which part
of the body's height, if not everywhere alike. ``0.5 0.1 left, 1.2 0.3 back 0.8``; over a time it is a gust:
``0.5-1.5 0.4 left``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.errors import ArgumentError, UserError
from egs_warp.motions.sequence import Stance

DIRECTIONS: Mapping[str, tuple[float, float, float]] = {
    "ahead": (1.0, 0.0, 0.0),
    "back": (-1.0, 0.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}
MAX_IMPULSE = 10.0
"""m sqrt(g H): more is a slip of the pen."""
MAX_TIME = 600.0
"""Seconds."""
HIT_HALF_HEIGHT = 0.25
"""Body heights above and below the height at which a body is hit."""
_FORM = "as 0.5 0.1 left, with 0.8 behind it at 0.8 of the height, or 0.5-1.5 in place of 0.5 for a gust"


@dataclass(frozen=True)
class Push:
    """An impulse at a time, or spread evenly over a while."""

    time: float
    """Seconds from the start."""
    impulse: np.ndarray
    """(3,) ahead, left and up as the body stands at the start, m sqrt(g H)."""
    height: float | None = None
    """Body heights over the sole, around which nodes take it; None: all alike."""
    duration: float = 0.0
    """Seconds."""

    def __post_init__(self) -> None:
        for name, value, most in (
            ("time", self.time, MAX_TIME),
            ("impulse", float(np.linalg.norm(self.impulse)), MAX_IMPULSE),
            ("height", self.height or 0.0, 1.0),
            ("lasts", self.duration, MAX_TIME),
        ):
            if not 0.0 <= value <= most:
                raise ArgumentError(name, f"give a number from 0 to {most:g}", value=f"{value:g}")

    def unapplied_note(self, end: float) -> str | None:
        """For the user: what of it a run that was over at ``end`` s did not see; None where it saw it all."""
        if self.time > end - _ROUNDING:
            return f"the push at {self.time:g} s never came: the run was over before"
        over = self.time + self.duration
        return f"the gust until {over:g} s was not over when the run was" if over > end + _ROUNDING else None

    def share(self, time: float, dt: float) -> float:
        """Of the impulse, in a step of ``dt`` s from ``time`` s on."""
        start, end = self.time - time, self.time + self.duration - time
        if self.duration == 0.0:
            return float(-_ROUNDING <= start < dt - _ROUNDING)
        return max(min(end, dt) - max(start, 0.0), 0.0) / self.duration


_ROUNDING = 1e-9
"""Seconds."""


class PushKicks:
    """What pushes do to the nodes of one body."""

    def __init__(self, place: Stance, pushes: Sequence[Push]) -> None:
        self._pushes = tuple(pushes)
        self._velocities = [kick_of(place, push.impulse @ place.ground.axes, push.height) for push in pushes]

    def __call__(self, time: float, dt: float) -> np.ndarray | None:
        """(N, 3) m/s that the nodes are given in a step of ``dt`` s from ``time`` s on; None if nothing pushes."""
        shares = [push.share(time, dt) for push in self._pushes]
        if not any(shares):
            return None
        return np.sum([share * kick for share, kick in zip(shares, self._velocities, strict=True)], axis=0)


def kick_of(place: Stance, impulse: np.ndarray, height: float | None) -> np.ndarray:
    """(N, 3) m/s that an ``impulse`` (3,) m sqrt(g H) gives the nodes of the body that stands at ``place``.

    ``height``: body heights over the sole, around which they take it, if not all of them alike.
    """
    body = place.body
    near = np.ones(len(body.node_mass))
    if height is not None:
        heights = (place.standing - place.ground.origin) @ place.ground.surface_normal / body.height
        away = np.abs(heights - height)
        # A coarse cage may have no node so near.
        near = np.maximum(1.0 - (away / max(HIT_HALF_HEIGHT, 1.5 * float(away.min()))) ** 2, 0.0) ** 2
    return near[:, None] / (body.node_mass @ near) * (body.mass * body.speed_unit * impulse)


def read_pushes(text: str) -> tuple[Push, ...]:
    """The pushes of a line; see the module. Raises ``UserError`` for the first mistake."""
    return tuple(_push(piece.strip(), f"push {number}") for number, piece in enumerate(text.split(","), start=1))


def _push(piece: str, where: str) -> Push:
    where = f"{where} ({piece!r})"
    words = piece.split()
    if len(words) not in (3, 4):
        raise UserError(f"{where}: give a time, an impulse and a way, {_FORM}")
    times = re.fullmatch(r"([0-9.]+)(?:-([0-9.]+))?", words[0])
    if times is None:
        raise UserError(f"{where}: time {words[0]!r}: give seconds, {_FORM}")
    start = _number(times[1], "time", "seconds", 0.0, MAX_TIME, where)
    end = start if times[2] is None else _number(times[2], "time", "seconds", start, MAX_TIME, where)
    if words[2] not in DIRECTIONS:
        raise UserError(f"{where}: unknown way {words[2]!r}; give one of {', '.join(DIRECTIONS)}")
    size = _number(words[1], "impulse", "m sqrt(g H)", 0.0, MAX_IMPULSE, where)
    height = _number(words[3], "height", "body heights", 0.0, 1.0, where) if len(words) == 4 else None
    return Push(start, size * np.array(DIRECTIONS[words[2]]), height, end - start)


def _number(text: str, name: str, unit: str, least: float, most: float, where: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not least <= number <= most:
        raise UserError(f"{where}: {name} {text}: give {unit} from {least:g} to {most:g}")
    return number
