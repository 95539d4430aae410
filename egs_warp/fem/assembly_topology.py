"""What elasticity is told of a body: its material, its mesh as the kernels read it, and the start of a step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.geometry.tetmesh import TetMesh


@dataclass(frozen=True)
class Material:
    """Isotropic Neo-Hookean material with stiffness-proportional damping."""

    young_modulus: float
    """E, pascals."""
    poisson_ratio: float
    density: float
    """kg/m^3."""
    damping_time: float
    """beta of Rayleigh damping C = beta K at rest, seconds."""

    @property
    def mu(self) -> float:
        """First Lame parameter of Eq. (5) (shear modulus), pascals."""
        return self.young_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def lam(self) -> float:
        """Second Lame parameter of Eq. (5), pascals."""
        nu = self.poisson_ratio
        return self.young_modulus * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


@dataclass(frozen=True)
class Damping:
    """What the damping of one step resists: the change of strain since the step's start (docs: body).

    It is blind to rotations however large, so a spin is not damped.
    """

    dt: float
    """Seconds of the step."""
    start: wp.array
    """Of its elements at its start, as the assembly's kernels want it."""


@dataclass(frozen=True)
class AssemblyTopology:
    """One mesh as the kernels of elasticity read it."""

    tets: np.ndarray
    """(T, 4) int32."""
    rest_inverses: np.ndarray
    """(T, 3, 3) 1/m, inverse edges at rest."""
    volumes: np.ndarray
    """(T,) m^3."""
    corner_offsets: np.ndarray
    """(N + 1,) where the slots of a node's corners begin."""
    corner_from_slot: np.ndarray
    """(4 T,)."""
    block_keys: np.ndarray
    """(blocks,) N times the row of a 3x3 block in the upper triangle, and its column."""
    contribution_offsets: np.ndarray
    """(blocks + 1,) where the slots of a block of the matrix begin."""
    block_from_contribution: np.ndarray
    """(slots,) 16 times the element, and which of its blocks."""
    entry_from_block: np.ndarray
    """(blocks, 9) of the upper triangle, -1 for those below it."""
    upper_pattern: sparse.csc_matrix
    """(3N, 3N), all entries there."""

    @classmethod
    def of(cls, mesh: TetMesh) -> AssemblyTopology:
        """Of ``mesh``."""
        corners = mesh.nodes[mesh.tets]
        edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        tets, count = mesh.tets.astype(np.int64), len(mesh.nodes)
        by_node = np.argsort(tets.ravel(), kind="stable")
        corner_offsets = np.searchsorted(tets.ravel()[by_node], np.arange(count + 1))
        rows = np.repeat(tets, 4, axis=1).ravel()
        columns = np.tile(tets, (1, 4)).ravel()
        upper = np.flatnonzero(rows <= columns)
        keys = rows[upper] * count + columns[upper]
        blocks, inverse = np.unique(keys, return_inverse=True)
        order = np.argsort(inverse, kind="stable")
        offsets = np.searchsorted(inverse[order], np.arange(len(blocks) + 1))
        block_rows, block_columns = blocks // count, blocks % count
        i, k = np.divmod(np.arange(9), 3)
        entry_rows = 3 * block_rows[:, None] + i
        entry_columns = 3 * block_columns[:, None] + k
        kept = entry_rows <= entry_columns
        pattern = sparse.coo_matrix(
            (np.arange(1, kept.sum() + 1, dtype=np.float64), (entry_rows[kept], entry_columns[kept])),
            shape=(3 * count, 3 * count),
        ).tocsc()
        pattern.sort_indices()
        entry_from_sequence = np.empty(pattern.nnz, dtype=np.int32)
        entry_from_sequence[pattern.data.astype(np.int64) - 1] = np.arange(pattern.nnz)
        entry_from_block = np.full(kept.shape, -1, dtype=np.int32)
        entry_from_block[kept] = entry_from_sequence
        return cls(
            mesh.tets.astype(np.int32),
            np.linalg.inv(edges),
            mesh.volumes(),
            corner_offsets.astype(np.int32),
            by_node.astype(np.int32),
            blocks,
            offsets.astype(np.int32),
            upper[order].astype(np.int32),
            entry_from_block,
            sparse.csc_matrix(pattern),
        )
