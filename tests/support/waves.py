"""Wavy ground, like a folded cloth."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.height_field import HeightField

LENGTH = 0.8
"""Wavelength, m."""


def wave(points: np.ndarray, amplitude: float, length: float = LENGTH) -> np.ndarray:
    """Return the heights (...,) of two crossing waves at ``points`` (..., 2)."""
    k = 2.0 * np.pi / length
    return amplitude * np.sin(k * points[..., 0] + 0.4) * np.cos(0.6 * k * points[..., 1])


def wavy_ground(amplitude: float = 0.03, *, spacing: float = 0.05, reach: float = 2.5) -> HeightField:
    """Return wavy ground about z = 0 that extends ``reach`` m from the origin in each direction."""
    count = int(np.ceil(2.0 * reach / spacing)) + 1
    at = np.stack(np.meshgrid(np.arange(count), np.arange(count), indexing="xy"), axis=-1) * spacing - reach
    return HeightField.through(np.eye(3), np.array([-reach, -reach, 0.0]), spacing, wave(at, amplitude))
