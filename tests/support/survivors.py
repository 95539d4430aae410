"""Mutants that no test can kill, or none need kill, each with its reason: ``make mutation`` counts them apart."""

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


SURVIVORS: list[Survivor] = [
    Survivor(
        "contact/coulomb.py",
        'wp.array(np.ascontiguousarray(value), device="cpu", copy=False) for value in (delassus, free_velocity, shift)',
        'wp.array(np.ascontiguousarray(value), device="cpu", copy=True) for value in (delassus, free_velocity, shift)',
        "a copy of what is only read",
    ),
    Survivor(
        "contact/coulomb.py",
        "if np.linalg.norm(trial_value / rate[:, None]) < (1.0 - 1e-4 * length) * np.linalg.norm(",
        "if np.linalg.norm(trial_value / rate[:, None]) < (1.0 + 1e-4 * length) * np.linalg.norm(",
        "a step that is worse by a ten-thousandth is gone on from, but the best forces so far are what comes out",
    ),
    Survivor(
        "contact/detection.py",
        "_SHORTENINGS = 40",
        "_SHORTENINGS = 39",
        "halving 39 times ends an arm 2e-12 of its length from the ground, 40 times 1e-12",
    ),
    Survivor(
        "fem/elasticity.py",
        "self._no_gradients = empty(0, Mat33, device)",
        "self._no_gradients = empty( 1, Mat33, device)",
        "it stands in for an array that no kernel reads without damping",
    ),
    Survivor(
        "kernels/deformation/embedding.py",
        "if vb <= real(0.0) and d2 >= real(0.0) and d6 <= real(0.0):",
        "if vb < real(0.0) and d2 >= real(0.0) and d6 <= real(0.0):",
        "on the boundary of two cases both give the same point of the triangle",
    ),
    Survivor(
        "kernels/deformation/embedding.py",
        "if weights[3] < real(0.0):",
        "if weights[3] <= real(0.0):",
        "one more face is looked at, to which the distance is never less than that to the nearest",
    ),
    Survivor(
        "locomotion/strategies.py",
        "def within(self, factor: float, share: float = 0.0) -> bool:",
        "def within(self, factor: float, share: float = -1.0) -> bool:",
        "the bound is a sum of squares and the factor at least one: the factor's side of the maximum decides",
    ),
]


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
