"""Mutants that no test can kill, or none need kill, each with its reason: ``tests/mutation.py`` counts them apart."""

from __future__ import annotations

from dataclasses import dataclass

from tests.support.mutants import Mutant


@dataclass(frozen=True)
class Survivor:
    """A line that may change so."""

    file: str
    """Of the package."""
    before: str
    after: str
    reason: str


SURVIVORS: list[Survivor] = []


def reason_for(mutant: Mutant) -> str | None:
    """Why this mutant may live; None where it may not."""
    for survivor in SURVIVORS:
        if (f"egs_warp/{survivor.file}", survivor.before, survivor.after) == (
            mutant.file,
            mutant.before,
            mutant.after,
        ):
            return survivor.reason
    return None
