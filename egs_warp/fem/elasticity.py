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
from egs_warp.fem.multifrontal import SymbolicFactorization
from egs_warp.fem.simd_elasticity import SimdElasticity
from egs_warp.fem.warp_elasticity import WarpElasticity
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.muscles.tension import MuscleEnergy


class ElasticAssembly:
    """Elasticity of one mesh: index maps, scratch memory and launches. Node arrays are (N, 3) float64 on the host."""

    def __init__(self, mesh: TetMesh, material: Material, *, device: str | None = None) -> None:
        self.mesh, self.material, self.device = mesh, material, wp.get_device(device)
        self.maps = AssemblyTopology.of(mesh)
        self.upper_pattern = self.maps.upper_pattern
        self.diagonal_entries = self.upper_pattern.indptr[1:] - 1
        on_device = SimdElasticity if self.device.is_cpu else WarpElasticity
        self.elements = on_device(self.maps, material, self.device)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the mesh and the material only; the copy rebuilds the arrays on its device."""
        return partial(ElasticAssembly, device=str(self.device)), (self.mesh, self.material)

    def with_rest_shape(self, nodes: np.ndarray) -> ElasticAssembly:
        """Return the elasticity of the same elements and material with the rest positions ``nodes`` (N, 3) m."""
        return ElasticAssembly(TetMesh(nodes, self.mesh.tets), self.material, device=str(self.device))

    @cached_property
    def analysis(self) -> SymbolicFactorization:
        """Symbolic factorization of ``upper_pattern``."""
        return SymbolicFactorization.of(self.upper_pattern)

    def damping(self, positions: np.ndarray, dt: float) -> Damping:
        """Return the damping of a step of ``dt`` seconds that starts at ``positions`` (N, 3) m."""
        return Damping(dt, self.elements.start(positions))

    def determinants(self, positions: np.ndarray) -> np.ndarray:
        """Return J = det F (T,) at ``positions`` (N, 3); not positive where an element is inverted."""
        return self.elements.energy(positions, None)[1]

    def energy(self, positions: np.ndarray, damping: Damping | None = None) -> float:
        """Return the elastic energy Psi(positions), J; infinite if an element is inverted.

        With ``damping``, add dt beta/2 sum V E':C:E', where E' = (F^T F - F0^T F0) / (2 dt) is the mean strain rate of
        the step.
        """
        return self.elements.energy(positions, damping)[0]

    def gradient(
        self, positions: np.ndarray, damping: Damping | None = None, tension: MuscleEnergy | None = None
    ) -> np.ndarray:
        """Return the derivative of ``energy`` with respect to the positions, minus the internal force: (N, 3) N.

        With ``tension``, add the gradient of the muscle energy.
        """
        return self.elements.gradient(positions, damping, tension)

    def energy_and_gradient(self, positions: np.ndarray, damping: Damping | None = None) -> tuple[float, np.ndarray]:
        """Return ``energy`` and ``gradient`` without muscles."""
        return self.elements.energy_and_gradient(positions, damping)

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
        return self.elements.hessian_entries(positions, damping, factor=factor, projected=projected)

    def entries_for(
        self,
        factors: LinearSolver,
        positions: np.ndarray,
        damping: Damping | None,
        *,
        factor: float = 1.0,
        projected: bool = False,
    ) -> Any:
        """Return ``hessian_entries`` where ``factors`` read them: a NumPy array, or a PyTorch tensor on the device."""
        if factors.is_host:
            return self.hessian_entries(positions, damping, factor=factor, projected=projected)
        assert isinstance(self.elements, WarpElasticity)
        return self.elements.entries_on_device(positions, damping, factor=factor, projected=projected)

    def matrix(self, entries: np.ndarray) -> sparse.csc_matrix:
        """Return the upper triangle (3N, 3N) with the given ``entries`` (nnz,)."""
        return sparse.csc_matrix(
            (entries, self.upper_pattern.indices, self.upper_pattern.indptr), shape=self.upper_pattern.shape
        )
