"""Selection of the contact points of a step: few, evenly spread and stable from step to step (Eq. 8)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from egs_warp.contact.detection import ContactGeometry
from egs_warp.geometry.tetmesh import mean_edge_length

MAX_CELLS_AT_REST = 32
"""Maximum number of cells that touch the ground at rest. The cage cannot resolve more forces than it has nodes
there.
"""
_MIN_SPACING = 0.4
"""Minimum spacing of the cells in mean edge lengths of the cage, so that small feet stand on several cells."""
GAP_TOLERANCE_FRACTION = 1e-7
"""Gap tolerance as a fraction of the activation distance. Of points whose gaps are equal within it, the one closest
to the centre of the cell is selected. A flat sole is flat only to rounding, and rounding would select different
points on different machines.
"""
_SPACING_GROWTH = 1.1
"""Growth factor of the cell spacing until few enough cells touch the ground."""


class ContactSelector:
    """Selector of contact points: cells of the surface, at least 0.4 mean cage edges apart, with at most one point
    each.

    A cell contributes its lowest point. A selected point is dropped once its gap exceeds twice the activation distance.
    A point without load is also dropped if its cell has a clearly lower point. Without this hysteresis points would
    alternate, and the load would oscillate.
    """

    def __init__(self, geometry: ContactGeometry, *, activation_distance: float, hysteresis: float) -> None:
        """Divide the surface into cells.

        Args:
            geometry: the points.
            activation_distance: m. A cell is active if its lowest point may come this close to a solid in the
                step.
            hysteresis: m. Another point of the cell replaces an unloaded one only if it is lower by this much.
        """
        self.geometry, self.activation_distance, self.hysteresis, self.gap_tolerance = (
            geometry,
            activation_distance,
            hysteresis,
            GAP_TOLERANCE_FRACTION * activation_distance,
        )
        corners = geometry.mesh.tets[geometry.tet_from_point]
        positions = np.einsum("pw,pwi->pi", geometry.weights, geometry.mesh.nodes[corners])
        # Rounding assigns points that are equally far from two centres to the same cell on every machine.
        positions = self.gap_tolerance * np.rint(positions / self.gap_tolerance)
        heights = geometry.ground_heights(positions)
        sole = np.flatnonzero(heights < heights.min() + 2.0 * activation_distance)
        spacing = _MIN_SPACING * mean_edge_length(geometry.mesh)
        self.cell_from_point, away = _few_cells(positions, heights, sole, spacing, MAX_CELLS_AT_REST)
        self.order = np.lexsort((np.rint(away / self.gap_tolerance), self.cell_from_point))
        """(P,) point indices sorted by cell, those closest to the cell centre first."""
        self.cell_count = int(self.cell_from_point.max()) + 1

    def select(self, previous: np.ndarray, loaded: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """Select the points of the next step.

        Args:
            previous: (m,) points of the previous step.
            loaded: (m,) bool, True for points that carried load.
            gaps: (P,) m, at the predicted end of the step.

        Returns:
            (n,) points in ascending order.
        """
        lowest = self._lowest(gaps < self.activation_distance, gaps)
        return self.select_from(previous, loaded, gaps[previous], lowest, gaps[lowest])

    def select_from(
        self, previous: np.ndarray, loaded: np.ndarray, gaps: np.ndarray, lowest: np.ndarray, lowest_gaps: np.ndarray
    ) -> np.ndarray:
        """Select the points of the next step from the lowest point of each cell.

        Args:
            previous: (m,) points of the previous step.
            loaded: (m,) bool, True for points that carried load.
            gaps: (m,) m, of ``previous`` at the predicted end.
            lowest: (k,) lowest point of each active cell.
            lowest_gaps: (k,) m.

        Returns:
            (n,) points in ascending order.
        """
        cells = self.cell_from_point
        close = gaps < 2.0 * self.activation_distance
        low = np.full(self.cell_count, np.inf)
        low[cells[lowest]] = lowest_gaps
        retained = previous[close & (loaded | (gaps <= low[cells[previous]] + self.hysteresis))]
        added = lowest[~np.isin(cells[lowest], cells[retained])]
        return np.sort(np.concatenate([retained, added]))

    def find_deeper(self, points: np.ndarray, gaps: np.ndarray, depth: float) -> np.ndarray:
        """Return (k,), the deepest point of each cell that ends more than ``depth`` metres deep and is not in
        ``points`` (n,).
        """
        deep = gaps < -depth
        deep[points] = False
        return self._lowest(deep, gaps)

    def order_by_gap(self, points: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """Return (n,), the order in which ``find_deeper`` lists ``points`` (n,) with ``gaps`` (n,) m, each the lowest
        of its cell.
        """
        return np.lexsort((points, np.rint(gaps / self.gap_tolerance)))

    def _lowest(self, among: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """Return (k,), the lowest point of each cell in the mask ``among`` (P,), lowest first. Ties go to the point
        closest to the centre.
        """
        if not among.any():
            return self.order[:0]
        points = self.order[among[self.order]]
        cells, heights = self.cell_from_point[points], np.rint(gaps[points] / self.gap_tolerance)
        starts = np.flatnonzero(np.diff(cells, prepend=-1))
        lowest_heights = np.repeat(np.minimum.reduceat(heights, starts), np.diff(starts, append=len(points)))
        lowest = np.flatnonzero(heights == lowest_heights)
        lowest = points[lowest[np.diff(cells[lowest], prepend=-1) > 0]]
        return lowest[self.order_by_gap(lowest, gaps[lowest])]

    @staticmethod
    def transfer_forces(points: np.ndarray, before: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """Map ``forces`` (m, 3) at the points ``before`` (m,) to ``points`` (n,); they are zero for new points."""
        matched = np.zeros((len(points), 3))
        now, then = np.nonzero(points[:, None] == before)
        matched[now] = forces[then]
        return matched


def _few_cells(
    positions: np.ndarray, heights: np.ndarray, sole: np.ndarray, spacing: float, maximum: int
) -> tuple[np.ndarray, np.ndarray]:
    """Assign points to cells, at most ``maximum`` of which touch the ground.

    Args:
        positions: (P, 3) m, points at rest.
        heights: (P,) m above the ground.
        sole: indices of the points near the ground.
        spacing: minimum distance of the cell centres, m; it grows until the cells are few enough.
        maximum: maximum number of cells with points of the sole.

    Returns:
        (P,) cell of each point and (P,) its distance to the cell centre, m.
    """
    seeds, apart = _spread(positions, int(np.argmin(heights)), spacing)
    while True:
        first = seeds[: np.count_nonzero(apart >= spacing)]
        away, nearest = (np.asarray(each) for each in KDTree(positions[first]).query(positions))
        if len(np.unique(nearest[sole])) <= maximum:
            return nearest.astype(int), away
        spacing *= _SPACING_GROWTH


def _spread(positions: np.ndarray, start: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Select points by farthest-point sampling, at least ``spacing`` metres apart.

    A coarser sampling is a prefix of the result.

    Args:
        positions: (P, 3) m.
        start: index of the first point.
        spacing: minimum distance, m.

    Returns:
        (k,) indices and (k,) m, the distance of each point to the nearest one before it.
    """
    columns = np.ascontiguousarray(positions.T)
    seeds, apart = [start], [np.inf]
    distance = np.full(len(positions), np.inf)
    while True:
        x, y, z = columns - columns[:, seeds[-1], None]
        np.minimum(distance, np.sqrt(x * x + y * y + z * z), out=distance)
        furthest = int(np.argmax(distance))
        if distance[furthest] < spacing:
            return np.array(seeds), np.array(apart)
        seeds.append(furthest)
        apart.append(float(distance[furthest]))
