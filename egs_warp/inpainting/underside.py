"""The underside of an object that stood on uneven or soft ground: no view has seen it, so it is closed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from scipy import ndimage

from egs_warp.geometry.bitmaps import depth_inside, distance_to, nearest_set
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud, concatenate
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.laplace_fill import laplace_fill
from egs_warp.inpainting.new_floor import flat_gaussians
from egs_warp.inpainting.rectified import PlaneWindow

_LOW = 0.03
"""Of the object's size: what of it is nearer to the ground is its rim there."""
_TEXELS = 128
"""Across the rim."""
_SPACING = 2
"""Texels between new Gaussians."""
_BRIDGED = 8.0
"""Texels: gaps in the rim that are twice as wide are bridged."""
_REACH = 2.0
"""Standard deviations of a splat that cover."""
_FOOT = 0.05
"""Of the texels that the rim encloses: fewer unseen ones are no underside."""


def with_underside(thing: GaussianCloud, ground: HeightField, size: float) -> tuple[GaussianCloud, int]:
    """``thing``, of ``size`` (scene units), with flat Gaussians over what its rim at the ``ground`` encloses, and how
    many these are: a soap film through the rim, in the rim's colours.
    """
    means = thing.means.numpy().astype(np.float64)
    low = (ground.heights(means) < _LOW * size) & (thing.opacities() > 0.3)
    if low.sum() < 3:
        return thing, 0
    plane, rim = ground.plane, means[low]
    tangents = np.stack(plane.tangents(), axis=1)
    flat = rim @ tangents
    texel = 1.2 * float(np.ptp(flat, axis=0).max()) / _TEXELS
    middle = 0.5 * (rim.min(axis=0) + rim.max(axis=0))
    if texel <= 0.0:
        return thing, 0
    window = PlaneWindow(plane, middle - plane.heights(middle) * plane.normal, texel, _TEXELS, _TEXELS)
    column, row = np.floor(window.pixels(rim)).astype(int).T
    heights = np.full((_TEXELS, _TEXELS), np.inf)
    np.minimum.at(heights, (row, column), plane.heights(rim))
    seen = np.isfinite(heights)
    colours = np.zeros((_TEXELS, _TEXELS, 3))
    # The lowest of each texel comes last, and counts.
    order = np.argsort(-plane.heights(rim), kind="stable")
    colours[row[order], column[order]] = thing.sh.numpy()[low][order, 0] * SH_BAND_0 + 0.5
    # Splats cover what is between their middles.
    width = float(np.median(thing.breadths(low)))
    covered = distance_to(seen) <= _REACH * width / texel
    # Filled while swollen, since the rim is a sieve.
    inside = depth_inside(np.asarray(ndimage.binary_fill_holes(distance_to(seen) <= _BRIDGED))) > _BRIDGED
    near = nearest_set(seen)
    unseen = inside & ~covered
    if not unseen.any() or unseen.sum() < _FOOT * inside.sum():
        return thing, 0
    film = laplace_fill(heights[tuple(near)], unseen)
    painted = laplace_fill(colours[tuple(near)], unseen)
    new = flat_gaussians(window, unseen, seen, painted, film, spacing=_SPACING, device=str(thing.device))
    if new is None:
        return thing, 0
    return concatenate(thing, _of_degree(new, thing.sh.shape[1])), new.count


def _of_degree(cloud: GaussianCloud, coefficients: int) -> GaussianCloud:
    """``cloud``, of SH degree 0, with as many ``coefficients`` as another has."""
    sh = np.zeros((cloud.count, coefficients, 3), np.float32)
    sh[:, 0] = cloud.sh.numpy()[:, 0]
    return replace(cloud, sh=wp.array(sh, dtype=wp.vec3, device=cloud.device))
