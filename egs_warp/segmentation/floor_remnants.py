"""The floor at an object's foot: the height up to which its Gaussians scatter, and remnants of the floor among the
object's Gaussians."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import SH_BAND_0
from egs_warp.geometry.height_field import HeightField
from egs_warp.segmentation.above_plane import SceneAbovePlane
from egs_warp.segmentation.connectivity import close_to

_MIN_REMNANT_WIDTH, _MAX_REMNANT_HEIGHT = 0.015, 0.1
"""Minimum standard deviation and maximum height of a Gaussian that may be a floor remnant, as fractions of the object's
size."""
_MAX_SCATTER = 0.02
"""Maximum scatter that is assumed for a floor, as a fraction of the object's size."""
_NEIGHBOURS = 16
"""Number of Gaussians whose median colour is used as the local colour."""


def floor_scatter_height(scene: SceneAbovePlane, chosen: np.ndarray, size: float) -> float:
    """Return the height, scene units, up to which the floor's Gaussians scatter, measured next to the object ``chosen``
    (n,) bool; at least 0."""
    middle = np.median(scene.flat[chosen], axis=0)
    around = scene.is_level & scene.is_opaque & ~chosen & (np.abs(scene.heights) < 0.05 * size)
    around &= np.linalg.norm(scene.flat - middle, axis=1) < size
    around &= ~close_to(scene.flat, scene.flat[chosen & (scene.heights < 0.2 * size)], 0.03 * size)
    if around.sum() < 20:
        return 0.0
    level = float(np.median(scene.heights[around]))
    spread = 1.4826 * float(np.median(np.abs(scene.heights[around] - level)))
    return float(np.clip(level + 3.0 * spread, 0.0, _MAX_SCATTER * size))


def floor_remnants(scene: SceneAbovePlane, chosen: np.ndarray, size: float) -> np.ndarray:
    """Return the mask (n,) bool of floor remnants: wide Gaussians at the foot of the object that have the colour of the
    floor. On uneven ground, Gaussians that lie flat are included."""
    low = scene.heights < _MAX_REMNANT_HEIGHT * size
    length = np.exp(scene.cloud.log_scales.numpy().max(axis=1))
    # Compare them with the other Gaussians at the foot: in a coarse capture, all Gaussians of a plant's stand are wide,
    # and those of the leaves above it are small.
    typical = float(np.median(length[chosen & low])) if (chosen & low).any() else 0.0
    wide = length > max(_MIN_REMNANT_WIDTH * size, 2.0 * typical)
    if isinstance(scene.plane, HeightField):
        # Under the object, the ground is only estimated, so remnants may be higher.
        wide |= scene.is_level
    suspects = np.flatnonzero(chosen & low & wide)
    own = np.flatnonzero(chosen & low & ~wide & scene.is_opaque)
    floor = np.flatnonzero(~chosen & low & scene.is_level & scene.is_opaque & (np.abs(scene.heights) < 0.05 * size))
    remnants = np.zeros(len(chosen), bool)
    if min(len(suspects), len(own), len(floor)) < 1:
        return remnants
    colours = scene.cloud.sh.numpy()[:, 0].astype(np.float64) * SH_BAND_0

    def apart(others: np.ndarray) -> np.ndarray:
        tree = KDTree(scene.means[others])
        _, nearest = tree.query(scene.means[suspects], k=min(_NEIGHBOURS, len(others)))
        nearest = np.reshape(nearest, (len(suspects), -1))
        return np.linalg.norm(np.median(colours[others[nearest]], axis=1) - colours[suspects], axis=1)

    remnants[suspects[apart(floor) < 0.5 * apart(own)]] = True
    return remnants
