"""Ground that is not flat, measured: heights over its plane, fused from the depth of many views."""

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
"""Of the object's height: ground that differs from its plane by more than this (standard deviation) is not flat; what
contact lets sink is half of it."""
REACH = 2.5
"""Of the object's size: how far from its middle the ground is measured, each way."""
_SPACING = 0.025
"""Of the object's size, between nodes."""
_BAND = 0.25
"""Of the object's size: what lies further from the plane is no ground."""
_LEAST_VIEWS = 3
"""That show a node, for it to be known."""
_AGREE = 0.02
"""Of the object's size: views that differ by more (standard deviation) do not know where a node is."""
_SIGNAL = 3.0
"""Ground is not flat if it is rougher than this many times what views differ by: reflections make bumps, too."""
_SMOOTHING = 0.7
"""Nodes: standard deviation of the blur that takes the noise of single nodes away."""
_BESIDE = 1.0
"""Of the object's size: ground about the object, by which it is judged."""
_VIEWS = 16
_SIDE = 400
"""Pixels of a view."""
_ELEVATIONS = (40.0, 58.0, 75.0)
"""Degrees, where the capture's own cameras are not known."""
_SAME = 0.005
"""Of the depth: what lies no nearer without the object was seen with it."""
_STEEPEST = 1.2
"""Rise over run from node to node: steeper ground is an edge, beyond which the plane goes on."""
_RAISED = 0.05
"""Of the object's size: an object that is further above the ground does not stand on it."""
_SOLID = 0.3
"""Opacity of what is taken to touch."""
_PATCH = 0.05
"""Of the widest connected patch of ground: smaller ones are specks."""


@dataclass(frozen=True)
class MeasuredGround:
    """The ground about an object."""

    field: HeightField
    """Scene units; where nothing is seen, and under the object, the smoothest continuation."""
    known: np.ndarray
    """(rows, columns) bool: nodes that were seen."""
    roughness: float
    """Standard deviation (robust) from the best plane beside the object, scene units."""
    noise: float
    """By how much the views of a node differ there, in the median, scene units."""

    def is_flat(self, height: float) -> bool:
        """Whether an object of ``height`` (scene units) may as well stand on the plane."""
        return self.roughness < max(ROUGH * height, _SIGNAL * self.noise)

    def touched_by(self, thing: GaussianCloud, size: float) -> HeightField:
        """``field``, raised where no view shows it until ``thing``, of ``size`` (scene units), stands on it: the top of
        the fold under an object is unseen, and the smoothest continuation leaves it out.
        """
        points = thing.means.numpy()[thing.opacities() > _SOLID].astype(np.float64)
        field, unseen = self.field, ~self.known
        column, row = np.rint((points - field.origin) @ field.axes[:2].T / field.spacing).astype(int).T
        inside = (column >= 0) & (column < unseen.shape[1]) & (row >= 0) & (row < unseen.shape[0])
        points, column, row = points[inside], column[inside], row[inside]
        gaps = field.heights(points)
        lowest = int(np.argmin(gaps)) if len(gaps) else -1
        if lowest < 0 or not 0.0 < gaps[lowest] < _RAISED * size or not unseen[row[lowest], column[lowest]]:
            return field
        depth = depth_inside(unseen)
        share = np.minimum(depth / depth[row[lowest], column[lowest]], 1.0)
        heights = (field.nodes() - field.origin) @ field.normal + gaps[lowest] * share * share * (3.0 - 2.0 * share)
        return HeightField.through(field.axes, field.origin, field.spacing, heights)


def measure_ground(
    cloud: GaussianCloud,
    thing: np.ndarray,
    plane: Plane,
    *,
    cameras: Sequence[Camera] = (),
    centre: np.ndarray,
    size: float,
) -> MeasuredGround:
    """Heights of the ground in ``cloud`` beside its object, the Gaussians ``thing`` (n,) bool, of ``size`` about
    ``centre`` (3,), scene units.

    It is rendered through ``cameras``, or a ring; of what each node of a grid gets from each view the median counts,
    and of the views the median. What is not seen, beyond edges and under the object, is the smoothest continuation; at
    the grid's edge it is the plane.
    """
    spacing, count = _SPACING * size, 2 * round(REACH / _SPACING) + 1
    first, second = plane.tangents()
    axes = np.stack([first, second, plane.normal])
    middle = centre - plane.heights(centre) * plane.normal
    origin = middle - 0.5 * (count - 1) * spacing * (first + second)
    above = [downscale(camera, _SIDE) for camera in cameras if plane.heights(camera.centre) > 0.2 * size]
    if len(above) < _LEAST_VIEWS:
        above = ring_cameras(plane, middle, 1.2 * size, count=_VIEWS - 1, elevations=_ELEVATIONS, size=_SIDE)
    if thing.all():
        raise UserError(
            f"segment: all {cloud.count} Gaussians of the capture are the object, so there is no ground to measure;"
            " animate the capture itself, or mark less of it"
        )
    bare = cloud.subset(~thing)
    looks = []
    for camera in above[:: -(-len(above) // _VIEWS)]:
        points = _seen_points(cloud, bare, camera, plane)
        points = points[np.abs(plane.heights(points)) < _BAND * size]
        looks.append(_medians(points, axes, origin, spacing, count))
    seen = np.stack(looks)
    views = np.isfinite(seen).sum(axis=0)
    with warnings.catch_warnings():
        # Of nodes that no view shows.
        warnings.simplefilter("ignore", RuntimeWarning)
        heights, apart = np.nanmedian(seen, axis=0), np.nanstd(seen, axis=0)
    known = (views >= _LEAST_VIEWS) & (apart < _AGREE * size)
    known = _one_patch(known & _walkable(heights, known, spacing))
    if not known.any():
        return MeasuredGround(HeightField(axes, origin, spacing, np.zeros((count, count))), known, 0.0, 0.0)
    share = ndimage.gaussian_filter(known.astype(np.float64), _SMOOTHING)
    smooth = ndimage.gaussian_filter(np.where(known, heights, 0.0), _SMOOTHING) / np.maximum(share, 1e-6)
    inner = np.pad(np.ones((count - 2, count - 2), bool), 1)
    whole = laplace_fill(np.where(known & inner, smooth, 0.0), ~known & inner)
    rows, columns = np.indices(whole.shape) - 0.5 * (count - 1)
    beside = known & (np.hypot(rows, columns) < _BESIDE / _SPACING)
    noise = float(np.median(apart[beside])) if beside.any() else 0.0
    field = HeightField.through(axes, origin, spacing, whole)
    return MeasuredGround(field, known, _roughness(whole, beside), noise)


def _seen_points(cloud: GaussianCloud, bare: GaussianCloud, camera: Camera, plane: Plane) -> np.ndarray:
    """(n, 3) what ``bare`` shows that is seen in ``cloud``, with the object, as well: through the hole that it leaves
    one sees under the ground. Heights over ``plane`` are those of the splats.
    """
    whole, left = SeenSurface.of(cloud, camera), SeenSurface.of(bare, camera)
    same = np.abs(whole.depth - left.depth) < _SAME * left.depth
    return left.points(plane, left.opaque & same)


def _walkable(heights: np.ndarray, known: np.ndarray, spacing: float) -> np.ndarray:
    """(rows, columns) bool: no neighbour is much higher or lower; not on the rim of what is ``known``, which frays."""
    low = ndimage.minimum_filter(np.where(known, heights, np.inf), 3)
    high = ndimage.maximum_filter(np.where(known, heights, -np.inf), 3)
    rim = np.logical_not(ndimage.binary_erosion(ndimage.binary_closing(known, iterations=2), iterations=1))
    return np.logical_not(rim) & (np.maximum(heights - low, high - heights) < _STEEPEST * spacing)


def _one_patch(mask: np.ndarray) -> np.ndarray:
    """``mask`` without its specks."""
    parts, _ = connected_parts(mask, corners=True)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return (sizes >= _PATCH * sizes.max())[parts] & mask


def _medians(points: np.ndarray, axes: np.ndarray, origin: np.ndarray, spacing: float, count: int) -> np.ndarray:
    """(count, count) median height of those of ``points`` (n, 3) that are nearest to each node, NaN where none is."""
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


def _roughness(heights: np.ndarray, beside: np.ndarray) -> float:
    """Standard deviation (robust) of ``heights`` (rows, columns) from their best plane, over ``beside`` (rows, columns)
    bool.
    """
    if beside.sum() < 4:
        return 0.0
    rows, columns = np.nonzero(beside)
    basis = np.stack([np.ones(len(rows)), rows / len(heights), columns / len(heights)], axis=1)
    tilted = np.linalg.lstsq(basis, heights[beside], rcond=None)[0]
    off = heights[beside] - basis @ tilted
    return 1.4826 * float(np.median(np.abs(off - np.median(off))))
