"""Search for the level surface that supports an object, in a room whose widest plane is a different one, such as the
floor."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from egs_warp.geometry.bitmaps import distance_to
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.connectivity import enclosed
from egs_warp.segmentation.object_mask import FOOTPRINT_HEIGHT
from egs_warp.segmentation.object_spec import Segmentation
from egs_warp.segmentation.plane_search import find_planes, lies_along

_LEVELS = 4
"""Number of radii around a point within which planes are searched for: half of the capture's diagonal, and successive
halves of this length."""
_MIN_SUPPORT = 0.1
"""Minimum share of the level surface near a point; a plane with a smaller share is not a table."""
_THICKNESS = 0.02
"""Thickness of a plane, as a fraction of the search radius."""
_LEVEL_DEGREES = 5.0
_CELL = 0.03
"""Side of a cell, as a fraction of the object's size."""
_APRON = 3
"""Width, in cells, of the band around the object's outline over which the surface must continue; the first cell beyond
the outline is excluded."""
_COVERED = 0.3
"""Fraction of a cell that must be covered by the surface."""
_NEAR = 0.03
"""Maximum distance of Gaussians that belong to a plane, as a fraction of the object's size."""


def planes_below(
    cloud: GaussianCloud, up: np.ndarray, point: np.ndarray, *, has_tolerance: bool = False
) -> list[Plane]:
    """Return the level planes below ``point`` (3,), the highest one first. The search runs in neighbourhoods of the
    point whose radii are a half, a quarter, ... of the capture's diagonal. With ``has_tolerance``, planes that are
    above the point by less than their thickness are included, because the point may lie on them."""
    means, opaque = cloud.means.numpy().astype(np.float64), cloud.visible(0.3)
    if not opaque.any():
        return []
    low, high = np.quantile(means[opaque], [0.02, 0.98], axis=0)
    away = means - point
    rise = away @ up
    across = np.linalg.norm(away - rise[:, None] * up, axis=1)
    lying = lies_along(cloud, Plane(up, 0.0))
    found: list[tuple[float, Plane]] = []
    for level in range(_LEVELS):
        reach = 0.5 * float(np.linalg.norm(high - low)) * 0.5**level
        near = lying & (across < reach) & (rise < 0.1 * reach) & (rise > -2.0 * reach)
        if not near.any():
            break
        for one in find_planes(
            cloud.subset(near), up, count=2, tilt_degrees=_LEVEL_DEGREES, thickness=_THICKNESS * reach
        ):
            height = float(one.plane.heights(point))
            lowest = -_THICKNESS * reach if has_tolerance else 0.0
            if height > lowest and one.support > _MIN_SUPPORT:
                found.append((height, one.plane))
    return [plane for _, plane in sorted(found, key=lambda entry: entry[0])]


def surface_around(cloud: GaussianCloud, plane: Plane, segmentation: Segmentation) -> float:
    """Return the fraction, 0 to 1, of the band around the object's outline on ``plane`` that is covered by a parallel
    surface."""
    cell, tangents = _CELL * segmentation.size, np.stack(plane.tangents(), axis=1)
    means = cloud.means.numpy().astype(np.float64)
    heights, flat = plane.heights(means), means @ tangents
    low = segmentation.object_mask & (heights < FOOTPRINT_HEIGHT * segmentation.size)
    if not low.any():
        return 0.0
    corner = flat[low].min(axis=0) - 2.0 * _APRON * cell
    shape = np.ceil((flat[low].max(axis=0) + 2.0 * _APRON * cell - corner) / cell).astype(int) + 1
    middles = corner + cell * (np.indices(tuple(shape)).reshape(2, -1).T + 0.5)
    foot = enclosed(middles, flat[low], cell).reshape(shape)
    area = _surface_area(cloud, plane, segmentation)
    place = np.floor((flat - corner) / cell).astype(int)
    around = (area > 0.0) & ((place >= 0) & (place < shape)).all(axis=1)
    cover = np.zeros(tuple(shape))
    np.add.at(cover, tuple(place[around].T), area[around] / cell**2)
    away = distance_to(foot)
    apron = (away > 1.0) & (away <= 1.0 + _APRON)
    return float((ndimage.gaussian_filter(cover, 1.0)[apron] > _COVERED).mean())


def is_own_ledge(cloud: GaussianCloud, plane: Plane, segmentation: Segmentation, whole: Segmentation) -> bool:
    """Return True if the level surface on ``plane`` around an object is a part of a larger object, such as the
    shoulders around a head: most of it, within one size of the object, belongs to ``whole``, the object found above a
    lower plane. A table top extends farther than an object found with it."""
    means = cloud.means.numpy().astype(np.float64)
    middle = np.median(means[segmentation.object_mask], axis=0)
    area = _surface_area(cloud, plane, segmentation)
    area[np.linalg.norm(means - middle, axis=1) > segmentation.size] = 0.0
    return bool(area[whole.object_mask].sum() > 0.5 * area.sum())


def _surface_area(cloud: GaussianCloud, plane: Plane, segmentation: Segmentation) -> np.ndarray:
    """Return the area (n,), weighted by opacity, of the Gaussians of a level surface on ``plane`` outside the object;
    zero for all others."""
    near = np.abs(plane.heights(cloud.means.numpy().astype(np.float64))) < _NEAR * segmentation.size
    area = 2.0 * np.pi * cloud.opacities() * np.exp(np.sort(cloud.log_scales.numpy(), axis=1)[:, 1:].sum(axis=1))
    return np.where(near & lies_along(cloud, plane) & ~segmentation.object_mask, area, 0.0)
