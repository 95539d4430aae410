"""Note to the user about a capture that seems to be a scene although no object is selected."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from egs_warp.geometry.bitmaps import connected_parts, nearest_set
from egs_warp.geometry.frames import orthonormal_basis
from egs_warp.geometry.gaussians import GaussianCloud

_SOLID = 0.3
"""Minimum opacity of a Gaussian to be considered; see ``GaussianCloud.visible``."""
_GROUND_HEIGHT = 0.15
"""Height, as a fraction of the height of the capture, below which everything over a part of the footprint must be for
that part to be ground on which nothing stands: higher than folds of cloth, grass or gravel beside a toy."""
_MIN_GROUND_SHARE = 0.4
"""Minimum share of such ground in the footprint of a scene. It is at most 0.35 in captures of single objects, for a
pawn with a wide foot, and at most 0.2 in all others."""
_LEVEL_THICKNESS = 0.03
"""Range of heights of a level surface, such as a table top, as a fraction of the height of the capture."""
_HIGHEST_LEVEL = 0.6
"""Maximum height of a level surface on which something stands, as a fraction of the height of the capture. Without the
floor, a table top is at the bottom; with a cloth or a plinth, it is higher."""
_MIN_RISE = 0.35
"""Minimum height above the level surface of what stands on it, as a fraction of the height of the capture."""
_MIN_STANDING_SHARE = 0.02
"""Minimum share of the footprint over which something stands on the level surface."""
_MIN_LEVEL_SHARE = 0.3
"""Minimum share of the level surface in the footprint. It is 0.21 for the foot of a pawn."""
_MIN_ENCLOSURE = 0.7
"""Minimum fraction of the surroundings of what stands on a level surface that belong to the surface. It is 0.47 for the
back of a chair on its seat, and 0.56 for the upper part of a pile of blocks."""
_SURROUNDINGS = 2
"""Width of these surroundings in cells."""
_CELLS = 32
"""Maximum number of cells along the side of a square with the area of the footprint."""
_PER_CELL = 8
"""Minimum mean number of Gaussians of a cell: the top of a cell with few of them is too low."""
_GAP = 2
"""Half the maximum width, in cells, of gaps between sparse Gaussians of a surface that are closed."""
_BOX = np.ones((3, 3), bool)


def scene_notes(cloud: GaussianCloud, up: np.ndarray | None) -> list[str]:
    """Return a note if ``cloud`` seems to be a scene; otherwise none.

    In a scene, 0.4 of the footprint is low ground on which nothing stands, or 0.3 of it is a level surface, such as a
    table top, that surrounds what stands on it.

    Args:
        cloud: Capture without a selected object.
        up: (3,) unit vector that points up; None if it is unknown, which gives no note.
    """
    visible = cloud.visible(_SOLID)
    if up is None or not visible.any():
        return []
    means = cloud.means.numpy()[visible].astype(np.float64)
    widths = np.sort(cloud.log_scales.numpy()[visible].astype(np.float64), axis=1)[:, 1:]
    tops = _column_tops(means @ up, means @ np.stack(orthonormal_basis(up)[:2], axis=1), np.exp(widths.sum(axis=1)))
    if tops.size == 0:
        return []
    ground, level = float((tops[np.isfinite(tops)] < _GROUND_HEIGHT).mean()), _level_share(tops)
    if ground < _MIN_GROUND_SHARE and level < _MIN_LEVEL_SHARE:
        return []
    return [
        f"the capture seems to be a scene: {100.0 * max(ground, level):.0f} % of its area is ground on which nothing"
        " stands; the ground moves with the body unless --object, or egs-warp pick, selects the object"
    ]


def _column_tops(heights: np.ndarray, across: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Return the height of the highest point over each cell of the footprint, as a fraction of the height of the
    capture; (k, l), nan outside the footprint. The shares of number and area beyond the footprint are at most 1 % on
    each side: a table may have few, large Gaussians.

    Args:
        heights: (n,) heights of points.
        across: (n, 2) their horizontal positions.
        areas: (n,) areas of their Gaussians, up to a common factor.
    """
    lowest, highest = np.percentile(heights, [1.0, 99.0])
    limited = np.minimum(areas, np.quantile(areas, 0.999))
    ends = [[*np.percentile(values, [1.0, 99.0]), *_weighted_ends(values, limited)] for values in across.T]
    low, high = np.min(ends, axis=1), np.max(ends, axis=1)
    cell = np.sqrt(np.prod(high - low) / min(_CELLS**2, max(1.0, len(heights) / _PER_CELL)))
    if cell <= 0.0 or highest <= lowest:
        return np.zeros((0, 0))
    cells = np.floor((across - low) / cell).astype(int)
    shape = np.floor((high - low) / cell).astype(int) + 1
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    tops = np.full(tuple(shape), -np.inf)
    np.maximum.at(tops, tuple(cells[inside].T), heights[inside])
    is_empty = np.isinf(tops)
    padded = np.pad(~is_empty, _GAP)
    footprint = ndimage.binary_closing(padded, _BOX, iterations=_GAP)[_GAP:-_GAP, _GAP:-_GAP] | ~is_empty
    return np.where(footprint, (tops[tuple(nearest_set(~is_empty))] - lowest) / (highest - lowest), np.nan)


def _weighted_ends(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the percentiles 1 and 99 of ``values`` (n,) with ``weights`` (n,)."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return values[order][np.searchsorted(total, np.array([0.01, 0.99]) * total[-1])]


def _level_share(tops: np.ndarray) -> float:
    """Return the share of the footprint of the widest level surface on which something stands that it surrounds; 0 if
    there is none.

    Args:
        tops: (k, l) heights of the columns, as fractions of the height of the capture; nan outside the footprint.
    """
    ordered = np.sort(tops[np.isfinite(tops)])
    counts = np.searchsorted(ordered, ordered + _LEVEL_THICKNESS, side="right") - np.arange(len(ordered))
    for index in np.argsort(-counts, kind="stable"):
        base, share = ordered[index], counts[index] / len(ordered)
        if share < _MIN_LEVEL_SHARE:
            break
        standing = tops > base + _LEVEL_THICKNESS
        if (
            base > _HIGHEST_LEVEL
            or standing.sum() < _MIN_STANDING_SHARE * len(ordered)
            or np.percentile(tops[standing], 90.0) < base + _MIN_RISE
        ):
            continue
        surface = np.pad((tops >= base) & ~standing, _SURROUNDINGS)
        parts = np.pad(connected_parts(standing)[0], _SURROUNDINGS)
        widest = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
        around = ndimage.binary_dilation(widest, _BOX, iterations=_SURROUNDINGS) & ~widest
        if surface[around].mean() >= _MIN_ENCLOSURE:
            return float(share)
    return 0.0
