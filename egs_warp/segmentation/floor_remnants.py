"""What of the floor lies at an object's foot: how high its Gaussians scatter, and which of the object's are shreds of
it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import SH_BAND_0
from egs_warp.geometry.height_field import HeightField
from egs_warp.segmentation.above_plane import SceneAbovePlane
from egs_warp.segmentation.connectivity import close_to

_WISP, _WISP_HEIGHT = 0.015, 0.1
"""Of the object's size: standard deviation from which, and height up to which,
a Gaussian may be a shred of the floor.
"""
_ROUGHEST = 0.02
"""Of the object's size: a floor is not taken to scatter more than this."""
_NEIGHBOURS = 16
"""Gaussians whose median colour is that of a place."""


def floor_scatter_height(scene: SceneAbovePlane, chosen: np.ndarray, size: float) -> float:
    """Height up to which the floor's own Gaussians scatter, judged beside the object ``chosen`` (n,) bool;
    at least 0.
    """
    middle = np.median(scene.flat[chosen], axis=0)
    beside = scene.is_level & scene.is_opaque & ~chosen & (np.abs(scene.heights) < 0.05 * size)
    beside &= np.linalg.norm(scene.flat - middle, axis=1) < size
    beside &= ~close_to(scene.flat, scene.flat[chosen & (scene.heights < 0.2 * size)], 0.03 * size)
    if beside.sum() < 20:
        return 0.0
    level = float(np.median(scene.heights[beside]))
    spread = 1.4826 * float(np.median(np.abs(scene.heights[beside] - level)))
    return float(np.clip(level + 3.0 * spread, 0.0, _ROUGHEST * size))


def floor_remnants(scene: SceneAbovePlane, chosen: np.ndarray, size: float) -> np.ndarray:
    """(n,) bool: wide Gaussians at the object's foot in the floor's colour, on uneven ground those that lie flat, too,
    which would go along as shreds of the floor.
    """
    low = scene.heights < _WISP_HEIGHT * size
    length = np.exp(scene.cloud.log_scales.numpy().max(axis=1))
    # Than others at the foot: where a capture is coarse, a stand is all of wide ones, and leaves above it are small.
    usual = float(np.median(length[chosen & low])) if (chosen & low).any() else 0.0
    wide = length > max(_WISP * size, 2.0 * usual)
    if isinstance(scene.plane, HeightField):
        # Under the object the ground is a guess, and what lies there may be higher.
        wide |= scene.is_level
    suspects = np.flatnonzero(chosen & low & wide)
    own = np.flatnonzero(chosen & low & ~wide & scene.is_opaque)
    floor = np.flatnonzero(~chosen & low & scene.is_level & scene.is_opaque & (np.abs(scene.heights) < 0.05 * size))
    found = np.zeros(len(chosen), bool)
    if min(len(suspects), len(own), len(floor)) < 1:
        return found
    colours = scene.cloud.sh.numpy()[:, 0].astype(np.float64) * SH_BAND_0

    def apart(others: np.ndarray) -> np.ndarray:
        tree = KDTree(scene.means[others])
        _, nearest = tree.query(scene.means[suspects], k=min(_NEIGHBOURS, len(others)))
        nearest = np.reshape(nearest, (len(suspects), -1))
        return np.linalg.norm(np.median(colours[others[nearest]], axis=1) - colours[suspects], axis=1)

    found[suspects[apart(floor) < 0.5 * apart(own)]] = True
    return found
