"""Coulomb coefficients of pairs of materials in a world."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from egs_warp.errors import ArgumentError, UserError, did_you_mean
from egs_warp.pipelines.captured_body import FRICTION_RANGE

GROUND_MATERIAL = "ground"
"""Material of the ground and of the obstacles in a friction table."""


@dataclass(frozen=True)
class FrictionTable:
    """Coulomb coefficients of pairs of materials."""

    coefficients: Mapping[tuple[str, str], float]
    """Coefficient of each pair of materials, in alphabetical order."""

    @classmethod
    def of(cls, entries: Iterable[tuple[tuple[str, str], float]]) -> Self:
        """Check pairs of materials, in any order, and their coefficients.

        Raises ``ArgumentError`` for a coefficient outside ``FRICTION_RANGE``, a pair without a body, or a pair that is
        given twice.
        """
        coefficients: dict[tuple[str, str], float] = {}
        for (first, second), friction in entries:
            pair = (min(first, second), max(first, second))
            if friction not in FRICTION_RANGE:
                raise ArgumentError(
                    "frictions", f"give {FRICTION_RANGE.described('a number')}", value=f"{_text(pair)}: {friction}"
                )
            if pair == (GROUND_MATERIAL, GROUND_MATERIAL):
                raise ArgumentError(
                    "frictions", "the ground does not move; give the material of a body", value=_text(pair)
                )
            if pair in coefficients:
                raise ArgumentError("frictions", "the pair is given twice; give it once", value=_text(pair))
            coefficients[pair] = float(friction)
        return cls(coefficients)

    @property
    def materials(self) -> list[str]:
        """The materials of bodies, in alphabetical order."""
        return sorted({each for pair in self.coefficients for each in pair} - {GROUND_MATERIAL})

    def check(self, name: str, material: str | None) -> None:
        """Raise ``UserError`` if the ``material`` of the body ``name`` is neither None nor in the table."""
        known = self.materials
        if material is not None and material not in known:
            given = f"give one of {', '.join(known)}" if known else "give frictions with this material to the world"
            raise UserError(
                f"{name}: no friction is given for the material {material!r}{did_you_mean(material, known)}; {given}"
            )

    def between(self, first: str | None, second: str | None) -> float | None:
        """Return the coefficient of two materials; None if the table does not contain the pair."""
        if first is None or second is None:
            return None
        return self.coefficients.get((min(first, second), max(first, second)))

    def matrix(self, materials: Sequence[str | None], others: Iterable[float]) -> np.ndarray:
        """Return the coefficients (k, k) between bodies.

        Args:
            materials: material of each of the k bodies.
            others: coefficient of each body for pairs that the table does not contain; the geometric mean of the
                coefficients of both bodies is used.
        """
        own = np.array([*others], float)
        result = np.sqrt(np.outer(own, own))
        for i, first in enumerate(materials):
            for k, second in enumerate(materials):
                given = self.between(first, second)
                result[i, k] = result[i, k] if given is None else given
        return result


def _text(pair: tuple[str, str]) -> str:
    return " and ".join(pair)
