"""How a jump is acted: numbers an animator knows, 1 being what egs_warp does by itself (docs/motions/style.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

from egs_warp.errors import ArgumentError
from egs_warp.motions.values import Value

LEAST, MOST = 0.5, 2.0
"""Of each number: beyond, the stroke of a jump is none that a body could make."""


@dataclass(frozen=True)
class Style:
    """Factors."""

    anticipation: float = 1.0
    """Of depth and time of a crouch."""
    squash: float = 1.0
    """Of the time in which a landing is stopped, and so of how far it gives way."""
    timing: float = 1.0
    """Of the time of crouch and thrust: below 1 they are quick and hard."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not LEAST <= value <= MOST:
                raise ArgumentError(name, f"give a number from {LEAST:g} to {MOST:g}", value=value)

    def __str__(self) -> str:
        """As ``read_style`` reads it: a preset's name, or all numbers."""
        values = vars(self)
        same = [name for name, preset in PRESETS.items() if preset == values]
        return same[0] if same else " ".join(f"{name}={value!r}" for name, value in values.items())


PRESETS: Mapping[str, Mapping[str, float]] = {
    "light": {"anticipation": 0.8, "squash": 0.7, "timing": 0.8},
    "heavy": {"anticipation": 1.3, "squash": 1.4, "timing": 1.25},
    "rubbery": {"anticipation": 1.5, "squash": 1.8, "timing": 1.0},
}
_NAMES = tuple(field.name for field in fields(Style))


def read_style(text: str) -> Style:
    """Of a line such as ``heavy`` or ``anticipation=1.3 squash=1.2``; numbers go before those of the preset.

    Raises ``UserError`` for the first mistake.
    """
    values: dict[str, float] = {}
    words = text.replace(",", " ").split()
    if not words:
        raise ArgumentError("style", f"nothing is given; give {_usage()}")
    for number, word in enumerate(words):
        name, equals, value = word.partition("=")
        if not equals and number == 0 and name in PRESETS:
            values |= PRESETS[name]
        elif equals and name in _NAMES:
            values[name] = Value(name, 1.0, LEAST, MOST, "times the usual").parse(value, "style")
        else:
            raise ArgumentError("style", f"unknown word {word!r}; give {_usage()}")
    return Style(**values)


def _usage() -> str:
    return f"one of {', '.join(PRESETS)}, or numbers as anticipation=1.3, of {', '.join(_NAMES)}"
