"""Numeric parameters of motions, with their bounds."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from egs_warp.errors import UserError


@dataclass(frozen=True)
class Value:
    """Numeric parameter of a motion."""

    name: str
    default: float
    minimum: float
    maximum: float
    unit: str
    is_integer: bool = False
    is_exclusive: bool = False
    """True if the value ``minimum`` itself is not allowed."""

    def parse(self, value: Any, where: str) -> float:
        """Return ``value`` as a number within the bounds.

        Raises:
            UserError: if ``value`` is not a number within the bounds; the message begins with ``where``.
        """
        try:
            number = math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        fits = self.minimum <= number <= self.maximum and not (self.is_exclusive and number == self.minimum)
        if not fits or (self.is_integer and number != int(number)):
            kind = "a whole number" if self.is_integer else "a number"
            span = f"above {self.minimum:g} up to" if self.is_exclusive else f"from {self.minimum:g} to"
            given = f"{self.name} {value}" if value != "" else f"{self.name} without a value"
            advice = f"give {kind} of {self.unit} {span} {self.maximum:g}"
            if isinstance(value, str) and re.fullmatch(r"[-+]?\.?\d[.\d]*[a-zA-Z%°]+", value):
                advice += ", without a unit"
                advice += "; 1 is the height of the body" if self.unit == "body heights" else ""
            raise UserError(f"{where}: {given}: {advice}")
        return number
