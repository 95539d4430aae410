"""Support polygon: the convex hull of the contact points on the ground, and the margins of points in it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull

_LINE_TOLERANCE = 1e-6
"""Maximum ratio of width to length of points that are considered collinear."""
_TOLERANCE = 1e-9
"""Maximum distance outside a half plane, relative to the distances involved, of a point that is considered inside."""


@dataclass(frozen=True)
class SupportPolygon:
    """Convex polygon on the ground. It may degenerate to a segment or a point."""

    corners: np.ndarray
    """(k, 2) m, corners in counterclockwise order."""
    normals: np.ndarray
    """(m, 2) outward unit normals of the edges."""
    offsets: np.ndarray
    """(m,) m, offsets of the edges: a point is inside if its dot product with each normal is at most the offset."""

    @classmethod
    def hull(cls, points: np.ndarray) -> SupportPolygon:
        """Return the convex hull of ``points`` (n, 2), n > 0. They may be collinear."""
        if is_line(points):
            along = np.linalg.svd(points - points.mean(axis=0), full_matrices=True)[2][0]
            coordinates = points @ along
            ends = points[[coordinates.argmin(), coordinates.argmax()]]
            normals = np.array([along, -along, [-along[1], along[0]], [along[1], -along[0]]])
            return cls(ends, normals, (normals @ ends.T).max(axis=1))
        hull = ConvexHull(points)
        return cls(points[hull.vertices], hull.equations[:, :2], -hull.equations[:, 2])

    @cached_property
    def middle(self) -> np.ndarray:
        """(2,) m, centre of area; the mean of the corners of a polygon without area."""
        first, then = self.corners, np.roll(self.corners, -1, axis=0)
        # Use coordinates relative to a corner, so that no digits are lost far from the origin.
        first, then = first - self.corners[0], then - self.corners[0]
        areas = first[:, 0] * then[:, 1] - first[:, 1] * then[:, 0]
        if areas.sum() <= 0.0:
            return self.corners.mean(axis=0)
        return self.corners[0] + areas @ (first + then) / (3.0 * areas.sum())

    def moved(self, offset: np.ndarray) -> SupportPolygon:
        """Return the polygon displaced by ``offset`` (2,) m."""
        return SupportPolygon(self.corners + offset, self.normals, self.offsets + self.normals @ offset)

    def scaled(self, fraction: float) -> SupportPolygon:
        """Return the polygon scaled about its middle."""
        levels = self.normals @ self.middle
        return SupportPolygon(
            self.middle + fraction * (self.corners - self.middle),
            self.normals,
            levels + fraction * (self.offsets - levels),
        )

    def margin(self, point: np.ndarray) -> float:
        """Return the distance in metres of ``point`` (2,) from the nearest edge: positive inside, negative outside."""
        inside = float((self.offsets - self.normals @ point).min())
        return inside if inside >= 0.0 else -float(np.linalg.norm(self.nearest(point) - point))

    def relative_distance(self, point: np.ndarray, min_distance: float) -> float:
        """Return the distance of ``point`` (2,) from the middle, as a fraction of the distance to the edge in the same
        direction: 0 in the middle, 1 on the edge. The distance to the edge is taken as at least ``min_distance``, m.
        """
        levels = self.normals @ self.middle
        return float(
            ((self.normals @ point - levels) / np.maximum(self.offsets - levels, min_distance)).max(initial=0.0)
        )

    def extent(self, direction: np.ndarray) -> float:
        """Return the distance in metres from the origin to the farthest point along the unit vector ``direction``
        (2,): the support function of the polygon."""
        return float((self.corners @ direction).max())

    def nearest(self, point: np.ndarray) -> np.ndarray:
        """Return the point (2,) of the polygon nearest to ``point`` (2,)."""
        return nearest_in_half_planes(self.normals, self.offsets, point)


def nearest_in_half_planes(normals: np.ndarray, offsets: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the point (2,) nearest to ``point`` (2,) whose dot products with the unit ``normals`` (m, 2) are at most
    the ``offsets`` (m,).

    It is the point itself, its projection onto an edge, or the intersection of two edges. If the half planes have no
    common point, it is the candidate that violates them least. A point that is not finite, as in a step without a
    solution, is returned unchanged.
    """
    outside = normals @ point - offsets
    if not np.isfinite(point).all() or (outside <= 0.0).all():
        return point
    projections = point - outside[:, None] * normals
    i, j = np.triu_indices(len(normals), 1)
    determinants = normals[i, 0] * normals[j, 1] - normals[i, 1] * normals[j, 0]
    crossing = np.abs(determinants) > _TOLERANCE
    i, j, determinants = i[crossing], j[crossing], determinants[crossing]
    intersections = (
        np.stack(
            [
                offsets[i] * normals[j, 1] - offsets[j] * normals[i, 1],
                normals[i, 0] * offsets[j] - normals[j, 0] * offsets[i],
            ],
            axis=1,
        )
        / determinants[:, None]
    )
    candidates = np.concatenate([projections, intersections])
    excess = (candidates @ normals.T - offsets).max(axis=1)
    scale = float(np.abs(offsets).max() + np.abs(point).max())
    feasible = excess <= max(_TOLERANCE * scale, float(excess.min()))
    return candidates[feasible][np.argmin(np.linalg.norm(candidates[feasible] - point, axis=1))]


def is_line(points: np.ndarray) -> bool:
    """Return True if ``points`` (k, 2) span no area."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return len(points) < 3 or bool(spread[1] <= _LINE_TOLERANCE * spread[0])
