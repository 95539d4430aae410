"""Flat Gaussians for a region of floor: their positions and their view-dependent colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from scipy import ndimage
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.laplace_fill import laplace_fill
from egs_warp.inpainting.rectified import PlaneWindow, RectifiedImage, mean_colours

_WIDTH = 0.62
"""Standard deviation along the plane, as a fraction of the spacing."""
_OPACITY = 0.97
_SKIRT = 2
"""Number of spacings by which the new floor continues under the old one, so that no gap shows between them."""
_SKIRT_DROP = 0.5
"""Depth of the new floor below the old one where they overlap, in spacings."""
_RIM_SMOOTHING = 3.0
"""Standard deviation, in texels, of the blur of the floor's height at the rim."""
_OUTLIER = 2.0
"""Heights are clipped at this many robust standard deviations from the tilted plane through the rim, to remove cracks
and blades of grass."""
_NEIGHBOURS = 512
"""Number of Gaussians of the old floor whose gloss is averaged for a new Gaussian. If there were fewer, all from one
part of the rim, most of them could be haze."""
_GLOSS_CELL = 4.0
"""Side of a cell, texels. New Gaussians in one cell have the same gloss."""


def rim_heights(before: RectifiedImage, hole: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the height (rows, columns) of the new floor above the plane: the solution of Laplace's equation in the
    hole, with the heights of the rim as boundary values.

    A real floor differs from the fitted plane; without this correction, the edge of the new floor would be a step that
    is visible in low views.
    """
    ring = ndimage.binary_dilation(hole, iterations=round(3 * _RIM_SMOOTHING)) & known
    rows, columns = np.indices(hole.shape) / max(hole.shape) - 0.5
    basis = np.stack([np.ones(hole.shape), rows, columns], axis=-1)
    at, values = basis[ring], before.height[ring].astype(np.float64)
    weight = np.ones(len(at))
    tilted, scale = np.zeros(3), 0.0
    for _ in range(10):
        tilted = np.linalg.lstsq(at * weight[:, None], values * weight, rcond=None)[0]
        off = np.abs(values - at @ tilted)
        scale = 1.4826 * float(np.median(off))
        weight = 1.0 / np.sqrt(1.0 + (off / max(scale, 1e-9)) ** 2)
    level = basis @ tilted
    rest = np.where(known, np.clip(before.height - level, -_OUTLIER * scale, _OUTLIER * scale), 0.0)
    share = ndimage.gaussian_filter(known.astype(np.float64), _RIM_SMOOTHING)
    rim = ndimage.gaussian_filter(rest, _RIM_SMOOTHING) / np.maximum(share, 0.05)
    return level + laplace_fill(rim, hole)


def flat_gaussians(
    window: PlaneWindow,
    hole: np.ndarray,
    known: np.ndarray,
    painted: np.ndarray,
    heights: np.ndarray,
    *,
    spacing: int,
    device: str | None = None,
) -> GaussianCloud | None:
    """Create flat Gaussians of SH degree 0 over a hole and its known rim.

    The Gaussians over the rim lie a little lower, so that they are visible only through gaps. Returns None if no block
    of ``spacing`` x ``spacing`` texels fits into the hole.

    Args:
        window: the plane and its grid of texels.
        hole: (rows, columns) bool, on the window.
        known: (rows, columns) bool, texels at which the old floor is known.
        painted: (rows, columns, 3) colours of the new floor, 0 to 1.
        heights: (rows, columns) heights of the new floor above the plane, scene units.
        spacing: distance between Gaussians, texels.
        device: Warp device of the result.
    """
    size = (np.array(hole.shape) // spacing) * spacing

    def blocks(values: np.ndarray) -> np.ndarray:
        whole = values[: size[0], : size[1]].astype(np.float64)
        return whole.reshape(size[0] // spacing, spacing, size[1] // spacing, spacing, -1).mean(axis=(1, 3))

    inner = blocks(hole)[..., 0] > 0.5
    coloured = blocks(hole | known)[..., 0] == 1.0
    rows, columns = np.nonzero(ndimage.binary_dilation(inner, iterations=_SKIRT) & coloured)
    count = len(rows)
    if count == 0:
        return None
    first, second = window.plane.tangents()
    step = spacing * window.texel
    log_scales = np.full((count, 3), np.log(_WIDTH * step))
    # Use the paper's thickness, except in scenes so small that Gaussians of this thickness would not be flat.
    log_scales[:, 2] = min(-10.0, float(np.log(0.05 * step)))
    height = blocks(heights)[rows, columns] - np.where(inner[rows, columns], 0.0, _SKIRT_DROP * step)[:, None]
    places = window.points((np.stack([columns, rows], axis=1) + 0.5) * spacing)
    x, y, z, w = Rotation.from_matrix(np.stack([first, second, window.plane.normal], axis=1)).as_quat()
    return GaussianCloud.from_numpy(
        places + height * window.plane.normal,
        np.tile([w, x, y, z], (count, 1)),
        log_scales,
        np.full(count, np.log(_OPACITY / (1.0 - _OPACITY))),
        ((blocks(painted)[rows, columns] - 0.5) / SH_BAND_0)[:, None],
        device=device,
    )


def with_gloss(new: GaussianCloud, floor: GaussianCloud, window: PlaneWindow) -> GaussianCloud:
    """Return ``new`` (SH degree 0) with the gloss of ``floor``: the higher SH bands of the nearest Gaussians of
    ``floor``.

    The mean colour over all directions does not change.
    """
    coefficients = floor.sh.shape[1]
    if coefficients == 1:
        return new
    neighbours = min(_NEIGHBOURS, floor.count)
    in_cells = np.floor(window.pixels(new.means.numpy()) / _GLOSS_CELL)
    cells, cell_of = np.unique(in_cells, axis=0, return_inverse=True)
    middles = window.points(_GLOSS_CELL * (cells + 0.5))
    distance, index = KDTree(floor.means.numpy()).query(middles, k=neighbours)
    weight = 1.0 / np.maximum(np.reshape(distance, (len(cells), neighbours)), window.texel)
    weight /= weight.sum(axis=1, keepdims=True)
    sh = np.zeros((new.count, coefficients, 3), np.float32)
    sh[:, 1:] = np.einsum("nk,nkcd->ncd", weight, floor.sh.numpy()[np.reshape(index, weight.shape), 1:])[cell_of]
    glossy = replace(new, sh=wp.array(sh, dtype=wp.vec3, device=new.device))
    sh[:, 0] = (mean_colours(new, window.plane) - mean_colours(glossy, window.plane)) / SH_BAND_0
    return replace(new, sh=wp.array(sh, dtype=wp.vec3, device=new.device))
