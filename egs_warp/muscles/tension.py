"""From an activation to the force on each node (Eq. 7): an energy while the body moves, columns for the program."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.kernels.muscles.impulses import impulses_kernel
from egs_warp.launching import copy_into, device_of, launch_cached, zeros
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.precision import Vec3, real

LENGTH_FULL_FORCE, LENGTH_ZERO_FORCE = 0.7, 0.3
"""Of its rest length: a segment that is at least so long pulls with all its tension, one at most so long not at all."""


def segment_vectors(rows: sparse.csr_matrix, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M, 3) vectors in metres between the ends of segments with difference ``rows`` (M, N) at node ``positions``
    (N, 3), and their lengths (M,); a segment whose ends coincide has length 1e-300, and a direction of 0.
    """
    vectors = rows @ positions
    return vectors, np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)


def shortening(muscles: MuscleSet, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(M,) metres by which segments are shorter at node positions ``end`` (N, 3) than at ``start`` (N, 3)."""
    rows = muscles.difference_rows
    return segment_vectors(rows, start)[1] - segment_vectors(rows, end)[1]


def force_length_factor(shortened: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """phi, its integral from 0 and its derivative, each (M,), at lengths over rest lengths ``shortened`` (M,).

    A muscle that has shortened far pulls less: the ascending limb of the force-length relation (Gordon, Huxley and
    Julian 1966), here a smooth step from SLACK to FULL. With a tension that no length changes, two ends that are drawn
    together meet in a point where the force has no direction, and no step has an end there.
    """
    width = LENGTH_FULL_FORCE - LENGTH_ZERO_FORCE
    along = np.clip((shortened - LENGTH_ZERO_FORCE) / width, 0.0, 1.0)
    integral = width * along**3 * (1.0 - 0.5 * along) + np.maximum(shortened - LENGTH_FULL_FORCE, 0.0)
    return along**2 * (3.0 - 2.0 * along), integral, 6.0 * along * (1.0 - along) / width


def activation_jacobian(muscles: MuscleSet, positions: np.ndarray) -> sparse.csc_matrix:
    """A(p) of Eq. (7), (3N, M): newtons on each node's axes for each metre of activation, at node ``positions`` (N, 3).

    Column j is k_j phi (B_i^T u - B_k^T u), u the unit vector from end i to end k: a_j > 0 contracts.
    """
    rows = muscles.difference_rows
    vectors, lengths = segment_vectors(rows, positions)
    share, _, _ = force_length_factor(lengths / muscles.rest_lengths)
    pulls = -(muscles.stiffness * share)[:, None] * (vectors / lengths[:, None])
    entries = rows.data[:, None] * np.repeat(pulls, np.diff(rows.indptr), axis=0)
    # One entry of a segment's row is three of its column: x, y and z of the node.
    nodes = (3 * rows.indices[:, None] + np.arange(3)).ravel()
    return sparse.csc_matrix(
        (entries.ravel(), nodes, 3 * rows.indptr), shape=(3 * muscles.node_count, len(rows.indptr) - 1)
    )


class SynergyColumns:
    """Columns of groups of segments that act together, over a step: kernel, index maps and memory, on the host."""

    def __init__(self, muscles: MuscleSet, group_from_muscle: np.ndarray) -> None:
        """``group_from_muscle`` (M,) from 0 to m - 1."""
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
        """(3N, m + 1) N s over ``dt`` seconds at node ``positions`` (N, 3), of each group at its bounds, and last
        ``other`` (3N,); overwritten the next time."""
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
    """Segments that pull with constant tensions T over a step: V(p) = sum_j T_j L_j Phi(|D_j p| / L_j), D_j p the
    vector between the ends, L_j its length at rest, Phi the integral of phi (``shares_of_tension``): where no segment
    is shorter than FULL of that, sum_j T_j |D_j p| and a constant.

    Its force is that of Eq. (7) at ``p``, so it turns with the body. Forces that keep the direction of the step's start
    instead are dead loads: they press on the elements without the tension's own stiffness T / L across the line, and
    slender parts buckle under muscles that in truth hold them straight.
    """

    rows: sparse.csr_matrix
    """(M, N) D."""
    tensions: np.ndarray
    """(M,) newtons, positive where the segment contracts."""
    rest_lengths: np.ndarray
    """(M,) metres."""

    @classmethod
    def of(cls, muscles: MuscleSet, activations: np.ndarray) -> MuscleEnergy:
        """Of all segments at ``activations`` (M,) metres."""
        return cls(muscles.difference_rows, muscles.stiffness * activations, muscles.rest_lengths)

    @cached_property
    def _ends(self) -> sparse.csr_matrix:
        return self.rows.T.tocsr()

    def energy(self, positions: np.ndarray) -> float:
        """Joules, V at node ``positions`` (N, 3)."""
        _, lengths = segment_vectors(self.rows, positions)
        return float((self.tensions * self.rest_lengths) @ force_length_factor(lengths / self.rest_lengths)[1])

    def gradient(self, positions: np.ndarray) -> np.ndarray:
        """(N, 3) newtons: the derivative of V by the positions, minus the force of the muscles."""
        vectors, lengths = segment_vectors(self.rows, positions)
        share, _, _ = force_length_factor(lengths / self.rest_lengths)
        return self._ends @ ((self.tensions * share / lengths)[:, None] * vectors)

    def hessian(self, positions: np.ndarray) -> TensionHessian:
        """The second derivative of V at ``positions``."""
        vectors, lengths = segment_vectors(self.rows, positions)
        share, _, slope = force_length_factor(lengths / self.rest_lengths)
        return TensionHessian(
            *(self.rows, vectors / lengths[:, None], self.tensions * share / lengths),
            self.tensions * slope / self.rest_lengths,
        )


@dataclass(frozen=True)
class TensionHessian:
    """K = sum_j D_j^T (r_j (I - u_j u_j^T) + s_j u_j u_j^T) D_j, never formed: the ends are spread over dozens of
    nodes.
    """

    rows: sparse.csr_matrix
    """(M, N)."""
    directions: np.ndarray
    """(M, 3) u."""
    transverse_stiffness: np.ndarray
    """(M,) r, tension over length, N/m."""
    axial_stiffness: np.ndarray
    """(M,) s, how much more tension a metre of length gives, N/m; 0 where none is so short that it loses any."""

    def factors(self, *, min_relative_stiffness: float) -> tuple[np.ndarray, np.ndarray]:
        """U (3N, n) and rates (n,) with K = U diag(rates) U^T, of the ``ways``."""
        segments, ways, rates = self.rank_one_terms(min_relative_stiffness=min_relative_stiffness)
        rows = self.rows[segments].toarray()
        return np.einsum("mn,mi->nim", rows, ways).reshape(3 * rows.shape[1], len(segments)), rates

    def rank_one_terms(self, *, min_relative_stiffness: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Segments (n,), unit vectors (n, 3) and rates (n,) of which K is the sum: of each segment two directions
        across it and the one along it, where its rate is above ``least`` of the largest.
        """
        axis = np.eye(3)[np.argmin(np.abs(self.directions), axis=1)]
        first = np.cross(self.directions, axis)
        first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
        frames = np.stack([first, np.cross(self.directions, first), self.directions], axis=1)
        rates = np.stack([self.transverse_stiffness, self.transverse_stiffness, self.axial_stiffness], axis=1)
        segments, which = np.nonzero(np.abs(rates) > min_relative_stiffness * np.abs(rates).max(initial=1e-300))
        return segments, frames[segments, which], rates[segments, which]
