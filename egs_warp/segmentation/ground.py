"""Heights of uneven ground over its plane, fused from depth images of many views."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from egs_warp.errors import UserError
from egs_warp.geometry.bitmaps import connected_parts, depth_inside
from egs_warp.geometry.camera import Camera, downscale
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.laplace_fill import laplace_fill
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.seen_surface import SeenSurface

ROUGH = 0.01
"""Standard deviation of the ground from its plane, as a fraction of the object's height, above which ground is uneven.
The penetration that contact allows is half as large."""
REACH = 2.5
"""Half of the side of the measured square around the object's centre, as a fraction of the object's size."""
_SPACING = 0.025
"""Distance between nodes, as a fraction of the object's size."""
_BAND = 0.25
"""Maximum distance of points of the ground from the plane, as a fraction of the object's size."""
_MIN_VIEWS = 3
"""Minimum number of views that must show a node."""
_MAX_VIEW_DIFFERENCE = 0.02
"""Standard deviation of a node's height between views, as a fraction of the object's size, above which the node is
unknown."""
_MIN_SIGNAL_TO_NOISE = 3.0
"""Factor on the difference between views. Ground is uneven only if it is rougher than this product, because reflections
also cause bumps."""
_SMOOTHING = 0.7
"""Standard deviation, in nodes, of the blur that removes the noise of single nodes."""
_ROUGHNESS_RADIUS = 1.0
"""Radius around the object within which roughness is measured, as a fraction of the object's size."""
_VIEWS = 16
_SIDE = 400
"""Longer side of a view, pixels."""
_ELEVATIONS = (40.0, 58.0, 75.0)
"""Elevations of the views, in degrees, if the cameras of the capture are unknown."""
_DEPTH_TOLERANCE = 0.005
"""Difference between the depths with and without the object, as a fraction of the depth, below which a pixel shows
ground."""
_MAX_SLOPE = 1.2
"""Maximum slope (rise over run) between nodes. Steeper ground is considered an edge, beyond which the plane
continues."""
_MAX_GAP = 0.05
"""Maximum gap between the ground and an object that stands on it, as a fraction of the object's size."""
_SOLID = 0.3
"""Minimum opacity of Gaussians that can touch the ground."""
_PATCH = 0.05
"""Minimum size of a connected patch of ground, as a fraction of the largest one. Smaller patches are specks."""


@dataclass(frozen=True)
class MeasuredGround:
    """Heights of the ground around an object, and their quality."""

    field: HeightField
    """Heights of the ground, scene units. Unseen ground, including the ground under the object, is filled by harmonic
    continuation."""
    known: np.ndarray
    """(rows, columns) bool, nodes that were seen."""
    roughness: float
    """Robust standard deviation of the ground next to the object from the best-fit plane of this ground, scene
    units."""
    noise: float
    """Median, over the nodes next to the object, of the standard deviation between views, scene units."""

    def is_flat(self, height: float) -> bool:
        """True if the ground is so flat that an object of ``height`` (scene units) may be placed on the plane instead
        of the height field."""
        return self.roughness < max(ROUGH * height, _MIN_SIGNAL_TO_NOISE * self.noise)

    def touched_by(self, object_cloud: GaussianCloud, size: float) -> HeightField:
        """Return the height field, raised where it is unseen until the object stands on it.

        The top of a fold under an object is unseen, so the harmonic continuation passes below it.

        Args:
            object_cloud: Gaussians of the object.
            size: size of the object, scene units.
        """
        points = object_cloud.means.numpy()[object_cloud.visible(_SOLID)].astype(np.float64)
        field, unseen = self.field, ~self.known
        column, row = np.rint((points - field.origin) @ field.axes[:2].T / field.spacing).astype(int).T
        inside = (column >= 0) & (column < unseen.shape[1]) & (row >= 0) & (row < unseen.shape[0])
        points, column, row = points[inside], column[inside], row[inside]
        gaps = field.heights(points)
        lowest = int(np.argmin(gaps)) if len(gaps) else -1
        if lowest < 0 or not 0.0 < gaps[lowest] < _MAX_GAP * size or not unseen[row[lowest], column[lowest]]:
            return field
        depth = depth_inside(unseen)
        share = np.minimum(depth / depth[row[lowest], column[lowest]], 1.0)
        heights = (field.nodes() - field.origin) @ field.normal + gaps[lowest] * share * share * (3.0 - 2.0 * share)
        return HeightField.through(field.axes, field.origin, field.spacing, heights)


def measure_ground(
    cloud: GaussianCloud,
    object_mask: np.ndarray,
    plane: Plane,
    *,
    cameras: Sequence[Camera] = (),
    centre: np.ndarray,
    size: float,
) -> MeasuredGround:
    """Measure the heights of the ground next to an object.

    The capture is rendered through ``cameras``, or through a ring of cameras. The height of a grid node is the median
    over the views of the median height in each view. Unseen ground, beyond edges and under the object, is filled by
    harmonic continuation, with the plane as the boundary value at the grid's edge.

    Args:
        cloud: the capture.
        object_mask: (n,) bool, Gaussians of the object.
        plane: the plane under the object.
        cameras: cameras of the capture, if known.
        centre: (3,) centre of the object.
        size: size of the object, scene units.

    Raises:
        UserError: all Gaussians belong to the object.
    """
    spacing, count = _SPACING * size, 2 * round(REACH / _SPACING) + 1
    first, second = plane.tangents()
    axes = np.stack([first, second, plane.normal])
    middle = centre - plane.heights(centre) * plane.normal
    origin = middle - 0.5 * (count - 1) * spacing * (first + second)
    above = [downscale(camera, _SIDE) for camera in cameras if plane.heights(camera.centre) > 0.2 * size]
    if len(above) < _MIN_VIEWS:
        above = ring_cameras(plane, middle, 1.2 * size, count=_VIEWS - 1, elevations=_ELEVATIONS, size=_SIDE)
    if object_mask.all():
        raise UserError(
            f"segment: all {cloud.count} Gaussians of the capture belong to the object, so there is no ground to"
            " measure; animate the capture itself, or mark less of it"
        )
    bare = cloud.subset(~object_mask)
    maps = []
    for camera in above[:: -(-len(above) // _VIEWS)]:
        points = _seen_points(cloud, bare, camera, plane)
        points = points[np.abs(plane.heights(points)) < _BAND * size]
        maps.append(_medians(points, axes, origin, spacing, count))
    seen = np.stack(maps)
    views = np.isfinite(seen).sum(axis=0)
    with warnings.catch_warnings():
        # Some nodes are visible in no view.
        warnings.simplefilter("ignore", RuntimeWarning)
        heights, spread = np.nanmedian(seen, axis=0), np.nanstd(seen, axis=0)
    known = (views >= _MIN_VIEWS) & (spread < _MAX_VIEW_DIFFERENCE * size)
    known = _one_patch(known & _without_edges(heights, known, spacing))
    if not known.any():
        return MeasuredGround(HeightField(axes, origin, spacing, np.zeros((count, count))), known, 0.0, 0.0)
    share = ndimage.gaussian_filter(known.astype(np.float64), _SMOOTHING)
    smooth = ndimage.gaussian_filter(np.where(known, heights, 0.0), _SMOOTHING) / np.maximum(share, 1e-6)
    inner = np.pad(np.ones((count - 2, count - 2), bool), 1)
    whole = laplace_fill(np.where(known & inner, smooth, 0.0), ~known & inner)
    rows, columns = np.indices(whole.shape) - 0.5 * (count - 1)
    around = known & (np.hypot(rows, columns) < _ROUGHNESS_RADIUS / _SPACING)
    noise = float(np.median(spread[around])) if around.any() else 0.0
    field = HeightField.through(axes, origin, spacing, whole)
    return MeasuredGround(field, known, _roughness(whole, around), noise)


def _seen_points(cloud: GaussianCloud, bare: GaussianCloud, camera: Camera, plane: Plane) -> np.ndarray:
    """Return the points (n, 3) of the ground that ``camera`` sees both in ``cloud`` and in ``bare``, which is the
    capture without the object. Points that appear only in ``bare`` are seen through the hole that the object leaves,
    and lie below the ground. The heights of the returned points over ``plane`` are computed from the splats
    (``SeenSurface``)."""
    whole, left = SeenSurface.of(cloud, camera), SeenSurface.of(bare, camera)
    same = np.abs(whole.depth - left.depth) < _DEPTH_TOLERANCE * left.depth
    return left.points(plane, left.opaque & same)


def _without_edges(heights: np.ndarray, known: np.ndarray, spacing: float) -> np.ndarray:
    """Return the mask (rows, columns) bool of the nodes whose neighbours are not much higher or lower. The rim of the
    ``known`` nodes is excluded, because it is ragged."""
    low = ndimage.minimum_filter(np.where(known, heights, np.inf), 3)
    high = ndimage.maximum_filter(np.where(known, heights, -np.inf), 3)
    rim = np.logical_not(ndimage.binary_erosion(ndimage.binary_closing(known, iterations=2), iterations=1))
    return np.logical_not(rim) & (np.maximum(heights - low, high - heights) < _MAX_SLOPE * spacing)


def _one_patch(mask: np.ndarray) -> np.ndarray:
    """Remove specks from ``mask``."""
    parts, _ = connected_parts(mask, corners=True)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return (sizes >= _PATCH * sizes.max())[parts] & mask


def _medians(points: np.ndarray, axes: np.ndarray, origin: np.ndarray, spacing: float, count: int) -> np.ndarray:
    """Return for each node the median height (count, count) of those ``points`` (n, 3) that are nearest to the node;
    NaN if there are none."""
    away = (points - origin) @ axes.T
    column, row = np.rint(away[:, :2] / spacing).astype(int).T
    inside = (column >= 0) & (column < count) & (row >= 0) & (row < count)
    cell, height = (row * count + column)[inside], away[inside, 2]
    order = np.lexsort([height, cell])
    cells, starts, sizes = np.unique(cell[order], return_index=True, return_counts=True)
    height = height[order]
    heights = np.full(count * count, np.nan)
    heights[cells] = 0.5 * (height[starts + (sizes - 1) // 2] + height[starts + sizes // 2])
    return heights.reshape(count, count)


def _roughness(heights: np.ndarray, around: np.ndarray) -> float:
    """Return the robust standard deviation of ``heights`` (rows, columns) from their best-fit plane, at the nodes
    selected by ``around`` (rows, columns) bool."""
    if around.sum() < 4:
        return 0.0
    rows, columns = np.nonzero(around)
    basis = np.stack([np.ones(len(rows)), rows / len(heights), columns / len(heights)], axis=1)
    tilted = np.linalg.lstsq(basis, heights[around], rcond=None)[0]
    off = heights[around] - basis @ tilted
    return 1.4826 * float(np.median(np.abs(off - np.median(off))))
