"""Eq. (5): elements in groups of four, which agree with single elements up to the order of summation."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse

from egs_warp.fem.assembly_topology import Material
from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.fem.warp_elasticity import WarpElasticity
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.muscles.tension import MuscleEnergy
from tests.support.meshes import block_mesh

MATERIAL = Material(young_modulus=3.0e4, poisson_ratio=0.4, density=1000.0, damping_time=0.01)
Pair = tuple[ElasticAssembly, ElasticAssembly]


def both(mesh: TetMesh) -> Pair:
    """Return the elasticity evaluated by single elements and by groups of four."""
    four = ElasticAssembly(mesh, MATERIAL, device="cpu")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("egs_warp.fem.elasticity.SimdElasticity", WarpElasticity)
        return ElasticAssembly(mesh, MATERIAL, device="cpu"), four


def part(count: int) -> TetMesh:
    """Return the first ``count`` tetrahedra of a block with permuted nodes."""
    mesh = block_mesh()
    used, corners = np.unique(mesh.tets[:count], return_inverse=True)
    order = np.random.default_rng(count).permutation(len(used))
    nodes = np.empty((len(used), 3))
    nodes[order] = mesh.nodes[used]
    return TetMesh(nodes, order[corners.reshape(-1, 4)].astype(np.int32))


def strings(mesh: TetMesh) -> MuscleEnergy:
    """Return three muscle segments that each depend on many nodes; one is slack, and one is shorter than the length
    below which the tension decreases."""
    rng = np.random.default_rng(2)
    rows = sparse.csr_matrix(rng.standard_normal((3, len(mesh.nodes))) * (rng.random((3, len(mesh.nodes))) < 0.6))
    lengths = np.linalg.norm(rows @ mesh.nodes, axis=1)
    return MuscleEnergy(rows, np.array([30.0, -4.0, 11.0]), lengths / [1.1, 0.5, 0.2])


@pytest.mark.parametrize("count", [1, 4, 7, 40, None])
@pytest.mark.parametrize("dt", [None, 1 / 60])
def test_groups_of_four_equal_single_elements(count: int | None, dt: float | None) -> None:
    """Eq. (5): energies, determinants, gradients with and without muscles, and both Hessians agree."""
    mesh = block_mesh() if count is None else part(count)
    one, four = both(mesh)
    rng = np.random.default_rng(3)
    start, end = (mesh.nodes + 0.008 * rng.standard_normal(mesh.nodes.shape) for _ in range(2))
    damping = [None if dt is None else each.damping(start, dt) for each in (one, four)]
    (energy, determinants), (found, others) = (
        (each.energy(end, damped), each.determinants(end)) for each, damped in zip((one, four), damping, strict=True)
    )
    assert found == pytest.approx(energy, rel=1e-13) and energy > 0.0
    np.testing.assert_allclose(others, determinants, rtol=1e-13)
    tension = strings(mesh)
    for muscles in (None, tension):
        expected, given = (
            each.gradient(end, damped, muscles) for each, damped in zip((one, four), damping, strict=True)
        )
        np.testing.assert_allclose(given, expected, atol=1e-13 * np.abs(expected).max())
    for projected in (False, True):
        expected, given = (
            each.hessian_entries(end, damped, factor=0.3, projected=projected)
            for each, damped in zip((one, four), damping, strict=True)
        )
        np.testing.assert_allclose(given, expected, atol=1e-13 * np.abs(expected).max())
    pulled = four.gradient(end, damping[1], tension) - four.gradient(end, damping[1], None)
    np.testing.assert_allclose(pulled, tension.gradient(end), atol=1e-9)


def test_shapes_with_equal_principal_stretches() -> None:
    """Bodies at rest, stretched along one axis, or scaled uniformly have equal principal stretches, for which the
    principal axes are not unique; results are finite and agree."""
    mesh = block_mesh()
    one, four = both(mesh)
    for shape in (np.ones(3), np.array([1.0, 1.0, 1.3]), 0.8 * np.ones(3)):
        expected, found = (
            each.hessian_entries(mesh.nodes * shape, None, factor=1.0, projected=True) for each in (one, four)
        )
        assert np.isfinite(found).all()
        np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


def test_an_inverted_element_among_four() -> None:
    """For an inverted element, the energy is infinite and the gradient not finite, as for single elements; later calls
    are not affected."""
    mesh = block_mesh()
    one, four = both(mesh)
    turned = mesh.nodes.copy()
    corner = mesh.tets[5, 0]
    turned[corner] = 2.0 * turned[mesh.tets[5, 1:]].mean(axis=0) - turned[corner]
    for each in (one, four):
        energy, determinants = each.energy(turned), each.determinants(turned)
        assert energy == np.inf and determinants[5] < 0.0
        assert not np.isfinite(each.gradient(turned, None, None)).all()
        assert np.abs(each.gradient(mesh.nodes, None, None)).max() < 1e-9
