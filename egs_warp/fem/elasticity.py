"""Elastic energy of a tetrahedral body (Eq. 5) and its derivatives, assembled in a fixed order from Warp kernels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.kernels.fem import elasticity as kernels
from egs_warp.launching import empty, launch_again, put
from egs_warp.muscles.tension import FULL, SLACK, MuscleTension
from egs_warp.precision import Mat33, Vec3, real


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
    start_gradients: wp.array
    """(T,) deformation gradients at its start."""


@dataclass(frozen=True)
class ElasticMaps:
    """One mesh as the kernels of elasticity read it."""

    rest_inverses: np.ndarray
    """(T, 3, 3) 1/m, inverse edges at rest."""
    volumes: np.ndarray
    """(T,) m^3."""
    corner_offsets: np.ndarray
    """(N + 1,) where the slots of a node's corners begin."""
    corner_from_slot: np.ndarray
    """(4 T,)."""
    contribution_offsets: np.ndarray
    """(blocks + 1,) where the slots of a 3x3 block of the matrix begin."""
    block_from_contribution: np.ndarray
    """(slots,) 16 times the element, and which of its blocks."""
    entry_from_block: np.ndarray
    """(blocks, 9) of the upper triangle, -1 for those below it."""


class _MuscleLines:
    """Kernel, index maps and scratch memory for the segments of one set of muscles."""

    def __init__(self, tension: MuscleTension, device: wp.Device) -> None:
        self.rows, self._device = tension.rows, device
        by_node = self.rows.T.tocsr()
        self.ends = self._index(by_node)
        self._lines = [*self._index(self.rows), wp.array(tension.rest_lengths, dtype=real, device=device), SLACK, FULL]
        count = len(tension.rest_lengths)
        self._tensions = wp.zeros(count, dtype=real, device=device)
        self._pulls = wp.zeros(count, dtype=Vec3, device=device)

    def _index(self, rows: sparse.csr_matrix) -> list[wp.array]:
        maps = [wp.array(part.astype(np.int32), dtype=int, device=self._device) for part in (rows.indptr, rows.indices)]
        return [*maps, wp.array(rows.data, dtype=real, device=self._device)]

    def pulled(self, tension: MuscleTension, positions: wp.array) -> wp.array:
        """(M,) newtons, by which each segment draws its ends together."""
        put(self._tensions, tension.tensions)
        launch_again(
            kernels.segment_pulls_kernel,
            len(self._tensions),
            inputs=[*self._lines, self._tensions, positions],
            outputs=[self._pulls],
            device=self._device,
        )
        return self._pulls


class ElasticAssembly:
    """Kernels, index maps and scratch memory for one mesh. Node arrays go in and out as (N, 3) float64 on the host."""

    def __init__(self, mesh: TetMesh, material: Material, *, device: str | None = None) -> None:
        self.mesh, self.material, self.device = mesh, material, wp.get_device(device)
        node_count, tet_count = len(mesh.nodes), len(mesh.tets)
        corners = mesh.nodes[mesh.tets]
        edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        self._tets = wp.array(mesh.tets, dtype=wp.vec4i, device=device)
        self._rest_inverses = wp.array(np.linalg.inv(edges), dtype=Mat33, device=device)
        self._volumes = wp.array(mesh.volumes(), dtype=real, device=device)
        self._no_gradients, self._no_pulls = empty(0, Mat33, device), empty(0, Vec3, device)
        self._no_ends = [empty(0, int, device), empty(0, int, device), empty(0, real, device)]
        self._muscles: _MuscleLines | None = None
        self._positions = wp.zeros(node_count, dtype=Vec3, device=device)
        self._energies = wp.zeros(tet_count, dtype=real, device=device)
        self._determinants = wp.zeros(tet_count, dtype=real, device=device)
        self._corner_gradients = wp.zeros((tet_count, 4), dtype=Vec3, device=device)
        self._node_gradients = wp.zeros(node_count, dtype=Vec3, device=device)
        self._blocks = wp.zeros((tet_count, 16), dtype=Mat33, device=device)
        self._index_corners()
        self._index_matrix()

    def __reduce__(self) -> tuple[Any, ...]:
        """It is made anew wherever a copy of it is read: its arrays lie on a device."""
        return partial(ElasticAssembly, device=str(self.device)), (self.mesh, self.material)

    @property
    def maps(self) -> ElasticMaps:
        """What the kernels read of the mesh, for those who lay it out for many bodies."""
        return ElasticMaps(
            self._rest_inverses.numpy(),
            self._volumes.numpy(),
            self._corner_offsets.numpy(),
            self._corner_from_slot.numpy(),
            self._contribution_offsets.numpy(),
            self._block_from_contribution.numpy(),
            self._entry_from_block.numpy(),
        )

    def _index_corners(self) -> None:
        flat = self.mesh.tets.ravel()
        order = np.argsort(flat, kind="stable")
        offsets = np.searchsorted(flat[order], np.arange(len(self.mesh.nodes) + 1))
        self._corner_offsets = wp.array(offsets.astype(np.int32), dtype=int, device=self.device)
        self._corner_from_slot = wp.array(order.astype(np.int32), dtype=int, device=self.device)

    def _index_matrix(self) -> None:
        tets, count = self.mesh.tets.astype(np.int64), len(self.mesh.nodes)
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
        self.upper_pattern = pattern
        self.diagonal_entries = pattern.indptr[1:] - 1
        self._block_keys = blocks
        self._contribution_offsets = wp.array(offsets.astype(np.int32), dtype=int, device=self.device)
        self._block_from_contribution = wp.array(upper[order].astype(np.int32), dtype=int, device=self.device)
        self._entry_from_block = wp.array(entry_from_block, dtype=int, device=self.device)
        self._entries = wp.zeros(pattern.nnz, dtype=real, device=self.device)

    @property
    def _model(self) -> list:
        material = self.material
        return [self._tets, self._rest_inverses, self._volumes, material.mu, material.lam, material.damping_time]

    def damping(self, positions: np.ndarray, dt: float) -> Damping:
        """Of a step of ``dt`` seconds that starts at ``positions`` (N, 3)."""
        gradients = empty(len(self.mesh.tets), Mat33, self.device)
        put(self._positions, positions)
        launch_again(
            kernels.deformation_gradients_kernel,
            len(self.mesh.tets),
            inputs=[self._tets, self._rest_inverses, self._positions],
            outputs=[gradients],
            device=self.device,
        )
        return Damping(dt, gradients)

    def _damping_inputs(self, damping: Damping | None) -> list:
        # A kernel that is told no step does not read the gradients.
        return (
            [self._no_gradients, self._positions, 0.0]
            if damping is None
            else [damping.start_gradients, self._positions, damping.dt]
        )

    def determinants(self, positions: np.ndarray) -> np.ndarray:
        """(T,) J = det F; not positive where an element is inverted."""
        self.energy(positions)
        return self._determinants.numpy().copy()

    def energy(self, positions: np.ndarray, damping: Damping | None = None) -> float:
        """Psi(positions), joules; infinite if an element is inverted.

        With ``damping``, plus dt beta/2 sum V E':C:E', where E' = (F^T F - F0^T F0) / (2 dt) is the mean strain rate of
        the step.
        """
        put(self._positions, positions)
        launch_again(
            kernels.element_energies_kernel,
            len(self.mesh.tets),
            inputs=[*self._model, *self._damping_inputs(damping)],
            outputs=[self._energies, self._determinants],
            device=self.device,
        )
        return float(self._energies.numpy().sum())

    def gradient(
        self, positions: np.ndarray, damping: Damping | None = None, tension: MuscleTension | None = None
    ) -> np.ndarray:
        """(N, 3) newtons: the derivative of ``energy`` by the positions, minus the internal force; with that of
        ``tension``."""
        put(self._positions, positions)
        ends, pulls = self._no_ends, self._no_pulls
        if tension is not None:
            muscles = self._muscles_of(tension)
            ends, pulls = muscles.ends, muscles.pulled(tension, self._positions)
        launch_again(
            kernels.element_gradients_kernel,
            len(self.mesh.tets),
            inputs=[*self._model, *self._damping_inputs(damping)],
            outputs=[self._corner_gradients],
            device=self.device,
        )
        launch_again(
            kernels.gather_forces_kernel,
            len(self.mesh.nodes),
            inputs=[self._corner_offsets, self._corner_from_slot, *ends, self._corner_gradients, pulls],
            outputs=[self._node_gradients],
            device=self.device,
        )
        return self._node_gradients.numpy().copy()

    def _muscles_of(self, tension: MuscleTension) -> _MuscleLines:
        if self._muscles is None or self._muscles.rows is not tension.rows:
            self._muscles = _MuscleLines(tension, self.device)
        return self._muscles

    def hessian_entries(
        self, positions: np.ndarray, damping: Damping | None = None, *, factor: float = 1.0, projected: bool = False
    ) -> np.ndarray:
        """Entries of ``factor`` times the second derivative of ``energy`` in the order of ``upper_pattern``.

        ``projected``: each element's part is made positive semi-definite.
        """
        put(self._positions, positions)
        hessian = kernels.element_projected_hessians_kernel if projected else kernels.element_hessians_kernel
        launch_again(
            hessian,
            len(self.mesh.tets),
            inputs=[*self._model, *self._damping_inputs(damping)],
            outputs=[self._blocks],
            device=self.device,
        )
        launch_again(
            kernels.gather_matrix_kernel,
            len(self._block_keys),
            inputs=[
                self._contribution_offsets,
                self._block_from_contribution,
                self._entry_from_block,
                self._blocks,
                factor,
            ],
            outputs=[self._entries],
            device=self.device,
        )
        return self._entries.numpy().copy()

    def matrix(self, entries: np.ndarray) -> sparse.csc_matrix:
        """Upper triangle (3N, 3N) with the given entries."""
        return sparse.csc_matrix(
            (entries, self.upper_pattern.indices, self.upper_pattern.indptr), shape=self.upper_pattern.shape
        )
