"""Record of a mutant that may survive."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Survivor:
    """Line, its change, and the reason why the mutant may survive."""

    file: str
    """File of the package."""
    before: str
    after: str
    reason: str
