"""The way of a walk: where a body stands after each of its paces.

A body's place is (x, y, heading): metres ahead and to the left of where it started, radians about up. See
docs/concepts/motions.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.io.text import read_text

MAX_STEPS = 400
"""Of one walk."""
_LONGEST_GAP = 1.0
"""Body heights between two points of a path."""
_THERE = 1e-9
"""Metres."""


@dataclass(frozen=True)
class StepLimits:
    """The most that a body's place changes by in one pace; what turns it leaves less for the way ahead."""

    length: float
    """Metres."""
    turn: float
    """Radians."""
    side_fraction: float = 0.0
    """Part of ``length`` that it may go to its side."""
    faces_travel: bool = True
    """Whether it turns the way it goes; what rolls or crawls goes any way as it is."""


Route = Callable[[StepLimits], np.ndarray]
"""Gives the places (P+1, 3) before the first and after each pace."""


def straight_route(distance: float) -> Route:
    """``distance`` metres ahead in even paces; backwards if it is negative."""

    def places(pace: StepLimits) -> np.ndarray:
        count = max(int(np.ceil(abs(distance) / pace.length - _THERE)), 1)
        return np.linspace([0.0, 0.0, 0.0], [distance, 0.0, 0.0], count + 1)

    return places


def turn_route(angle: float) -> Route:
    """By ``angle`` radians on the spot, in even paces."""

    def places(pace: StepLimits) -> np.ndarray:
        count = max(int(np.ceil(abs(angle) / pace.turn - _THERE)), 1)
        return np.linspace([0.0, 0.0, 0.0], [0.0, 0.0, angle], count + 1)

    return places


def path_route(points: np.ndarray) -> Route:
    """Past each of ``points`` (n, 2), metres, to the last, turned the way it goes if it ``faces`` that; it turns on the
    spot where it must.

    Raises ``UserError`` where that takes more than ``MOST_PACES``.
    """

    def places(pace: StepLimits) -> np.ndarray:
        way = [np.zeros(3)]
        for number, point in enumerate(points):
            near = _THERE if number == len(points) - 1 else pace.length
            while np.linalg.norm(point - way[-1][:2]) > near:
                if len(way) > MAX_STEPS:
                    raise UserError(f"walk: the way takes more than {MAX_STEPS} paces; choose a shorter one")
                way.append(_nearer(way[-1], point, pace))
        return np.array(way) if len(way) > 1 else np.zeros((2, 3))

    return places


def _nearer(place: np.ndarray, point: np.ndarray, pace: StepLimits) -> np.ndarray:
    """(3,) one pace on from ``place`` (3,) towards ``point`` (2,)."""
    arm = point - place[:2]
    if not pace.faces_travel:
        way = float(np.linalg.norm(arm))
        return np.array([*(place[:2] + min(1.0, pace.length / way) * arm), place[2]])
    off = np.arctan2(arm[1], arm[0]) - place[2]
    turn = float(np.clip((off + np.pi) % (2.0 * np.pi) - np.pi, -pace.turn, pace.turn))
    heading = place[2] + turn
    ahead = np.array([np.cos(heading), np.sin(heading)])
    length = min(pace.length * (1.0 - abs(turn) / pace.turn), max(float(arm @ ahead), 0.0))
    if float(np.linalg.norm(arm)) <= pace.length and abs(turn) < 0.5 * pace.turn:
        return np.array([*point, heading])
    return np.array([*(place[:2] + length * ahead), heading])


def read_path(path: Path) -> np.ndarray:
    """(n, 2) body heights ahead and to the left of the start, of a file of lines ``ahead,left``.

    Raises ``UserError``, with the line, for what is no such file or has gaps.
    """
    points: list[Sequence[float]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            point = [float(word) for word in line.replace(",", " ").split()]
        except ValueError:
            if not points:
                continue  # the names of the columns
            point = []
        if len(point) != 2 or not np.all(np.isfinite(point)):
            raise UserError(f"{path}, line {number}: {line.strip()[:60]!r}: give two numbers, ahead and left")
        gap = float(np.linalg.norm(np.subtract(point, points[-1] if points else (0.0, 0.0))))
        if gap > _LONGEST_GAP:
            advice = f"give points at most {_LONGEST_GAP:g} apart, the first so near the start 0,0"
            raise UserError(f"{path}, line {number}: the path jumps by {gap:.3g} body heights; {advice}")
        points.append(point)
    if not points:
        raise UserError(f"{path}: no points; give lines of two numbers, ahead and left in body heights")
    return np.array(points)
