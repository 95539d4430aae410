"""Closing of the underside of an object that stood on uneven or soft ground; no view shows this underside."""

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

_SOLID = 0.3
"""Minimum opacity of a Gaussian of the rim; see ``GaussianCloud.visible``."""
_LOW = 0.03
"""Height above the ground below which Gaussians belong to the object's rim, as a fraction of the object's size."""
_TEXELS = 128
"""Number of texels across the rim."""
_SPACING = 2
"""Minimum distance between new Gaussians, texels."""
_MAX_GROWTH = 0.2
"""Maximum number of new Gaussians, as a fraction of the number in the object."""
_BRIDGED = 8.0
"""Half of the maximum width, in texels, of the gaps in the rim that are closed."""
_REACH = 2.0
"""Radius around its mean, in standard deviations, that a splat covers."""
_FOOT = 0.05
"""Minimum fraction of unseen texels among the texels inside the rim. With a smaller fraction there is no open
underside."""


def with_underside(object_cloud: GaussianCloud, ground: HeightField, size: float) -> tuple[GaussianCloud, int]:
    """Return the object with flat Gaussians over the opening that its rim at the ground encloses, and the number of
    these Gaussians.

    Their heights and colours solve Laplace's equation, with the values of the rim as boundary values. The number of new
    Gaussians is at most a fifth of the number in the object.

    Args:
        object_cloud: Gaussians of the object, scene units.
        ground: the ground under the object.
        size: size of the object, scene units.
    """
    means = object_cloud.means.numpy().astype(np.float64)
    low = (ground.heights(means) < _LOW * size) & object_cloud.visible(_SOLID)
    if low.sum() < 3:
        return object_cloud, 0
    plane, rim = ground.plane, means[low]
    tangents = np.stack(plane.tangents(), axis=1)
    flat = rim @ tangents
    texel = 1.2 * float(np.ptp(flat, axis=0).max()) / _TEXELS
    middle = 0.5 * (rim.min(axis=0) + rim.max(axis=0))
    if texel <= 0.0:
        return object_cloud, 0
    window = PlaneWindow(plane, middle - plane.heights(middle) * plane.normal, texel, _TEXELS, _TEXELS)
    column, row = np.floor(window.pixels(rim)).astype(int).T
    heights = np.full((_TEXELS, _TEXELS), np.inf)
    np.minimum.at(heights, (row, column), plane.heights(rim))
    seen = np.isfinite(heights)
    colours = np.zeros((_TEXELS, _TEXELS, 3))
    # The lowest Gaussian of each texel is written last and determines the colour.
    order = np.argsort(-plane.heights(rim), kind="stable")
    colours[row[order], column[order]] = object_cloud.sh.numpy()[low][order, 0] * SH_BAND_0 + 0.5
    # Splats cover the space between their means as well.
    width = float(np.median(object_cloud.breadths(low)))
    covered = distance_to(seen) <= _REACH * width / texel
    # The region is dilated before it is filled, because the rim has gaps.
    inside = depth_inside(np.asarray(ndimage.binary_fill_holes(distance_to(seen) <= _BRIDGED))) > _BRIDGED
    near = nearest_set(seen)
    unseen = inside & ~covered
    if not unseen.any() or unseen.sum() < _FOOT * inside.sum():
        return object_cloud, 0
    film = laplace_fill(heights[tuple(near)], unseen)
    painted = laplace_fill(colours[tuple(near)], unseen)
    spacing, device = _SPACING, str(object_cloud.device)
    new = flat_gaussians(window, unseen, seen, painted, film, spacing=spacing, device=device)
    while new is not None and new.count > _MAX_GROWTH * object_cloud.count:
        spacing += 1
        new = flat_gaussians(window, unseen, seen, painted, film, spacing=spacing, device=device)
    if new is None:
        return object_cloud, 0
    new = replace(_of_degree(new, object_cloud.sh.shape[1]), antialiased=object_cloud.antialiased)
    return concatenate(object_cloud, new), new.count


def _of_degree(cloud: GaussianCloud, coefficients: int) -> GaussianCloud:
    """Return ``cloud``, of SH degree 0, with ``coefficients`` SH coefficients for each Gaussian."""
    sh = np.zeros((cloud.count, coefficients, 3), np.float32)
    sh[:, 0] = cloud.sh.numpy()[:, 0]
    return replace(cloud, sh=wp.array(sh, dtype=wp.vec3, device=cloud.device))
