"""Parts of a body that stick out of it: arms, ears, tails, heads on a neck, what a figure holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import dijkstra

from egs_warp.geometry.tetmesh import TetMesh

_MIN_SLENDERNESS = 0.39
"""Smallest V / A^(3/2) of a part of volume V behind a cut of area A: a half ball has 0.38, a cylinder of two radii
1.1."""
_OPENING = 0.95
"""The cut lies where V / A^(3/2) has its first maximum from the tip on, beyond which it falls below this fraction: the
part opens into the body."""
_MIN_LENGTH = 1.75
"""Smallest length of a part, in mean edges: at less, the corners of single elements count as parts."""
_MAX_SHARE = 0.3
"""Largest volume of a part, as a fraction of the body's: more is the body itself."""
_BASE_HEIGHT = 0.06
"""Height in body heights below which a node belongs to the base; a part that reaches it supports the body."""
_MIN_NODES = 4
"""Nodes without which a part cannot bend."""
_LATTICE = 4
"""A tetrahedron is sampled at the centres of a lattice with this many cells along its edge."""


@dataclass(frozen=True, eq=False)
class Protrusion:
    """A part that sticks out and does not stand on the ground."""

    nodes: np.ndarray
    """(k,) indices of its nodes, ascending."""
    tip: int
    """Node farthest from the rest of the body."""
    length: float
    """m, along the surface of the mesh from the tip to the cut that separates it from the body."""


def find_protrusions(mesh: TetMesh, up: np.ndarray) -> tuple[Protrusion, ...]:
    """Find the parts that stick out of a body at rest, whose lowest nodes are on the ground.

    Tips are the local maxima of the mean geodesic distance to the body (Hilaga et al., "Topology matching for fully
    automatic similarity estimation of 3D shapes", SIGGRAPH 2001). From a tip on, the body is cut at increasing
    geodesic distances; the part ends where the volume behind the cut is largest for the area of the cut. Parts with
    common nodes, such as those of both corners of a back rest, are joined.

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
    """Return the part that ends at ``tip``, or None; ``distances`` (N,) m are geodesic from the tip, ``base`` (N,) are
    the nodes on the ground, ``edge`` is the mean length of an edge, m."""
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
    """Yield distance (m), volume behind and area of cuts at increasing ``distances`` (N,) m; volume and area are in
    units of the body's volume and its power 2/3, the area that of a slab one ``edge`` thick."""
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
