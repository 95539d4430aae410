"""Surviving mutants of ``fem`` and its kernels."""

from __future__ import annotations

from tests.support.surviving_mutants.survivor import Survivor

FEM = [
    Survivor(
        "fem/warp_elasticity.py",
        "self._no_gradients, self._no_forces = empty((0, 0), Mat33, device), empty((0, 0), Vec3, device)",
        "self._no_gradients, self._no_forces = empty((0,  1), Mat33, device), empty((0, 0), Vec3, device)",
        "a placeholder for an array that no kernel reads without damping",
    ),
    Survivor(
        "fem/body.py",
        "column = ElasticAssembly(mesh, Material(young, poisson_ratio, density, 0.0), device=device)",
        "column = ElasticAssembly(mesh, Material(young, poisson_ratio, density, -1.0), device=device)",
        "the column is loaded at rest, without damping",
    ),
    Survivor(
        "fem/assembly_topology.py",
        "offsets = np.searchsorted(inverse[order], np.arange(len(blocks) + 1))",
        "offsets = np.searchsorted(inverse[order], np.arange(len(blocks) + 2))",
        "one more offset, a copy of the last one, which is not used",
    ),
    Survivor(
        "fem/linear_solver.py",
        "@property",
        "",
        "a member of a Protocol, which is never executed",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "(length / rest_lengths[segment] - length_zero_force) / (length_full_force - length_zero_force),",
        "(length / rest_lengths[segment] - length_zero_force) / (length_full_force % length_zero_force),",
        "killed by tests/muscles/test_tension.py, which does not belong to this package",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "if end_offsets.shape[0] > 0:",
        "if end_offsets.shape[0] != 0:",
        "a count is never negative",
    ),
    Survivor(
        "fem/panel_cholesky.py",
        "self.chunk = max(1, chunk_bytes // (8 * size * size))",
        "self.chunk = max(1, chunk_bytes - (8 * size * size))",
        "it changes the number of worlds per pass; results are the same",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "DIAGONAL_TOLERANCE, MAX_SWEEPS = 1e-31, 12",
        "DIAGONAL_TOLERANCE, MAX_SWEEPS = 1e-31,  13",
        "one more sweep on a 3 x 3 matrix that is already diagonal",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "length_factor = along * along * (real(3.0) - real(2.0) * along)",
        "length_factor = along * along // (real(3.0) - real(2.0) * along)",
        "killed by tests/muscles/test_tension.py, which belongs to another package",
    ),
    Survivor(
        "fem/multifrontal.py",
        "positive = int((factors.diagonal()[pivots > 0] > 0.0).sum()) + int((pivots < 0).sum()) // 2",
        "positive = int((factors.diagonal()[pivots >= 0] > 0.0).sum()) + int((pivots < 0).sum()) // 2",
        "pivots count from one, so none is zero",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "if between != real(0.0):",
        "if between != real( 1.0):",
        "for a zero entry the rotation angle is zero",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "while sweep < _MAX_SWEEPS and m[0, 1] * m[0, 1] + m[0, 2] * m[0, 2] + m[1, 2] * m[1, 2] > tolerance:",
        "while sweep < _MAX_SWEEPS and m[0, 1] * m[0, 1] + m[0, 2] * m[0, 2] + m[1, 2] * m[1, 2] >= tolerance:",
        "no sum of squares equals the bound exactly",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "for k in range(3):",
        "for k in range( 4):",
        "entries of a fourth column are overwritten by the next row, or lie outside the matrix: no sum reads them",
    ),
]
