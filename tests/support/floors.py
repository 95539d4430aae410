"""Floors for the tests of inpainting: a periodic pattern on an inclined plane."""

from __future__ import annotations

import numpy as np

from egs_warp.assets.surface import quaternions_from_normals, sh_from_colour
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane

PLANE = Plane.from_coefficients(0.1, -0.2, 1.0, -0.3)
PERIOD = 0.4


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return colours (..., 3) of checks with soft edges and a stripe, with a period of 0.4 in both directions."""
    u, v = 2.0 * np.pi * x / PERIOD, 2.0 * np.pi * y / PERIOD
    checks = np.tanh(3.0 * np.sin(u) * np.sin(v))
    return np.stack([0.5 + 0.3 * checks, 0.5 - 0.2 * checks, 0.45 + 0.15 * np.cos(u)], axis=-1)


def floor(
    *, half: float = 1.0, spacing: float = 0.025, height: float = 0.0, gloss: float = 0.0, device: str | None = None
) -> GaussianCloud:
    """Return flat Gaussians on a grid at ``height`` above ``PLANE``; glossy ones have SH degree 3."""
    line = np.arange(-half, half, spacing) + 0.5 * spacing
    x, y = (values.ravel() for values in np.meshgrid(line, line))
    first, second = PLANE.tangents()
    means = x[:, None] * first + y[:, None] * second + (height - PLANE.offset) * PLANE.normal
    normals = np.tile(PLANE.normal, (len(means), 1))
    colour = pattern(x, y)
    if gloss:
        sh = sh_from_colour(colour, normals, np.full(len(means), gloss))
    else:
        sh = ((colour - 0.5) / 0.28209479177387814)[:, None]
    log_scales = np.tile(np.log([0.6 * spacing, 0.6 * spacing, 0.02 * spacing]), (len(means), 1))
    return GaussianCloud.from_numpy(
        means, quaternions_from_normals(normals, np.zeros(len(means))), log_scales, np.full(len(means), 4.0), sh,
        device=device,
    )  # fmt: skip


def centre() -> np.ndarray:
    """Return the origin (3,) of the pattern on the plane."""
    return -PLANE.offset * PLANE.normal


def on_plane(x: float, y: float) -> np.ndarray:
    """Return the point (3,) on the plane at the coordinates ``x`` and ``y`` of the pattern."""
    first, second = PLANE.tangents()
    return centre() + x * first + y * second
