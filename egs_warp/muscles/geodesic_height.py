"""Geodesic height: a function that increases along every limb of a body away from the ground.

First, the Poisson equation -lap u = 1 is solved with u = 0 at the base, as for a body that is heated evenly and cooled
at its base. The only minimum of u is the base, and its maxima are the tips. The geodesic height then has the direction
of the gradient of u and unit slope, as in the heat method of Crane, Weischedel and Wardetzky (2013).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from egs_warp.geometry.tetmesh import TetMesh, edge_graph

_BASE_FRACTION = 0.02
"""Height above the lowest point of the body up to which nodes belong to the base, as a fraction of the body height; at
least 0.4 edge lengths."""


def base_nodes(mesh: TetMesh, up: np.ndarray) -> np.ndarray:
    """Return the indices of the nodes on which the body stands."""
    heights = mesh.nodes @ up
    edge = edge_graph(mesh).data.mean()
    return np.flatnonzero(heights <= heights.min() + max(_BASE_FRACTION * np.ptp(heights), 0.4 * edge))


def geodesic_height(mesh: TetMesh, up: np.ndarray) -> np.ndarray:
    """Return the geodesic height (N,) m, described in the module's docstring: zero at the base, with about unit slope
    along every limb."""
    volumes = mesh.volumes()
    corners = mesh.nodes[mesh.tets]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    gradients = np.concatenate([-inverse.sum(axis=2, keepdims=True), inverse], axis=2).transpose(0, 2, 1)
    stiffness = np.einsum("t,tai,tbi->tab", volumes, gradients, gradients)
    rows, columns = np.repeat(mesh.tets, 4, axis=1).ravel(), np.tile(mesh.tets, (1, 4)).ravel()
    laplacian = sp.csc_matrix((stiffness.ravel(), (rows, columns)), shape=(len(mesh.nodes),) * 2)
    free = np.setdiff1d(np.arange(len(mesh.nodes)), base_nodes(mesh, up))
    solver = splu(laplacian[free][:, free].tocsc())
    drainage, ascent = np.zeros(len(mesh.nodes)), np.zeros(len(mesh.nodes))
    drainage[free] = solver.solve(mesh.lumped_masses(1.0)[free])
    slopes = np.einsum("tai,ta->ti", gradients, drainage[mesh.tets])
    slopes /= np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-300)
    divergence = np.zeros(len(mesh.nodes))
    np.add.at(divergence, mesh.tets, np.einsum("t,tai,ti->ta", volumes, gradients, slopes))
    ascent[free] = solver.solve(divergence[free])
    return ascent
