"""Contact between bodies: gaps and rows compared with a plane and with finite differences, invariance under rigid
motions, equal and opposite forces and torques, and the selection of contacts.
"""

from __future__ import annotations

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
from tests.support.meshes import box_mesh

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
