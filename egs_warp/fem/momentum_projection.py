"""Rank-3 correction that makes solutions with a step's matrix conserve angular momentum (Eq. 4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Self

import numpy as np

from egs_warp.fem.batched import ArrayT, BatchedRecord, array_module


@dataclass(frozen=True, eq=False)
class MomentumProjection(BatchedRecord, Generic[ArrayT]):
    """Correction of solutions by rigid rotations that gives them the angular momenta of their right-hand sides.

    Arrays are NumPy arrays or PyTorch tensors, also with a leading world axis.
    """

    rotation_modes: ArrayT
    """(n, 3) rigid rotations T, as nodal velocities."""
    mode_momenta: ArrayT
    """(n, 3) M T; (M T)^T v is the angular momentum of velocities v."""
    inertia_ratio: float
    """Factor of the angular momentum of a solution, 1 + dt alpha."""
    rotation_response: ArrayT
    """(n, 3) U, solutions for the right-hand sides M T."""
    inverse: ArrayT
    """(3, 3) inverse of inertia_ratio (M T)^T U."""

    @classmethod
    def of(cls, rotation_modes: ArrayT, mode_momenta: ArrayT, inertia_ratio: float, rotation_response: ArrayT) -> Self:
        """Build the projection; arguments as the fields. With PyTorch tensors, the inverse of a singular matrix is not
        finite, because an exception would stop all worlds."""
        matrix = inertia_ratio * mode_momenta.swapaxes(-1, -2) @ rotation_response
        linalg = array_module(matrix).linalg
        inverse = linalg.inv(matrix) if linalg is np.linalg else linalg.inv_ex(matrix).inverse
        return cls(rotation_modes, mode_momenta, inertia_ratio, rotation_response, inverse)

    def corrected(self, right: ArrayT, plain: ArrayT) -> ArrayT:
        """Return the corrected solution.

        Args:
            right: (n, m) right-hand sides, or (n,).
            plain: solutions for them, of the same shape.
        """
        modes, momenta = self.rotation_modes.swapaxes(-1, -2), self.mode_momenta.swapaxes(-1, -2)
        missing = modes @ right - self.inertia_ratio * (momenta @ plain)
        return plain + self.rotation_response @ (self.inverse @ missing)
