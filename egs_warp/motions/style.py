"""Style of a jump: factors that follow principles of animation and are 1 by default (docs/motions/style.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, TypeAlias

import numpy as np

from egs_warp.checked_calls import Range, checked_constructor
from egs_warp.errors import ArgumentError, did_you_mean
from egs_warp.motions.values import Value

MIN_FACTOR, MAX_FACTOR = 0.5, 2.0
"""Minimum and maximum of a factor; outside this range, no body could perform the stroke of the jump."""
MAX_OVERLAP = 0.5
"""Maximum overlap; with it, the tip of a part sags by half of the part's length and swings by its whole length."""
Factor: TypeAlias = Annotated[float, Range(MIN_FACTOR, MAX_FACTOR)]
"""A factor of a style."""


@checked_constructor
@dataclass(frozen=True)
class Style:
    """Factors of a jump relative to the default, and the softness of the parts that stick out of the body.

    Raises:
        ArgumentError: for a factor below 0.5 or above 2, or an overlap below 0 or above 0.5.
    """

    anticipation: Factor = 1.0
    """Depth and duration of the crouch."""
    squash: Factor = 1.0
    """Time in which the fall is stopped on landing, which determines the compression."""
    bounce: Factor = 1.0
    """Oscillation of the body about its standing height after the landing; the damping ratio is 1 / bounce^2."""
    timing: Factor = 1.0
    """Duration of crouch and thrust; below 1, both are quick and hard."""
    overlap: Annotated[float, Range(0.0, MAX_OVERLAP)] = 0.0
    """Softness of the parts that stick out of the body (``CreatureOptions.overlap``); this is not a factor. Because
    softness is a property of the body, the style of a single motion does not change it."""

    def scaled(self, factors: Mapping[str, float]) -> Style:
        """Return the style with its factors multiplied by ``factors`` and limited to their bounds."""
        scaled = {name: value * factors.get(name, 1.0) for name, value in vars(self).items()}
        return Style(**{name: float(np.clip(value, *span(name))) for name, value in scaled.items()})

    def __str__(self) -> str:
        """Return the style as text for ``read_style``: the name of a preset, or all factors."""
        values = vars(self)
        same = [name for name, preset in PRESETS.items() if preset == values]
        numbers = [f"{name}={value!r}" for name, value in values.items() if value or name != "overlap"]
        return same[0] if same else " ".join(numbers)


def span(name: str) -> tuple[float, float]:
    """Return the minimum and maximum of the field ``name`` of a style."""
    return (0.0, MAX_OVERLAP) if name == "overlap" else (MIN_FACTOR, MAX_FACTOR)


PRESETS: Mapping[str, Mapping[str, float]] = {
    "light": {"anticipation": 0.6, "squash": 0.6, "bounce": 1.0, "timing": 0.7, "overlap": 0.05},
    "heavy": {"anticipation": 1.6, "squash": 1.8, "bounce": 1.0, "timing": 1.4, "overlap": 0.12},
    "rubbery": {"anticipation": 1.5, "squash": 1.9, "bounce": 1.9, "timing": 1.0, "overlap": 0.25},
}
_NAMES = tuple(field.name for field in fields(Style))


def read_style(text: str) -> Style:
    """Parse a style such as ``heavy`` or ``anticipation=1.3 squash=1.2``; numbers override the values of the preset.

    Raises:
        UserError: for the first mistake.
    """
    values: dict[str, float] = {}
    words = text.replace(",", " ").split()
    if not words:
        raise ArgumentError("style", f"the text is empty; give {_usage()}")
    for number, word in enumerate(words):
        name, equals, value = word.partition("=")
        if not equals and number == 0 and name in PRESETS:
            values |= PRESETS[name]
        elif equals and name in _NAMES:
            unit = "lengths of the part" if name == "overlap" else "times the usual"
            values[name] = Value(name, 1.0, *span(name), unit).parse(value, "style")
        else:
            near = did_you_mean(name, _NAMES if equals else (*PRESETS, *_NAMES))
            raise ArgumentError("style", f"unknown word {word!r}{near}; give {_usage()}")
    return Style(**values)


def _usage() -> str:
    return f"one of {', '.join(PRESETS)}, or numbers such as anticipation=1.3 for {', '.join(_NAMES)}"
