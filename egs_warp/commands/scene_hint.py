"""Note to the user about a capture that seems to be a scene although no object is selected."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.frames import orthonormal_basis
from egs_warp.geometry.gaussians import GaussianCloud

_SOLID = 0.3
"""Minimum opacity of a Gaussian to be considered; see ``GaussianCloud.visible``."""
_GROUND_HEIGHT = 0.1
"""Height, as a fraction of the height of the capture, below which everything over a part of the footprint must be for
that part to be ground on which nothing stands. It is thicker than a sheet or gravel, and thinner than the foot of a
chess piece."""
_MIN_GROUND_SHARE = 0.5
"""Minimum share of such ground in the footprint of a scene: the ground is larger than what stands on it. It is 0.54 to
0.99 in captures of scenes, and at most 0.27 in those of single objects, for a pawn with a wide foot."""
_CELLS = 32
"""Number of cells along the side of a square with the area of the footprint."""


def scene_notes(cloud: GaussianCloud, up: np.ndarray | None) -> list[str]:
    """Return a note if more than half of the footprint of ``cloud`` is low ground with nothing on it, so that it seems
    to be a scene; otherwise none.

    Args:
        cloud: Capture without a selected object.
        up: (3,) unit vector that points up; None if it is unknown, which gives no note.
    """
    means = cloud.means.numpy()[cloud.visible(_SOLID)].astype(np.float64)
    if up is None or len(means) == 0:
        return []
    share = _ground_share(means @ up, means @ np.stack(orthonormal_basis(up)[:2], axis=1))
    if share < _MIN_GROUND_SHARE:
        return []
    return [
        f"the capture seems to be a scene: {100.0 * share:.0f} % of its area is ground on which nothing stands; the"
        " ground moves with the body unless --object, or egs-warp pick, selects the object"
    ]


def _ground_share(heights: np.ndarray, across: np.ndarray) -> float:
    """Return the share of the footprint over which nothing is higher than ``_GROUND_HEIGHT``.

    Args:
        heights: (n,) heights of points.
        across: (n, 2) their horizontal positions.
    """
    lowest, highest = np.percentile(heights, [1.0, 99.0])
    low, high = np.percentile(across, [1.0, 99.0], axis=0)
    area = float(np.prod(high - low))
    if area <= 0.0 or highest <= lowest:
        return 0.0
    cells = np.floor((across - low) / (np.sqrt(area) / _CELLS))
    column_from_point = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    tops = np.full(int(column_from_point.max()) + 1, -np.inf)
    np.maximum.at(tops, column_from_point, heights)
    return float((tops < lowest + _GROUND_HEIGHT * (highest - lowest)).mean())
