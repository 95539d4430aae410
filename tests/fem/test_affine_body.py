"""Affine bodies of one tetrahedron: moments of a box, energies of affine motions, and flight, sag, tipping and sliding
compared with closed forms.
"""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.errors import UserError
from egs_warp.fem.affine_body import VolumeMoments, affine_body
from egs_warp.fem.body import GRAVITY, BodyState, SoftBody
from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.meshing.occupancy import LatticeSolid
from egs_warp.precision import Vec3
from tests.support.clouds import surface_cloud
from tests.support.meshes import UP, block_mesh, box_mesh
from tests.support.passive import PassiveBody, passive_body
from tests.support.props import moments_of

FLOOR = Plane(UP, 0.0)
DT = 1 / 240


def box_prop(size: tuple[float, float, float], slope: float = 0.0, *, sag: float = 1e-5) -> SoftBody:
    """Create a box on z = 0 under gravity that is tilted towards +x by ``slope`` radians."""
    moments = moments_of(box_mesh((1, 1, 1), size))
    return affine_body(moments, size[2], up=np.array([-np.sin(slope), 0.0, np.cos(slope)]), sag=sag, device="cpu")


def on_floor(body: SoftBody, size: tuple[float, float, float], friction: float) -> PassiveBody:
    corners = box_mesh((1, 1, 1), size).nodes
    return passive_body(body, corners, plane=FLOOR, friction=friction)


def test_moments_of_a_box_are_the_same_from_mesh_and_solid() -> None:
    size = np.array([0.4, 0.2, 0.9])
    mesh = box_mesh((2, 1, 3), tuple(size))
    # The cubes of the lattice fill a box of 20 x 10 columns; the lowest of the 45 layers has half the height.
    spacing = 0.02
    solid = LatticeSolid(
        np.ones((20, 10, 45), bool), np.array([-10, -5, 0]), spacing, 0.9, np.zeros(0, bool), np.zeros(0, bool), 0
    )
    height = 44.5 * spacing
    for moments, top, middle in (
        (moments_of(mesh), 0.9, 0.0),
        (VolumeMoments.of_solid(solid), height, -0.5 * spacing),
    ):
        assert np.isclose(moments.volume, 0.4 * 0.2 * top, rtol=1e-12)
        assert np.allclose(moments.centre, [middle, middle, top / 2], atol=1e-12)
        assert np.allclose(moments.second_moment, np.diag([0.16, 0.04, top**2]) / 12.0, atol=1e-12)


def test_energies_of_affine_motions_are_those_of_the_fine_mesh() -> None:
    random = np.random.default_rng(0)
    mesh = TetMesh(Rotation.from_rotvec([0.3, 0.5, -0.2]).apply(block_mesh().nodes), block_mesh().tets)
    moments = moments_of(mesh)
    body = affine_body(moments, 1.0, up=UP, density=700.0, device="cpu")
    fine = ElasticAssembly(mesh, body.assembly.material, device="cpu")
    ratio = moments.volume / body.mesh.volumes()[0]
    for _ in range(10):
        matrix, shift = np.eye(3) + random.uniform(-0.2, 0.2, (3, 3)), random.normal(size=3)
        moved = [nodes @ matrix.T + shift for nodes in (mesh.nodes, body.mesh.nodes)]
        # The energies are equal up to the ratio of the volumes, by which the material of the element is stiffer.
        assert np.isclose(fine.energy(moved[0]), ratio * body.assembly.energy(moved[1]), rtol=1e-10)
        mean = matrix @ moments.centre + shift
        exact = mean @ mean + np.trace(matrix @ moments.second_moment @ matrix.T)
        kinetic = body.node_mass @ (moved[1] ** 2).sum(axis=1)
        assert np.isclose(kinetic, 700.0 * moments.volume * exact, rtol=1e-12)
    assert np.allclose(body.centre_of_mass(body.mesh.nodes), moments.centre, atol=1e-12)


def test_gaussians_follow_affine_motions_of_the_prop_exactly() -> None:
    random = np.random.default_rng(3)
    body = box_prop((0.2, 0.3, 0.5))
    cloud = surface_cloud(box_mesh((2, 2, 2), (0.2, 0.3, 0.5)), 200)
    embedding = embed_gaussians(cloud, body.mesh)
    matrix, shift = np.eye(3) + random.uniform(-0.3, 0.3, (3, 3)), random.normal(size=3)
    rest, moved = (
        embedding.points.interpolate(wp.array(nodes, dtype=Vec3, device="cpu")).numpy()
        for nodes in (body.mesh.nodes, body.mesh.nodes @ matrix.T + shift)
    )
    assert np.allclose(rest[::7], cloud.means.numpy(), atol=1e-12)
    assert np.allclose(moved, rest @ matrix.T + shift, atol=1e-11)


def test_free_flight_is_a_parabola_with_constant_momentum() -> None:
    body = box_prop((0.2, 0.3, 0.5))
    nodes = body.mesh.nodes
    spin, speed = np.array([0.0, 0.0, 3.0]), np.array([1.0, 0.5, 2.0])
    centre = body.centre_of_mass(nodes)
    flight = passive_body(body, state=BodyState(nodes, speed + np.cross(spin, nodes - centre)))
    momentum = body.angular_momentum(nodes, flight.state.velocities)
    for step in range(1, 49):
        _, result = flight.advance(DT)
        assert result.converged
        time = step * DT
        # In the time t, a body falls by g t (t + dt) / 2 with implicit Euler, which is g t dt / 2 more than on the true
        # parabola.
        exact = centre + speed * time - 0.5 * GRAVITY * UP * time * (time + DT)
        assert np.abs(body.centre_of_mass(flight.state.positions) - exact).max() < 1e-9
        now = body.angular_momentum(flight.state.positions, flight.state.velocities)
        assert np.abs(now - momentum).max() < 1e-9 * np.linalg.norm(momentum)
    rotation = body.best_fit_rotation(flight.state.positions)
    expected = Rotation.from_rotvec(spin * 48 * DT).as_matrix()
    assert np.abs(rotation - expected).max() < 0.01


def test_a_column_shortens_by_half_of_its_sag() -> None:
    size, sag = (0.4, 0.4, 1.0), 1e-3
    standing = on_floor(box_prop(size, sag=sag), size, 0.0)
    for _ in range(60):
        standing.advance(0.02)
        standing.state = BodyState(standing.state.positions, np.zeros((4, 3)))
    body, x = standing.body, standing.state.positions
    deformation = (x[1:] - x[0]).T @ np.linalg.inv((body.mesh.nodes[1:] - body.mesh.nodes[0]).T)
    assert np.isclose(1.0 - deformation[2, 2], 0.5 * sag, rtol=0.01)
    assert np.isclose(deformation[0, 0] - 1.0, 0.4 * 0.5 * sag, rtol=0.01)


@pytest.mark.parametrize(("ratio", "falls"), [(0.97, False), (1.03, True)])
def test_a_box_tips_at_the_angle_of_its_diagonal(ratio: float, falls: bool) -> None:
    size = (0.3, 0.3, 1.0)
    standing = on_floor(box_prop(size, np.arctan(ratio * size[0] / size[2])), size, 2.0)
    for _ in range(240):
        _, result = standing.advance(DT)
        assert result.converged
    tilt = standing.body.best_fit_rotation(standing.state.positions)[2, 2]
    assert tilt < 0.99 if falls else tilt > 1.0 - 1e-6


@pytest.mark.parametrize(("slope", "friction"), [(0.3, 0.2), (0.3, 0.35)])
def test_a_box_slides_with_the_acceleration_that_friction_leaves(slope: float, friction: float) -> None:
    size = (0.6, 0.6, 0.2)
    sliding = on_floor(box_prop(size, slope), size, friction)
    for _ in range(60):
        _, result = sliding.advance(DT)
        assert result.converged
    speed = sliding.body.centre_of_mass(sliding.state.velocities)
    expected = max(0.0, GRAVITY * (np.sin(slope) - friction * np.cos(slope)) * 60 * DT)
    assert np.isclose(speed[0], expected, rtol=1e-3, atol=1e-5)
    assert np.abs(speed[1:]).max() < 1e-4


def test_flat_and_huge_bodies_are_refused() -> None:
    flat = VolumeMoments(1.0, np.zeros(3), np.diag([1.0, 1.0, 0.0]))
    with pytest.raises(UserError, match="the body is flat or has no volume"):
        affine_body(flat, 1.0, up=UP, device="cpu")
    with pytest.raises(UserError, match="give a height of"):
        affine_body(VolumeMoments(1.0, np.zeros(3), np.eye(3)), 1e6, up=UP, device="cpu")
