"""Attachment of muscle end points: non-negative weights over the nodes around each point."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from egs_warp.geometry.tetmesh import TetMesh, edge_graph

MIN_ATTACHMENT_NODES = 8
"""Minimum number of nodes of an attachment. With fewer nodes, the force is concentrated on one or two elements, which
collapse."""

_NEWTON_ITERATIONS = 30
_MULTIPLIER_PENALTY = 0.05


def attachment_rows(mesh: TetMesh, points: np.ndarray, *, radius: float | None = None) -> sp.csr_matrix:
    """Attach points to the nodes around them.

    The weight of a node is a Gaussian of width ``radius`` times the node's share of the volume, so that the force per
    volume, rather than the force per node, is smooth. The weights are tilted exponentially so that the weighted
    centroid B p lies at the point if the surrounding nodes allow it (local maximum-entropy weights, Arroyo and Ortiz
    2006). Distances are measured along the edges of the mesh, so that nodes across the gap between two limbs are
    excluded.

    Args:
        mesh: cage at rest.
        points: (P, 3) m, muscle end points.
        radius: width of the Gaussian, m; nodes within twice this distance are attached; default: the mean edge length.

    Returns:
        Rows B (P, N) with B >= 0 and row sums 1.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    graph = edge_graph(mesh)
    radius = float(graph.data.mean()) if radius is None else radius
    volumes = mesh.lumped_masses(1.0)
    distances = np.linalg.norm(points[:, None] - mesh.nodes[None], axis=2)
    nearest = np.argmin(distances, axis=1)
    sources, row_from_point = np.unique(nearest, return_inverse=True)
    along_edges = dijkstra(graph, directed=False, indices=sources)
    columns, weights, counts = [], [], []
    for point, to_nodes, row in zip(points, distances, row_from_point, strict=True):
        order = np.argsort(along_edges[row], kind="stable")
        reached = (to_nodes <= 2.0 * radius) & (along_edges[row] <= 3.0 * radius)
        reached[order[:MIN_ATTACHMENT_NODES]] = True
        nodes = np.flatnonzero(reached)
        scale = max(radius, float(np.sort(to_nodes[nodes])[MIN_ATTACHMENT_NODES - 1]))
        columns.append(nodes)
        weights.append(_maximum_entropy_weights((mesh.nodes[nodes] - point) / scale, volumes[nodes]))
        counts.append(len(nodes))
    starts = np.concatenate([[0], np.cumsum(counts)])
    return sp.csr_matrix(
        (np.concatenate(weights), np.concatenate(columns), starts), shape=(len(points), len(mesh.nodes))
    )


def _maximum_entropy_weights(offsets: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return weights (n,) >= 0 with sum 1 and a weighted mean offset near zero, closest in relative entropy to shares
    exp(-|offset|^2).

    Newton's method minimizes the smooth, strictly convex dual log sum(prior exp(offset.t)) + penalty |t|^2 / 2. The
    penalty keeps t finite if the origin lies outside the convex hull of the nodes.

    Args:
        offsets: (n, 3) nodes relative to the point, in units of the Gaussian's width.
        shares: (n,) shares of the nodes in the volume.
    """
    log_prior = np.log(shares) - np.einsum("ni,ni->n", offsets, offsets)

    def evaluate(tilt: np.ndarray) -> tuple[float, np.ndarray]:
        exponents = log_prior + offsets @ tilt
        top = exponents.max()
        terms = np.exp(exponents - top)
        total = terms.sum()
        return top + np.log(total) + 0.5 * _MULTIPLIER_PENALTY * tilt @ tilt, terms / total

    tilt = np.zeros(3)
    value, weights = evaluate(tilt)
    for _ in range(_NEWTON_ITERATIONS):
        mean = weights @ offsets
        gradient = mean + _MULTIPLIER_PENALTY * tilt
        if np.linalg.norm(gradient) < 1e-12:
            break
        centred = offsets - mean
        hessian = (centred * weights[:, None]).T @ centred + _MULTIPLIER_PENALTY * np.eye(3)
        step = -np.linalg.solve(hessian, gradient)
        length = 1.0
        while length > 1e-6:
            trial_value, trial_weights = evaluate(tilt + length * step)
            if trial_value <= value + 1e-4 * length * (gradient @ step):
                break
            length *= 0.5
        else:
            break
        tilt, value, weights = tilt + length * step, trial_value, trial_weights
    return weights / weights.sum()
