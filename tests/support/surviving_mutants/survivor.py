"""A mutant that may survive."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Survivor:
    """A line, its change, and the reason why it may survive."""

    file: str
    """File of the package."""
    before: str
    after: str
    reason: str
