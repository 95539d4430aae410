"""Beats to dance to, and which two of them a jump leaves and comes back to the ground on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from egs_warp.errors import ArgumentError, UserError
from egs_warp.io.text import read_text

MOST_BEATS = 1000
LATEST = 600.0
"""Seconds."""
_WAITING = 0.5
"""Seconds of waiting for its take-off that are as bad as a flight so much off the easiest one."""
_FINEST = 8
"""Parts into which the way to a beat is divided at most."""


@dataclass(frozen=True)
class Span:
    """A take-off and the touch-down after it, seconds from the start of the dance."""

    take_off: float
    touch_down: float
    """On a beat."""
    parts: int = 1
    """1: the take-off is on a beat, too; else it is the last part of the way from the beat before, divided in so many.
    """

    @property
    def flight(self) -> float:
        """Seconds."""
        return self.touch_down - self.take_off


def even_beats(tempo: float, first: float, count: int) -> tuple[float, ...]:
    """Seconds of ``count`` beats, ``tempo`` a minute from ``first`` seconds on."""
    return tuple(first + 60.0 / tempo * k for k in range(count))


def read_beats(path: Path) -> tuple[float, ...]:
    """Seconds of the beats of a file: one a line, in its first column.

    Raises ``UserError``, with the line, for what is no such file or goes back.
    """
    beats: list[float] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        word = line.replace(",", " ").replace(";", " ").split()
        time = _number(word[0]) if word else math.nan
        where = f"{path}, line {number}: {line.strip()[:60]!r}"
        if math.isnan(time) and number == 1:
            continue  # the names of the columns
        if not 0.0 <= time <= LATEST:
            raise UserError(f"{where}: give the seconds of a beat, from 0 to {LATEST:g}")
        if beats and time <= beats[-1]:
            raise UserError(f"{where}: is not after {beats[-1]:g}, the beat before; give beats in their order")
        beats.append(time)
    if not beats:
        raise UserError(f"{path}: no beats; give lines of seconds")
    if len(beats) > MOST_BEATS:
        raise UserError(f"{path}: {len(beats)} beats; at most {MOST_BEATS} are danced to")
    return tuple(beats)


def asked_beats(text: str) -> dict[str, str] | Path:
    """What ``--beats`` gives: a tempo, with the seconds of its first beat behind it or not, by the names of a dance's
    values, or a file."""
    words = text.replace(",", " ").split()
    if not words:
        raise ArgumentError("beats", "nothing is given; give a file of seconds or a tempo, as 90")
    if len(words) <= 2 and not math.isnan(_number(words[0])):
        return dict(zip(("tempo", "first"), words, strict=False))
    return Path(text.strip())


def next_span(
    beats: Sequence[float],
    after: float,
    *,
    earliest: Callable[[float], float],
    flights: tuple[float, float],
    easiest: float,
) -> Span | None:
    """The jump to come, that which goes on soonest for its ease; None if there is none left.

    It lands on a beat later than ``after``, and leaves the ground on one, or where that would be too far before it, at
    half, a quarter or an eighth of the way from the beat before. ``earliest`` tells when a flight of so many seconds
    can begin; ``flights`` are the shortest and the longest, ``easiest`` the one that is liked best, seconds.
    """
    shortest, longest = flights
    best, least = None, math.inf
    for number, landing in enumerate(beats):
        if landing <= after:
            continue
        if landing - longest > after + least:
            break
        gap = landing - beats[number - 1] if number else math.inf
        starts = [(start, 1) for start in beats[:number] if landing - longest <= start <= landing - shortest]
        if not starts and math.isfinite(gap) and gap > longest:
            divided = [(landing - gap / parts, parts) for parts in _parts() if shortest <= gap / parts <= longest]
            starts = divided[:1]
        for start, parts in starts:
            flight = landing - start
            cost = start - after + abs(flight - easiest) / _WAITING
            if start >= earliest(flight) and cost < least:
                best, least = Span(start, landing, parts), cost
    return best


def _parts() -> list[int]:
    return [2**k for k in range(1, _FINEST.bit_length())]


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan
