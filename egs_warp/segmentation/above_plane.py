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
_HEAVY, _LIGHT = 0.05, 0.01
"""Of the object's opacity mass: a part that hangs in the air from this share on is no stray; one below the second holds
nothing.
"""
_APART, _TWICE = 0.2, 2.0
"""Of the object's size: so far apart a part of it may hang, as a robot's hands do, if nothing else that could hold it
is nearer than so many times that.
"""
_NEAR_CLICK = 0.1
"""Of the object's size: a click that hits only what makes no connection means what is so near to it."""


@dataclass(frozen=True)
class SceneAbovePlane:
    """What is asked of the capture again and again; all (n, ...)."""

    cloud: GaussianCloud
    plane: Plane | HeightField
    means: np.ndarray
    flat: np.ndarray
    """(n, 2) along the plane."""
    heights: np.ndarray
    opacity: np.ndarray
    is_opaque: np.ndarray
    """(n,) bool: opaque enough to connect."""
    is_level: np.ndarray
    """(n,) bool: flat, and lying along the plane as a floor's Gaussians do."""

    @classmethod
    def of(cls, cloud: GaussianCloud, plane: Plane | HeightField) -> SceneAbovePlane:
        means, opacity = cloud.means.numpy().astype(np.float64), cloud.opacities()
        level = lies_along(cloud, plane)
        flat = means @ np.stack(plane.tangents(), axis=1)
        return cls(cloud, plane, means, flat, plane.heights(means), opacity, opacity >= _MIN_OPACITY, level)

    def is_under(self, chosen: np.ndarray, height: float, size: float) -> np.ndarray:
        """(n,) bool: within the outline, seen along the normal, of what ``chosen`` has below ``height``."""
        return enclosed(self.flat, self.flat[chosen & (self.heights < height)], size / CELLS)

    def is_within(self, these: np.ndarray, chosen: np.ndarray, size: float) -> np.ndarray:
        """(m,) bool: which of ``these`` (m,) lie within what is ``chosen`` (n,), which the plane closes from below."""
        upright = np.column_stack([self.flat, self.heights])
        skin = upright[chosen]
        return enclosed(upright[these], np.concatenate([skin, skin * [1.0, 1.0, 0.0]]), 2.0 * size / CELLS)


def detached_parts(
    scene: SceneAbovePlane, indices: np.ndarray, parts: np.ndarray, meant: np.ndarray, size: float
) -> np.ndarray:
    """Those of the ``parts`` (m,) of the Gaussians ``indices`` (m,) that hang in the air beside the ``meant`` ones, and
    are less than these: where a capture is coarse, leaves come off their twigs, and nothing else holds them. What is no
    stray may hang further away, where it is by far the nearest that could hold it.
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
    own = mass[meant].sum()
    heavy = free & ~held & (mass > _HEAVY * own)
    if heavy.any():
        points = scene.means[indices]
        gaps, others = (
            _gaps(points, parts, heavy, held),
            _gaps(points, parts, heavy, ~free & ~held & (mass > _LIGHT * own)),
        )
        held |= (gaps < _APART * size) & (others > _TWICE * gaps)
    return np.setdiff1d(np.flatnonzero(held), meant)


def _gaps(points: np.ndarray, parts: np.ndarray, these: np.ndarray, those: np.ndarray) -> np.ndarray:
    """(k,) how far each of ``these`` (k,) bool parts of the ``points`` (m, 3) is from the nearest of ``those`` (k,)
    bool; infinite for all others, and where there are none.
    """
    gaps = np.full(len(these), np.inf)
    of, near = np.flatnonzero(these[parts]), np.flatnonzero(those[parts])
    if len(of) and len(near):
        np.minimum.at(gaps, parts[of], KDTree(points[near]).query(points[of])[0])
    return gaps


def clicked_parts(
    indices: np.ndarray, parts: np.ndarray, scene: SceneAbovePlane, clicks: Sequence[Click], size: float
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
