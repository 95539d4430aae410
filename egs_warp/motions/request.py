"""One motion that is asked for, and the numbers that it takes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egs_warp.errors import UserError
from egs_warp.motions.command import DrivePlan

LARGEST_TARGET = 10.0
"""Body heights; a larger target is refused as a slip of the pen."""
LARGEST_TURN = 720.0
"""Degrees."""


@dataclass(frozen=True)
class Value:
    """One number that a motion takes."""

    name: str
    default: float
    least: float
    most: float
    unit: str
    whole: bool = False
    above: bool = False
    """Whether ``least`` itself is too little."""

    def read(self, given: Any, where: str) -> float:
        """``given`` as a number within the bounds. Raises ``UserError``, which begins with ``where``."""
        try:
            number = math.nan if isinstance(given, bool) else float(given)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        fits = self.least <= number <= self.most and not (self.above and number == self.least)
        if not fits or (self.whole and number != int(number)):
            kind = "a whole number" if self.whole else "a number"
            span = f"above {self.least:g} up to" if self.above else f"from {self.least:g} to"
            raise UserError(f"{where}: {self.name} {given}: give {kind} of {self.unit} {span} {self.most:g}")
        return number


@dataclass(frozen=True)
class MotionRequest:
    """One motion of a script, with every value known."""

    name: str
    asked: Mapping[str, float]
    """Values by name, lengths in body heights, as reports give them."""
    repeat: int = 1
    file: Path | None = None
    """Key frames of a trajectory, points of a path, speeds of a drive."""
    drive: DrivePlan | None = None
    """Speeds that come from no file."""
