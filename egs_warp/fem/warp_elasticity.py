"""Elasticity on a GPU: one kernel for the elements, and one that gathers their terms by node or matrix entry.

It launches the kernels of ``egs_warp.kernels.fem.elasticity``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.assembly_topology import AssemblyTopology, Damping, Material
from egs_warp.kernels.fem import elasticity as kernels
from egs_warp.launching import PinnedMirror, empty, lanes_on, launch_cached
from egs_warp.muscles.tension import LENGTH_FULL_FORCE, LENGTH_ZERO_FORCE, MuscleEnergy
from egs_warp.precision import Mat33, Vec3, real


class MuscleSegmentMaps:
    """Index maps and scratch memory for the segments of one set of muscles."""

    def __init__(self, tension: MuscleEnergy, device: wp.Device) -> None:
        self.rows, self._device = tension.rows, device
        by_node = self.rows.T.tocsr()
        self.ends = self._index(by_node)
        self._segments = [
            *self._index(self.rows),
            wp.array(tension.rest_lengths, dtype=real, device=device),
            LENGTH_ZERO_FORCE,
            LENGTH_FULL_FORCE,
        ]
        count = len(tension.rest_lengths)
        self._tensions = wp.zeros(count, dtype=real, device=device)
        self._tensions_mirror = PinnedMirror(self._tensions)
        self._forces = wp.zeros(count, dtype=Vec3, device=device)

    def _index(self, rows: sparse.csr_matrix) -> list[wp.array]:
        maps = [wp.array(part.astype(np.int32), dtype=int, device=self._device) for part in (rows.indptr, rows.indices)]
        return [*maps, wp.array(rows.data, dtype=real, device=self._device)]

    def enqueue_segment_forces(self, tensions: wp.array, positions: wp.array) -> wp.array:
        """Queue the computation of the forces (M,) N of segments with ``tensions`` (M,) N; return the output array."""
        launch_cached(
            kernels.segment_forces_kernel,
            (len(self._forces), lanes_on(self._device)),
            inputs=[*self._segments, tensions, positions],
            outputs=[self._forces],
            device=self._device,
        )
        return self._forces

    def upload_tensions(self, tension: MuscleEnergy) -> wp.array:
        """Upload the tensions (M,) N and return the device array."""
        self._tensions_mirror.put(tension.tensions)
        return self._tensions


class WarpElasticity:
    """Elasticity of one mesh on a device: arrays and scratch memory."""

    def __init__(self, maps: AssemblyTopology, material: Material, device: wp.Device) -> None:
        self._device, self._material = device, material
        node_count, tet_count = len(maps.corner_offsets) - 1, len(maps.tets)
        self._tets = wp.array(maps.tets, dtype=wp.vec4i, device=device)
        self._rest_inverses = wp.array(maps.rest_inverses, dtype=Mat33, device=device)
        self._volumes = wp.array(maps.volumes, dtype=real, device=device)
        self._corners, self._blocks_of = (
            [wp.array(part, dtype=int, device=device) for part in parts]
            for parts in (
                (maps.corner_offsets, maps.corner_from_slot),
                (maps.contribution_offsets, maps.block_from_contribution, maps.entry_from_block),
            )
        )
        self._no_gradients, self._no_forces = empty(0, Mat33, device), empty(0, Vec3, device)
        self._no_weights = empty(0, real, device)
        self._no_ends = [empty(0, int, device), empty(0, int, device), self._no_weights]
        self._muscles: MuscleSegmentMaps | None = None
        self._positions = wp.zeros(node_count, dtype=Vec3, device=device)
        self._positions_mirror = PinnedMirror(self._positions)
        # One array, so that both are downloaded in one copy.
        self._energies_and_determinants = wp.zeros((2, tet_count), dtype=real, device=device)
        energies: Any = self._energies_and_determinants
        self._energies, self._determinants = energies[0], energies[1]
        self._energies_mirror = PinnedMirror(self._energies_and_determinants)
        self._corner_gradients = wp.zeros((tet_count, 4), dtype=Vec3, device=device)
        self._node_gradients = wp.zeros(node_count, dtype=Vec3, device=device)
        self._gradients_mirror = PinnedMirror(self._node_gradients)
        self._blocks = wp.zeros((tet_count, 16), dtype=Mat33, device=device)
        self._entries = wp.zeros(maps.upper_pattern.nnz, dtype=real, device=device)

    @property
    def _model(self) -> list:
        material = self._material
        return [self._tets, self._rest_inverses, self._volumes, material.mu, material.lam, material.damping_time]

    def start(self, positions: np.ndarray) -> wp.array:
        """Return the deformation gradients at ``positions`` (N, 3), the reference of the damping of a step."""
        gradients = empty(len(self._tets), Mat33, self._device)
        self._positions_mirror.put(positions)
        self.enqueue_start(self._positions, gradients)
        return gradients

    def enqueue_start(self, positions: wp.array, gradients: wp.array) -> None:
        """Queue ``start`` of device ``positions``; write the deformation gradients to ``gradients`` (T,)."""
        launch_cached(
            kernels.deformation_gradients_kernel,
            len(self._tets),
            inputs=[self._tets, self._rest_inverses, positions],
            outputs=[gradients],
            device=self._device,
        )

    def _start_of(self, damping: Damping | None) -> tuple[wp.array, float]:
        # A kernel with a step size of 0 does not read the gradients.
        return (self._no_gradients, 0.0) if damping is None else (damping.start, damping.dt)

    def energy(self, positions: np.ndarray, damping: Damping | None) -> tuple[float, np.ndarray]:
        """Return the energy, J, and det F (T,)."""
        self._positions_mirror.put(positions)
        self.enqueue_energies(self._positions, *self._start_of(damping))
        energies, determinants = self._energies_mirror.get()
        return float(energies.sum()), determinants

    def energy_and_gradient(self, positions: np.ndarray, damping: Damping | None) -> tuple[float, np.ndarray]:
        """Return the energy, J, and its gradient (N, 3), N, of elasticity and damping."""
        self._positions_mirror.put(positions)
        start, dt = self._start_of(damping)
        self.enqueue_energies(self._positions, start, dt)
        self.enqueue_gradient(self._positions, start, dt, None, self._no_weights, self._node_gradients)
        (energies, _), gradients = PinnedMirror.get_all(self._energies_mirror, self._gradients_mirror)
        return float(energies.sum()), gradients

    def enqueue_energies(self, positions: wp.array, start: wp.array, dt: float) -> wp.array:
        """Queue the computation of the element energies (T,) J at device ``positions``; return the output array."""
        launch_cached(
            kernels.element_energies_kernel,
            len(self._tets),
            inputs=[*self._model, start, positions, dt],
            outputs=[self._energies, self._determinants],
            device=self._device,
        )
        return self._energies

    def gradient(self, positions: np.ndarray, damping: Damping | None, tension: MuscleEnergy | None) -> np.ndarray:
        """Return the gradient (N, 3), N, of elasticity, damping and muscles."""
        self._positions_mirror.put(positions)
        lines = None if tension is None else self.muscle_segments(tension)
        tensions = self._no_weights if lines is None or tension is None else lines.upload_tensions(tension)
        start, dt = self._start_of(damping)
        self.enqueue_gradient(self._positions, start, dt, lines, tensions, self._node_gradients)
        return self._gradients_mirror.get()

    def enqueue_gradient(
        self,
        positions: wp.array,
        start: wp.array,
        dt: float,
        lines: MuscleSegmentMaps | None,
        tensions: wp.array,
        gradient: wp.array,
    ) -> None:
        """Queue ``gradient`` of device arrays.

        Args:
            positions: (N,) Vec3, m.
            start: (T,) deformation gradients at the start of the step; not read if ``dt`` is 0.
            dt: step size, s, or 0 for no damping.
            lines: muscle segments, or None.
            tensions: (M,) N; not read without segments.
            gradient: (N,) Vec3, N, output.
        """
        ends, forces = self._no_ends, self._no_forces
        if lines is not None:
            ends, forces = lines.ends, lines.enqueue_segment_forces(tensions, positions)
        launch_cached(
            kernels.element_gradients_kernel,
            len(self._tets),
            inputs=[*self._model, start, positions, dt],
            outputs=[self._corner_gradients],
            device=self._device,
        )
        launch_cached(
            kernels.gather_forces_kernel,
            (len(self._positions), lanes_on(self._device)),
            inputs=[*self._corners, *ends, self._corner_gradients, forces],
            outputs=[gradient],
            device=self._device,
        )

    def muscle_segments(self, tension: MuscleEnergy) -> MuscleSegmentMaps:
        """Return the maps of the segments of ``tension``; they are cached for one set of muscles."""
        if self._muscles is None or self._muscles.rows is not tension.rows:
            self._muscles = MuscleSegmentMaps(tension, self._device)
        return self._muscles

    def hessian_entries(
        self, positions: np.ndarray, damping: Damping | None, *, factor: float, projected: bool
    ) -> np.ndarray:
        """Return the upper entries (nnz,) of ``factor`` times the Hessian; see ``ElasticAssembly.hessian_entries``."""
        return self._compute_entries(positions, damping, factor, projected).numpy().copy()

    def entries_on_device(
        self, positions: np.ndarray, damping: Damping | None, *, factor: float, projected: bool
    ) -> Any:
        """Return ``hessian_entries`` as a PyTorch tensor on the device; PyTorch must use Warp's stream."""
        return wp.to_torch(self._compute_entries(positions, damping, factor, projected)).clone()

    def _compute_entries(
        self, positions: np.ndarray, damping: Damping | None, factor: float, projected: bool
    ) -> wp.array:
        """Return the upper entries (nnz,) in an array that the next call overwrites."""
        self._positions_mirror.put(positions)
        start, dt = self._start_of(damping)
        return self.enqueue_entries(self._positions, start, dt, factor=factor, projected=projected)

    def enqueue_entries(
        self, positions: wp.array, start: wp.array, dt: float, *, factor: float, projected: bool
    ) -> wp.array:
        """Queue the computation of the upper entries (nnz,) from device arrays; return the output array."""
        hessian = kernels.element_projected_hessians_kernel if projected else kernels.element_hessians_kernel
        launch_cached(
            hessian,
            len(self._tets),
            inputs=[*self._model, start, positions, dt],
            outputs=[self._blocks],
            device=self._device,
        )
        launch_cached(
            kernels.gather_matrix_kernel,
            self._blocks_of[2].shape[0],
            inputs=[*self._blocks_of, self._blocks, factor],
            outputs=[self._entries],
            device=self._device,
        )
        return self._entries
