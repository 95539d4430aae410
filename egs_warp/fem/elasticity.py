"""Elastic energy of a tetrahedral body (Eq. 5) and its derivatives, assembled in a fixed order by Warp kernels."""

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
    """Kernels, index maps and scratch memory for one mesh. Node arrays go in and out as (N, 3) float64 on the host."""

    def __init__(self, mesh: TetMesh, material: Material, *, device: str | None = None) -> None:
        self.mesh, self.material, self.device = mesh, material, wp.get_device(device)
        self.maps = AssemblyTopology.of(mesh)
        self.upper_pattern = self.maps.upper_pattern
        self.diagonal_entries = self.upper_pattern.indptr[1:] - 1
        on_device = SimdElasticity if self.device.is_cpu else WarpElasticity
        self.elements = on_device(self.maps, material, self.device)

    def __reduce__(self) -> tuple[Any, ...]:
        """It is made anew wherever a copy of it is read: its arrays lie on a device."""
        return partial(ElasticAssembly, device=str(self.device)), (self.mesh, self.material)

    @cached_property
    def analysis(self) -> SymbolicFactorization:
        """Of ``upper_pattern``."""
        return SymbolicFactorization.of(self.upper_pattern)

    def damping(self, positions: np.ndarray, dt: float) -> Damping:
        """Of a step of ``dt`` seconds that starts at ``positions`` (N, 3)."""
        return Damping(dt, self.elements.start(positions))

    def determinants(self, positions: np.ndarray) -> np.ndarray:
        """(T,) J = det F; not positive where an element is inverted."""
        return self.elements.energy(positions, None)[1]

    def energy(self, positions: np.ndarray, damping: Damping | None = None) -> float:
        """Psi(positions), joules; infinite if an element is inverted.

        With ``damping``, plus dt beta/2 sum V E':C:E', where E' = (F^T F - F0^T F0) / (2 dt) is the mean strain rate of
        the step.
        """
        return self.elements.energy(positions, damping)[0]

    def gradient(
        self, positions: np.ndarray, damping: Damping | None = None, tension: MuscleEnergy | None = None
    ) -> np.ndarray:
        """(N, 3) newtons: the derivative of ``energy`` by the positions, minus the internal force; with that of
        ``tension``."""
        return self.elements.gradient(positions, damping, tension)

    def energy_and_gradient(self, positions: np.ndarray, damping: Damping | None = None) -> tuple[float, np.ndarray]:
        """Both of them."""
        return self.elements.energy_and_gradient(positions, damping)

    def hessian_entries(
        self, positions: np.ndarray, damping: Damping | None = None, *, factor: float = 1.0, projected: bool = False
    ) -> np.ndarray:
        """Entries of ``factor`` times the second derivative of ``energy`` in the order of ``upper_pattern``.

        ``projected``: each element's part is made positive semi-definite.
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
        """``hessian_entries`` where ``factors`` want them: a tensor of torch, or an array of the host."""
        if factors.is_host:
            return self.hessian_entries(positions, damping, factor=factor, projected=projected)
        assert isinstance(self.elements, WarpElasticity)
        return self.elements.entries_on_device(positions, damping, factor=factor, projected=projected)

    def matrix(self, entries: np.ndarray) -> sparse.csc_matrix:
        """Upper triangle (3N, 3N) with the given entries."""
        return sparse.csc_matrix(
            (entries, self.upper_pattern.indices, self.upper_pattern.indptr), shape=self.upper_pattern.shape
        )
