"""Support polygon: the convex hull of the contact points on the ground, and the margins of points in it.

In the shapes below, "..." is the world axis, or nothing for one world.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from egs_warp.fem.batched import BatchedRecord, as_warp, launch_on
from egs_warp.kernels.motions.support import LINE_TOLERANCE, Vec2, hull_kernel, nearest_kernel
from egs_warp.launching import launch_cached, round_up
from egs_warp.precision import real

MIN_OVERHANG = 1e-3
"""Minimum distance (``overhang``), in body heights, at which a body counts as unable to stand. It is far above the
rounding of a centre of mass on the edge."""


@dataclass(frozen=True)
class SupportPolygon(BatchedRecord):
    """Convex polygon on the ground. It may degenerate to a segment or a point.

    Polygons of many worlds are padded with their last corner and their last edge.
    """

    corners: np.ndarray
    """(..., k, 2) m, corners in counterclockwise order."""
    normals: np.ndarray
    """(..., m, 2) outward unit normals of the edges."""
    offsets: np.ndarray
    """(..., m) m, offsets of the edges: a point is inside if its dot product with each normal is at most the offset."""

    @classmethod
    def hull(cls, points: np.ndarray, counts: np.ndarray | None = None) -> SupportPolygon:
        """Return the convex hull of ``points`` (..., n, 2), n > 0, which may be collinear.

        Args:
            points: (..., n, 2) m.
            counts: (...,) number of points of each world, at the start of its row; None uses all points.
        """
        worlds, count = points.shape[:-2], points.shape[-2]
        space = _hull_workspace(int(np.prod(worlds)), count)
        space.points[:, :count] = points.reshape(-1, count, 2)
        space.counts[:] = count if counts is None else counts.reshape(-1)
        launch_cached(
            hull_kernel, len(space.counts), inputs=space.inputs, outputs=space.outputs, device=wp.get_device("cpu")
        )
        k, m = (int(each.max()) for each in space.sizes)
        return cls(
            space.corners[:, :k].reshape(*worlds, k, 2).copy(),
            space.normals[:, :m].reshape(*worlds, m, 2).copy(),
            space.offsets[:, :m].reshape(*worlds, m).copy(),
        )

    @classmethod
    def concatenated(cls, records: Sequence[SupportPolygon]) -> SupportPolygon:
        """Return the polygons of the worlds of all ``records``."""
        columns = zip(*((one.corners, one.normals, one.offsets) for one in records), strict=True)
        return cls(*(_concatenate_padded(each) for each in columns))

    @cached_property
    def middle(self) -> np.ndarray:
        """(..., 2) m, centroid of the area; for a degenerate polygon, the middle of the segment."""
        # Use coordinates relative to a corner, so that no precision is lost far from the origin.
        start = self.corners[..., :1, :]
        first = self.corners - start
        then = np.roll(first, -1, axis=-2)
        areas = first[..., 0] * then[..., 1] - first[..., 1] * then[..., 0]
        total = areas.sum(axis=-1)[..., None]
        moments = (areas[..., None] * (first + then)).sum(axis=-2)
        is_flat = total <= 0.0
        centre = moments / np.where(is_flat, 1.0, 3.0 * total)
        return start[..., 0, :] + np.where(is_flat, 0.5 * first[..., -1, :], centre)

    def moved(self, offset: np.ndarray) -> SupportPolygon:
        """Return the polygon displaced by ``offset`` (..., 2) m."""
        return SupportPolygon(
            self.corners + offset[..., None, :], self.normals, self.offsets + _levels(self.normals, offset)
        )

    def scaled(self, fraction: float) -> SupportPolygon:
        """Return the polygon scaled about its middle."""
        middle = self.middle[..., None, :]
        levels = _levels(self.normals, self.middle)
        return SupportPolygon(
            middle + fraction * (self.corners - middle),
            self.normals,
            levels + fraction * (self.offsets - levels),
        )

    def margin(self, point: np.ndarray) -> float:
        """Return the distance in metres of ``point`` (2,) from the nearest edge of the polygon of one world: positive
        inside, negative outside."""
        inside = float((self.offsets - self.normals @ point).min())
        return inside if inside >= 0.0 else -float(np.linalg.norm(self.nearest(point) - point))

    def relative_distance(self, point: np.ndarray, min_distance: float) -> np.ndarray:
        """Return the distance (...,) of ``point`` (..., 2) from the middle, as a fraction of the distance to the edge
        in the same direction: 0 in the middle, 1 on the edge. For this ratio, the distance to the edge is at least
        ``min_distance``, m."""
        levels = _levels(self.normals, self.middle)
        beyond = _levels(self.normals, point) - levels
        return (beyond / np.maximum(self.offsets - levels, min_distance)).max(axis=-1, initial=0.0)

    def extent(self, direction: np.ndarray) -> np.ndarray:
        """Return the distance (...,) in metres from the origin to the farthest point along the unit vector
        ``direction`` (2,): the support function of the polygon."""
        return (self.corners @ direction).max(axis=-1)

    def distance_to_edge(self, direction: np.ndarray) -> np.ndarray:
        """Return the distance (...,) in metres from the origin, which is inside, to the edge along the unit vector
        ``direction`` (2,)."""
        slopes = self.normals @ direction
        return np.where(slopes > 0.0, self.offsets / np.where(slopes > 0.0, slopes, 1.0), np.inf).min(axis=-1)

    def nearest(self, point: np.ndarray) -> np.ndarray:
        """Return the point (..., 2) of the polygon nearest to ``point`` (..., 2)."""
        return nearest_in_half_planes(self.normals, self.offsets, point)


def nearest_in_half_planes(normals: np.ndarray, offsets: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the point (..., 2) nearest to ``point`` (..., 2) whose dot products with the unit ``normals`` (..., m, 2)
    are at most the ``offsets`` (..., m).

    It is the point itself, its projection onto an edge, or the intersection of two edges. If the half planes have no
    common point, it is the candidate that violates them least. A point that is not finite, as can occur in a step that
    has no solution, is returned unchanged.
    """
    m = normals.shape[-2]
    points = np.ascontiguousarray(point.reshape(-1, 2), np.float64)
    nearest = np.empty_like(points)
    launch_on(
        nearest,
        nearest_kernel,
        len(points),
        inputs=[
            (np.ascontiguousarray(normals.reshape(-1, m, 2)), Vec2),
            (np.ascontiguousarray(offsets.reshape(-1, m)), real),
            (points, Vec2),
        ],
        outputs=[(nearest, Vec2)],
    )
    return nearest.reshape(point.shape)


def overhang(points: np.ndarray, centre: np.ndarray) -> float:
    """Return the distance in metres by which a centre of mass at ``centre`` (2,), m, is outside the convex hull of the
    ``points`` (k, 2), m, that carry it; 0 inside, infinite without points."""
    return max(0.0, -SupportPolygon.hull(points).margin(centre)) if len(points) > 0 else np.inf


def is_line(points: np.ndarray) -> bool:
    """Return True if ``points`` (k, 2) span no area."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return len(points) < 3 or bool(spread[1] <= float(LINE_TOLERANCE) * spread[0])


class _HullWorkspace:
    """Arrays of ``hull_kernel`` for a number of worlds and a maximum number of points, as NumPy and as Warp arrays."""

    def __init__(self, worlds: int, points: int) -> None:
        capacity = max(points + 1, 4)
        self.points, self.counts = np.zeros((worlds, points, 2)), np.zeros(worlds, np.int32)
        self.corners, self.normals = np.zeros((worlds, capacity, 2)), np.zeros((worlds, capacity, 2))
        self.offsets, self.sizes = np.zeros((worlds, capacity)), np.zeros((2, worlds), np.int32)
        order = np.zeros((worlds, points), np.int32)
        self.inputs = [as_warp(self.points, Vec2), as_warp(self.counts, wp.int32), as_warp(order, wp.int32)]
        self.outputs = [
            *(as_warp(self.corners, Vec2), as_warp(self.normals, Vec2), as_warp(self.offsets, real)),
            *(as_warp(each, wp.int32) for each in self.sizes),
        ]


class _HullWorkspaces(threading.local):
    """Most recently used workspaces of the current thread, by numbers of worlds and points."""

    def __init__(self) -> None:
        self.by_size: OrderedDict[tuple[int, int], _HullWorkspace] = OrderedDict()


_workspaces = _HullWorkspaces()
_MAX_WORKSPACES = 8
"""Maximum number of workspaces of a thread."""


def _hull_workspace(worlds: int, points: int) -> _HullWorkspace:
    """Return a workspace for the hulls of at most ``points`` points in each of the ``worlds``. Reusing a workspace
    pays, because a launch on the arrays of an earlier launch takes a third of the time of a launch on new arrays."""
    key = worlds, round_up(points, 16)
    space = _workspaces.by_size.pop(key, None) or _HullWorkspace(*key)
    _workspaces.by_size[key] = space
    if len(_workspaces.by_size) > _MAX_WORKSPACES:
        _workspaces.by_size.popitem(last=False)
    return space


def _levels(normals: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the dot products (..., m) of ``normals`` (..., m, 2) with ``point`` (..., 2)."""
    return (normals @ point[..., None])[..., 0]


def _concatenate_padded(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate ``rows`` (c, k, ...) of different width k, padded with their last entries."""
    widest = max(each.shape[1] for each in rows)
    return np.concatenate(
        [np.concatenate([each, np.repeat(each[:, -1:], widest - each.shape[1], axis=1)], axis=1) for each in rows]
    )
