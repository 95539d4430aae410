"""Depth of contact points in another body, or in another part of their own body, for the audit of a world
(docs/concepts/bodies.md). No code of the solver is used."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from scipy.spatial import KDTree

_POINTS_AT_A_TIME = 256
"""Number of points that are located in the tetrahedra of a body at once; it bounds the memory that this takes."""

GapFunction: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function that returns the gaps (n,) m and normals (n, 3) of points from the nodes (n, 4) of their tetrahedra, their
weights (n, 4) and the positions (n, 4, 3) m of these nodes (``ContactShape.gaps``)."""


def depth_in_body(points: np.ndarray, gaps_in: GapFunction, tets: np.ndarray, positions: np.ndarray) -> float:
    """Return the depth, in metres, of the deepest of the ``points`` (n, 3) m in a body with ``tets`` (T, 4) and nodal
    ``positions`` (N, 3) m, whose gaps are ``gaps_in``. Points outside a cage of several tetrahedra are outside the
    body, which it encloses."""
    if len(points) == 0:
        return 0.0
    corners = positions[tets]
    near = (corners.min(axis=1) <= points.max(axis=0)) & (corners.max(axis=1) >= points.min(axis=0))
    near = near.all(axis=1) | (len(tets) == 1)
    near[near] = np.linalg.det(corners[near, 1:] - corners[near, :1]) > 0.0
    tets, corners, depth = tets[near], corners[near], 0.0
    if len(tets) == 0:
        return 0.0
    inverses = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    for first in range(0, len(points), _POINTS_AT_A_TIME):
        arms = points[first : first + _POINTS_AT_A_TIME, None] - corners[:, 0]
        weights = _with_first(np.einsum("pti,tij->ptj", arms, inverses))
        least = weights.min(axis=2)
        tet = least.argmax(axis=1)
        rows = np.arange(len(tet))
        inside = (least[rows, tet] >= 0.0) | (len(near) == 1)
        rows, tet = rows[inside], tet[inside]
        gaps, _ = gaps_in(tets[tet], weights[rows, tet], corners[tet])
        depth = max(depth, -float(gaps.min(initial=0.0)))
    return depth


def depth_in_itself(
    point_tets: np.ndarray,
    point_weights: np.ndarray,
    gaps_in: GapFunction,
    tets: np.ndarray,
    rest: np.ndarray,
    positions: np.ndarray,
    min_shift: float,
) -> float:
    """Return the depth, in metres, of the deepest contact point of a body in another part of it: in a tetrahedron that
    maps the point to a place of the rest shape at least ``min_shift`` metres from its own.

    Args:
        point_tets: (P,) int, tetrahedron of each contact point.
        point_weights: (P, 4) barycentric weights of each point.
        gaps_in: gaps of the body.
        tets: (T, 4) nodes of the tetrahedra.
        rest: (N, 3) m, nodes at rest.
        positions: (N, 3) m, nodes.
        min_shift: m.
    """
    first, second = _overlapping_tets(tets, rest, positions, min_shift)
    order = np.argsort(point_tets, kind="stable")
    starts = np.searchsorted(point_tets[order], np.arange(len(tets) + 1))
    counts = np.diff(starts)[first]
    # All points of the first tetrahedron of each pair, pair by pair.
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    points, other = order[np.repeat(starts[first], counts) + within], np.repeat(second, counts)
    corners, weights = tets[point_tets[points]], point_weights[points]
    places, own = (np.einsum("nw,nwi->ni", weights, nodes[corners]) for nodes in (positions, rest))
    weights = _weights_in(places[:, None], positions[tets[other]])[:, 0]
    shifts = np.einsum("nw,nwi->ni", weights, rest[tets[other]]) - own
    inside = (weights.min(axis=1) >= 0.0) & (np.linalg.norm(shifts, axis=1) >= min_shift)
    nodes = tets[other[inside]]
    gaps, _ = gaps_in(nodes, weights[inside], positions[nodes])
    return max(0.0, -float(gaps.min(initial=0.0)))


def _overlapping_tets(
    tets: np.ndarray, rest: np.ndarray, positions: np.ndarray, min_shift: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs (n,) and (n,) of tetrahedra such that a point of the first may be inside the second, and be shifted
    by ``min_shift`` there."""
    corners, rest_corners = positions[tets], rest[tets]
    edges, rest_edges = corners[:, 1:] - corners[:, :1], rest_corners[:, 1:] - rest_corners[:, :1]
    upright = np.flatnonzero(np.linalg.det(edges) > 0.0)
    middles = corners.mean(axis=1)
    radius = np.linalg.norm(corners - middles[:, None], axis=2).max()
    pairs = upright[KDTree(middles[upright]).query_pairs(2.0 * radius, output_type="ndarray")]
    low, high = corners.min(axis=1), corners.max(axis=1)
    for axis in range(3):
        first, second = pairs.T
        least, greatest = low[:, axis], high[:, axis]
        pairs = pairs[(least[first] < greatest[second]) & (least[second] < greatest[first])]
    first, second = np.concatenate([pairs, pairs[:, ::-1]]).T
    # The second tetrahedron maps a place x to x A + b at rest. Shifts of the corners of the first, which need no
    # weights, exclude most pairs of neighbours. Shifts of its points lie between those of its corners.
    maps, offsets = np.zeros((len(tets), 3, 3)), np.zeros((len(tets), 3))
    maps[upright] = np.linalg.solve(edges[upright], rest_edges[upright])
    offsets[upright] = rest_corners[upright, 0] - np.einsum("ti,tij->tj", corners[upright, 0], maps[upright])
    shifts = corners[first] @ maps[second] + offsets[second, None] - rest_corners[first]
    is_shifted = np.einsum("nci,nci->nc", shifts, shifts).max(axis=1) >= min_shift**2
    first, second = first[is_shifted], second[is_shifted]
    weights = _weights_in(corners[first], corners[second])
    chosen = (weights.max(axis=1) >= 0.0).all(axis=1)
    return first[chosen], second[chosen]


def _weights_in(places: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the barycentric weights (n, k, 4) of ``places`` (n, k, 3) m in tetrahedra with ``corners`` (n, 4, 3) m."""
    inverses = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    return _with_first(np.einsum("nki,nij->nkj", places - corners[:, :1], inverses))


def _with_first(weights: np.ndarray) -> np.ndarray:
    """Return the four barycentric weights (..., 4) for the last three (..., 3)."""
    return np.concatenate([1.0 - weights.sum(axis=2, keepdims=True), weights], axis=2)
