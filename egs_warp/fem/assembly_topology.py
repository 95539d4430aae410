"""Inputs of the elasticity kernels: material, mesh topology for assembly, and reference state of the damping."""

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
    """Young's modulus E, Pa."""
    poisson_ratio: float
    """Poisson's ratio nu."""
    density: float
    """Mass density at rest, kg/m^3."""
    damping_time: float
    """Coefficient beta of the Rayleigh damping C = beta K at rest, s."""
    relative_stiffness: np.ndarray | None = None
    """(T,) Young's modulus of each element relative to ``young_modulus``; None means 1 everywhere."""

    def weighted_volumes(self, volumes: np.ndarray) -> np.ndarray:
        """Return ``volumes`` (T,) times the relative stiffness. Energy, forces and damping of an element are
        proportional to both, so the kernels need only the product."""
        return volumes if self.relative_stiffness is None else volumes * self.relative_stiffness

    @property
    def mu(self) -> float:
        """Shear modulus mu of Eq. (5), Pa."""
        return self.young_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def lam(self) -> float:
        """Lame's first parameter lambda of Eq. (5), Pa."""
        nu = self.poisson_ratio
        return self.young_modulus * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


@dataclass(frozen=True)
class Damping:
    """Reference state of the damping of one step. Damping resists the change of strain since the start of the step.

    The strain is invariant under rotations of any size, so the damping does not slow a rigid rotation
    (docs/concepts/body.md).
    """

    dt: float
    """Step size, s."""
    start: wp.array
    """Deformation of each element at the start of the step, in the layout of the assembly (``elements.start``)."""


@dataclass(frozen=True)
class AssemblyTopology:
    """Mesh topology of one body and the maps that gather element terms into nodes and matrix entries."""

    tets: np.ndarray
    """(T, 4) int32, nodes of each tetrahedron."""
    rest_inverses: np.ndarray
    """(T, 3, 3) 1/m, inverses of the matrices whose columns are the edges at rest."""
    volumes: np.ndarray
    """(T,) m^3, volumes at rest."""
    corner_offsets: np.ndarray
    """(N + 1,) int32, offset of each node in ``corner_from_slot``."""
    corner_from_slot: np.ndarray
    """(4 T,) int32, element corners (4 times the element, plus its corner), grouped by node."""
    block_keys: np.ndarray
    """(blocks,) N times the block row plus the block column of each 3x3 block of the upper triangle, ascending."""
    contribution_offsets: np.ndarray
    """(blocks + 1,) int32, offset of each block in ``block_from_contribution``."""
    block_from_contribution: np.ndarray
    """(contributions,) int32, element blocks that sum to each block (16 times the element, plus 4 times the row corner,
    plus the column corner)."""
    entry_from_block: np.ndarray
    """(blocks, 9) int32, matrix entry of each element of a block; -1 below the diagonal."""
    upper_pattern: sparse.csc_matrix
    """(3N, 3N) upper triangle with sorted indices and the diagonal; its values have no meaning."""

    @classmethod
    def of(cls, mesh: TetMesh) -> AssemblyTopology:
        """Build the topology of ``mesh``."""
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
        in_upper = entry_rows <= entry_columns
        pattern = sparse.coo_matrix(
            (np.arange(1, in_upper.sum() + 1, dtype=np.float64), (entry_rows[in_upper], entry_columns[in_upper])),
            shape=(3 * count, 3 * count),
        ).tocsc()
        pattern.sort_indices()
        entry_from_sequence = np.empty(pattern.nnz, dtype=np.int32)
        entry_from_sequence[pattern.data.astype(np.int64) - 1] = np.arange(pattern.nnz)
        entry_from_block = np.full(in_upper.shape, -1, dtype=np.int32)
        entry_from_block[in_upper] = entry_from_sequence
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
