"""Contact between bodies: gaps and rows compared with a plane and with finite differences, invariance under rigid
motions, equal and opposite forces and torques, and the selection of contacts.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.detection import ContactGeometry
from egs_warp.contact.pair_contact import PairBody, PairContactDetector
from egs_warp.contact.selection import ContactSelector
from egs_warp.deformation.embedding import embed_points
from egs_warp.geometry.plane import Plane
from egs_warp.meshing.level_set import LevelSet, level_set_of_surface
from tests.support.meshes import box_mesh, u_bar

NEAR = 0.01
FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)


@cache
def level_set(size: tuple[float, float, float]) -> LevelSet:
    mesh = box_mesh((1, 1, 1), size)
    return level_set_of_surface(mesh.nodes, mesh.boundary_faces(), cells=64)


def box(size: tuple[float, float, float], counts: tuple[int, int, int] = (2, 2, 2), spacing: float = 0.1) -> PairBody:
    """Create a box on z = 0 with a grid of contact points on its surface."""
    mesh = box_mesh(counts, size)
    steps = [np.linspace(-s / 2, s / 2, int(np.ceil(s / spacing)) + 1) for s in size[:2]]
    heights = np.linspace(0.0, size[2], int(np.ceil(size[2] / spacing)) + 1)
    grid = np.stack(np.meshgrid(*steps, heights, indexing="ij"), axis=-1).reshape(-1, 3)
    on_surface = np.any(np.isclose(np.abs(grid), [size[0] / 2, size[1] / 2, size[2]]), axis=1) | (grid[:, 2] == 0.0)
    embedding = embed_points(mesh, grid[on_surface], device="cpu")
    geometry = ContactGeometry(mesh, (FLOOR,), 0.5, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0)
    selector = ContactSelector(geometry, activation_distance=NEAR, hysteresis=1e-3, device="cpu")
    return PairBody(geometry, selector, level_set(size), mesh.nodes)


@cache
def prongs() -> PairBody:
    """Create a bar with two prongs; its contact points are the nodes of its surface."""
    mesh = u_bar()
    faces = mesh.boundary_faces()
    embedding = embed_points(mesh, mesh.nodes[np.unique(faces)], device="cpu")
    geometry = ContactGeometry(mesh, (FLOOR,), 0.5, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0)
    selector = ContactSelector(geometry, activation_distance=NEAR, hysteresis=1e-3, device="cpu")
    shape = level_set_of_surface(mesh.nodes, faces, cells=64)
    return PairBody(geometry, selector, shape, mesh.nodes, self_contact=True)


def overlapping(depth: float) -> np.ndarray:
    """Return the nodes of ``prongs`` with the prongs moved into each other by ``depth`` m without rotation."""
    nodes = prongs().geometry.mesh.nodes.copy()
    prong = nodes[:, 2] > 0.25
    nodes[prong, 0] -= np.sign(nodes[prong, 0]) * (0.15 + 0.5 * depth)
    return nodes


def points_of(body: PairBody, positions: np.ndarray) -> np.ndarray:
    corners = body.geometry.mesh.tets[body.geometry.tet_from_point]
    return np.einsum("pw,pwi->pi", body.geometry.weights, positions[corners])


def place(*bodies: tuple[PairBody, np.ndarray]) -> np.ndarray:
    return np.concatenate([body.geometry.mesh.nodes + shift for body, shift in bodies])


NOTHING = np.zeros(0, int), np.zeros(0, bool)
"""Empty set of contacts, as at the start of a run without a previous step."""
SMALL, LARGE = (0.3, 0.3, 0.3), (1.0, 1.0, 0.4)


@pytest.fixture(scope="module")
def deformed() -> tuple[PairContactDetector, np.ndarray, ContactSet]:
    """Place a small, rotated box in the top of a larger one, both with perturbed nodes. The contacts are all points of
    the small box near the surface of the larger one, inside or outside."""
    random = np.random.default_rng(1)
    small, large = box(SMALL), box(LARGE)
    detector = PairContactDetector([small, large], device="cpu")
    turned = Rotation.from_rotvec([0.4, 0.2, 0.1]).apply(small.geometry.mesh.nodes) + [0.1, 0.05, 0.35]
    positions = np.concatenate([turned, large.geometry.mesh.nodes])
    positions += random.uniform(-0.02, 0.02, positions.shape)
    gaps = detector.gaps(0, 1, positions)
    near = np.flatnonzero(np.isfinite(gaps))
    contacts = detector.contact_set(detector.indices(0, near, 1), positions)
    return detector, positions, contacts


def test_gaps_and_frames_over_a_large_box_are_those_of_a_plane() -> None:
    small, large = box(SMALL), box(LARGE)
    detector = PairContactDetector([small, large], device="cpu")
    positions = place((small, np.array([0.05, -0.1, LARGE[2] - 0.004])), (large, np.zeros(3)))
    plane = Plane(FLOOR.normal, -LARGE[2])
    numbers = detector.select(positions, *NOTHING)
    keys = detector.keys(numbers)
    assert set(map(tuple, keys[:, :2])) == {(0, 1), (1, 0)}
    contacts = detector.contact_set(numbers[keys[:, 0] == 0], positions)
    heights = plane.heights(points_of(small, positions[: len(small.geometry.mesh.nodes)]))
    assert contacts.count >= 4
    assert np.allclose(contacts.gaps, heights[keys[keys[:, 0] == 0, 2]], atol=1e-6)
    assert np.allclose(contacts.axes, [plane.normal, *plane.tangents()], atol=1e-5)
    other = detector.contact_set(numbers[keys[:, 0] == 1], positions)
    places = points_of(large, positions[len(small.geometry.mesh.nodes) :])[keys[keys[:, 0] == 1, 2]]
    under = np.all(np.abs(places[:, :2] - [0.05, -0.1]) < SMALL[0] / 2 - 0.02, axis=1)
    assert under.sum() >= 4
    assert np.allclose(other.axes[under, 0], -plane.normal, atol=1e-5)
    assert np.allclose(other.gaps[under], -0.004, atol=1e-6)


def test_rows_are_the_derivative_of_the_gap_at_the_surface(
    deformed: tuple[PairContactDetector, np.ndarray, ContactSet],
) -> None:
    detector, positions, contacts = deformed
    small = detector.bodies[0]
    count = len(small.geometry.mesh.nodes)
    # The body is moved so that its point closest to the surface lies on it.
    chosen = int(np.argmin(np.abs(contacts.gaps)))
    point = int(detector.keys(contacts.points)[chosen, 2])
    for _ in range(8):
        record = detector.contact_set(contacts.points[[chosen]], positions)
        positions = positions.copy()
        positions[:count] -= record.gaps[0] * record.axes[0, 0]
    record, step = detector.contact_set(contacts.points[[chosen]], positions), 1e-6
    assert abs(record.gaps[0]) < 1e-9
    row = record.jacobian[[0]].toarray().ravel()
    measured = np.zeros_like(row)
    for index in np.flatnonzero(row):
        for sign in (1.0, -1.0):
            moved = positions.copy().ravel()
            moved[index] += sign * step
            measured[index] += sign * detector.gaps(0, 1, moved.reshape(-1, 3))[point] / (2.0 * step)
    assert np.count_nonzero(row) >= 12
    assert np.allclose(measured, row, atol=1e-5)


def test_forces_and_torques_of_a_pair_cancel_at_any_gap(
    deformed: tuple[PairContactDetector, np.ndarray, ContactSet],
) -> None:
    _, positions, contacts = deformed
    assert contacts.gaps.min() < -0.05 and contacts.gaps.max() > 0.005
    forces = np.random.default_rng(2).normal(size=(contacts.count, 3))
    nodal = (contacts.jacobian.T @ forces.ravel()).reshape(-1, 3)
    scale = np.abs(forces).sum()
    assert np.abs(nodal.sum(axis=0)).max() < 1e-12 * scale
    assert np.abs(np.cross(positions, nodal).sum(axis=0)).max() < 1e-12 * scale
    rigid = np.cross([0.3, -0.5, 0.2], positions) + [1.0, 2.0, 3.0]
    assert np.abs(contacts.jacobian @ rigid.ravel()).max() < 1e-12 * np.abs(rigid).max() * 10


def test_a_common_rigid_motion_changes_no_gap(
    deformed: tuple[PairContactDetector, np.ndarray, ContactSet],
) -> None:
    detector, positions, contacts = deformed
    rotation = Rotation.from_rotvec([0.7, -1.1, 0.4])
    moved = detector.contact_set(contacts.points, rotation.apply(positions) + [3.0, -2.0, 5.0])
    # The boxes do not rotate, so points near their edges have a tetrahedron in only one of the two boxes.
    both = np.isfinite(moved.gaps) & np.isfinite(contacts.gaps) & (contacts.gaps < NEAR)
    same = both & (moved.nodes == contacts.nodes).all(axis=1)
    assert same.sum() > 15 and np.array_equal(same, both)
    assert np.allclose(moved.gaps[same], contacts.gaps[same], atol=1e-12)
    assert np.allclose(moved.axes[same, 0], rotation.apply(contacts.axes[same, 0]), atol=1e-9)


def test_gaps_follow_each_of_the_two_bodies() -> None:
    """Gaps are evaluated again only after one of the bodies has moved, also by a detector that shares the bodies."""
    small, large = box(SMALL), box(LARGE)
    detector = PairContactDetector([small, large], device="cpu")
    up, down = np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, -0.1])
    least = {}
    for name, parts in (
        ("first", ((small, up), (large, np.zeros(3)))),
        ("large moved", ((small, up), (large, -down))),
        ("both moved", ((small, up + down), (large, np.zeros(3)))),
    ):
        positions = place(*parts)
        least[name] = np.sort(detector.gaps(0, 1, positions))[:4]
        assert detector.gaps(0, 1, positions) is detector.gaps(0, 1, positions.copy())
        assert np.array_equal(least[name], np.sort(detector.subset([0, 1]).gaps(0, 1, positions))[:4])
    with pytest.raises(ValueError, match="read-only"):
        detector.gaps(0, 1, positions)[0] = 0.0
    assert not np.isfinite(least["first"]).any()
    assert least["large moved"] == pytest.approx(0.0, abs=1e-3)
    assert least["both moved"] == pytest.approx(least["large moved"], abs=1e-6)
    assert detector.gaps(1, 0, positions).min() >= -1e-3


def test_selection_is_sorted_stable_and_empty_without_overlap() -> None:
    small, large = box(SMALL), box(LARGE)
    detector = PairContactDetector([small, large, small], device="cpu")
    top = LARGE[2]

    def at(first: float, third: float) -> np.ndarray:
        shifts = np.array([0.2, 0.0, first]), np.zeros(3), np.array([-0.2, 0.0, third])
        return place((small, shifts[0]), (large, shifts[1]), (small, shifts[2]))

    apart = at(top + 0.1, top + 0.5)
    assert detector.body_pairs(apart) == [] and len(detector.select(apart, *NOTHING)) == 0
    assert detector.contact_set(np.zeros(0, int), apart).count == 0

    positions = at(top - 0.001, top + 0.005)
    assert detector.body_pairs(positions) == [(0, 1), (1, 0), (1, 2), (2, 1)]
    indices = detector.select(positions, *NOTHING)
    keys = detector.keys(indices)
    assert np.array_equal(indices, detector.indices(keys[:, 0], keys[:, 2], keys[:, 1]))
    assert np.array_equal(keys, keys[np.lexsort(keys.T[::-1])])
    cells = [(a, b, detector.bodies[a].selector.cell_from_point[point]) for a, b, point in keys]
    assert len(set(cells)) == len(cells)

    # Loaded contacts are retained up to twice the activation distance; contacts without load are replaced or dropped.
    lifted = at(top + 1.5 * NEAR, top + 2.5 * NEAR)
    stays = detector.select(lifted, indices, np.ones(len(indices), bool))
    assert np.array_equal(stays, indices[(keys[:, :2] < 2).all(axis=1)])
    assert len(detector.select(lifted, *NOTHING)) == 0


def test_a_body_does_not_touch_itself_at_rest_and_after_a_rigid_motion() -> None:
    """A gap between the prongs of 0.005 m, half of the reach, or of 0 m at rest causes no contact either."""
    body = prongs()
    for gap in (0.3, 0.005, 0.0):
        nodes = body.rest_positions.copy()
        nodes[:, 0] -= np.sign(nodes[:, 0]) * np.minimum(np.abs(nodes[:, 0]), 0.15) / 0.15 * (0.15 - gap / 2)
        mesh = replace(body.geometry.mesh, nodes=nodes)
        narrow = replace(body, geometry=replace(body.geometry, mesh=mesh), rest_positions=nodes)
        detector = PairContactDetector([narrow], device="cpu")
        assert detector.body_pairs(nodes) == [(0, 0)]
        turned = Rotation.from_rotvec([0.7, -1.1, 0.4]).apply(nodes) + [3.0, -2.0, 5.0]
        for positions in (nodes, turned):
            assert not detector.may_touch_itself(0, positions)


def test_prongs_touch_each_other_with_equal_and_opposite_forces() -> None:
    body = prongs()
    detector, positions = PairContactDetector([body], device="cpu"), overlapping(0.004)
    indices = detector.select(positions, *NOTHING)
    contacts, keys = detector.contact_set(indices, positions), detector.keys(indices)
    assert (keys[:, :2] == 0).all() and (contacts.faces == -1).all()
    x, y, z = points_of(body, body.rest_positions)[keys[:, 2]].T
    assert np.allclose(np.abs(x), 0.15) and (z > 0.25).all() and len(set(np.sign(x))) == 2
    # Points away from the edges of the flat sides.
    inner = np.flatnonzero((np.abs(y) < 0.05) & (z > 0.45) & (z < 0.75))
    assert len(inner) >= 4
    normals = np.sign(x[inner])[:, None] * [1.0, 0.0, 0.0]
    assert np.allclose(contacts.axes[inner, 0], normals, atol=1e-5)
    assert np.allclose(contacts.gaps[inner], -0.004, atol=1e-6)
    forces = np.random.default_rng(2).normal(size=(contacts.count, 3))
    nodal = contacts.nodal_forces(forces)
    scale = np.abs(forces).sum()
    assert np.abs(nodal).max() > 0.1
    assert np.abs(nodal.sum(axis=0)).max() < 1e-12 * scale
    assert np.abs(np.cross(positions, nodal).sum(axis=0)).max() < 1e-12 * scale
    # The rows are the derivatives of the gap at the surface.
    positions, chosen, step = overlapping(0.0), indices[inner[:1]], 1e-6
    row, point = detector.contact_set(chosen, positions).jacobian[[0]].toarray()[0], int(keys[inner[0], 2])
    assert np.count_nonzero(np.abs(row) > 0.1) >= 2
    for index in np.flatnonzero(row):
        ends = np.array([positions, positions])
        ends.reshape(2, -1)[:, index] += [step, -step]
        measured = np.subtract(*(detector.gaps(0, 0, each)[point] for each in ends)) / (2.0 * step)
        assert measured == pytest.approx(row[index], abs=1e-4)


def test_both_sides_of_a_contact_may_have_the_same_nodes() -> None:
    """The columns of the Jacobian are those of SciPy, which adds entries at the same place."""
    contacts = ContactSet(
        np.zeros(1, int),
        np.array([[0, 1, 2, 3, 2, 3, 4, 5]], np.int32),
        np.array([[0.1, 0.2, 0.3, 0.4, -0.3, -0.2, -0.4, -0.1]]),
        Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix()[None],
        np.zeros(1),
        np.array([-1], np.int32),
        6,
    )
    columns = contacts.jacobian_columns.toarray()
    assert np.array_equal(columns[6:9], np.zeros((3, 3)))
    assert np.allclose(contacts.jacobian_transposed(), columns, atol=1e-15)
    velocities = np.random.default_rng(0).normal(size=18)
    assert np.allclose(contacts.contact_velocities(velocities), columns.T @ velocities, atol=1e-15)


def test_penetrating_points_of_several_pairs_are_those_of_each_pair_alone() -> None:
    """Two boxes fall 0.06 m onto a larger one. The contacts use the tetrahedra at the end of the step: at the start, no
    tetrahedron of the large box contains the points."""
    small, large = box(SMALL), box(LARGE)

    def at(gap: float, *shifts: float) -> np.ndarray:
        falling = [(small, np.array([x, 0.0, LARGE[2] + gap])) for x in shifts]
        return place((large, np.zeros(3)), *falling)

    detector = PairContactDetector([large, small, small], device="cpu")
    start = at(0.05, 0.2, -0.2)
    found = detector.find_penetrating(NOTHING[0], start, at(-0.01, 0.2, -0.2), 1e-3)
    keys = detector.keys(found)
    contacts = detector.contact_set(found, start)
    assert np.allclose(contacts.gaps[keys[:, 1] == 0], 0.05, atol=2e-3)
    for body, shift in ((1, 0.2), (2, -0.2)):
        alone = PairContactDetector([large, small], device="cpu")
        expected = alone.keys(alone.find_penetrating(NOTHING[0], at(0.05, shift), at(-0.01, shift), 1e-3))
        own = keys[(keys[:, :2] == body).any(axis=1)]
        assert len(own) > 0 and np.array_equal(np.where(own[:, :2] == body, 1, 0), expected[:, :2])
        assert np.array_equal(own[:, 2], expected[:, 2])
