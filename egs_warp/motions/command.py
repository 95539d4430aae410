"""Speeds that a body is steered by: ``Drive``, and a file of them over time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from egs_warp.errors import ArgumentError, UserError
from egs_warp.io.text import read_text

FASTEST = 2.0
"""sqrt(g H), or radians in sqrt(H / g): more is a slip of the pen."""
LONGEST = 60.0
"""Seconds of a file."""


@dataclass(frozen=True)
class Drive:
    """How a body is to go from now on; it goes as fast as it can where that is less.

    Raises ``ArgumentError`` for what is no number or beyond 2.
    """

    forward: float = 0.0
    """sqrt(g H), the way it faces; backwards if negative."""
    sideways: float = 0.0
    """sqrt(g H), to its left."""
    turn: float = 0.0
    """Radians in sqrt(H / g), to its left."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and abs(value) <= FASTEST):
                raise ArgumentError(name, f"give a speed from -{FASTEST:g} to {FASTEST:g}", value=value)

    @property
    def is_zero(self) -> bool:
        """Whether it asks for nothing."""
        return self.forward == self.sideways == self.turn == 0.0


@dataclass(frozen=True)
class DrivePlan:
    """Commands one after the other, each until the next one's time; the last is to stand."""

    times: tuple[float, ...]
    """Seconds from the start, growing."""
    commands: tuple[Drive, ...]

    def __post_init__(self) -> None:
        before = -1.0
        for time in self.times:
            if not (0.0 <= time <= LONGEST and time > before):
                raise ArgumentError("time", f"give seconds that grow, from 0 to {LONGEST:g}", value=f"{time:g}")
            before = time
        if not self.commands or not self.commands[-1].is_zero:
            raise ArgumentError("commands", "the last one does not stand; end with 0,0,0")

    def at(self, elapsed: float) -> Drive:
        """What holds ``elapsed`` seconds after the start."""
        past = [command for time, command in zip(self.times, self.commands, strict=True) if time <= elapsed + 1e-9]
        return past[-1] if past else Drive()

    @property
    def seconds(self) -> float:
        """Until it is told to stand for good."""
        return self.times[-1]


def read_drive(path: Path) -> DrivePlan:
    """Of a file of lines ``time,forward,sideways,turn``. Raises ``UserError``, with the line, for what is no such
    file."""
    times: list[float] = []
    commands: list[Drive] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{path}, line {number}"
        try:
            row = [float(word) for word in line.replace(",", " ").split()]
        except ValueError:
            if not times and not any(character.isdigit() for character in line):
                continue  # the names of the columns
            row = []
        if len(row) != 4:
            raise UserError(f"{where}: {line.strip()[:60]!r}: give four numbers, time,forward,sideways,turn")
        time, *speeds = row
        times.append(time)
        try:
            commands.append(Drive(*speeds))
            DrivePlan((*times,), (Drive(),) * len(times))
        except ArgumentError as error:
            raise UserError(f"{where}: {error}") from None
    if not times:
        raise UserError(f"{path}: no commands; give lines of four numbers, time,forward,sideways,turn")
    try:
        return DrivePlan(tuple(times), tuple(commands))
    except ArgumentError as error:
        raise UserError(f"{path}: {error}") from None
