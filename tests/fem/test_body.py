"""Soft body: mass, momenta, energy, best-fit rotation, and elasticity and damping that follow from its height."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg as dense
import scipy.sparse as sparse
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.fem.body import GRAVITY, MAX_HEIGHT, MAX_SAG, MIN_HEIGHT, SoftBody, make_body
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from tests.support.meshes import block_mesh, box_mesh, coarse_stool

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)


@pytest.fixture(scope="module")
def body() -> SoftBody:
    return make_body(block_mesh(), FLOOR, sag=0.03, device="cpu")


def test_material_follows_from_height() -> None:
    """Young's modulus is E = rho g H / sag for any size and any up direction (docs/concepts/cage.md)."""
    for size, normal in ((0.3, [0.0, 0.0, 1.0]), (2.0, [0.0, 1.0, 0.0])):
        mesh = block_mesh(size=(0.4 * size, 0.4 * size, size))
        made = make_body(mesh, Plane(np.array(normal), 0.1), sag=0.03, density=800.0, device="cpu")
        height = np.ptp(mesh.nodes @ normal)
        assert made.height == pytest.approx(height)
        assert made.assembly.material.young_modulus == pytest.approx(800.0 * GRAVITY * height / 0.03)
        assert np.allclose(made.gravity, -9.81 * np.array(normal))
        assert made.mass == pytest.approx(800.0 * mesh.volumes().sum())
        assert made.weight == pytest.approx(made.mass * GRAVITY)
        assert made.time_unit == pytest.approx(np.sqrt(height / GRAVITY))
        assert made.speed_unit == pytest.approx(np.sqrt(GRAVITY * height))


def test_damping_ratio_of_the_first_mode(body: SoftBody) -> None:
    """Eq. (6): beta = 2 zeta / omega_1, with omega_1 from a dense eigenvalue problem of the body clamped at its
    base."""
    upper = body.assembly.matrix(body.assembly.hessian_entries(body.mesh.nodes))
    free = np.repeat(body.mesh.nodes[:, 2] > 0.05 * body.height, 3)
    stiffness = (upper + sparse.triu(upper, 1).T).toarray()[free][:, free]
    omega = np.sqrt(dense.eigh(stiffness, np.diag(np.repeat(body.node_mass, 3)[free]), eigvals_only=True)[0])
    assert body.assembly.material.damping_time == pytest.approx(2 * 0.05 / omega, rel=1e-8)


def test_momenta_of_a_rigid_motion(body: SoftBody) -> None:
    """For v = u + omega x (x - c), the velocity of the centre of mass is u, L = I omega, and the kinetic energy is m
    u^2 / 2 + omega . I omega / 2.
    """
    x = body.mesh.nodes @ Rotation.from_rotvec([0.1, 0.7, -0.4]).as_matrix().T + [0.3, 0.2, 1.0]
    centre = body.centre_of_mass(x)
    u, omega = np.array([1.0, -0.5, 2.0]), np.array([0.3, 1.1, -0.7])
    v = u + np.cross(omega, x - centre)
    assert np.allclose(body.centre_of_mass(v), u, atol=1e-13)
    inertia = np.zeros((3, 3))
    for m, arm in zip(body.node_mass, x - centre, strict=True):
        inertia += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    assert np.allclose(body.inertia(x), inertia)
    assert np.allclose(body.angular_momentum(x, v), inertia @ omega)
    kinetic = 0.5 * body.mass * u @ u + 0.5 * omega @ inertia @ omega
    potential = body.mass * GRAVITY * centre[2]
    assert body.mechanical_energy(x, v) == pytest.approx(kinetic + potential, rel=1e-9)


def test_best_fit_rotation_recovers_a_rotation(body: SoftBody) -> None:
    """The rotation is exact for a rotated stretch along the principal axes, and proper even for a mirrored body."""
    turn = Rotation.from_rotvec([0.4, -1.9, 0.8]).as_matrix()
    centred = body.mesh.nodes - body.centre_of_mass(body.mesh.nodes)
    assert np.allclose(body.best_fit_rotation(centred @ turn.T + [1.0, 2.0, 3.0]), turn, atol=1e-12)
    spread = np.einsum("n,ni,nj->ij", body.node_mass, centred, centred)
    _, axes = np.linalg.eigh(spread)
    stretch = axes @ np.diag([0.8, 1.1, 1.5]) @ axes.T
    assert np.allclose(body.best_fit_rotation(centred @ (turn @ stretch).T), turn, atol=1e-10)
    mirrored = body.best_fit_rotation(centred * [-1.0, 1.0, 1.0])
    assert np.linalg.det(mirrored) == pytest.approx(1.0)


@pytest.mark.parametrize("scale", [1e-300, 1e-4, 1e5])
def test_a_height_that_no_body_has_is_refused(scale: float) -> None:
    mesh = block_mesh()
    with pytest.raises(
        UserError, match=r"metres_per_unit: the body is .* m high; choose a value that gives a height of 0.001"
    ):
        make_body(TetMesh(mesh.nodes * scale, mesh.tets), FLOOR, device="cpu")


def test_the_smallest_and_the_largest_body_are_bodies() -> None:
    for height in (MIN_HEIGHT, MAX_HEIGHT):
        mesh = box_mesh((2, 2, 2), (0.4 * height, 0.4 * height, height))
        assert make_body(mesh, FLOOR, device="cpu").height == height


def test_a_body_hinged_at_an_edge_is_refused() -> None:
    """Two boxes that share only an edge form a hinge. The upper one rotates freely, so the lowest frequency is zero and
    the body is refused."""
    box = box_mesh((1, 1, 1), (1.0, 1.0, 1.0))
    low = box.nodes.min(axis=0)
    both = np.concatenate([box.nodes - low, box.nodes - low + [1.0, 0.0, 1.0]])
    nodes, merged = np.unique(both.round(9), axis=0, return_inverse=True)
    assert len(nodes) == 2 * len(box.nodes) - 2
    tets = merged.ravel()[np.concatenate([box.tets, box.tets + len(box.nodes)])].astype(np.int32)
    with pytest.raises(
        UserError, match="nodes: parts of the cage are connected by a single corner or edge; request more"
    ):
        make_body(TetMesh(nodes, tets), FLOOR, device="cpu")


def test_a_body_on_thin_legs_is_stiffened_until_it_sinks_by_two_percent() -> None:
    """The centre of mass sinks by ``MAX_SAG`` H in a dense linear solve with a clamped base; a column, which sags less,
    is not stiffened (docs/concepts/cage.md).
    """
    for mesh, stiffened in ((coarse_stool(), True), (box_mesh((2, 2, 4), (0.8, 0.8, 2.0)), False)):
        made = make_body(mesh, FLOOR, sag=0.05, device="cpu")
        upper = made.assembly.matrix(made.assembly.hessian_entries(mesh.nodes))
        free = np.repeat(mesh.nodes[:, 2] > 0.05 * made.height, 3)
        stiffness = (upper + sparse.triu(upper, 1).T).toarray()[free][:, free]
        moved = np.zeros(3 * len(mesh.nodes))
        moved[free] = np.linalg.solve(stiffness, (made.node_mass[:, None] * made.gravity).ravel()[free])
        sink = -made.centre_of_mass(moved.reshape(-1, 3))[2]
        if stiffened:
            assert made.stiffening > 1.5 and sink == pytest.approx(MAX_SAG * made.height, rel=1e-6)
        else:
            assert made.stiffening == pytest.approx(1.0) and sink < MAX_SAG * made.height
