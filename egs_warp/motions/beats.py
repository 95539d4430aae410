"""Beats of a dance, and the selection of the times of take-off and touch-down of the next jump."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from egs_warp.errors import ArgumentError, UserError
from egs_warp.io.text import read_text

MAX_BEATS = 1000
MAX_BEAT_TIME = 600.0
"""Largest time of a beat, s."""
_FLIGHT_TOLERANCE = 0.5
"""Deviation from the preferred flight time, s, that has the same cost as a delay of one second."""
_MAX_DIVISION = 8
"""Largest number of parts into which the interval before a beat is divided."""


@dataclass(frozen=True)
class Span:
    """Times of a take-off and of the touch-down after it, in seconds from the start of the dance."""

    take_off: float
    touch_down: float
    """Time of the touch-down, which is a beat, s."""
    parts: int = 1
    """1 if the take-off is on a beat. Otherwise, the interval before the beat of the touch-down is divided into this
    number of equal parts, and the take-off is at the start of the last part."""

    @property
    def flight(self) -> float:
        """Flight time, s."""
        return self.touch_down - self.take_off


def even_beats(tempo: float, first: float, count: int) -> tuple[float, ...]:
    """Return the times in seconds of ``count`` beats at ``tempo`` beats per minute, the first at ``first`` seconds."""
    return tuple(first + 60.0 / tempo * k for k in range(count))


def read_beats(path: Path) -> tuple[float, ...]:
    """Read the times of beats, in seconds: one beat per line, in the first column.

    Raises:
        UserError: for a malformed file or times that do not increase; the message contains the line.
    """
    beats: list[float] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        word = line.replace(",", " ").replace(";", " ").split()
        time = _number(word[0]) if word else math.nan
        where = f"{path}, line {number}: {line.strip()[:60]!r}"
        if math.isnan(time) and number == 1:
            continue  # Skip the header line.
        if not 0.0 <= time <= MAX_BEAT_TIME:
            raise UserError(f"{where}: give the time of a beat in seconds, from 0 to {MAX_BEAT_TIME:g}")
        if beats and time <= beats[-1]:
            raise UserError(f"{where}: is not after the previous beat, {beats[-1]:g}; give beats in increasing order")
        beats.append(time)
    if not beats:
        raise UserError(f"{path}: it has no beats; give one time in seconds per line")
    if len(beats) > MAX_BEATS:
        raise UserError(f"{path}: it has {len(beats)} beats; give at most {MAX_BEATS}")
    return tuple(beats)


def parse_beats(text: str) -> dict[str, str] | Path:
    """Parse the value of ``--beats``: a tempo, optionally followed by the time of the first beat, or the path of a
    file.

    Returns:
        A mapping from parameters of a dance to the texts of their values, or the path.
    """
    words = text.replace(",", " ").split()
    if not words:
        raise ArgumentError("beats", "the value is empty; give a file of times in seconds or a tempo such as 90")
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
    """Return the times of the next jump, or None if no remaining beat can be reached.

    The jump lands on a beat later than ``after``. It takes off on a beat or, if no earlier beat is late enough, a half,
    a quarter or an eighth of the last interval before the landing. The result is the candidate with the lowest cost
    ``wait + |flight - easiest| / _FLIGHT_TOLERANCE``, where ``wait`` is the time from ``after`` to the take-off.

    Args:
        beats: times of the beats, increasing, s.
        after: current time, s.
        earliest: function from a flight time to the earliest possible time of take-off, s.
        flights: minimum and maximum flight time, s.
        easiest: preferred flight time, s.
    """
    shortest, longest = flights
    best, lowest = None, math.inf
    for number, landing in enumerate(beats):
        if landing <= after:
            continue
        if landing - longest > after + lowest:
            break
        gap = landing - beats[number - 1] if number else math.inf
        starts = [(start, 1) for start in beats[:number] if landing - longest <= start <= landing - shortest]
        if not starts and math.isfinite(gap) and gap > longest:
            divided = [(landing - gap / parts, parts) for parts in _parts() if shortest <= gap / parts <= longest]
            starts = divided[:1]
        for start, parts in starts:
            flight = landing - start
            cost = start - after + abs(flight - easiest) / _FLIGHT_TOLERANCE
            if start >= earliest(flight) and cost < lowest:
                best, lowest = Span(start, landing, parts), cost
    return best


def _parts() -> list[int]:
    return [2**k for k in range(1, _MAX_DIVISION.bit_length())]


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan
