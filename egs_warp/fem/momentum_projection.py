"""Rank-3 correction with which the solutions of a step's matrix conserve angular momentum (Eq. 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class MomentumProjection:
    """Correction by rigid rotations that gives solutions the angular momenta of their right-hand sides."""

    rotation_modes: np.ndarray
    """(n, 3) rigid rotations T, as nodal velocities."""
    mode_momenta: np.ndarray
    """(n, 3) M T; (M T)^T v is the angular momentum of velocities v."""
    inertia_ratio: float
    """Factor of the angular momentum of a solution, 1 + dt alpha."""
    rotation_response: np.ndarray
    """(n, 3) U, solutions for the right-hand sides M T."""
    inverse: np.ndarray
    """(3, 3) inverse of inertia_ratio (M T)^T U."""

    def corrected(self, right: np.ndarray, plain: np.ndarray) -> np.ndarray:
        """Return the corrected solution.

        Args:
            right: (n,) or (n, m) right-hand sides.
            plain: solutions for them, of the same shape.
        """
        missing = self.rotation_modes.T @ right - self.inertia_ratio * (self.mode_momenta.T @ plain)
        return plain + self.rotation_response @ (self.inverse @ missing)
