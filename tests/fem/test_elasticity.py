"""Eq. (5): Neo-Hookean elasticity compared with finite differences and closed forms, and its symmetries."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import pytest
import scipy.sparse as sparse
from scipy.spatial.transform import Rotation

from egs_warp.fem.assembly_topology import Damping, Material
from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.geometry.tetmesh import TetMesh
from tests.support.meshes import block_mesh

MATERIAL = Material(young_modulus=3.0e4, poisson_ratio=0.4, density=1000.0, damping_time=0.01)


def full(assembly: ElasticAssembly, entries: np.ndarray) -> np.ndarray:
    upper = assembly.matrix(entries).toarray()
    return upper + np.triu(upper, 1).T


DT = 1 / 60


Bent: TypeAlias = tuple[ElasticAssembly, np.ndarray, Damping]


@pytest.fixture
def bent(device: str) -> Bent:
    mesh = block_mesh()
    rng = np.random.default_rng(1)
    x = mesh.nodes @ Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix().T
    x = x * [1.0, 0.9, 1.1] + 0.008 * rng.standard_normal(x.shape)
    assembly = ElasticAssembly(mesh, MATERIAL, device=device)
    start = x @ Rotation.from_rotvec([0.1, 0.0, 0.3]).as_matrix() + 0.006 * rng.standard_normal(x.shape)
    assert assembly.determinants(x).min() > 0.1
    return assembly, x, assembly.damping(start, DT)


@pytest.mark.parametrize("damped", [False, True])
def test_gradient_is_derivative_of_energy(bent: Bent, damped: bool) -> None:
    """Eq. (5) and, with damping over a step of dt, Eq. (6): the gradient equals central differences of the energy in
    x."""
    assembly, x, damping = bent
    assert assembly.energy(x, damping) > 1.05 * assembly.energy(x)
    damping = damping if damped else None
    rng = np.random.default_rng(2)
    for _ in range(4):
        direction = rng.standard_normal(x.shape)
        h = 1e-6
        slope = (assembly.energy(x + h * direction, damping) - assembly.energy(x - h * direction, damping)) / (2 * h)
        assert slope == pytest.approx(np.sum(assembly.gradient(x, damping) * direction), rel=1e-6)
    energy, gradient = assembly.energy_and_gradient(x, damping)
    assert energy == assembly.energy(x, damping) and np.array_equal(gradient, assembly.gradient(x, damping))


@pytest.mark.parametrize("damped", [False, True])
def test_hessian_is_derivative_of_gradient(bent: Bent, damped: bool) -> None:
    """Eq. (5), Eq. (6): the Hessian equals central differences of the gradient; the projected matrix is positive
    semi-definite."""
    assembly, x, damping = bent
    damping = damping if damped else None
    matrix = full(assembly, assembly.hessian_entries(x, damping))
    direction = np.random.default_rng(3).standard_normal(x.shape)
    h = 1e-6
    change = (assembly.gradient(x + h * direction, damping) - assembly.gradient(x - h * direction, damping)) / (2 * h)
    assert np.abs(matrix @ direction.ravel() - change.ravel()).max() < 1e-6 * np.abs(change).max()
    projected = np.linalg.eigvalsh(full(assembly, assembly.hessian_entries(x, damping, projected=True)))
    assert projected.min() > -1e-9 * projected.max()
    assert np.allclose(
        assembly.hessian_entries(x, damping, factor=0.3), 0.3 * assembly.hessian_entries(x, damping), rtol=1e-12
    )


def test_projected_hessian_clamps_each_element(device: str) -> None:
    """The analytic projection equals the Hessian with its negative eigenvalues set to zero numerically, in the
    coordinates of the deformation gradient."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assembly = ElasticAssembly(TetMesh.oriented(corners, np.array([[0, 1, 2, 3]])), MATERIAL, device=device)
    weights = np.linalg.cholesky(assembly_gram(corners)).T
    rng = np.random.default_rng(4)
    indefinite = 0
    maps = [np.diag(rng.uniform(0.3, 1.6, 3)) + 0.3 * rng.standard_normal((3, 3)) for _ in range(20)]
    for i, k in ((0, 1), (1, 2), (2, 0)):
        # The deformations are a shear in one plane, and an expansion to about three times the size along all axes but
        # one.
        sheared, blown = np.diag([0.5, 0.7, 0.6]), np.diag([3.0, 2.6, 2.8])
        sheared[i, k], blown[k, k] = 0.4, 1.1
        maps += [sheared, blown, blown + 0.1 * rng.standard_normal((3, 3))]
    for map_ in maps:
        x = corners @ map_.T
        if np.linalg.det((x[1:] - x[0]).T) < 0.05:
            continue
        true = full(assembly, assembly.hessian_entries(x))
        projected = full(assembly, assembly.hessian_entries(x, projected=True))
        # The projection acts on deformation gradients, so both 12 x 12 Hessians are transformed to gradient and mean
        # position.
        pull = np.kron(np.linalg.pinv(weights), np.eye(3))
        values, vectors = np.linalg.eigh(pull.T @ true @ pull)
        indefinite += values.min() < -1e-6 * values.max()
        clamped = vectors @ np.diag(np.maximum(values, 0)) @ vectors.T
        assert np.abs(pull.T @ projected @ pull - clamped).max() < 1e-8 * values.max()
    assert indefinite >= 5


def assembly_gram(corners: np.ndarray) -> np.ndarray:
    """Return the 4 x 4 Gram matrix G of a tetrahedron: for corner values u (4,), u^T G u is the squared norm of their
    gradient plus the square of their mean."""
    inverse = np.linalg.inv((corners[1:] - corners[0]).T)
    gradients = np.vstack([-inverse.sum(0), inverse])
    return gradients @ gradients.T + np.full((4, 4), 1.0 / 16.0)


def test_rigid_motion_costs_nothing(bent: Bent) -> None:
    """A rigid motion causes no elastic energy, force or damping; internal forces have no net force or torque."""
    assembly, x, damping = bent
    nodes = assembly.mesh.nodes
    motion = Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix().T
    turned = nodes @ motion + [1.0, 2.0, 3.0]
    assert abs(assembly.energy(turned)) < 1e-9 * MATERIAL.mu
    assert np.abs(assembly.gradient(turned)).max() < 1e-9 * MATERIAL.mu
    force = assembly.gradient(x, damping)
    scale = np.abs(force).sum()
    for part in (force, assembly.gradient(x)):
        assert np.abs(part.sum(0)).max() < 1e-12 * scale
        assert np.abs(np.cross(x, part).sum(0)).max() < 1e-12 * scale
    damping = assembly.damping(x, DT)
    turned = x @ motion + [1.0, 2.0, 3.0]
    assert np.abs(assembly.gradient(turned, damping) - assembly.gradient(turned)).max() < 1e-9 * MATERIAL.mu


def test_uniaxial_stretch_closed_form(device: str) -> None:
    """Eq. (5) for F = diag(a, b, c): Psi = mu/2 (a^2+b^2+c^2-3) - mu ln J + lambda/2 ln^2 J, times the volume."""
    mesh = block_mesh()
    assembly = ElasticAssembly(mesh, MATERIAL, device=device)
    stretch = np.array([1.2, 0.9, 0.8])
    log_j = np.log(stretch.prod())
    density = MATERIAL.mu / 2 * (np.sum(stretch**2) - 3) - MATERIAL.mu * log_j + MATERIAL.lam / 2 * log_j**2
    energy = assembly.energy(mesh.nodes * stretch)
    assert energy == pytest.approx(density * mesh.volumes().sum(), rel=1e-12)


def test_inverted_element_has_infinite_energy(device: str) -> None:
    mesh = block_mesh()
    assembly = ElasticAssembly(mesh, MATERIAL, device=device)
    assert assembly.energy(mesh.nodes * [1, 1, -1]) == np.inf


def test_pattern_is_the_meshs(device: str) -> None:
    mesh = block_mesh()
    assembly = ElasticAssembly(mesh, MATERIAL, device=device)
    pairs = sparse.coo_matrix(
        (np.ones(16 * len(mesh.tets)), (np.repeat(mesh.tets, 4, 1).ravel(), np.tile(mesh.tets, (1, 4)).ravel()))
    ).tocsr()
    assert full(assembly, np.ones(assembly.upper_pattern.nnz)).astype(bool).sum() == 9 * pairs.nnz


def test_moduli_of_a_material() -> None:
    """Lame's parameters satisfy E = mu (3 lambda + 2 mu) / (lambda + mu) and nu = lambda / (2 (lambda + mu))."""
    for nu in (0.1, 0.25, 0.45):
        material = Material(young_modulus=3.0, poisson_ratio=nu, density=1.0, damping_time=0.0)
        mu, lam = material.mu, material.lam
        assert mu * (3.0 * lam + 2.0 * mu) / (lam + mu) == pytest.approx(3.0)
        assert lam / (2.0 * (lam + mu)) == pytest.approx(nu)


def test_a_cpu_gets_sparse_factors_and_a_gpu_dense_ones(device: str) -> None:
    solver = ElasticAssembly(block_mesh(), MATERIAL, device=device).new_solver()
    assert type(solver).__name__ == ("MultifrontalLdl" if device == "cpu" else "TiledCholesky")
