"""The plane on which the object rests: N.x + d = 0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from egs_warp.checked_calls import Finite, checked_constructor, checked_method
from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.frames import orthonormal_basis
from egs_warp.short_repr import short_repr

_UNIT = 1e-3
"""Maximum difference between 1 and the length of a normal."""


@checked_constructor
@dataclass(frozen=True)
class Plane:
    """The plane N.x + d = 0 with |N| = 1 and N pointing to the object's side of the plane, which is up."""

    __repr__ = short_repr

    normal: Annotated[np.ndarray, 3]
    """(3,) float64, unit normal N."""
    offset: Finite
    """Offset d, in the units of x."""

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.normal))
        if abs(length - 1.0) > _UNIT:
            advice = f"its length is {length:g}, not 1; call Plane.from_coefficients, which scales it"
            raise ArgumentError("normal", advice, value=",".join(f"{x:g}" for x in self.normal))

    @classmethod
    @checked_method
    def from_coefficients(cls, nx: float, ny: float, nz: float, d: float) -> Plane:
        """Create the plane nx x + ny y + nz z + d = 0, scaled to a unit normal.

        Raises ``UserError`` for a zero or non-finite normal.
        """
        normal = np.array([nx, ny, nz], dtype=np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            length = float(np.linalg.norm(normal))
        if not np.isfinite([length, d]).all() or length == 0.0:
            raise UserError(
                f"plane {nx},{ny},{nz},{d}: give four finite numbers nx,ny,nz,d with a normal that is not zero"
            )
        return cls(normal / length, float(d) / length)

    def heights(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance (...,) of ``points`` (..., 3) from the plane, positive above."""
        return np.asarray(points, float) @ self.normal + self.offset

    def scaled(self, factor: float) -> Plane:
        """Return the same plane with all lengths multiplied by ``factor``."""
        return Plane(self.normal, self.offset * factor)

    def moved(self, shift: np.ndarray) -> Plane:
        """Return the same plane moved by ``shift`` (3,)."""
        return Plane(self.normal, self.offset - float(self.normal @ shift))

    def tangents(self) -> tuple[np.ndarray, np.ndarray]:
        """Return two unit vectors (3,) that span the plane; (t1, t2, N) is right-handed."""
        return orthonormal_basis(self.normal)
