"""Angular momentum that the solutions of a step's matrix keep (Eq. 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class MomentumProjection:
    """Angular momentum that solutions keep: so much of a turn is added to each that it has that of what is given."""

    rotation_modes: np.ndarray
    """(n, 3) rigid turns T."""
    mode_momenta: np.ndarray
    """(n, 3) M T: angular momenta of velocities."""
    inertia_ratio: float
    """By which those of a solution count."""
    rotation_response: np.ndarray
    """(n, 3) solutions U of the ``momenta``."""
    inverse: np.ndarray
    """(3, 3) of ratio (M T)^T U."""

    def corrected(self, right: np.ndarray, plain: np.ndarray) -> np.ndarray:
        """Of ``right`` (n,) or (n, m) the solution ``plain``, and the turn that it lacks."""
        missing = self.rotation_modes.T @ right - self.inertia_ratio * (self.mode_momenta.T @ plain)
        return plain + self.rotation_response @ (self.inverse @ missing)
