"""Angular momentum that the solutions of a step's matrix keep (Eq. 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Kept:
    """Angular momentum that solutions keep: so much of a turn is added to each that it has that of what is given."""

    turns: np.ndarray
    """(n, 3) rigid turns T."""
    momenta: np.ndarray
    """(n, 3) M T: angular momenta of velocities."""
    ratio: float
    """By which those of a solution count."""
    turned: np.ndarray
    """(n, 3) solutions U of the ``momenta``."""
    inverse: np.ndarray
    """(3, 3) of ratio (M T)^T U."""

    def corrected(self, right: np.ndarray, plain: np.ndarray) -> np.ndarray:
        """Of ``right`` (n,) or (n, m) the solution ``plain``, and the turn that it lacks."""
        missing = self.turns.T @ right - self.ratio * (self.momenta.T @ plain)
        return plain + self.turned @ (self.inverse @ missing)
