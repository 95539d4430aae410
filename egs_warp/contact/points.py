"""Which points of the body take part in contact: few, spread evenly, and the same ones from step to step (Eq. 8)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from egs_warp.contact.detection import ContactGeometry
from egs_warp.geometry.tetmesh import mean_edge_length

MOST_AT_REST = 32
"""Cells that touch the ground at rest: the cage cannot resolve more forces than it has nodes there, nor a base tell
more apart.
"""
_FINEST = 0.4
"""Edges of the cage across the smallest cells: small feet stand on several."""
_WIDER = 1.1
"""Growth of the cells until they are few enough."""


class ContactPoints:
    """Cells of the body's surface about as wide as an edge of the cage, each with at most one point in the contact set.

    A cell brings its lowest point. Points that press stay, and so do those that a step has added; others leave once
    they are clear of the ground by twice the distance at which they came, or their cell has a clearly lower one: points
    that come and go make the load chatter.
    """

    def __init__(self, geometry: ContactGeometry, *, near: float, lower: float) -> None:
        """``near`` metres: a cell takes part if the step may bring it so near to a solid. ``lower`` metres: by how much
        another point of a cell must lie lower to take its place.
        """
        self.geometry, self.near, self.lower = geometry, near, lower
        corners = geometry.mesh.tets[geometry.tet_from_point]
        places = np.einsum("pw,pwi->pi", geometry.weights, geometry.mesh.nodes[corners])
        heights = geometry.ground_heights(places)
        sole = np.flatnonzero(heights < heights.min() + 2.0 * near)
        spacing = _FINEST * mean_edge_length(geometry.mesh)
        self.cell_from_point = _few_cells(places, heights, sole, spacing, MOST_AT_REST)

    def choose(self, previous: np.ndarray, loaded: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """(n,) points of the next step in ascending order; ``previous`` (m,) were the last's, ``loaded`` (m,) bool
        those that pressed; ``gaps`` (P,) metres as it may end.
        """
        cells = self.cell_from_point
        near = gaps[previous] < 2.0 * self.near
        lowest = self._lowest(np.flatnonzero(gaps < self.near), gaps)
        low = np.full(cells.max() + 1, np.inf)
        low[cells[lowest]] = gaps[lowest]
        kept = previous[near & (loaded | (gaps[previous] <= low[cells[previous]] + self.lower))]
        fresh = lowest[~np.isin(cells[lowest], cells[kept])]
        return np.sort(np.concatenate([kept, fresh]))

    def deeper(self, points: np.ndarray, gaps: np.ndarray, depth: float) -> np.ndarray:
        """(k,) the deepest point of each cell of which one ends more than ``depth`` metres deep that is not among
        ``points`` (n,).
        """
        return self._lowest(np.setdiff1d(np.flatnonzero(gaps < -depth), points), gaps)

    def _lowest(self, points: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """(k,) of ``points`` (n,) the lowest of each cell."""
        points = points[np.argsort(gaps[points], kind="stable")]
        _, first = np.unique(self.cell_from_point[points], return_index=True)
        return points[np.sort(first)]

    @staticmethod
    def matched(points: np.ndarray, before: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """(n, 3) the ``forces`` (m, 3) of the points ``before`` (m,) on those of them among ``points`` (n,), zero on
        others.
        """
        matched = np.zeros((len(points), 3))
        _, now, then = np.intersect1d(points, before, return_indices=True)
        matched[now] = forces[then]
        return matched


def _few_cells(places: np.ndarray, heights: np.ndarray, sole: np.ndarray, spacing: float, most: int) -> np.ndarray:
    """(P,) nearest seed of each of ``places`` (P, 3); as many seeds as are ``spacing`` metres apart, or fewer, until at
    most ``most`` of them are nearest to points of the ``sole``.
    """
    seeds, apart = _spread(places, int(np.argmin(heights)), spacing)
    while True:
        first = seeds[: np.count_nonzero(apart >= spacing)]
        nearest = np.asarray(KDTree(places[first]).query(places)[1], dtype=int)
        if len(np.unique(nearest[sole])) <= most:
            return nearest
        spacing *= _WIDER


def _spread(places: np.ndarray, start: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """(k,) points from ``start`` on, always the one furthest from all before, and how far it was (k,), at least
    ``spacing`` metres: fewer points, further apart, are the first of these.
    """
    columns = np.ascontiguousarray(places.T)
    seeds, apart = [start], [np.inf]
    distance = np.full(len(places), np.inf)
    while True:
        x, y, z = columns - columns[:, seeds[-1], None]
        np.minimum(distance, np.sqrt(x * x + y * y + z * z), out=distance)
        furthest = int(np.argmax(distance))
        if distance[furthest] < spacing:
            return np.array(seeds), np.array(apart)
        seeds.append(furthest)
        apart.append(float(distance[furthest]))
