"""From an activation to the force on each node (Eq. 7): an energy while the body moves, columns for the program."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse

from egs_warp.muscles.muscle_set import MuscleSet


def lines(rows: sparse.csr_matrix, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M, 3) vectors in metres between the ends of segments with difference ``rows`` (M, N) at node ``positions``
    (N, 3), and their lengths (M,); a segment whose ends coincide has length 1, so that it pulls nothing.
    """
    vectors = rows @ positions
    lengths = np.linalg.norm(vectors, axis=1)
    return vectors, np.where(lengths > 0.0, lengths, 1.0)


def muscle_columns(muscles: MuscleSet, positions: np.ndarray) -> sparse.csc_matrix:
    """A(p) of Eq. (7), (3N, M): newtons on each node's axes for each metre of activation, at node ``positions`` (N, 3).

    Column j is k_j (B_i^T u - B_k^T u), u the unit vector from end i to end k: a_j > 0 contracts.
    """
    rows = muscles.difference_rows
    vectors, lengths = lines(rows, positions)
    pulls = -muscles.stiffness[:, None] * (vectors / lengths[:, None])
    entries = rows.data[:, None] * np.repeat(pulls, np.diff(rows.indptr), axis=0)
    # One entry of a segment's row is three of its column: x, y and z of the node.
    nodes = (3 * rows.indices[:, None] + np.arange(3)).ravel()
    return sparse.csc_matrix(
        (entries.ravel(), nodes, 3 * rows.indptr), shape=(3 * muscles.node_count, len(rows.indptr) - 1)
    )


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
    def _ends(self) -> sparse.csr_matrix:
        return self.rows.T.tocsr()

    def gradient(self, positions: np.ndarray) -> np.ndarray:
        """(N, 3) newtons: the derivative of V by the positions, minus the force of the muscles."""
        vectors, lengths = lines(self.rows, positions)
        return self._ends @ ((self.tensions / lengths)[:, None] * vectors)

    def hessian(self, positions: np.ndarray) -> TensionHessian:
        """The second derivative of V at ``positions``."""
        vectors, lengths = lines(self.rows, positions)
        return TensionHessian(self.rows, vectors / lengths[:, None], self.tensions / lengths)


@dataclass(frozen=True)
class TensionHessian:
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
