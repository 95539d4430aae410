"""Gaussians of a box, for props of your own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from egs_warp.checked_calls import Positive
from egs_warp.errors import ArgumentError
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.launching import use_device

_ROUNDING = 1e-6
"""Largest difference from a whole number at which the ratio of an edge to the spacing is considered whole."""


def box_cloud(
    size: tuple[Positive, Positive, Positive],
    paint: Callable[[np.ndarray], np.ndarray | tuple[float, float, float]],
    *,
    spacing: float = 0.02,
    device: str | None = None,
) -> GaussianCloud:
    """Create a capture of a box that stands on z = 0, with flat Gaussians on a grid on each side.

    Args:
        size: length along x, width along y and height along z, m.
        paint: function that maps points (n, 3) m relative to the middle of the box to their colours (n, 3), or to one
            colour; red, green and blue are 0 to 1.
        spacing: largest distance between Gaussians, m; at most the smallest edge. The distance along an edge that is
            not a multiple of it is smaller, so that Gaussians cover the edge evenly.
        device: Warp device; None is the current one.

    Raises:
        UserError: the spacing is not positive, or exceeds an edge.
    """
    if not 0.0 < spacing <= min(size):
        raise ArgumentError(
            "spacing", f"choose a positive spacing of at most the smallest edge, {min(size):g} m", value=spacing
        )
    if device is not None:
        use_device(device)
    half = 0.5 * np.array(size)
    counts = np.ceil(np.divide(size, spacing) - _ROUNDING)
    # Multiples of the spacing are divided exactly by it.
    is_multiple = np.divide(size, spacing) > counts - _ROUNDING
    steps = np.where(is_multiple, spacing, np.divide(size, counts))
    points, scales = [], []
    for axis in range(3):
        first, second = (k for k in range(3) if k != axis)
        grids = [np.arange(-half[k] + 0.5 * steps[k], half[k], steps[k]) for k in (first, second)]
        u, v = (grid.ravel() for grid in np.meshgrid(*grids, indexing="ij"))
        for sign in (-1.0, 1.0):
            side = np.zeros((len(u), 3))
            side[:, first], side[:, second], side[:, axis] = u, v, sign * half[axis]
            points.append(side)
            scale = np.tile(0.6 * steps, (len(u), 1))
            scale[:, axis] = 0.05 * spacing
            scales.append(scale)
    means = np.concatenate(points)
    colour = np.broadcast_to(paint(means), means.shape)
    return GaussianCloud.from_numpy(
        means + [0.0, 0.0, half[2]],
        np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1)),
        np.log(np.concatenate(scales)),
        np.full(len(means), 4.0),
        ((colour - 0.5) / SH_BAND_0)[:, None, :],
        device=device,
    )
