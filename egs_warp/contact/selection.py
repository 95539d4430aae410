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
ALIKE = 1e-7
"""Of the distance at which points take part: those whose gaps are the same but for so much lie alike, and the one next
to the middle of its cell is taken. What is flat lies flat on the ground to rounding, which would choose otherwise on
each machine."""
_WIDER = 1.1
"""Growth of the cells until they are few enough."""


class ContactSelector:
    """Cells of the body's surface about as wide as an edge of the cage, each with at most one point in the contact set.

    A cell brings its lowest point. Points that press stay, and so do those that a step has added; others leave once
    they are clear of the ground by twice the distance at which they came, or their cell has a clearly lower one: points
    that come and go make the load chatter.
    """

    def __init__(self, geometry: ContactGeometry, *, near: float, lower: float) -> None:
        """``near`` metres: a cell takes part if the step may bring it so near to a solid. ``lower`` metres: by how much
        another point of a cell must lie lower to take its place.
        """
        self.geometry, self.activation_distance, self.hysteresis, self.gap_tolerance = (
            geometry,
            near,
            lower,
            ALIKE * near,
        )
        corners = geometry.mesh.tets[geometry.tet_from_point]
        places = np.einsum("pw,pwi->pi", geometry.weights, geometry.mesh.nodes[corners])
        # What is as far from one seed as from another goes to the same on every machine.
        places = self.gap_tolerance * np.rint(places / self.gap_tolerance)
        heights = geometry.ground_heights(places)
        sole = np.flatnonzero(heights < heights.min() + 2.0 * near)
        spacing = _FINEST * mean_edge_length(geometry.mesh)
        self.cell_from_point, away = _few_cells(places, heights, sole, spacing, MOST_AT_REST)
        self.order = np.lexsort((np.rint(away / self.gap_tolerance), self.cell_from_point))
        """(P,) points cell by cell, those next to its middle first."""
        self.cell_count = int(self.cell_from_point.max()) + 1

    def select(self, previous: np.ndarray, loaded: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """(n,) points of the next step in ascending order; ``previous`` (m,) were the last's, ``loaded`` (m,) bool
        those that pressed; ``gaps`` (P,) metres as it may end.
        """
        lowest = self._lowest(gaps < self.activation_distance, gaps)
        return self.select_from(previous, loaded, gaps[previous], lowest, gaps[lowest])

    def select_from(
        self, previous: np.ndarray, loaded: np.ndarray, gaps: np.ndarray, lowest: np.ndarray, lowest_gaps: np.ndarray
    ) -> np.ndarray:
        """``choose``, of the ``previous`` (m,) points with ``gaps`` (m,), and of the ``lowest`` (k,) of each cell that
        is near, with ``lowest_gaps`` (k,) metres."""
        cells = self.cell_from_point
        near = gaps < 2.0 * self.activation_distance
        low = np.full(self.cell_count, np.inf)
        low[cells[lowest]] = lowest_gaps
        kept = previous[near & (loaded | (gaps <= low[cells[previous]] + self.hysteresis))]
        fresh = lowest[~np.isin(cells[lowest], cells[kept])]
        return np.sort(np.concatenate([kept, fresh]))

    def find_deeper(self, points: np.ndarray, gaps: np.ndarray, depth: float) -> np.ndarray:
        """(k,) the deepest point of each cell of which one ends more than ``depth`` metres deep that is not among
        ``points`` (n,).
        """
        deep = gaps < -depth
        deep[points] = False
        return self._lowest(deep, gaps)

    def order_by_gap(self, points: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """(n,) the order of ``points`` (n,) with ``gaps`` (n,) metres, each the lowest of its cell, in ``deeper``."""
        return np.lexsort((points, np.rint(gaps / self.gap_tolerance)))

    def _lowest(self, among: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """(k,) of the points ``among`` (P,) bool the lowest of each cell, the lowest of all first; of those that lie
        alike the one next to the cell's middle."""
        if not among.any():
            return self.order[:0]
        points = self.order[among[self.order]]
        cells, heights = self.cell_from_point[points], np.rint(gaps[points] / self.gap_tolerance)
        begins = np.flatnonzero(np.diff(cells, prepend=-1))
        least = np.repeat(np.minimum.reduceat(heights, begins), np.diff(begins, append=len(points)))
        found = np.flatnonzero(heights == least)
        found = points[found[np.diff(cells[found], prepend=-1) > 0]]
        return found[self.order_by_gap(found, gaps[found])]

    @staticmethod
    def transfer_forces(points: np.ndarray, before: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """(n, 3) the ``forces`` (m, 3) of the points ``before`` (m,) on those of them among ``points`` (n,), zero on
        others.
        """
        matched = np.zeros((len(points), 3))
        now, then = np.nonzero(points[:, None] == before)
        matched[now] = forces[then]
        return matched


def _few_cells(
    places: np.ndarray, heights: np.ndarray, sole: np.ndarray, spacing: float, most: int
) -> tuple[np.ndarray, np.ndarray]:
    """(P,) nearest seed of each of ``places`` (P, 3), and how far it is (P,); as many seeds as are ``spacing`` metres
    apart, or fewer, until at most ``most`` of them are nearest to points of the ``sole``.
    """
    seeds, apart = _spread(places, int(np.argmin(heights)), spacing)
    while True:
        first = seeds[: np.count_nonzero(apart >= spacing)]
        away, nearest = (np.asarray(each) for each in KDTree(places[first]).query(places))
        if len(np.unique(nearest[sole])) <= most:
            return nearest.astype(int), away
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
