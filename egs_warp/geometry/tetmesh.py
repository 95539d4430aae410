"""A tetrahedral mesh in its rest shape."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np
import scipy.sparse as sp

from egs_warp.checked_calls import checked_method
from egs_warp.errors import UserError
from egs_warp.short_repr import short_repr


@dataclass(frozen=True)
class TetMesh:
    """Nodes and tetrahedra; every tetrahedron has positive volume."""

    __repr__ = short_repr

    nodes: Annotated[np.ndarray, "nodes", 3]
    """(N, 3) float64, m, positions of the nodes."""
    tets: Annotated[np.ndarray, "tets", 4]
    """(T, 4) int32, node indices of the tetrahedra; (x1-x0, x2-x0, x3-x0) is right-handed."""

    @classmethod
    def oriented(cls, nodes: np.ndarray, tets: np.ndarray) -> TetMesh:
        """Create the mesh. Two nodes of each left-handed tetrahedron are swapped (fTetWild writes such tetrahedra), so
        that all are right-handed.

        Raises ``UserError`` if an element has no volume.
        """
        nodes = np.ascontiguousarray(nodes, dtype=np.float64)
        tets = np.array(tets, dtype=np.int32)
        volumes = _signed_volumes(nodes, tets)
        if len(tets) == 0 or not np.all(np.abs(volumes) > 0):
            raise UserError(
                f"mesh: {int(np.sum(volumes == 0))} of {len(tets)} tetrahedra have no volume; remesh the body"
            )
        left_handed = volumes < 0
        tets[left_handed, 2], tets[left_handed, 3] = tets[left_handed, 3].copy(), tets[left_handed, 2].copy()
        return cls(nodes, tets)

    def volumes(self) -> np.ndarray:
        """Return the volumes (T,) float64, m^3, of the tetrahedra; all are positive."""
        return _signed_volumes(self.nodes, self.tets)

    def lumped_masses(self, density: float) -> np.ndarray:
        """Return the nodal masses (N,) float64, kg: each tetrahedron adds a quarter of its mass to each of its nodes.
        ``density`` is in kg/m^3."""
        masses = np.zeros(len(self.nodes))
        np.add.at(masses, self.tets.ravel(), np.repeat(density * self.volumes() / 4.0, 4))
        return masses

    def boundary_faces(self) -> np.ndarray:
        """Return the node indices (B, 3) int32 of the surface triangles, wound outwards; the array is read-only."""
        return self._surface

    # Surface and mean edge length are cached, because each motion needs them when it starts.
    @cached_property
    def _surface(self) -> np.ndarray:
        faces = self.tets[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
        _, first, counts = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        surface = faces[np.sort(first[counts == 1])]
        surface.flags.writeable = False
        return surface

    @cached_property
    def _mean_edge(self) -> float:
        return float(edge_graph(self).data.mean())

    def min_dihedral_degrees(self) -> float:
        """Return the minimum dihedral angle over all tetrahedra, degrees."""
        corners = self.nodes[self.tets]
        normals = np.stack(
            [
                np.cross(corners[:, b] - corners[:, a], corners[:, c] - corners[:, a])
                for a, b, c in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))
            ],
            axis=1,
        )
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        cosines = -np.einsum("tai,tbi->tab", normals, normals)[:, *np.triu_indices(4, 1)]
        return float(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)).min()))

    @checked_method
    def write_vtu(self, path: Path) -> None:
        """Write the mesh as a .vtu file through meshio."""
        import meshio

        meshio.Mesh(self.nodes, [("tetra", self.tets)]).write(path)


def _signed_volumes(nodes: np.ndarray, tets: np.ndarray) -> np.ndarray:
    x = nodes[tets]
    return np.einsum("ti,ti->t", x[:, 1] - x[:, 0], np.cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 0])) / 6.0


def edge_graph(mesh: TetMesh) -> sp.csr_matrix:
    """Return the symmetric matrix (N, N) whose entry (a, b) is the length in metres of the edge from node a to b."""
    pairs = mesh.tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2)
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    lengths = np.linalg.norm(mesh.nodes[pairs[:, 0]] - mesh.nodes[pairs[:, 1]], axis=1)
    graph = sp.coo_matrix((lengths, (pairs[:, 0], pairs[:, 1])), shape=(len(mesh.nodes),) * 2)
    return (graph + graph.T).tocsr()


def mean_edge_length(mesh: TetMesh) -> float:
    """Return the mean edge length of ``mesh``, m."""
    return mesh._mean_edge
