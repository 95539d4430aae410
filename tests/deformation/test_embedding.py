"""Eq. (2), (3): embedding of points and Gaussians in the rest cage."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial import Delaunay

from egs_warp.deformation.embedding import CageLocator, embed_points
from egs_warp.errors import UserError
from egs_warp.geometry.tetmesh import TetMesh


def blob(seed: int = 0, count: int = 60) -> TetMesh:
    """Return a perturbed box with a cut-out, which is not convex."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    nodes = np.concatenate([grid, rng.uniform(0.05, 0.95, (count, 3))])
    tets = Delaunay(nodes).simplices
    x = nodes[tets]
    volume = np.abs(np.linalg.det(x[:, 1:] - x[:, :1]))
    centre = x.mean(axis=1)
    tets = tets[(volume > 1e-4) & ~((centre[:, 0] > 0.5) & (centre[:, 1] > 0.5))]
    used, renumbered = np.unique(tets, return_inverse=True)
    return TetMesh.oriented(nodes[used], renumbered.reshape(-1, 4))


def distance_to_triangles(corners: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the distances (F,) from the point p (3,) to the triangles ``corners`` (F, 3, 3), computed from their
    planes and edges."""
    edges = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(edges[:, 0], edges[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = np.einsum("fi,fi->f", normal, p - corners[:, 0])
    to_foot = (p - height[:, None] * normal)[:, None] - corners
    above = (np.einsum("fei,fi->fe", np.cross(edges, to_foot), normal) >= 0).all(axis=1)
    along = np.einsum("fei,fei->fe", edges, p - corners) / np.einsum("fei,fei->fe", edges, edges)
    on_edge = corners + np.clip(along, 0, 1)[..., None] * edges
    return np.where(above, np.abs(height), np.linalg.norm(on_edge - p, axis=2).min(axis=1))


def brute_force(mesh: TetMesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Test all T tetrahedra for each of P points.

    Returns:
        Barycentric weights (P, T, 4), their minima (P, T) and the distances (P, T).
    """
    x = mesh.nodes[mesh.tets]
    system = np.concatenate([x.transpose(0, 2, 1), np.ones((len(x), 1, 4))], axis=1)
    right = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    weights = np.einsum("tij,pj->pti", np.linalg.inv(system), right)
    faces = x[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3, 3)
    distance = np.stack([distance_to_triangles(faces, p).reshape(-1, 4).min(axis=1) for p in points])
    least = weights.min(axis=2)
    return weights, least, np.where(least >= 0, 0.0, distance)


def test_points_are_located_as_by_brute_force(device: str) -> None:
    """Eq. (2): the containing tetrahedron, or the nearest one by true distance, is found with its barycentric
    weights."""
    mesh = blob()
    points = np.random.default_rng(1).uniform(-0.6, 1.6, (250, 3))
    points[:20] = np.random.default_rng(2).uniform(0.05, 0.45, (20, 3))
    points[20:25] *= 50.0
    embedding = embed_points(mesh, points, device=device)
    weights, least, distance = brute_force(mesh, points)
    tets, rows = np.asarray(embedding.tets.numpy(), np.int32), np.arange(len(points))
    inside = least.max(axis=1) >= 0
    assert 15 < inside.sum() < 200
    np.testing.assert_array_equal(embedding.inside.numpy(), inside)
    np.testing.assert_array_equal(tets[inside], np.argmax(least[inside] >= 0, axis=1))
    nearest = distance.min(axis=1)
    tied = distance <= nearest[:, None] * (1 + 1e-9) + 1e-9
    assert tied[rows, tets][~inside].all()
    assert (tied[~inside].sum(axis=1) > 1).any()
    best = np.where(tied, least, -np.inf).max(axis=1)
    np.testing.assert_allclose(least[rows, tets][~inside], best[~inside], rtol=1e-9)
    np.testing.assert_allclose(embedding.weights.numpy(), weights[rows, tets], rtol=1e-9, atol=1e-11)
    np.testing.assert_array_equal(embedding.nodes.numpy(), mesh.tets[tets])


def test_weights_reproduce_points_and_shared_faces_take_the_lowest_tet(device: str) -> None:
    """Eq. (2): weights sum to 1 and sum w x = p to rounding, also far from the origin; on shared faces the lowest index
    is taken."""
    mesh = blob(seed=3)
    far = TetMesh(mesh.nodes + np.array([100.0, -200.0, 50.0]), mesh.tets)
    corners = far.nodes[far.tets]
    points = np.concatenate([far.nodes, corners[:, :3].mean(axis=1), 0.5 * (corners[:, 0] + corners[:, 3])])
    embedding = embed_points(far, points, device=device)
    weights = embedding.weights.numpy()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=0, atol=4e-15)
    used = np.einsum("pk,pki->pi", weights, far.nodes[np.asarray(embedding.nodes.numpy(), np.int32)])
    np.testing.assert_allclose(used, points, rtol=0, atol=1e-10)
    assert embedding.inside.numpy().all()
    lowest = np.array([np.flatnonzero((far.tets == node).any(axis=1))[0] for node in range(len(far.nodes))])
    np.testing.assert_array_equal(embedding.tets.numpy()[: len(far.nodes)], lowest)


@pytest.mark.parametrize("off", [0.0, 30.0])
def test_the_nearest_faces_are_those_of_brute_force(off: float, device: str) -> None:
    """The nearest faces of the cage's surface, and of a horizontal sheet within the cage, equal those found by brute
    force, from inside and outside, and far from the origin."""
    mesh = blob(seed=4)
    mesh = TetMesh(mesh.nodes + np.array([off, -2.0 * off, 0.3]), mesh.tets)
    cage = CageLocator(mesh, device=device)
    points = np.random.default_rng(5).uniform(-0.6, 1.6, (200, 3)) + mesh.nodes.min(axis=0)
    sheet = mesh.nodes.min(axis=0) + np.array([[0.1, 0.1, 0.4], [0.9, 0.1, 0.4], [0.9, 0.9, 0.4], [0.1, 0.9, 0.4]])
    for vertices, faces, surface in (
        (mesh.nodes, mesh.boundary_faces(), None),
        (sheet, np.array([[0, 1, 2], [0, 2, 3]]), cage.local_surface(sheet, np.array([[0, 1, 2], [0, 2, 3]]))),
    ):
        given = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
        found = np.asarray(cage.nearest_faces(given, surface).numpy(), np.int64)
        distance = np.stack([distance_to_triangles(vertices[faces], point) for point in points])
        np.testing.assert_allclose(distance[np.arange(200), found], distance.min(axis=1), rtol=0, atol=2e-5)
        assert len(set(found.tolist())) > 1


def test_a_point_that_is_not_finite_is_refused() -> None:
    points = np.zeros((5, 3))
    points[3, 1] = np.nan
    with pytest.raises(
        UserError, match=r"^embedding: 1 of 5 points are not finite \(first: number 3\); give finite points$"
    ):
        embed_points(blob(), points, device="cpu")
