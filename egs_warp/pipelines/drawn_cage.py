"""The cage of a body as players draw it: nodes, tetrahedra, and a surface that resembles the body.

Players use the surface to select bodies and to draw shadows. The surface of a creature is that of its cage. The single
tetrahedron of a prop does not resemble the prop, so its drawn cage has further nodes on the zero set of its level set,
which move affinely with the tetrahedron.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.world_audit import ContactShape
from egs_warp.meshing.level_set import LevelSet
from egs_warp.short_repr import short_repr

_CELLS = 12
"""Number of cells along the longest side of the lattice on which the surface of a prop is triangulated."""
_LEVEL_SET_CELLS = 32
"""Number of cells along the longest side of the lattice of ``drawn_level_set``."""


@dataclass(frozen=True)
class DrawnCage:
    """Cage of N nodes, of which the first C are the nodes of the solver's cage."""

    __repr__ = short_repr

    nodes: np.ndarray
    """(N, 3) m, positions of the nodes at rest."""
    tets: np.ndarray
    """(T, 4) nodes of the tetrahedra."""
    surface: np.ndarray
    """(B, 3) nodes of the surface triangles, wound outwards."""
    weights: np.ndarray
    """(N - C, 4) barycentric weights of the additional nodes in the single tetrahedron; (0, 4) if there are none."""

    @classmethod
    def of(cls, mesh: TetMesh, shape: ContactShape | None = None) -> DrawnCage:
        """Return the drawn cage of a body with the cage ``mesh`` at rest. ``shape`` contains the level set of a prop;
        without it, the surface is the surface of the tetrahedra."""
        if shape is None or len(mesh.tets) > 1:
            return cls(mesh.nodes, mesh.tets, mesh.boundary_faces(), np.zeros((0, 4)))
        vertices, faces = _surface(mesh, shape)
        # The level set is in the frame of the shape's ``rest_positions``, which are the nodes of the cage at rest.
        matrix = np.vstack([mesh.nodes[mesh.tets[0]].T, np.ones(4)])
        weights = np.linalg.solve(matrix, np.vstack([vertices.T, np.ones(len(vertices))])).T
        count = len(mesh.nodes)
        return cls(np.concatenate([mesh.nodes, vertices]), mesh.tets, faces + count, weights)

    def positions(self, nodes: np.ndarray) -> np.ndarray:
        """Return the positions (..., N, 3) m of all nodes, for the positions ``nodes`` (..., C, 3) m of the solver's
        cage."""
        if len(self.weights) == 0:
            return nodes
        return np.concatenate([nodes, np.einsum("vw,...wi->...vi", self.weights, nodes[..., self.tets[0], :])], axis=-2)


def drawn_level_set(shape: ContactShape) -> LevelSet:
    """Return a coarse level set of a body at rest, from which players compute its contact shadows on other bodies."""
    return shape.level_set.resampled(_LEVEL_SET_CELLS)


def _surface(mesh: TetMesh, shape: ContactShape) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) m and triangles (B, 3) of the zero set of the level set on a coarse lattice, or of the
    convex hull of the contact points if the body is too thin for the lattice."""
    from skimage import measure

    counts = np.array(shape.coefficients.shape)
    step = shape.spacing * float(counts.max()) / _CELLS
    axes = [np.arange(0.0, shape.spacing * (count - 1) + step, step) for count in counts]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = shape.level_set.evaluate(shape.origin + lattice.reshape(-1, 3))[0].reshape(lattice.shape[:3])
    if values.min() < 0.0:
        vertices, faces, _, _ = measure.marching_cubes(values, 0.0)
        return shape.origin + step * vertices.astype(np.float64), faces.astype(np.int32)
    points = shape.points(mesh.tets, mesh.nodes)
    hull = ConvexHull(points)
    used, faces = np.unique(hull.simplices, return_inverse=True)
    vertices, faces = points[used], faces.reshape(-1, 3)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("fi,fi->f", normals, hull.equations[:, :3]) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return vertices, faces.astype(np.int32)
