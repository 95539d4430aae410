"""Velocity commands for a body: ``Drive``, and files that list commands with their times."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

from egs_warp.checked_calls import Range, checked_constructor
from egs_warp.errors import ArgumentError, UserError
from egs_warp.io.text import read_text
from egs_warp.short_repr import short_repr

MAX_SPEED = 2.0
"""Maximum speed of a command, in sqrt(g H) or radians per sqrt(H / g); larger values are rejected as typing errors."""
MAX_TIME = 60.0
"""Maximum time of a command in a file, s."""
Speed: TypeAlias = Annotated[float, Range(-MAX_SPEED, MAX_SPEED, "a speed")]
"""A speed of a command."""


@checked_constructor
@dataclass(frozen=True)
class Drive:
    """Velocity command. A body that cannot reach the commanded speed moves as fast as it can.

    Raises:
        ArgumentError: for a value that is not finite or exceeds 2 in magnitude.
    """

    __repr__ = short_repr

    forward: Speed = 0.0
    """Forward speed, sqrt(g H); negative is backwards."""
    sideways: Speed = 0.0
    """Speed to the left, sqrt(g H)."""
    turn: Speed = 0.0
    """Turning rate to the left, radians per sqrt(H / g)."""

    @property
    def is_zero(self) -> bool:
        """True if all speeds are zero."""
        return self.forward == self.sideways == self.turn == 0.0


@dataclass(frozen=True)
class DrivePlan:
    """Sequence of commands, each valid until the time of the next one; the last command is zero."""

    __repr__ = short_repr

    times: tuple[float, ...]
    """Times of the commands in seconds from the start, increasing."""
    commands: tuple[Drive, ...]

    def __post_init__(self) -> None:
        before = -1.0
        for time in self.times:
            if not (0.0 <= time <= MAX_TIME and time > before):
                raise ArgumentError(
                    "time", f"give increasing times in seconds, from 0 to {MAX_TIME:g}", value=f"{time:g}"
                )
            before = time
        if not self.commands:
            raise ArgumentError("commands", "the list is empty; give at least one, the last of which is 0,0,0")
        if not self.commands[-1].is_zero:
            speeds = ",".join(f"{speed:g}" for speed in vars(self.commands[-1]).values())
            raise ArgumentError("commands", f"the last command is {speeds}, not zero; end with 0,0,0")

    def at(self, elapsed: float) -> Drive:
        """Return the command that is valid ``elapsed`` seconds after the start."""
        past = [command for time, command in zip(self.times, self.commands, strict=True) if time <= elapsed + 1e-9]
        return past[-1] if past else Drive()

    @property
    def seconds(self) -> float:
        """Time of the last command, s."""
        return self.times[-1]


def read_drive(path: Path) -> DrivePlan:
    """Read a file of lines ``time,forward,sideways,turn``.

    Raises:
        UserError: for a malformed file; the message contains the line number.
    """
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
                continue  # Skip the header line.
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
        raise UserError(f"{path}: it has no commands; give lines of four numbers, time,forward,sideways,turn")
    try:
        return DrivePlan(tuple(times), tuple(commands))
    except ArgumentError as error:
        raise UserError(f"{path}: {error}") from None
