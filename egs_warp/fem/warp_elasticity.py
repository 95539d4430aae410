"""Elasticity of one or many worlds: one kernel computes the terms of the elements, another gathers them by node or
matrix entry.

The kernels are in ``egs_warp.kernels.fem.elasticity``. All worlds share the mesh, the material and the muscles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.assembly_topology import AssemblyTopology, Material
from egs_warp.kernels.fem import elasticity as kernels
from egs_warp.launching import PinnedMirror, empty, lanes_on, launch_cached, zeros
from egs_warp.muscles.tension import LENGTH_FULL_FORCE, LENGTH_ZERO_FORCE
from egs_warp.precision import Mat33, Vec3, real


class MuscleSegmentMaps:
    """Index maps and scratch memory for the segments of one set of muscles."""

    def __init__(
        self, rows: sparse.csr_matrix, rest_lengths: np.ndarray, device: wp.Device, *, worlds: int = 1
    ) -> None:
        """Build the maps.

        Args:
            rows: (M, N) difference rows.
            rest_lengths: (M,) m.
            device: device of the arrays.
            worlds: maximum number of worlds.
        """
        self.rows, self._device = rows, device
        self.ends = self._index(rows.T.tocsr())
        self._segments = [
            *self._index(rows),
            wp.array(rest_lengths, dtype=real, device=device),
            LENGTH_ZERO_FORCE,
            LENGTH_FULL_FORCE,
        ]
        self.tensions = PinnedMirror(zeros((1, len(rest_lengths)), real, device))
        """(1, M) N, tensions of one world, which the host sets."""
        self._forces = zeros((worlds, len(rest_lengths)), Vec3, device)

    def _index(self, rows: sparse.csr_matrix) -> list[wp.array]:
        maps = [wp.array(part.astype(np.int32), dtype=int, device=self._device) for part in (rows.indptr, rows.indices)]
        return [*maps, wp.array(rows.data, dtype=real, device=self._device)]

    def enqueue_segment_forces(self, tensions: wp.array, positions: wp.array) -> wp.array:
        """Queue the forces of the segments under ``tensions`` (B, M) N at ``positions`` (B, N) m.

        Returns:
            The output array, whose first B rows are the forces (B, M) N.
        """
        positions = _by_world(positions)
        launch_cached(
            kernels.segment_forces_kernel,
            (positions.shape[0], self._forces.shape[1], lanes_on(self._device)),
            inputs=[*self._segments, _by_world(tensions), positions],
            outputs=[self._forces],
            device=self._device,
        )
        return self._forces


class WarpElasticity:
    """Elasticity of one mesh in one or many worlds: arrays and scratch memory on a device.

    Arrays of B worlds, at most ``worlds``, have a leading world axis; it may be missing for one world. The first B rows
    of a returned array are the result; the next call overwrites the array.
    """

    def __init__(
        self, maps: AssemblyTopology, material: Material, device: wp.Device, *, worlds: int = 1, matrices: int = 1
    ) -> None:
        """Allocate the arrays.

        Args:
            maps: topology of the mesh.
            material: its material.
            device: device of the arrays.
            worlds: maximum number of worlds.
            matrices: maximum number of worlds whose matrices are computed in one call.
        """
        self.device, self._material = device, material
        self._node_count, self._tet_count = len(maps.corner_offsets) - 1, len(maps.tets)
        self._tets = wp.array(maps.tets, dtype=wp.vec4i, device=device)
        self._rest_inverses = wp.array(maps.rest_inverses, dtype=Mat33, device=device)
        self._volumes = wp.array(material.weighted_volumes(maps.volumes), dtype=real, device=device)
        self._corners, self._blocks_of = (
            [wp.array(part, dtype=int, device=device) for part in parts]
            for parts in (
                (maps.corner_offsets, maps.corner_from_slot),
                (maps.contribution_offsets, maps.block_from_contribution, maps.entry_from_block),
            )
        )
        self._no_gradients, self._no_forces = empty((0, 0), Mat33, device), empty((0, 0), Vec3, device)
        self._no_ends = [empty(0, int, device), empty(0, int, device), empty(0, real, device)]
        self.energy_offset = worlds * self._tet_count
        # One array holds both, so that both are downloaded in one copy.
        self.determinants_and_energies = zeros(2 * self.energy_offset, real, device)
        both: Any = self.determinants_and_energies.reshape((2, worlds, self._tet_count))
        self._determinants, self._energies = both[0], both[1]
        self._corner_gradients = zeros((worlds, self._tet_count, 4), Vec3, device)
        self._blocks = zeros((matrices, self._tet_count, 16), Mat33, device)
        self._entries = zeros((matrices, maps.upper_pattern.nnz), real, device)

    def node_vectors(self) -> wp.array:
        """Return an array (1, N) of zero vectors."""
        return zeros((1, self._node_count), Vec3, self.device)

    def new_start(self) -> wp.array:
        """Return an array for the deformation gradients (1, T) at the start of a step."""
        return empty((1, self._tet_count), Mat33, self.device)

    def segments(self, rows: sparse.csr_matrix, rest_lengths: np.ndarray) -> MuscleSegmentMaps:
        """Return the maps of muscle segments with difference ``rows`` (M, N) and ``rest_lengths`` (M,) m."""
        return MuscleSegmentMaps(rows, rest_lengths, self.device)

    @property
    def _model(self) -> list:
        material = self._material
        return [self._tets, self._rest_inverses, self._volumes, material.mu, material.lam, material.damping_time]

    def _state(self, positions: wp.array, start: wp.array | None, dt: float) -> list:
        # For a step size of 0, a kernel does not read the gradients.
        return [self._no_gradients if start is None else _by_world(start), positions, dt]

    def enqueue_start(self, positions: wp.array, gradients: wp.array) -> None:
        """Compute the deformation ``gradients`` (B, T) at ``positions`` (B, N) m, which are the reference state of the
        damping of a step, asynchronously."""
        positions = _by_world(positions)
        launch_cached(
            kernels.deformation_gradients_kernel,
            (positions.shape[0], self._tet_count),
            inputs=[self._tets, self._rest_inverses, positions],
            outputs=[_by_world(gradients)],
            device=self.device,
        )

    def enqueue_energies(self, positions: wp.array, start: wp.array | None, dt: float) -> tuple[wp.array, wp.array]:
        """Queue the energies (B, T) J and determinants (B, T) of the elements; arguments as in ``enqueue_gradient``."""
        positions = _by_world(positions)
        launch_cached(
            kernels.element_energies_kernel,
            (positions.shape[0], self._tet_count),
            inputs=[*self._model, *self._state(positions, start, dt)],
            outputs=[self._energies, self._determinants],
            device=self.device,
        )
        return self._energies, self._determinants

    def enqueue_gradient(
        self,
        positions: wp.array,
        start: wp.array | None,
        dt: float,
        segments: MuscleSegmentMaps | None,
        gradient: wp.array,
        tensions: wp.array | None = None,
    ) -> None:
        """Queue the gradient of elasticity, damping and muscles.

        Args:
            positions: (B, N) Vec3, m.
            start: (B, T) deformation gradients at the start of the step; None if ``dt`` is 0.
            dt: step size, s, or 0 for no damping.
            segments: muscle segments, or None.
            gradient: (B, N) Vec3, N, output.
            tensions: (B, M) N, tensions; None uses the tensions that the host has set in ``segments``.
        """
        positions, ends, forces = _by_world(positions), self._no_ends, self._no_forces
        if segments is not None:
            tensions = segments.tensions.array if tensions is None else tensions
            ends, forces = segments.ends, segments.enqueue_segment_forces(tensions, positions)
        worlds = positions.shape[0]
        launch_cached(
            kernels.element_gradients_kernel,
            (worlds, self._tet_count),
            inputs=[*self._model, *self._state(positions, start, dt)],
            outputs=[self._corner_gradients],
            device=self.device,
        )
        launch_cached(
            kernels.gather_forces_kernel,
            (worlds, self._node_count, lanes_on(self.device)),
            inputs=[*self._corners, *ends, self._corner_gradients, forces],
            outputs=[_by_world(gradient)],
            device=self.device,
        )

    def enqueue_entries(
        self, positions: wp.array, start: wp.array | None, dt: float, *, factor: float, projected: bool
    ) -> wp.array:
        """Queue the upper entries (B, nnz) of ``factor`` times the Hessian; other arguments as in
        ``enqueue_gradient``."""
        positions = _by_world(positions)
        hessian = kernels.element_projected_hessians_kernel if projected else kernels.element_hessians_kernel
        launch_cached(
            hessian,
            (positions.shape[0], self._tet_count),
            inputs=[*self._model, *self._state(positions, start, dt)],
            outputs=[self._blocks],
            device=self.device,
        )
        launch_cached(
            kernels.gather_matrix_kernel,
            (positions.shape[0], self._blocks_of[2].shape[0]),
            inputs=[*self._blocks_of, self._blocks, factor],
            outputs=[self._entries],
            device=self.device,
        )
        return self._entries


def _by_world(array: wp.array) -> wp.array:
    """Return ``array`` with a leading world axis."""
    return array if array.ndim == 2 else array.reshape((1, array.shape[0]))
