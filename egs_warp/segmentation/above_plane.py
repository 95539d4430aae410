"""A capture over its plane, as the search for an object asks for it, and which of its connected parts are meant."""

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
"""Across the object, for connectivity."""
_MIN_OPACITY = 0.1
"""Fainter Gaussians make no connection; they go with what surrounds them."""
_HELD_UP = 0.1
"""Of the object's size: what has all of itself higher than this stands on nothing."""
_GAP = 2.0 / CELLS
"""Of the object's size: what hangs in the air so near to the object is held by it."""
_CHAIN = 4
"""Leaves on leaves on leaves."""
_NEAR_CLICK = 0.1
"""Of the object's size: a click that hits only what makes no connection means what is so near to it."""


@dataclass(frozen=True)
class AbovePlane:
    """What is asked of the capture again and again; all (n, ...)."""

    cloud: GaussianCloud
    plane: Plane | HeightField
    means: np.ndarray
    flat: np.ndarray
    """(n, 2) along the plane."""
    heights: np.ndarray
    opacity: np.ndarray
    solid: np.ndarray
    """(n,) bool: opaque enough to connect."""
    level: np.ndarray
    """(n,) bool: flat, and lying along the plane as a floor's Gaussians do."""

    @classmethod
    def of(cls, cloud: GaussianCloud, plane: Plane | HeightField) -> AbovePlane:
        means, opacity = cloud.means.numpy().astype(np.float64), cloud.opacities()
        level = lies_along(cloud, plane)
        flat = means @ np.stack(plane.tangents(), axis=1)
        return cls(cloud, plane, means, flat, plane.heights(means), opacity, opacity >= _MIN_OPACITY, level)

    def under(self, chosen: np.ndarray, height: float, size: float) -> np.ndarray:
        """(n,) bool: within the outline, seen along the normal, of what ``chosen`` has below ``height``."""
        return enclosed(self.flat, self.flat[chosen & (self.heights < height)], size / CELLS)


def hanging_parts(
    scene: AbovePlane, indices: np.ndarray, parts: np.ndarray, meant: np.ndarray, size: float
) -> np.ndarray:
    """Those of the ``parts`` (m,) of the Gaussians ``indices`` (m,) that hang in the air beside the ``meant`` ones, and
    are less than these: where a capture is coarse, leaves come off their twigs, and nothing else holds them.
    """
    heights, mass = scene.heights[indices], np.bincount(parts, weights=scene.opacity[indices])
    lowest = np.full(len(mass), np.inf)
    np.minimum.at(lowest, parts, heights)
    free = (lowest > _HELD_UP * size) & (mass < mass[meant].sum())
    held = np.isin(np.arange(len(mass)), meant)
    for _ in range(_CHAIN):
        others = np.flatnonzero(~held[parts] & free[parts])
        tree = KDTree(scene.means[indices[held[parts]]])
        gaps = np.full(len(mass), np.inf)
        np.minimum.at(gaps, parts[others], tree.query(scene.means[indices[others]])[0])
        more = gaps < _GAP * size
        if not more.any():
            break
        held |= more
    return np.setdiff1d(np.flatnonzero(held), meant)


def clicked_parts(
    indices: np.ndarray, parts: np.ndarray, scene: AbovePlane, clicks: Sequence[Click], size: float
) -> np.ndarray:
    """Those of the ``parts`` (m,) of the Gaussians ``indices`` (m,) that clicks on the object hit or just miss."""
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
