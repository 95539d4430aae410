"""Mutants that no test can or needs to kill, each with its reason; ``make mutation`` counts them separately."""

from __future__ import annotations

from tests.support.mutants import Mutant
from tests.support.surviving_mutants.contact import CONTACT
from tests.support.surviving_mutants.deformation import DEFORMATION
from tests.support.surviving_mutants.fem import FEM
from tests.support.surviving_mutants.locomotion import LOCOMOTION
from tests.support.surviving_mutants.segmentation import SEGMENTATION
from tests.support.surviving_mutants.survivor import Survivor

SURVIVORS: list[Survivor] = [*CONTACT, *LOCOMOTION, *FEM, *DEFORMATION, *SEGMENTATION]


def reason_for(mutant: Mutant) -> str | None:
    """Return the reason why this mutant may survive, or None if it must be killed."""
    for survivor in SURVIVORS:
        if (f"egs_warp/{survivor.file}", survivor.before, survivor.after) == (
            mutant.file,
            mutant.before,
            mutant.after,
        ):
            return survivor.reason
    return None
