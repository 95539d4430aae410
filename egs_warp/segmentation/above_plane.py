"""Quantities of a capture above its plane that the search for an object needs, and the selection of the object's
connected parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.connectivity import enclosed
from egs_warp.segmentation.plane_search import lies_along

CELLS = 64
"""Number of grid cells across the object in the connectivity test."""
MIN_OPACITY = 0.1
"""Minimum opacity of Gaussians that connect others. Fainter Gaussians are assigned like their surroundings."""
_MIN_DETACHED_HEIGHT = 0.1
"""Height of the lowest point, as a fraction of the object's size, above which a part does not stand on the ground."""
_GAP = 2.0 / CELLS
"""Maximum distance of a detached part that belongs to the object, as a fraction of the object's size."""
_MAX_CHAIN = 4
"""Maximum length of a chain of detached parts, such as leaves that hang next to other detached leaves."""
_HEAVY, _LIGHT = 0.05, 0.01
"""Two fractions of the object's opacity mass. A detached part heavier than the first is not a stray; a part lighter
than the second cannot support another part."""
_MAX_DETACHED_GAP, _MIN_GAP_RATIO = 0.2, 2.0
"""Maximum distance from the object of a heavy detached part, such as a robot's hand, as a fraction of the object's
size; and the minimum ratio between the part's distance from any other possible support and its distance from the
object."""
_NEAR_CLICK = 0.1
"""Maximum distance, as a fraction of the object's size, of the part that is selected by a click that hits only faint
Gaussians."""


@dataclass(frozen=True)
class SceneAbovePlane:
    """Quantities of a capture above its plane that the search for the object uses repeatedly; arrays have shape (n,
    ...)."""

    cloud: GaussianCloud
    plane: Plane | HeightField
    means: np.ndarray
    flat: np.ndarray
    """(n, 2) coordinates along the plane."""
    heights: np.ndarray
    opacity: np.ndarray
    is_opaque: np.ndarray
    """(n,) bool, True for Gaussians that are opaque enough to connect parts."""
    is_level: np.ndarray
    """(n,) bool, True for Gaussians that are flat and parallel to the plane, as a floor's Gaussians are."""

    @classmethod
    def of(cls, cloud: GaussianCloud, plane: Plane | HeightField) -> SceneAbovePlane:
        means, opacity = cloud.means.numpy().astype(np.float64), cloud.opacities()
        level = lies_along(cloud, plane)
        flat = means @ np.stack(plane.tangents(), axis=1)
        return cls(cloud, plane, means, flat, plane.heights(means), opacity, cloud.visible(MIN_OPACITY), level)

    def is_under(self, chosen: np.ndarray, height: float, size: float) -> np.ndarray:
        """Return the mask (n,) bool of Gaussians under the object's low parts: inside the outline, seen along the
        normal, of those Gaussians among the ``chosen`` (n,) bool that are lower than ``height``. ``size`` is the size
        of the object; both are in scene units."""
        return enclosed(self.flat, self.flat[chosen & (self.heights < height)], size / CELLS)

    def is_within(self, indices: np.ndarray, chosen: np.ndarray, size: float) -> np.ndarray:
        """Return the mask (m,) bool of those Gaussians with ``indices`` (m,) that are inside the shell which the
        ``chosen`` (n,) bool Gaussians form and the plane closes from below. ``size`` is the size of the object, scene
        units."""
        upright = np.column_stack([self.flat, self.heights])
        skin = upright[chosen]
        return enclosed(upright[indices], np.concatenate([skin, skin * [1.0, 1.0, 0.0]]), 2.0 * size / CELLS)


def detached_parts(
    scene: SceneAbovePlane, indices: np.ndarray, parts: np.ndarray, meant: np.ndarray, size: float
) -> np.ndarray:
    """Return the indices of the detached parts that belong to the object. Such parts do not touch the ground, are next
    to the ``meant`` parts and have less mass than these.

    In a coarse capture, leaves are separated from their twigs, and nothing else supports them. Parts that are not
    strays may be farther away if the object is by far the nearest possible support.

    Args:
        scene: the capture.
        indices: (m,) Gaussians.
        parts: (m,) connected part of each Gaussian.
        meant: indices of the parts that are known to belong to the object.
        size: size of the object, scene units.
    """
    heights, mass = scene.heights[indices], np.bincount(parts, weights=scene.opacity[indices])
    lowest = np.full(len(mass), np.inf)
    np.minimum.at(lowest, parts, heights)
    free = (lowest > _MIN_DETACHED_HEIGHT * size) & (mass < mass[meant].sum())
    attached = np.isin(np.arange(len(mass)), meant)
    for _ in range(_MAX_CHAIN):
        others = np.flatnonzero(~attached[parts] & free[parts])
        tree = KDTree(scene.means[indices[attached[parts]]])
        gaps = np.full(len(mass), np.inf)
        np.minimum.at(gaps, parts[others], tree.query(scene.means[indices[others]])[0])
        more = gaps < _GAP * size
        if not more.any():
            break
        attached |= more
    own = mass[meant].sum()
    heavy = free & ~attached & (mass > _HEAVY * own)
    if heavy.any():
        points = scene.means[indices]
        gaps, others = (
            _gaps(points, parts, heavy, attached),
            _gaps(points, parts, heavy, ~free & ~attached & (mass > _LIGHT * own)),
        )
        attached |= (gaps < _MAX_DETACHED_GAP * size) & (others > _MIN_GAP_RATIO * gaps)
    return np.setdiff1d(np.flatnonzero(attached), meant)


def _gaps(points: np.ndarray, parts: np.ndarray, selected: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the distance of each selected part from the nearest of the other parts.

    Args:
        points: (m, 3) positions.
        parts: (m,) part of each point.
        selected: (k,) bool, parts whose distances are computed.
        others: (k,) bool, parts from which they are measured.

    Returns:
        Distances (k,) in scene units; infinite for parts that are not selected, and if there are no others.
    """
    gaps = np.full(len(selected), np.inf)
    of, near = np.flatnonzero(selected[parts]), np.flatnonzero(others[parts])
    if len(of) and len(near):
        np.minimum.at(gaps, parts[of], KDTree(points[near]).query(points[of])[0])
    return gaps


def clicked_parts(
    indices: np.ndarray, parts: np.ndarray, scene: SceneAbovePlane, clicks: Sequence[Click], size: float
) -> np.ndarray:
    """Return the indices of the parts that clicks on the object hit or narrowly miss. ``parts`` (m,) is the part of
    each of the Gaussians with the indices ``indices`` (m,); ``size`` is the size of the object, scene units."""
    found = []
    for click in clicks:
        if not click.inside:
            continue
        hit = np.isin(indices, click.hits)
        away = np.linalg.norm(scene.means[indices] - click.point, axis=1)
        if hit.any():
            found.append(int(np.argmax(np.bincount(parts[hit], weights=scene.opacity[indices[hit]]))))
        elif away.min() < _NEAR_CLICK * size:
            found.append(int(parts[np.argmin(away)]))
    return np.array(found, int)
