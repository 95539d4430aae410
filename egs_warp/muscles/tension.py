"""Nodal forces of muscle activations (Eq. 7): as an energy in the equation of motion, and as columns of the quadratic
program.

The kernel is in ``egs_warp.kernels.muscles.impulses``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.kernels.muscles.impulses import impulses_kernel
from egs_warp.launching import copy_into, device_of, launch_cached, zeros
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.precision import Vec3, real

LENGTH_FULL_FORCE, LENGTH_ZERO_FORCE = 0.7, 0.3
"""Relative length above which a segment exerts its full tension, and relative length below which it exerts none."""


def segment_vectors(rows: sparse.csr_matrix, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vectors and lengths of segments.

    Args:
        rows: (M, N) difference rows.
        positions: (N, 3) m, node positions.

    Returns:
        Vectors (M, 3) m, and lengths (M,) m of at least 1e-300, so that a segment with coincident ends has direction 0.
    """
    vectors = rows @ positions
    return vectors, np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)


def shortening(muscles: MuscleSet, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the shortening (M,) m of the segments from the positions ``start`` (N, 3) to ``end`` (N, 3)."""
    rows = muscles.difference_rows
    return segment_vectors(rows, start)[1] - segment_vectors(rows, end)[1]


def force_length_factor(shortened: Any) -> tuple[Any, Any, Any]:
    """Return the force-length factor phi, its integral from 0, and its derivative at the relative lengths
    ``shortened``, which are a NumPy array or a tensor.

    A strongly shortened muscle exerts less force. This is the ascending limb of the force-length relation (Gordon,
    Huxley and Julian 1966), here a smooth step from ``LENGTH_ZERO_FORCE`` to ``LENGTH_FULL_FORCE``. A constant tension
    could pull both ends of a segment together into one point, where its force would have no direction and the step no
    solution.
    """
    width = LENGTH_FULL_FORCE - LENGTH_ZERO_FORCE
    along = ((shortened - LENGTH_ZERO_FORCE) / width).clip(0.0, 1.0)
    integral = width * along**3 * (1.0 - 0.5 * along) + (shortened - LENGTH_FULL_FORCE).clip(0.0, None)
    return along**2 * (3.0 - 2.0 * along), integral, 6.0 * along * (1.0 - along) / width


def segment_stiffnesses(tensions: Any, lengths: Any, rest_lengths: Any) -> tuple[Any, Any]:
    """Return the transverse and the axial stiffness of segments, N/m, as arrays or tensors.

    The transverse stiffness is the tension divided by the length. The axial stiffness is the derivative of the tension
    with respect to the length, which is 0 at full force.
    """
    share, _, slope = force_length_factor(lengths / rest_lengths)
    return tensions * share / lengths, tensions * slope / rest_lengths


def activation_jacobian(muscles: MuscleSet, positions: np.ndarray) -> sparse.csc_matrix:
    """Return A(p) of Eq. (7), (3N, M) N/m: nodal forces per metre of activation, at node ``positions`` (N, 3).

    Column j is k_j phi (B_i^T u - B_k^T u), where u is the unit vector from end i to end k; a_j > 0 contracts.
    """
    rows = muscles.difference_rows
    vectors, lengths = segment_vectors(rows, positions)
    share, _, _ = force_length_factor(lengths / muscles.rest_lengths)
    pulls = -(muscles.stiffness * share)[:, None] * (vectors / lengths[:, None])
    entries = rows.data[:, None] * np.repeat(pulls, np.diff(rows.indptr), axis=0)
    # Each entry of a segment's row gives three entries of the segment's column, for x, y and z of the node.
    nodes = (3 * rows.indices[:, None] + np.arange(3)).ravel()
    return sparse.csc_matrix(
        (entries.ravel(), nodes, 3 * rows.indptr), shape=(3 * muscles.node_count, len(rows.indptr) - 1)
    )


class SynergyColumns:
    """Impulse columns of groups of segments that share an activation, computed on the host into reused memory."""

    def __init__(self, muscles: MuscleSet, group_from_muscle: np.ndarray) -> None:
        """Create the index maps; ``group_from_muscle`` (M,) is the group of each segment, from 0 to m - 1."""
        rows, self._count = muscles.difference_rows, int(group_from_muscle.max(initial=-1)) + 1
        order = np.argsort(group_from_muscle, kind="stable")
        offsets = np.searchsorted(group_from_muscle[order], np.arange(self._count + 1))
        self._maps = [
            *(wp.array(part.astype(np.int32), dtype=int, device="cpu") for part in (offsets, order)),
            *(wp.array(part.astype(np.int32), dtype=int, device="cpu") for part in (rows.indptr, rows.indices)),
            *(
                wp.array(part, dtype=real, device="cpu")
                for part in (rows.data, muscles.stiffness * muscles.bounds, muscles.rest_lengths)
            ),
            *(LENGTH_ZERO_FORCE, LENGTH_FULL_FORCE),
        ]
        self._positions = zeros(muscles.node_count, Vec3, "cpu")
        self._impulses = np.zeros((self._count + 1, 3 * muscles.node_count))
        self._rows = wp.array(self._impulses.reshape(len(self._impulses), -1, 3), dtype=Vec3, device="cpu", copy=False)

    def with_base(self, other: np.ndarray, positions: np.ndarray, dt: float) -> np.ndarray:
        """Return the impulses of each group at the bounds of its activations, and ``other`` as the last column.

        Args:
            other: (3N,) N s, another impulse.
            positions: (N, 3) m, node positions.
            dt: step size, s.

        Returns:
            (3N, m + 1) N s; the next call overwrites this array.
        """
        copy_into(self._positions, positions)
        launch_cached(
            impulses_kernel,
            self._count,
            inputs=[*self._maps, self._positions, dt],
            outputs=[self._rows],
            device=device_of(self._positions),
        )
        self._impulses[-1] = other
        return self._impulses.T


@dataclass(frozen=True)
class MuscleEnergy:
    """Energy of muscle segments with constant tensions T over a step.

    V(p) = sum_j T_j L_j Phi(|D_j p| / L_j), with the segment vectors D_j p, rest lengths L_j and the integral Phi of
    phi (``force_length_factor``). If all relative lengths are at least ``LENGTH_FULL_FORCE``, V is sum_j T_j |D_j p|
    plus a constant.

    The negative gradient at ``p`` is the force of Eq. (7), which rotates with the body. Forces with fixed directions,
    those at the start of the step, would be dead loads: they would lack the transverse stiffness T / L of the tension,
    and slender parts would buckle under muscles that in reality keep them straight.
    """

    rows: sparse.csr_matrix
    """(M, N) difference rows D."""
    tensions: np.ndarray
    """(M,) N, tensions, positive for segments that contract."""
    rest_lengths: np.ndarray
    """(M,) m, lengths at rest."""

    @classmethod
    def of(cls, muscles: MuscleSet, activations: np.ndarray) -> MuscleEnergy:
        """Build the energy of all segments at ``activations`` (M,) m."""
        return cls(muscles.difference_rows, muscles.stiffness * activations, muscles.rest_lengths)

    @cached_property
    def _ends(self) -> sparse.csr_matrix:
        return self.rows.T.tocsr()

    def energy(self, positions: np.ndarray) -> float:
        """Return V at node ``positions`` (N, 3), J."""
        _, lengths = segment_vectors(self.rows, positions)
        return float((self.tensions * self.rest_lengths) @ force_length_factor(lengths / self.rest_lengths)[1])

    def gradient(self, positions: np.ndarray) -> np.ndarray:
        """Return the gradient (N, 3) N of V with respect to the positions; its negative is the force of the muscles."""
        vectors, lengths = segment_vectors(self.rows, positions)
        share, _, _ = force_length_factor(lengths / self.rest_lengths)
        return self._ends @ ((self.tensions * share / lengths)[:, None] * vectors)

    def hessian(self, positions: np.ndarray) -> TensionHessian:
        """Return the Hessian of V at node ``positions`` (N, 3)."""
        vectors, lengths = segment_vectors(self.rows, positions)
        stiffnesses = segment_stiffnesses(self.tensions, lengths, self.rest_lengths)
        return TensionHessian(self.rows, vectors / lengths[:, None], *stiffnesses)


@dataclass(frozen=True)
class TensionHessian:
    """Hessian K = sum_j D_j^T (r_j (I - u_j u_j^T) + s_j u_j u_j^T) D_j, in factored form.

    K is never assembled, because the end points of a segment are attached to dozens of nodes.
    """

    rows: sparse.csr_matrix
    """(M, N) difference rows D."""
    directions: np.ndarray
    """(M, 3), u, unit vectors of the segments."""
    transverse_stiffness: np.ndarray
    """(M,), r, N/m, tension divided by length."""
    axial_stiffness: np.ndarray
    """(M,), s, N/m, derivative of the tension with respect to the length; 0 at full force."""

    def factors(self, *, min_relative_stiffness: float) -> tuple[np.ndarray, np.ndarray]:
        """Return U (3N, n) and rates (n,) N/m with K = U diag(rates) U^T, for the terms of ``rank_one_terms``."""
        segments, directions, rates = self.rank_one_terms(min_relative_stiffness=min_relative_stiffness)
        rows = self.rows[segments].toarray()
        return np.einsum("mn,mi->nim", rows, directions).reshape(3 * rows.shape[1], len(segments)), rates

    def rank_one_terms(self, *, min_relative_stiffness: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the rank-1 terms of which K is the sum: two transverse directions and the axis of each segment.

        Args:
            min_relative_stiffness: terms with a stiffness of at most this fraction of the maximum are dropped.

        Returns:
            Indices of the segments (n,), unit vectors (n, 3), and stiffnesses (n,) N/m of the terms.
        """
        axis = np.eye(3)[np.argmin(np.abs(self.directions), axis=1)]
        first = np.cross(self.directions, axis)
        first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
        frames = np.stack([first, np.cross(self.directions, first), self.directions], axis=1)
        rates = np.stack([self.transverse_stiffness, self.transverse_stiffness, self.axial_stiffness], axis=1)
        segments, which = np.nonzero(np.abs(rates) > min_relative_stiffness * np.abs(rates).max(initial=1e-300))
        return segments, frames[segments, which], rates[segments, which]
