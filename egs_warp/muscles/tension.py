"""Muscles that pull along the line between their ends while the body moves: an energy, not a dead load."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse

from egs_warp.muscles.muscle_set import MuscleSet


@dataclass(frozen=True)
class MuscleTension:
    """Segments that pull with constant tensions T over a step: V(p) = sum_j T_j |D_j p|, D_j p the vector between the
    ends.

    Its force is that of Eq. (7) at ``p``, so it turns with the body. Forces that keep the direction of the step's start
    instead are dead loads: they press on the elements without the tension's own stiffness T / L across the line, and
    slender parts buckle under muscles that in truth hold them straight.
    """

    rows: sparse.csr_matrix
    """(M, N) D."""
    tensions: np.ndarray
    """(M,) newtons, positive where the segment contracts."""

    @classmethod
    def of(cls, muscles: MuscleSet, activations: np.ndarray) -> MuscleTension:
        """Of all segments at ``activations`` (M,) metres."""
        return cls(muscles.difference_rows, muscles.stiffness * activations)

    @cached_property
    def _columns(self) -> sparse.csr_matrix:
        return self.rows.T.tocsr()

    def forces(self, positions: np.ndarray) -> np.ndarray:
        """(N, 3) newtons, minus the derivative of V."""
        vectors = self.rows @ positions
        lengths = np.linalg.norm(vectors, axis=1)
        return -(self._columns @ ((self.tensions / np.where(lengths > 0.0, lengths, 1.0))[:, None] * vectors))

    def stiffness(self, positions: np.ndarray) -> TensionStiffness:
        """The second derivative of V at ``positions``."""
        vectors = self.rows @ positions
        lengths = np.linalg.norm(vectors, axis=1)
        held = np.where(lengths > 0.0, lengths, 1.0)
        return TensionStiffness(self.rows, vectors / held[:, None], self.tensions / held)


@dataclass(frozen=True)
class TensionStiffness:
    """K = sum_j T_j / L_j D_j^T (I - u_j u_j^T) D_j, never formed: the ends are spread over dozens of nodes."""

    rows: sparse.csr_matrix
    """(M, N)."""
    directions: np.ndarray
    """(M, 3) u."""
    rates: np.ndarray
    """(M,) T / L, N/m."""

    def factors(self, *, least: float) -> tuple[np.ndarray, np.ndarray]:
        """U (3N, 2m) and rates (2m,) with K = U diag(rates) U^T: two directions across each of the m segments whose
        rate is above ``least`` of the largest.
        """
        kept = np.flatnonzero(np.abs(self.rates) > least * np.abs(self.rates).max(initial=1e-300))
        along = self.directions[kept]
        axis = np.eye(3)[np.argmin(np.abs(along), axis=1)]
        first = np.cross(along, axis)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        across = np.stack([first, np.cross(along, first)], axis=1)
        rows = self.rows[kept].toarray()
        U = np.einsum("mn,mci->nimc", rows, across).reshape(3 * rows.shape[1], 2 * len(kept))
        return U, np.repeat(self.rates[kept], 2)
