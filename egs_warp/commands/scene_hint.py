"""Note to the user about a capture that seems to be a scene although no object is selected."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.frames import orthonormal_basis
from egs_warp.geometry.gaussians import GaussianCloud

_SOLID = 0.3
"""Minimum opacity of a Gaussian to be considered."""
_LOW_PART = 0.2
"""Height of the low part of a capture, as a fraction of the height of the capture."""
_MIN_WIDTH_RATIO = 2.0
"""Minimum ratio of the width of the low part of a scene to the width of the rest. Among measured captures of single
objects, the largest ratio is 1.7, for a pawn with a wide base."""


def scene_notes(cloud: GaussianCloud, up: np.ndarray | None) -> list[str]:
    """Return a note if the low part of ``cloud`` is so wide that it seems to be the ground of a scene; otherwise none.

    Args:
        cloud: Capture without a selected object.
        up: (3,) unit vector that points up; None if it is unknown, which gives no note.
    """
    means = cloud.means.numpy()[cloud.opacities() > _SOLID].astype(np.float64)
    if up is None or len(means) == 0:
        return []
    heights = means @ up
    lowest, highest = np.percentile(heights, [1.0, 99.0])
    is_low = heights < lowest + _LOW_PART * (highest - lowest)
    rest = ~is_low & (heights <= highest)
    if not is_low.any() or not rest.any():
        return []
    across = means @ np.stack(orthonormal_basis(up)[:2], axis=1)
    low_width, width = (_width(across[part]) for part in (is_low, rest))
    if low_width < _MIN_WIDTH_RATIO * width:
        return []
    return [
        f"the capture seems to be a scene: its lowest fifth is {low_width / width:.1f} times as wide as what is above "
        "it; the ground moves with the body unless --object, or egs-warp pick, selects the object"
    ]


def _width(points: np.ndarray) -> float:
    """Return the geometric mean of the two extents of ``points`` (n, 2) without outliers, at least 1e-12."""
    low, high = np.percentile(points, [2.0, 98.0], axis=0)
    return max(float(np.sqrt(np.prod(high - low))), 1e-12)
