"""Numbers that can be asked for, each within bounds of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from egs_warp.errors import UserError


@dataclass(frozen=True)
class Value:
    """One number that a motion takes."""

    name: str
    default: float
    least: float
    most: float
    unit: str
    is_integer: bool = False
    is_exclusive: bool = False
    """Whether ``least`` itself is too little."""

    def parse(self, given: Any, where: str) -> float:
        """``given`` as a number within the bounds. Raises ``UserError``, which begins with ``where``."""
        try:
            number = math.nan if isinstance(given, bool) else float(given)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        fits = self.least <= number <= self.most and not (self.is_exclusive and number == self.least)
        if not fits or (self.is_integer and number != int(number)):
            kind = "a whole number" if self.is_integer else "a number"
            span = f"above {self.least:g} up to" if self.is_exclusive else f"from {self.least:g} to"
            raise UserError(f"{where}: {self.name} {given}: give {kind} of {self.unit} {span} {self.most:g}")
        return number
