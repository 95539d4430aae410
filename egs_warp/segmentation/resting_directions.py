"""Directions in which an object may rest on a plane: the normals of the large facets of its convex hull."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, KDTree, QhullError

_NEIGHBOUR, _STRAY = 8, 3.0
"""Rank of a neighbour, and ratio of distances: a point is a stray if its 8th neighbour is more than 3 times as far away
as the median 8th neighbour of all points."""
_CONE = np.cos(np.radians(5.0))
"""Cosine of the maximum angle between facets of the hull that are merged into one."""
_SLABS = (0.02, 0.01, 0.006)
"""Thicknesses, as fractions of the object's size, of the successive slabs of its lowest points to which a plane is
fitted."""
_LOWEST_SHARE = 0.002
_MIN_POINTS = 10
_MIN_WIDTH_RATIO = 0.1
"""Minimum ratio of the two standard deviations along a support, because a body does not rest on a line."""
_MAX_TURN = np.cos(np.radians(10.0))
"""Cosine of the maximum angle between the normals of a facet and of the fitted plane."""


def resting_directions(points: np.ndarray, *, at_most: int) -> np.ndarray:
    """Return (m, 3) unit up directions, at most ``at_most``, in which ``points`` (n, 3) can rest, in descending order
    of the area of their facets.

    The result is empty if the points have no volume.
    """
    if len(points) <= _NEIGHBOUR:
        return np.empty((0, 3))
    distances = KDTree(points).query(points, k=_NEIGHBOUR + 1)[0][:, _NEIGHBOUR]
    points = points[distances <= _STRAY * np.median(distances)]
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return np.empty((0, 3))
    corners = points[hull.simplices]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    normals, left = -hull.equations[:, :3], areas.copy()
    ups: list[np.ndarray] = []
    while len(ups) < at_most and left.max() > 0.0:
        largest = int(np.argmax(left))
        up = _unit((areas * (normals @ normals[largest] > _CONE)) @ normals)
        ups.append(_fitted(points, up))
        left[(normals @ up > _CONE)] = 0.0
        left[largest] = 0.0
    return np.array(ups)


def _fitted(points: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the normal (3,) of the plane through the lowest points along ``up``, if they form a level support."""
    size, fitted = float(np.ptp(points, axis=0).max()), up
    for slab in _SLABS:
        heights = points @ fitted
        low = points[heights < np.quantile(heights, _LOWEST_SHARE) + slab * size]
        if len(low) < _MIN_POINTS:
            break
        _, widths, axes = np.linalg.svd(low - low.mean(axis=0), full_matrices=False)
        normal = axes[2] * np.sign(axes[2] @ up)
        if widths[1] < _MIN_WIDTH_RATIO * widths[0] or normal @ up < _MAX_TURN:
            break
        fitted = normal
    return fitted


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
