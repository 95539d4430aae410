"""Heights of the surface along the outline of an object: whether the object stands out of its ground, and whether the
level surface under its foot continues all round."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from egs_warp.geometry.bitmaps import distance_to
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.connectivity import enclosed
from egs_warp.segmentation.object_mask import FOOTPRINT_HEIGHT
from egs_warp.segmentation.object_spec import Segmentation

_CELL = 0.015
"""Minimum side of a cell, as a fraction of the object's size."""
_NEIGHBOUR = 4
"""Number, counted from 1, of the nearest neighbour whose median distance is the minimum side of a cell in a sparse
capture."""
_MAX_SAMPLE = 10_000
"""Maximum number of Gaussians whose neighbours are searched for."""
_MARGIN = 5
"""Width of the strip around the outline that the grid includes, cells."""
_RIM = 3
"""Width of the rim of the outline, cells. Outside, the first cell is excluded, because the edges of the object's
Gaussians reach into it."""
_MIN_OPACITY = 0.3
"""Minimum opacity of the Gaussians of a surface."""
_BAND = 0.15
"""Maximum distance from the plane of the ground next to an object, as a fraction of the object's size."""
_TOP = 0.95
"""Quantile of the heights of the Gaussians that defines the height of an object."""
_LEVEL = 0.015
"""Maximum distance from the plane of the surface that supports an object, as a fraction of the object's size."""
_TALL = 0.1
"""Height, as a fraction of the object's size, above which nothing is a piece of the ground."""
_MIN_STEP, _MIN_STEP_TO_NOISE = 0.015, 2.0
"""Minimum height of the step between an object and the ground next to it: as a fraction of the object's size, and as a
multiple of the ground's standard deviation."""


@dataclass(frozen=True)
class _Grid:
    """Cells of a plane around an outline."""

    outline: np.ndarray
    """(rows, columns) bool, cells in the outline."""
    place: np.ndarray
    """(n, 2) int, cell of each Gaussian."""
    is_inside: np.ndarray
    """(n,) bool, True for Gaussians over a cell of the grid."""

    @classmethod
    def of(cls, flat: np.ndarray, outlined: np.ndarray, cell: float) -> _Grid:
        """Return the grid of cells with the side ``cell`` around those points ``flat`` (n, 2) that ``outlined`` (n,)
        bool selects."""
        corner = flat[outlined].min(axis=0) - _MARGIN * cell
        shape = np.ceil((flat[outlined].max(axis=0) + _MARGIN * cell - corner) / cell).astype(int) + 1
        middles = corner + cell * (np.indices(tuple(shape)).reshape(2, -1).T + 0.5)
        place = np.floor((flat - corner) / cell).astype(int)
        return cls(
            enclosed(middles, flat[outlined], cell).reshape(shape), place, ((place >= 0) & (place < shape)).all(axis=1)
        )

    def highest(self, heights: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return the largest of the ``heights`` (n,) of the ``chosen`` (n,) bool Gaussians over each cell (rows,
        columns); minus infinity for a cell without Gaussians."""
        top = np.full(self.outline.shape, -np.inf)
        chosen = chosen & self.is_inside
        np.maximum.at(top, tuple(self.place[chosen].T), heights[chosen])
        return top

    @property
    def outer_rim(self) -> np.ndarray:
        """(rows, columns) bool, cells next to the outline."""
        away = distance_to(self.outline)
        return (away > 1.0) & (away <= _RIM)

    @property
    def inner_rim(self) -> np.ndarray:
        """(rows, columns) bool, cells of the outline next to its edge."""
        return self.outline & (distance_to(~self.outline) <= _RIM)


def stands_out(cloud: GaussianCloud, plane: Plane | HeightField, segmentation: Segmentation) -> bool:
    """Return True if the object is tall, or higher than the ground next to it nearly all along its outline.

    The ground scatters about its plane, so that a piece of it can lie above the plane and look like an object. At the
    outline of such a piece, there is no step. A flat object, such as a book, has a step all round. The step is the
    lower quartile, over the cells next to the outline, of the height of the object over the highest ground nearby.
    True if no ground is visible next to the object.
    """
    size, heights, flat, is_opaque = _surface(cloud, plane, segmentation)
    own = segmentation.object_mask & is_opaque
    ground = segmentation.background_mask & is_opaque & (np.abs(heights) < _BAND * size)
    if not own.any() or not ground.any() or np.quantile(heights[own], _TOP) > _TALL * size:
        return True
    grid = _Grid.of(flat, own, _cell(flat, own, ground, size))
    inside, outside = grid.highest(heights, own), grid.highest(heights, ground)
    inner, outer = grid.inner_rim & np.isfinite(inside), grid.outer_rim & np.isfinite(outside)
    if not inner.any() or not outer.any():
        return True
    away, nearest = KDTree(np.argwhere(outer)).query(np.argwhere(inner))
    steps = (inside[inner] - outside[outer][nearest])[away < 2 * _RIM]
    noise = 1.4826 * float(np.median(np.abs(outside[outer] - np.median(outside[outer]))))
    return len(steps) == 0 or float(np.quantile(steps, 0.25)) > max(_MIN_STEP * size, _MIN_STEP_TO_NOISE * noise)


def ledge_around(cloud: GaussianCloud, plane: Plane, segmentation: Segmentation) -> float:
    """Return the fraction, 0 to 1, of the rim of the object's foot over which the highest surface lies in ``plane``.

    It is nearly 1 if the object stands on a level surface, however narrow this is, and small if ``plane`` cuts an
    object that continues below it.
    """
    size, heights, flat, is_opaque = _surface(cloud, plane, segmentation)
    foot = segmentation.object_mask & is_opaque & (heights < FOOTPRINT_HEIGHT * size)
    rest = ~segmentation.object_mask & is_opaque & (heights < _BAND * size)
    support = rest & (np.abs(heights) < _LEVEL * size)
    if not foot.any() or not support.any():
        return 0.0
    grid = _Grid.of(flat, foot, _cell(flat, foot, support, size))
    top = grid.highest(heights, rest)
    # Cells between the Gaussians of a sparse surface are as high as their neighbours.
    top = np.where(np.isfinite(top), top, ndimage.maximum_filter(top, 3))
    return float((np.abs(top[grid.outer_rim]) < _LEVEL * size).mean())


def _surface(
    cloud: GaussianCloud, plane: Plane | HeightField, segmentation: Segmentation
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Return the object's size; the heights (n,) of all means above ``plane``; their coordinates (n, 2) along it, all
    in scene units; and the mask (n,) bool of opaque Gaussians."""
    means = cloud.means.numpy().astype(np.float64)
    flat = means @ np.stack(plane.tangents(), axis=1)
    return segmentation.size, plane.heights(means), flat, cloud.visible(_MIN_OPACITY)


def _cell(flat: np.ndarray, own: np.ndarray, ground: np.ndarray, size: float) -> float:
    """Return the side of cells, scene units, in which most cells near the outline of ``own`` (n,) bool contain a
    Gaussian of the ``ground`` (n,) bool."""
    low, high = flat[own].min(axis=0) - 0.1 * size, flat[own].max(axis=0) + 0.1 * size
    points = flat[ground & np.all((flat > low) & (flat < high), axis=1)]
    if len(points) <= _NEIGHBOUR:
        return _CELL * size
    few = points[:: -(-len(points) // _MAX_SAMPLE)]
    return max(_CELL * size, float(np.median(KDTree(points).query(few, k=_NEIGHBOUR + 1)[0][:, _NEIGHBOUR])))
