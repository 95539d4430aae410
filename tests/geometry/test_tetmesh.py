"""Surface and volume of a tetrahedral mesh."""

from __future__ import annotations

import pickle
from itertools import combinations

import numpy as np
import pytest

from egs_warp.geometry.tetmesh import TetMesh, mean_edge_length
from tests.support.meshes import box_mesh


def test_surface_and_edges_are_those_of_the_tetrahedra() -> None:
    """The surface is closed and encloses the volume of the mesh. Its array is cached, shared by all callers and
    therefore read-only."""
    mesh = box_mesh((2, 2, 3), (0.5, 0.5, 1.0))
    faces = mesh.boundary_faces()
    a, b, c = mesh.nodes[faces].transpose(1, 0, 2)
    assert np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0 == pytest.approx(0.25)
    np.testing.assert_allclose(np.cross(b - a, c - a).sum(axis=0), 0.0, atol=1e-12)
    assert mesh.boundary_faces() is faces
    with pytest.raises(ValueError, match="read-only"):
        faces[0, 0] = 0
    edges = {tuple(sorted(pair)) for tet in mesh.tets.tolist() for pair in combinations(tet, 2)}
    lengths = [np.linalg.norm(mesh.nodes[a] - mesh.nodes[b]) for a, b in edges]
    assert mean_edge_length(mesh) == mean_edge_length(mesh) == pytest.approx(np.mean(lengths))
    again: TetMesh = pickle.loads(pickle.dumps(mesh))
    np.testing.assert_array_equal(again.boundary_faces(), faces)
