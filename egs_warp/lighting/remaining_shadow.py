"""Removal of the object's shadow from the captured ground: the shadow must not remain there when the creature moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.main_light import DISPLAY_GAMMA, MainLight
from egs_warp.geometry.plane import Plane
from egs_warp.lighting.evidence import GroundEvidence, displayed, log_luminance

_LIT = 0.05
"""Maximum shadow, 0 to 1, on a cell of the ground that counts as lit."""
_MIN_LIT = 40
"""Minimum number of lit cells from which the brightness of the others is predicted."""
_SMOOTH = 12
"""Number of neighbouring cells over which the darkening is averaged; averaging preserves the texture of the ground."""
_MAX_SHADE = 0.99
"""Maximum fraction of the brightness that a shadow removes; a black shadow cannot be lightened."""
_BRIGHTEST = 0.75
"""Quantile of the lit Gaussians, by brightness relative to its prediction, that no lightened Gaussian exceeds."""
_MARGIN = 1.5
"""Maximum height of the Gaussians that are lightened, relative to the maximum height of Gaussians in cells of the
ground."""


def without_shadow(
    background: GaussianCloud, object_cloud: GaussianCloud, ground: Plane | HeightField, light: MainLight
) -> GaussianCloud:
    """Return ``background`` with the ground lightened where it is darker than predicted from the lit ground around it.

    No part of the ground is lightened by more than the shadow of ``light`` darkens it, so drawing the shadow of the
    object at rest restores the captured brightness. No Gaussian becomes brighter than lit ground or than white, which
    would clip single channels and so change its hue. Ground that was inpainted without shadow is not changed.

    Args:
        background: the capture without the object.
        object_cloud: the object at rest.
        ground: ground under the object.
        light: main light.
    """
    evidence = GroundEvidence.of(object_cloud, background, ground)
    if light.shade <= 0.0 or evidence.causes is None:
        return background
    shadow = evidence.shadow(light)
    lit = shadow < _LIT
    if lit.sum() < _MIN_LIT or lit.all():
        return background
    weights = np.linalg.lstsq(evidence.causes[lit], evidence.log_brightness[lit], rcond=1e-6)[0]
    predicted = evidence.causes @ weights
    darker = predicted - evidence.log_brightness
    tree = KDTree(evidence.points)
    near = np.asarray(tree.query(evidence.points, k=min(_SMOOTH, len(evidence.points)))[1])
    depth = -DISPLAY_GAMMA * np.log1p(-min(light.shade, _MAX_SHADE))
    excess = np.clip(darker[near].mean(axis=1), 0.0, depth * shadow)
    means = background.means.numpy().astype(np.float64)
    on_ground = np.flatnonzero(np.abs(ground.heights(means)) < _MARGIN * evidence.max_height)
    distance, cell = tree.query(means[on_ground], distance_upper_bound=2.0 * evidence.cell)
    found = np.isfinite(distance)
    rows, cell = on_ground[found], np.asarray(cell)[found]
    colours = displayed(background)[rows]
    # A cell also has lit Gaussians if the edge of the shadow or of the inpainted ground crosses it.
    brighter = log_luminance(colours) - predicted[cell]
    is_lit = lit[cell]
    limit = np.quantile(brighter[is_lit], _BRIGHTEST) if is_lit.any() else 0.0
    gain = np.exp(np.clip(excess[cell], 0.0, np.maximum(limit - brighter, 0.0)) / DISPLAY_GAMMA)
    gain = np.clip(gain, 1.0, 1.0 / colours.max(axis=1))[:, None]
    sh = background.sh.numpy().copy()
    sh[rows] *= gain[:, None]
    sh[rows, 0] += 0.5 * (gain - 1.0) / SH_BAND_0
    return replace(background, sh=wp.array(sh, dtype=wp.vec3, device=background.device))
