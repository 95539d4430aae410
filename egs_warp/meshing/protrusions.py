"""Protrusions of a body: arms, ears, tails, heads on a neck, objects that a figure holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import dijkstra

from egs_warp.geometry.tetmesh import TetMesh

_MIN_SLENDERNESS = 0.39
"""Minimum of V / A^(3/2) for a part of volume V behind a cut of area A. The ratio is 0.38 for a half ball, and 1.1 for
a cylinder with a length of two radii."""
_OPENING = 0.95
"""Fraction of a maximum of V / A^(3/2). The cut is at the first maximum from the tip after which the ratio falls below
this fraction of it, because there the part opens into the body."""
_MIN_LENGTH = 1.75
"""Minimum length of a part, in mean edge lengths; shorter parts are corners of single elements."""
_MAX_SHARE = 0.3
"""Maximum volume of a part, as a fraction of the body's volume; a larger part is the body itself."""
_BASE_HEIGHT = 0.06
"""Height, in body heights, below which a node belongs to the base; a part that contains such a node supports the
body."""
_MIN_NODES = 4
"""Minimum number of nodes of a part that can bend."""
_LATTICE = 4
"""Number of lattice cells along the edge of a tetrahedron; the tetrahedron is sampled at the centres of the cells."""


@dataclass(frozen=True, eq=False)
class Protrusion:
    """A part that sticks out of the body and does not stand on the ground."""

    nodes: np.ndarray
    """(k,) indices of the nodes of the part, ascending."""
    tip: int
    """Index of the node farthest from the rest of the body."""
    length: float
    """Geodesic distance from the tip to the cut that separates the part from the body, m."""


def find_protrusions(mesh: TetMesh, up: np.ndarray) -> tuple[Protrusion, ...]:
    """Find the protrusions of a body at rest. The lowest nodes of ``mesh`` are on the ground.

    Tips are the local maxima of the mean geodesic distance to all points of the body (Hilaga et al., "Topology matching
    for fully automatic similarity estimation of 3D shapes", SIGGRAPH 2001). The body is cut at increasing geodesic
    distances from each tip; the part ends where the volume behind the cut is largest relative to the area of the cut.
    Parts with common nodes, such as the two corners of a back rest, are joined.

    Args:
        mesh: cage at rest, m.
        up: (3,) unit vector away from the ground.
    """
    heights = mesh.nodes @ up
    base = heights < heights.min() + _BASE_HEIGHT * float(np.ptp(heights))
    edges = np.unique(np.sort(np.concatenate([mesh.tets[:, pair] for pair in combinations(range(4), 2)])), axis=0)
    lengths = np.linalg.norm(mesh.nodes[edges[:, 1]] - mesh.nodes[edges[:, 0]], axis=1)
    graph = sparse.coo_matrix((lengths, edges.T), shape=(len(heights), len(heights))).tocsr()
    distances, edge = dijkstra(graph, directed=False), float(lengths.mean())
    mean_distances = distances @ mesh.lumped_masses(1.0)
    found = []
    for tip in np.flatnonzero(~base):
        if mean_distances[tip] >= mean_distances[distances[tip] < 1.5 * edge].max():
            part = _part_behind_cut(mesh, int(tip), distances[tip], base, edge)
            found += [] if part is None else [part]
    joined: list[Protrusion] = []
    for part in found:
        common = [other for other in joined if np.isin(part.nodes, other.nodes).any()]
        longest = max([part, *common], key=lambda one: one.length)
        nodes = np.unique(np.concatenate([one.nodes for one in (part, *common)]))
        joined = [other for other in joined if other not in common] + [replace(longest, nodes=nodes)]
    share = mesh.lumped_masses(1.0) / float(mesh.volumes().sum())
    return tuple(part for part in joined if share[part.nodes].sum() <= _MAX_SHARE)


def _part_behind_cut(
    mesh: TetMesh, tip: int, distances: np.ndarray, base: np.ndarray, edge: float
) -> Protrusion | None:
    """Return the protruding part that ends at ``tip``; None if there is none.

    Args:
        mesh: cage at rest, m.
        tip: index of the node.
        distances: (N,) m, geodesic distances from the tip.
        base: (N,) bool, nodes on the ground.
        edge: mean edge length of the cage, m.
    """
    best, best_length = 0.0, 0.0
    for length, volume, area in _cuts(mesh, distances, edge):
        slenderness = volume / area**1.5
        if slenderness > best:
            best, best_length = slenderness, length
        elif best >= _MIN_SLENDERNESS and slenderness < _OPENING * best:
            nodes = np.flatnonzero(distances < best_length)
            return Protrusion(nodes, tip, best_length) if len(nodes) >= _MIN_NODES else None
        if volume > _MAX_SHARE or base[distances < length].any():
            return None
    return None


def _cuts(mesh: TetMesh, distances: np.ndarray, edge: float) -> Iterator[tuple[float, float, float]]:
    """Yield the distance (m), the volume behind the cut, and the area of the cut, for cuts at increasing distances from
    a tip.

    The unit of volume is the volume V of the body, the unit of area is V^(2/3). The area of a cut is the mean over a
    slab of thickness ``edge`` (m). ``distances`` (N,) m are the distances of the nodes from the tip.
    """
    n = _LATTICE
    cells = np.array([(i, j, k) for i in range(n) for j in range(n - i) for k in range(n - i - j)])
    weights = (np.column_stack([cells, n - 1 - cells.sum(axis=1)]) + 0.25) / n
    volumes = np.repeat(mesh.volumes() / len(weights), len(weights))
    samples = (distances[mesh.tets] @ weights.T).ravel()
    order = np.argsort(samples, kind="stable")
    samples, total = samples[order], float(volumes.sum())
    behind = np.r_[0.0, np.cumsum(volumes[order])] / total
    for length in np.arange(_MIN_LENGTH * edge, samples[-1], 0.25 * edge):
        before, here, after = behind[np.searchsorted(samples, [length - 0.5 * edge, length, length + 0.5 * edge])]
        yield float(length), float(here), float((after - before) * total ** (1.0 / 3.0) / edge)
