"""Elastic energy of a tetrahedral body (Eq. 5) and its derivatives, assembled in a fixed order by Warp kernels.

The kernels are in ``egs_warp.kernels.fem.elasticity`` (GPU) and ``elasticity_cpu`` (CPU).
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import Any

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.assembly_topology import AssemblyTopology, Damping, Material
from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.fem.multifrontal import MultifrontalLdl, SymbolicFactorization
from egs_warp.fem.simd_elasticity import SimdElasticity
from egs_warp.fem.warp_elasticity import WarpElasticity
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.launching import PinnedMirror
from egs_warp.muscles.tension import MuscleEnergy


class ElasticAssembly:
    """Elasticity of one mesh: index maps, scratch memory and launches. Node arrays are (N, 3) float64 on the host."""

    def __init__(self, mesh: TetMesh, material: Material, *, device: str | None = None) -> None:
        self.mesh, self.material, self.device = mesh, material, wp.get_device(device)
        self.maps = AssemblyTopology.of(mesh)
        self.upper_pattern = self.maps.upper_pattern
        self.diagonal_entries = self.upper_pattern.indptr[1:] - 1
        on_device = SimdElasticity if self.device.is_cpu else WarpElasticity
        elements = on_device(self.maps, material, self.device)
        # Typed as Any, because each implementation accepts only the arrays that it has created itself.
        self.elements: Any = elements
        self._positions, self._gradient, self._energies = map(
            PinnedMirror, (elements.node_vectors(), elements.node_vectors(), elements.determinants_and_energies)
        )
        self._segments: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the mesh and the material only; the copy rebuilds the arrays on its device."""
        return partial(ElasticAssembly, device=str(self.device)), (self.mesh, self.material)

    def with_rest_shape(self, nodes: np.ndarray) -> ElasticAssembly:
        """Return the elasticity of the same elements and material with the rest positions ``nodes`` (N, 3) m."""
        return ElasticAssembly(TetMesh(nodes, self.mesh.tets), self.material, device=str(self.device))

    @cached_property
    def analysis(self) -> SymbolicFactorization:
        """Symbolic factorisation of ``upper_pattern``."""
        return SymbolicFactorization.of(self.upper_pattern)

    def new_solver(self) -> LinearSolver:
        """Return a linear solver for ``upper_pattern``: sparse on a CPU, dense on a GPU, which requires PyTorch.

        On an H100 the inverse of a dense factor takes 0.15 ms for 568 nodes and 0.44 ms for 1,064.
        """
        if self.device.is_cpu:
            return MultifrontalLdl(self.upper_pattern, self.analysis)
        from egs_warp.fem.tiled_cholesky import TiledCholesky

        return TiledCholesky(self.upper_pattern, device=str(self.device))

    def damping(self, positions: np.ndarray, dt: float) -> Damping:
        """Return the damping of a step of ``dt`` seconds that starts at ``positions`` (N, 3) m."""
        start = self.elements.new_start()
        self._positions.put(positions)
        self.elements.enqueue_start(self._positions.array, start)
        return Damping(dt, start)

    def _upload(self, positions: np.ndarray, damping: Damping | None) -> tuple[wp.array, wp.array | None, float]:
        """Upload ``positions``; return the first arguments of the methods of ``elements``: positions, start, dt."""
        self._positions.put(positions)
        start, dt = (None, 0.0) if damping is None else (damping.start, damping.dt)
        return self._positions.array, start, dt

    def load_segments(self, tension: MuscleEnergy | None) -> Any:
        """Return the muscle segments in the form that ``elements`` uses, with the tensions of ``tension``; None if it
        is None. The segments of the last set of muscles are cached."""
        if tension is None:
            return None
        if self._segments is None or self._segments.rows is not tension.rows:
            self._segments = self.elements.segments(tension.rows, tension.rest_lengths)
        self._segments.tensions.put(tension.tensions)
        return self._segments

    def determinants(self, positions: np.ndarray) -> np.ndarray:
        """Return J = det F (T,) at ``positions`` (N, 3) m; not positive where an element is inverted."""
        self.elements.enqueue_energies(*self._upload(positions, None))
        return self._energies.get()[: len(self.mesh.tets)]

    def energy(self, positions: np.ndarray, damping: Damping | None = None) -> float:
        """Return the elastic energy Psi(positions), J; infinite if an element is inverted.

        With ``damping``, add dt beta/2 sum V E':C:E', where E' = (F^T F - F0^T F0) / (2 dt) is the mean strain rate of
        the step.
        """
        self.elements.enqueue_energies(*self._upload(positions, damping))
        return self._sum(self._energies.get())

    def gradient(
        self, positions: np.ndarray, damping: Damping | None = None, tension: MuscleEnergy | None = None
    ) -> np.ndarray:
        """Return the derivative of ``energy`` with respect to the positions, minus the internal force: (N, 3) N.

        With ``tension``, add the gradient of the muscle energy.
        """
        segments = self.load_segments(tension)
        self.elements.enqueue_gradient(*self._upload(positions, damping), segments, self._gradient.array)
        return self._gradient.get().reshape(-1, 3)

    def energy_and_gradient(self, positions: np.ndarray, damping: Damping | None = None) -> tuple[float, np.ndarray]:
        """Return ``energy`` and ``gradient`` at the same positions, without muscles."""
        inputs = self._upload(positions, damping)
        self.elements.enqueue_energies(*inputs)
        self.elements.enqueue_gradient(*inputs, None, self._gradient.array)
        energies, gradient = PinnedMirror.get_all(self._energies, self._gradient)
        return self._sum(energies), gradient.reshape(-1, 3)

    def _sum(self, determinants_and_energies: np.ndarray) -> float:
        return float(determinants_and_energies[self.elements.energy_offset :].sum())

    def enqueue_hessian(
        self, positions: np.ndarray, damping: Damping | None = None, *, factor: float = 1.0, projected: bool = False
    ) -> wp.array:
        """Queue ``hessian_entries``; return the output array, which the next call overwrites."""
        return self.elements.enqueue_entries(*self._upload(positions, damping), factor=factor, projected=projected)

    def hessian_entries(
        self, positions: np.ndarray, damping: Damping | None = None, *, factor: float = 1.0, projected: bool = False
    ) -> np.ndarray:
        """Return the entries (nnz,), ordered as in ``upper_pattern``, of ``factor`` times the Hessian of ``energy``.

        Args:
            positions: (N, 3) m.
            damping: damping of the step, or None.
            factor: multiplies all entries.
            projected: project the Hessian of each element to a positive semi-definite one.
        """
        return self.enqueue_hessian(positions, damping, factor=factor, projected=projected).numpy().flatten()

    def matrix(self, entries: np.ndarray) -> sparse.csc_matrix:
        """Return the upper triangle (3N, 3N) with the given ``entries`` (nnz,)."""
        return sparse.csc_matrix(
            (entries, self.upper_pattern.indices, self.upper_pattern.indptr), shape=self.upper_pattern.shape
        )
