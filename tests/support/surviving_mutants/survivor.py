"""A mutant that may live."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Survivor:
    """A line that may change so."""

    file: str
    """Of the package."""
    before: str
    after: str
    reason: str
