"""Coulomb coefficients of pairs of materials in a world."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Self, TypeGuard

import numpy as np

from egs_warp.contact.detection import mean_frictions
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
    def of(cls, entries: Iterable[tuple[object, object]]) -> Self:
        """Check pairs of materials, in any order, and their coefficients.

        Raises ``ArgumentError`` for a key that is not a tuple of two names, a coefficient that is not a number in
        ``FRICTION_RANGE``, a pair without a body, or a pair that is given twice.
        """
        coefficients: dict[tuple[str, str], float] = {}
        for key, friction in entries:
            if not _is_pair(key):
                raise ArgumentError(
                    "frictions", 'give a pair of materials as the key, such as ("ice", "rubber")', value=repr(key)
                )
            pair = (min(key), max(key))
            if not isinstance(friction, Real) or isinstance(friction, bool) or friction not in FRICTION_RANGE:
                given = friction if isinstance(friction, Real) else repr(friction)
                raise ArgumentError(
                    "frictions", f"give {FRICTION_RANGE.described('a number')}", value=f"{_text(pair)}: {given}"
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

    def unused_notes(self, bodies: Sequence[tuple[str | None, bool]]) -> tuple[str, ...]:
        """Return a note for each material without a body, and for each material that has a coefficient with itself and
        a single body.

        Args:
            bodies: material of each body, and True if the parts of the body touch each other.
        """
        counts = Counter(material for material, _ in bodies)
        touch_themselves = {material for material, self_contact in bodies if self_contact}
        notes = [
            f"no body has the material {material!r}, so its frictions are not used"
            for material in self.materials
            if not counts[material]
        ]
        for first, second in self.coefficients:
            if first == second and counts[first] == 1 and first not in touch_themselves:
                notes.append(f"only one body has the material {first!r}, so its friction with itself is not used")
        return tuple(notes)

    def between(self, first: str | None, second: str | None) -> float | None:
        """Return the coefficient of two materials; None if the table does not contain the pair."""
        if first is None or second is None:
            return None
        return self.coefficients.get((min(first, second), max(first, second)))

    def matrix(self, materials: Sequence[str | None], others: Iterable[float]) -> np.ndarray:
        """Return the coefficients (k, k) between bodies.

        Args:
            materials: material of each of the k bodies.
            others: coefficient of each body for pairs that the table does not contain (``mean_frictions``).
        """
        result = mean_frictions([*others])
        for i, first in enumerate(materials):
            for k, second in enumerate(materials):
                given = self.between(first, second)
                result[i, k] = result[i, k] if given is None else given
        return result


def _is_pair(key: object) -> TypeGuard[tuple[str, str]]:
    return isinstance(key, tuple) and len(key) == 2 and all(isinstance(each, str) and each for each in key)


def _text(pair: tuple[str, str]) -> str:
    return " and ".join(pair)
