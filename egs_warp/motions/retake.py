"""Gentler forms of motions, with which a run is repeated after a fall (docs/motions/retakes.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

STEP_FRACTION = "step_fraction"
"""Name of a value that a retake sets: factor on the length and the turn of steps."""


@dataclass(frozen=True)
class Retake:
    """Change of a motion for a retake."""

    change: str
    """Description that follows the name of the motion in messages."""
    factors: Mapping[str, float] = field(default_factory=dict)
    """Factors on the requested values, by name; factors on values that are missing are ignored."""
    replacements: Mapping[str, float] = field(default_factory=dict)
    """Values that replace the requested ones, by name; a motion without a parameter of this name is performed with the
    value, too."""
    style: Mapping[str, float] = field(default_factory=dict)
    """Factors on the style of jumps (``egs_warp.motions.style``)."""

    def values(self, requested: Mapping[str, float]) -> dict[str, float]:
        """Return the values with which the motion is performed instead of the ``requested`` ones."""
        scaled = {name: self.factors.get(name, 1.0) * value for name, value in requested.items()}
        return {**scaled, **self.replacements}


SOFT_JUMPS = Retake("slower and softer", style={"timing": 1.25, "squash": 1.5})
"""First retake of jumps."""
HIGH_FLIPS = Retake("higher", factors={"height": 1.3})
"""Retake of somersaults: a longer flight needs less angular momentum, and a shorter lever arm of the ground force."""
SHORT_STEPS = Retake("in steps of half the length", replacements={STEP_FRACTION: 0.5})
PATH_RETAKES = (SHORT_STEPS, Retake("in steps of a quarter of the length", replacements={STEP_FRACTION: 0.25}))
"""Retakes of motions in steps along a path, in the order in which they are tried."""
