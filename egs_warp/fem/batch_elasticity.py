"""Elasticity, damping and muscles of many worlds with the same body.

It launches the kernels of ``egs_warp.kernels.fem.elasticity`` over index maps that repeat the mesh once per world.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sparse
import torch
import warp as wp

from egs_warp.fem.batched import as_warp, launch_on, repeat_bounds, repeat_offsets
from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.kernels.fem import elasticity as kernels
from egs_warp.launching import lanes_on
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import LENGTH_FULL_FORCE, LENGTH_ZERO_FORCE
from egs_warp.precision import Mat33, Vec3, real

_MIN_LENGTH = 1e-300
"""Lower bound of segment lengths, m; it gives a segment whose ends coincide the direction 0."""


class BatchElasticity:
    """Index maps for ``count`` consecutive copies of a body's mesh and muscles.

    Methods take and return tensors of c worlds, c <= ``count``, and use the first c copies.
    """

    def __init__(self, assembly: ElasticAssembly, muscles: MuscleSet, count: int, *, matrices: int) -> None:
        """Build the maps.

        Args:
            assembly: assembly of the single body.
            muscles: muscles of the body.
            count: maximum number of worlds.
            matrices: maximum number of worlds whose matrices are computed in one call.
        """
        self.device, self._lanes = torch.device(str(assembly.device)), lanes_on(assembly.device)
        self.node_count, self.tet_count = len(assembly.mesh.nodes), len(assembly.mesh.tets)
        self._material, maps = assembly.material, assembly.maps
        self._tets = as_warp(repeat_offsets(assembly.mesh.tets, count, self.node_count, self.device), wp.vec4i)
        self._rest_inverses = as_warp(self._tensor(maps.rest_inverses).repeat(count, 1, 1), Mat33)
        self._volumes = as_warp(self._tensor(maps.volumes).repeat(count), real)
        self._corners = [
            as_warp(repeat_bounds(maps.corner_offsets, count, self.device), wp.int32),
            as_warp(repeat_offsets(maps.corner_from_slot, count, 4 * self.tet_count, self.device), wp.int32),
        ]
        self._block_count, self._entry_count = len(maps.entry_from_block), assembly.upper_pattern.nnz
        self._gather_maps = [
            as_warp(repeat_bounds(maps.contribution_offsets, matrices, self.device), wp.int32),
            as_warp(repeat_offsets(maps.block_from_contribution, matrices, 16 * self.tet_count, self.device), wp.int32),
            as_warp(repeat_offsets(maps.entry_from_block, matrices, self._entry_count, self.device), wp.int32),
        ]
        size, pattern = 3 * self.node_count, assembly.upper_pattern
        columns = np.repeat(np.arange(size), np.diff(pattern.indptr))
        self._lower = torch.as_tensor(columns * size + pattern.indices.astype(np.int64), device=self.device)
        self._diagonal = torch.as_tensor(assembly.diagonal_entries.astype(np.int64), device=self.device)
        rows = muscles.difference_rows
        self.segment_count = muscles.segment_count
        self._rows = self._tensor(rows.toarray())
        self._rest_lengths = self._tensor(muscles.rest_lengths)
        self._segments = [
            *self._copies(rows, count, self.node_count),
            as_warp(self._rest_lengths.repeat(count), real),
        ]
        self._ends = self._copies(rows.T.tocsr(), count, self.segment_count)
        self._no_ends = self._copies(rows.T.tocsr(), 0, 0)
        self._no_ends[0] = as_warp(torch.zeros(0, dtype=torch.int32, device=self.device), wp.int32)
        self._no_gradients = as_warp(self._empty(0, 3, 3), Mat33)

    def _copies(self, rows: sparse.csr_matrix, count: int, column_count: int) -> list[wp.array]:
        """Return ``count`` copies of CSR ``rows``: offsets, columns shifted by ``column_count`` each, and values."""
        return [
            as_warp(repeat_bounds(rows.indptr, count, self.device), wp.int32),
            as_warp(repeat_offsets(rows.indices, count, column_count, self.device), wp.int32),
            as_warp(self._tensor(rows.data).repeat(count), real),
        ]

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values, dtype=np.float64), device=self.device)

    def _model(self) -> list[Any]:
        material = self._material
        return [self._tets, self._rest_inverses, self._volumes, material.mu, material.lam, material.damping_time]

    def _empty(self, *shape: int) -> torch.Tensor:
        return torch.empty(shape, dtype=torch.float64, device=self.device)

    def deformation_gradients(self, positions: torch.Tensor) -> torch.Tensor:
        """Return the deformation gradients F (c, T, 3, 3) at ``positions`` (c, N, 3)."""
        gradients = self._empty(len(positions), self.tet_count, 3, 3)
        launch_on(
            self.device,
            kernels.deformation_gradients_kernel,
            len(positions) * self.tet_count,
            inputs=[self._tets, self._rest_inverses, (positions.reshape(-1, 3), Vec3)],
            outputs=[(gradients.view(-1, 3, 3), Mat33)],
        )
        return gradients

    def is_inversion_free(self, positions: torch.Tensor) -> torch.Tensor:
        """Return, for each world, True if no element is inverted at ``positions`` (c, N, 3): (c,) bool."""
        energies, determinants = self._empty(2, len(positions), self.tet_count)
        flat = positions.reshape(-1, 3)
        launch_on(
            self.device,
            kernels.element_energies_kernel,
            energies.numel(),
            inputs=[*self._model(), self._no_gradients, (flat, Vec3), 0.0],
            outputs=[(energies.view(-1), real), (determinants.view(-1), real)],
        )
        return determinants.amin(dim=1) > 0.0

    def gradient(
        self, positions: torch.Tensor, start_gradients: torch.Tensor, dt: float, tensions: torch.Tensor | None
    ) -> torch.Tensor:
        """Return minus the internal forces of elasticity, damping and muscles.

        Args:
            positions: (c, N, 3) m.
            start_gradients: (c, T, 3, 3) deformation gradients at the start of the step.
            dt: step size, s.
            tensions: (c, M) N, muscle tensions, or None for no muscles.

        Returns:
            (c, N, 3) N.
        """
        count, flat = len(positions), (positions.reshape(-1, 3), Vec3)
        corners, nodes = self._empty(count * self.tet_count, 4, 3), self._empty(count, self.node_count, 3)
        ends, segment_forces = self._no_ends, self._empty(0, 3)
        if tensions is not None:
            ends, segment_forces = self._ends, self._empty(count * self.segment_count, 3)
            launch_on(
                self.device,
                kernels.segment_forces_kernel,
                (len(segment_forces), self._lanes),
                inputs=[*self._segments, LENGTH_ZERO_FORCE, LENGTH_FULL_FORCE, (tensions.reshape(-1), real), flat],
                outputs=[(segment_forces, Vec3)],
            )
        launch_on(
            self.device,
            kernels.element_gradients_kernel,
            count * self.tet_count,
            inputs=[*self._model(), (start_gradients.view(-1, 3, 3), Mat33), flat, dt],
            outputs=[(corners, Vec3)],
        )
        launch_on(
            self.device,
            kernels.gather_forces_kernel,
            (count * self.node_count, self._lanes),
            inputs=[*self._corners, *ends, (corners, Vec3), (segment_forces, Vec3)],
            outputs=[(nodes.view(-1, 3), Vec3)],
        )
        return nodes

    def matrices(
        self,
        positions: torch.Tensor,
        start_gradients: torch.Tensor,
        dt: float,
        diagonal: torch.Tensor,
        *,
        projected: bool,
    ) -> torch.Tensor:
        """Return the lower triangles of the step matrices without muscles.

        Args:
            positions: (c, N, 3) m.
            start_gradients: (c, T, 3, 3) deformation gradients at the start of the step.
            dt: step size, s; elasticity and damping enter with the factor dt^2.
            diagonal: (3N,) kg, added to the diagonal of every matrix.
            projected: project the Hessian of each element to a positive semi-definite one.

        Returns:
            (c, 3N, 3N) kg.
        """
        count, size = len(positions), 3 * self.node_count
        blocks, entries = self._empty(count * self.tet_count, 16, 3, 3), self._empty(count, self._entry_count)
        launch_on(
            self.device,
            kernels.element_projected_hessians_kernel if projected else kernels.element_hessians_kernel,
            count * self.tet_count,
            inputs=[
                *self._model(),
                *((start_gradients.view(-1, 3, 3), Mat33), (positions.reshape(-1, 3), Vec3), dt),
            ],
            outputs=[(blocks, Mat33)],
        )
        launch_on(
            self.device,
            kernels.gather_matrix_kernel,
            count * self._block_count,
            inputs=[*self._gather_maps, (blocks, Mat33), dt**2],
            outputs=[(entries.view(-1), real)],
        )
        entries[:, self._diagonal] += diagonal
        out = torch.zeros((count, size * size), dtype=torch.float64, device=self.device)
        out.index_copy_(1, self._lower, entries)
        return out.view(count, size, size)

    def add_stiffness(
        self,
        matrices: torch.Tensor,
        positions: torch.Tensor,
        tensions: torch.Tensor,
        factor: float,
        *,
        min_relative: float,
    ) -> None:
        """Add ``factor`` times the Hessian of the muscle energy to the lower triangles of ``matrices``.

        Args:
            matrices: (c, 3N, 3N) kg, modified in place.
            positions: (c, N, 3) m.
            tensions: (c, M) N, muscle tensions.
            factor: s^2, multiplies the Hessian.
            min_relative: stiffnesses below this fraction of the largest of the same world are dropped, as in
                ``TensionHessian.rank_one_terms``.
        """
        vectors = self._rows @ positions
        lengths = vectors.norm(dim=2).clamp(min=_MIN_LENGTH)
        directions = vectors / lengths[:, :, None]
        along = ((lengths / self._rest_lengths - LENGTH_ZERO_FORCE) / (LENGTH_FULL_FORCE - LENGTH_ZERO_FORCE)).clamp(
            0.0, 1.0
        )
        across = tensions * along**2 * (3.0 - 2.0 * along) / lengths
        stretch = tensions * 6.0 * along * (1.0 - along) / (LENGTH_FULL_FORCE - LENGTH_ZERO_FORCE) / self._rest_lengths
        largest = torch.maximum(across.abs(), stretch.abs()).amax(dim=1, keepdim=True).clamp(min=_MIN_LENGTH)
        across, stretch = (torch.where(rate.abs() > min_relative * largest, rate, 0.0) for rate in (across, stretch))
        blocks = matrices.view(len(matrices), self.node_count, 3, self.node_count, 3)
        for i in range(3):
            for k in range(i + 1):
                rates = (stretch - across) * directions[:, :, i] * directions[:, :, k] + (across if i == k else 0.0)
                part = self._rows.T @ (factor * rates[:, :, None] * self._rows)
                blocks[:, :, i, :, k] += part
                if i != k:
                    blocks[:, :, k, :, i] += part
