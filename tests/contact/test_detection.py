"""Contact (Eq. 3, 8, 9): candidate points, contact frames, and the exact Coulomb forces of a set of contacts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.contact.contact_set import push_out_speeds
from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.contact.detection import (
    ContactDetector,
    _hull_points,
    contact_geometry,
    tangent_directions,
)
from egs_warp.contact.flat_top import FlatTop
from egs_warp.contact.terrain import Solid, step
from egs_warp.deformation.embedding import embed_points
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from tests.support.clouds import surface_cloud
from tests.support.meshes import block_mesh

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
GRAVITY = 9.81


def seven_points(cloud: GaussianCloud, gamma: float = 3.0) -> np.ndarray:
    """Return (n, 7, 3), the mean and the six arm ends (T+ and T-) of each Gaussian, in a loop over Gaussians (slow
    reference)."""
    rows = []
    for mean, (w, x, y, z), log_scale in zip(
        cloud.means.numpy(), cloud.rotations.numpy(), cloud.log_scales.numpy(), strict=True
    ):
        axes = Rotation.from_quat([x, y, z, w]).as_matrix()
        arms = [gamma * np.exp(float(s)) * axes[:, i] for i, s in enumerate(log_scale)]
        rows.append([mean, *(mean + arm for arm in arms), *(mean - arm for arm in arms)])
    return np.array(rows, dtype=np.float64)


def test_hull_points_include_the_lowest_of_all_points(device: str) -> None:
    """Eq. (3), Eq. (8): in each of 50 deformations of the cage, the minimum gap of the hull points equals the minimum
    gap of all 7 n points."""
    mesh = block_mesh()
    cloud = surface_cloud(mesh, 3000, lowest=0.05)
    tilted = (FLOOR, Plane.from_coefficients(0.3, 0.1, 1.0, 0.4))
    geometry = contact_geometry(cloud, mesh, tilted, device=device)
    assert geometry.excluded_count == 0
    all_points = embed_points(mesh, seven_points(cloud).reshape(-1, 3), device="cpu")
    assert len(geometry.weights) < 0.25 * all_points.count
    detector = ContactDetector(geometry, device=device)
    weights = np.asarray(all_points.weights.numpy(), np.float64)
    corners = np.asarray(all_points.nodes.numpy(), np.int32)
    rng = np.random.default_rng(1)
    for _ in range(50):
        x = mesh.nodes @ rng.standard_normal((3, 3)) + 0.1 * rng.standard_normal(mesh.nodes.shape)
        points = np.einsum("pw,pwi->pi", weights, x[corners])
        lowest = min(plane.heights(points).min() for plane in tilted)
        # Both results are from float32 means, but the sums have different orders.
        assert detector.gaps(x)[0].min() == pytest.approx(lowest, abs=1e-6)


def test_gaps_kernel_equals_its_twin(device: str) -> None:
    """Eq. (8): gaps and nearest plane of every point, compared with plain NumPy."""
    mesh = block_mesh()
    planes = (FLOOR, Plane.from_coefficients(1.0, 0.2, 0.3, 0.5), Plane.from_coefficients(-1.0, 0.0, 0.5, 0.7))
    geometry = contact_geometry(surface_cloud(mesh, 200, lowest=0.05), mesh, planes, device=device)
    x = mesh.nodes + 0.2 * np.random.default_rng(2).standard_normal(mesh.nodes.shape)
    points = np.einsum("pw,pwi->pi", geometry.weights, x[mesh.tets[geometry.tet_from_point]])
    heights = np.stack([plane.heights(points) for plane in planes])
    gaps, nearest = ContactDetector(geometry, device=device).gaps(x)
    assert np.abs(gaps - heights.min(axis=0)).max() < 1e-13
    assert np.array_equal(nearest, heights.argmin(axis=0)) and set(nearest) == {0, 1, 2}


def test_gaps_to_a_step_and_a_wall_equal_their_twin(device: str) -> None:
    """Eq. (8): gaps to a floor, a step with two faces, and a wall. A point over the step has its gap to the tread, a
    point in front of the step has its gap to the riser."""
    mesh = block_mesh()
    low = mesh.nodes.min(axis=0)
    size = np.ptp(mesh.nodes, axis=0)
    stair = step(FLOOR, low + 0.5 * size, np.array([1.0, 0.0, 0.3]), 0.3 * size[2])
    wall = Solid((Plane.from_coefficients(0.0, -1.0, 0.0, low[1] + 0.9 * size[1]),))
    geometry = contact_geometry(surface_cloud(mesh, 300), mesh, (FLOOR,), solids=(stair, wall), device=device)
    assert geometry.solid_from_plane == (0, 1, 1, 2) and len(geometry.planes) == 4
    x = mesh.nodes + 0.2 * size * np.random.default_rng(2).standard_normal(mesh.nodes.shape)
    points = np.einsum("pw,pwi->pi", geometry.weights, x[mesh.tets[geometry.tet_from_point]])
    floor, top, riser, side = (plane.heights(points) for plane in geometry.planes)
    expected = np.minimum(np.minimum(floor, np.maximum(top, riser)), side)
    gaps, facing = ContactDetector(geometry, device=device).gaps(x)
    assert np.abs(gaps - expected).max() < 1e-13
    assert set(facing) == {0, 1, 2, 3}
    on_top, before = facing == 1, facing == 2
    assert (top[on_top] >= riser[on_top]).all() and (riser[before] > top[before]).all()
    axes = ContactDetector(geometry, device=device).contact_set(np.flatnonzero(before), x).axes
    assert np.allclose(axes[:, 0], [-1.0, 0.0, 0.0])


def test_endpoints_are_shortened_to_the_plane_at_rest() -> None:
    """Eq. (3): arms that pass through the plane are shortened to end on it; all other arms have the length gamma
    sigma."""
    mesh = block_mesh()
    mean = np.array([[0.05, 0.02, 0.03]])
    cloud = GaussianCloud.from_numpy(
        mean, np.array([[1.0, 0, 0, 0]]), np.log([[0.01, 0.02, 0.05]]), np.zeros(1), np.zeros((1, 1, 3)), device="cpu"
    )
    geometry = contact_geometry(cloud, mesh, (FLOOR,), device="cpu")
    points = np.einsum("pw,pwi->pi", geometry.weights, mesh.nodes[mesh.tets[geometry.tet_from_point]])
    expected = mean + np.array(
        [[0, 0, 0], [0.03, 0, 0], [-0.03, 0, 0], [0, 0.06, 0], [0, -0.06, 0], [0, 0, 0.15], [0, 0, -0.03]]
    )
    assert len(points) == 7
    assert max(np.abs(points - e).max(axis=1).min() for e in expected) < 1e-7
    crowd = contact_geometry(surface_cloud(mesh, 2000), mesh, (FLOOR,), device="cpu")
    assert ContactDetector(crowd, device="cpu").gaps(mesh.nodes)[0].min() > -1e-8


def test_a_flat_top_has_no_points_above_and_none_closely_below() -> None:
    """Points within 0.05 of the top move onto it, and arms of Gaussians below it end there. Gaussians that it does not
    bound, such as those of the back of a chair, keep their points."""
    mesh, band = block_mesh(), 0.05
    cloud = surface_cloud(mesh, 3000, lowest=0.05)
    size = float(mesh.nodes[:, 2].max())
    top = Plane(np.array([0.0, 0.0, 1.0]), -0.5 * size)
    means = top.heights(cloud.means.numpy())
    flat = FlatTop(top, means < band, band)
    geometry = contact_geometry(cloud, mesh, (FLOOR,), tops=(flat,), device="cpu")
    heights = top.heights(np.einsum("pw,pwi->pi", geometry.weights, mesh.nodes[mesh.tets[geometry.tet_from_point]]))
    near = np.abs(heights) < 1e-6
    assert near.sum() > 20 and not ((heights > -band) & (heights < -1e-6)).any()
    # Arms of Gaussians above the band reach down by less than 0.031.
    assert (heights[heights > 1e-6] > band - 0.031).all() and (means > band).any()
    plain = contact_geometry(cloud, mesh, (FLOOR,), device="cpu")
    rest = top.heights(np.einsum("pw,pwi->pi", plain.weights, mesh.nodes[mesh.tets[plain.tet_from_point]]))
    assert heights.max() == rest.max()


def flat_base(noise: float) -> GaussianCloud:
    """Return Gaussians inside the block, half of them with means in its base; all values have an error of up to
    ``noise``."""
    rng, off = np.random.default_rng(4), np.random.default_rng(5)
    count = 2000
    means = np.column_stack([rng.uniform(-0.18, 0.18, (count, 2)), rng.uniform(0.0, 0.9, count)])
    means[: count // 2, 2] = 0.0
    quaternions = rng.standard_normal((count, 4))
    quaternions[: count // 2, 1:3] = 0.0
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    values = [means, quaternions, np.log(rng.uniform(0.002, 0.02, (count, 3))), np.zeros(count)]
    values = [value + noise * off.uniform(-1.0, 1.0, value.shape) for value in values]
    return GaussianCloud.from_numpy(*values, np.zeros((count, 1, 3)), device="cpu")


def test_grid_points_do_not_depend_on_the_last_bits_of_a_file() -> None:
    """Points on the grid are not below the floor and are sorted by position. Rounding errors of single precision change
    fewer than 0.3 % of them, and none on the floor, although half of the means and arms there are then below it.
    Without a grid, most points change."""
    mesh, grid = block_mesh(), 2.0**-10

    def places(noise: float, grid: float | None) -> np.ndarray:
        geometry = contact_geometry(flat_base(noise), mesh, (FLOOR,), grid=grid, device="cpu")
        return np.einsum("pw,pwi->pi", geometry.weights, mesh.nodes[mesh.tets[geometry.tet_from_point]])

    points = places(0.0, grid) / grid
    cells = np.rint(points).astype(int)
    assert np.abs(points - cells).max() < 1e-6 and cells[:, 2].min() == 0
    assert [*map(tuple, cells)] == sorted(set(map(tuple, cells)))
    assert (cells[:, 2] == 0).sum() > 50
    other = np.rint(places(1e-7, grid) / grid).astype(int)
    apart = set(map(tuple, cells)) ^ set(map(tuple, other))
    assert len(apart) < 0.003 * len(cells) and not [place for place in apart if place[2] == 0]
    loose = [{*map(tuple, places(noise, None))} for noise in (0.0, 1e-7)]
    assert len(loose[0] & loose[1]) < 0.5 * len(loose[0])


def test_points_within_an_edge_or_face_of_the_hull_are_no_vertices() -> None:
    """Only the corners of a cubic grid are hull vertices, in any order of its points."""
    line = np.arange(5.0)
    cube = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)
    for seed in range(20):
        places = np.random.default_rng(seed).permutation(cube)
        kept = places[_hull_points(np.zeros(len(places), int), places, 1)]
        assert {*map(tuple, kept)} == {(x, y, z) for x in (0, 4) for y in (0, 4) for z in (0, 4)}


def test_gaussians_below_the_plane_are_left_out_and_counted() -> None:
    """A Gaussian with its mean below the plane is ignored; its fraction of the total opacity is reported.

    See docs/concepts/contact.md.
    """
    mesh = block_mesh()
    means = np.array([[0.0, 0.0, 0.1], [0.1, 0.0, 0.5], [0.0, 0.1, -0.01]])
    logits = np.log([1.0, 3.0, 0.25])
    cloud = GaussianCloud.from_numpy(
        means, np.tile([1.0, 0, 0, 0], (3, 1)), np.full((3, 3), -6.0), logits, np.zeros((3, 1, 3)), device="cpu"
    )
    geometry = contact_geometry(cloud, mesh, (FLOOR,), device="cpu")
    assert geometry.excluded_count == 1
    assert geometry.excluded_opacity == pytest.approx(0.2 / (0.5 + 0.75 + 0.2))
    points = np.einsum("pw,pwi->pi", geometry.weights, mesh.nodes[mesh.tets[geometry.tet_from_point]])
    assert len(points) == 14 and points[:, 2].min() > 0.05


def test_contact_frame_maps_nodes_to_points(device: str) -> None:
    """Eq. (8): the Jacobian gives the normal and tangential velocities of each point in an orthonormal frame; the gaps
    at the end of a step are linear in the velocities."""
    mesh = block_mesh()
    slope = Plane.from_coefficients(0.4, -0.2, 1.0, 0.3)
    geometry = contact_geometry(surface_cloud(mesh, 200, lowest=0.1), mesh, (slope,), device=device)
    detector = ContactDetector(geometry, device=device)
    chosen = np.array([3, 17, 5, 40])
    contacts = detector.contact_set(chosen, mesh.nodes)
    v = np.random.default_rng(3).standard_normal(mesh.nodes.shape)
    local = (contacts.jacobian @ v.ravel()).reshape(-1, 3)
    for i, point in enumerate(chosen):
        velocity = geometry.weights[point] @ v[mesh.tets[geometry.tet_from_point[point]]]
        assert np.allclose(contacts.axes[i] @ contacts.axes[i].T, np.eye(3), atol=1e-14)
        assert np.allclose(local[i], contacts.axes[i] @ velocity, atol=1e-13)
    many = np.random.default_rng(4).standard_normal((v.size, 5))
    assert np.allclose(contacts.contact_velocities(many), contacts.jacobian @ many, atol=1e-13)
    forces = many.ravel()[: 3 * contacts.count].reshape(-1, 3)
    expected = np.zeros_like(mesh.nodes)
    for i, point in enumerate(chosen):
        for weight, node in zip(geometry.weights[point], mesh.tets[geometry.tet_from_point[point]], strict=True):
            expected[node] += weight * contacts.axes[i].T @ forces[i]
    assert np.allclose(contacts.nodal_forces(forces), expected, atol=1e-13)
    assert np.allclose(contacts.contact_velocities(v.ravel()), local.ravel(), atol=1e-13)
    assert detector.contact_set(chosen[:0], mesh.nodes).contact_velocities(many).shape == (0, 5)
    moved, _ = detector.gaps(mesh.nodes + 0.01 * v)
    assert np.allclose(contacts.end_gaps(0.01, v), moved[chosen], atol=1e-13)


def test_push_out_speed_and_tangent_directions() -> None:
    """Eq. (8): the bias is max(phi, 0) / dt + min(phi + slop, 0) b / dt with a limited push-out speed. The tangent
    directions form a regular star."""
    gaps = np.array([0.02, 0.0, -0.004, -1.0])
    assert push_out_speeds(gaps, 0.1, 0.3, 0.5, 0.0).tolist() == pytest.approx([0.2, 0.0, -0.02, -0.3])
    assert push_out_speeds(gaps, 0.1, 0.3, 0.2, 0.003).tolist() == pytest.approx([0.2, 0.0, -0.002, -0.3])
    for count in (4, 6, 8):
        star = tangent_directions(count)
        assert np.allclose(np.linalg.norm(star, axis=1), 1.0) and np.allclose(star.sum(axis=0), 0.0)
        assert np.allclose(star.T @ star, count / 2 * np.eye(2))


def assert_coulomb(
    delassus: np.ndarray, free: np.ndarray, shift: np.ndarray, friction: float, force: np.ndarray, tolerance: float
) -> None:
    """Assert Eq. (9) with the exact cone, to ``tolerance`` in m/s."""
    velocity = (free + delassus @ force.ravel()).reshape(-1, 3)
    measure = velocity[:, 0] + shift
    rate = 1.0 / np.diag(delassus).mean()
    assert force[:, 0].min() >= 0.0
    assert measure.min() >= -tolerance
    assert (force[:, 0] * measure).max() <= tolerance * max(force[:, 0].max(), rate)
    tangent = np.linalg.norm(force[:, 1:], axis=1)
    assert (tangent - friction * force[:, 0]).max() <= 1e-12 * max(force[:, 0].max(), 1.0)
    for f, t, u in zip(force, tangent, velocity[:, 1:], strict=True):
        slip = np.linalg.norm(u)
        # Maximal dissipation: a slipping contact has its force on the cone, opposite to the slip.
        if slip > 10 * tolerance and f[0] > 10 * tolerance * rate:
            assert t == pytest.approx(friction * f[0], rel=1e-4, abs=tolerance * rate)
            assert f[1:] @ u == pytest.approx(-t * slip, rel=1e-4, abs=tolerance**2 * rate)


@pytest.mark.parametrize(("count", "unknowns"), [(1, 6), (4, 20), (12, 60), (12, 24), (40, 150), (40, 60)])
@pytest.mark.parametrize("friction", [0.0, 0.3, 0.8])
def test_coulomb_forces_on_random_problems(count: int, unknowns: int, friction: float) -> None:
    """Eq. (8), Eq. (9): forces satisfy complementarity and the exact cone, also for a singular G, which has fewer
    unknowns than rows and a duplicate contact."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        rows = rng.standard_normal((3 * count, unknowns)) * rng.uniform(0.3, 2.0, unknowns)
        if count > 1:
            rows[-3:] = rows[:3]
        # All normals have a common component, as on a floor, so that some motion separates all contacts.
        rows[0::3, 0] = 4.0 + np.abs(rows[0::3, 0])
        falling = rng.standard_normal(unknowns) - 2.0 * np.eye(unknowns)[0]
        shift = rng.uniform(-0.1, 0.3, count)
        if count > 1:
            shift[-1] = shift[0]
        delassus = rows @ rows.T / unknowns
        delassus[np.diag_indices_from(delassus)] += 1e-7 * delassus.diagonal().mean()
        free = rows @ falling
        force, residual = coulomb_forces(delassus, free, shift, friction, np.zeros((count, 3)))
        assert residual < 1e-7
        assert_coulomb(delassus, free, shift, friction, force, 1e-6)
        assert force[:, 0].max() > 0.0


def block_on_incline(angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the Delassus operator (12, 12), the contact accelerations by gravity (12,), m/s^2, and the lever arms (4,
    6) of a rigid unit cube of 2 kg that rests with its four corners on an incline."""
    mass, inertia = 2.0, 2.0 / 6.0 * np.eye(3)
    arms = np.array([[x, y, -0.5] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    axes = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    jacobian = np.vstack([np.hstack([axes, np.cross(arm, axes)]) for arm in arms])
    mobility = np.zeros((6, 6))
    mobility[:3, :3], mobility[3:, 3:] = np.eye(3) / mass, np.linalg.inv(inertia)
    pull = GRAVITY * np.array([np.sin(angle), 0.0, -np.cos(angle), 0.0, 0.0, 0.0])
    return jacobian @ mobility @ jacobian.T, jacobian @ pull, np.hstack([arms, np.zeros((4, 3))])


def test_block_on_an_incline() -> None:
    """Eq. (9), closed form: the block sticks if tan(angle) < mu. Otherwise it slides with a = g (sin - mu cos), and the
    friction is mu m g cos, uphill.
    """
    friction, dt = 0.5, 0.01
    for angle in np.radians([5.0, 20.0, 26.0, 27.2, 35.0, 42.0]):
        delassus, acceleration, _ = block_on_incline(angle)
        force, residual = coulomb_forces(delassus, dt * acceleration, np.zeros(4), friction, np.zeros((4, 3)))
        assert residual < 1e-10
        velocity = (dt * acceleration + delassus @ force.ravel()).reshape(-1, 3)
        slide = max(GRAVITY * (np.sin(angle) - friction * np.cos(angle)), 0.0)
        assert velocity[:, 1] == pytest.approx(dt * slide, abs=1e-9)
        assert velocity[:, [0, 2]] == pytest.approx(0.0, abs=1e-9)
        assert force[:, 0].sum() == pytest.approx(2.0 * GRAVITY * np.cos(angle) * dt)
        hold = min(np.sin(angle), friction * np.cos(angle))
        assert force[:, 1].sum() == pytest.approx(-2.0 * GRAVITY * hold * dt)


def test_separating_and_absent_contacts_need_no_force() -> None:
    """Eq. (9): there is no contact force on a body that leaves the ground or has no contact."""
    delassus, acceleration, _ = block_on_incline(0.0)
    force, _ = coulomb_forces(delassus, -acceleration, np.zeros(4), 0.5, np.ones((4, 3)))
    assert np.abs(force).max() < 1e-12
    none, residual = coulomb_forces(np.zeros((0, 0)), np.zeros(0), np.zeros(0), 0.5, np.zeros((0, 3)))
    assert none.shape == (0, 3) and residual == 0.0


@pytest.mark.parametrize("regularisation", [0.0, 1e-7])
def test_coulomb_forces_of_forty_points_under_a_rigid_base(regularisation: float) -> None:
    """Eq. (9): for a Jacobian of 120 rows with rank 6 and sticking, sliding, spinning and tilting motions of the body,
    the forces satisfy Coulomb's law and carry the body."""
    rng = np.random.default_rng(5)
    mass, inertia = 2.0, np.diag([0.3, 0.4, 0.2])
    arms = np.column_stack([rng.uniform(-0.5, 0.5, (40, 2)), np.full(40, -0.5)])
    axes = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    jacobian = np.vstack([np.hstack([axes, np.cross(arm, axes)]) for arm in arms])
    mobility = np.zeros((6, 6))
    mobility[:3, :3], mobility[3:, 3:] = np.eye(3) / mass, np.linalg.inv(inertia)
    delassus = jacobian @ mobility @ jacobian.T
    delassus[np.diag_indices_from(delassus)] += regularisation * delassus.diagonal().mean()
    for twist in (
        [0, 0, -0.16, 0, 0, 0],
        [0.05, 0.02, -0.16, 0, 0, 0],
        [0.5, 0, -0.16, 0, 0, 3.0],
        [0, 0, -1, 1, 2, 0],
    ):
        free = jacobian @ np.array(twist, dtype=float)
        force, residual = coulomb_forces(delassus, free, np.zeros(40), 0.5, np.zeros((40, 3)))
        assert residual < 1e-7
        assert_coulomb(delassus, free, np.zeros(40), 0.5, force, 1e-6)
        assert force[:, 0].sum() > 0.5 * mass * -twist[2]


def test_gaps_are_those_of_the_requested_positions(device: str) -> None:
    """Cached gaps are correct for more configurations than the cache holds, in any order, and for arrays that are
    changed in place. Cached results are read-only."""
    mesh = block_mesh()
    geometry = contact_geometry(surface_cloud(mesh, 50, lowest=0.05), mesh, (FLOOR,), device=device)
    kept, place = ContactDetector(geometry, device=device), mesh.nodes.copy()
    for height in (0.0, 0.1, 0.0, 0.2, 0.3, 0.4, 0.5, 0.0, 0.1):
        place[:, 2] = mesh.nodes[:, 2] + height
        expected, faces = ContactDetector(geometry, device=device).gaps(place)
        for _ in range(2):
            gaps, nearest = kept.gaps(place)
            assert np.array_equal(gaps, expected) and np.array_equal(nearest, faces)
            for given in (gaps, nearest):
                with pytest.raises(ValueError, match="read-only"):
                    given[:] = -1
