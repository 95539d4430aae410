"""A ball on a floor under a light of known direction, with shading and shadow in closed form."""

from __future__ import annotations

import numpy as np

from egs_warp.assets.surface import SurfaceSamples, flat_gaussians
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud

RADIUS = 0.5
AMBIENT = 0.5
"""Ambient irradiance, to which the light adds ``1 - AMBIENT`` on a surface that faces it."""


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """Return the unit vector (3,) towards a light at ``azimuth`` and ``elevation``, degrees."""
    a, e = np.radians([azimuth, elevation])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def lit_ball(light: np.ndarray, *, key: float = 1.0 - AMBIENT, albedo: float = 0.5) -> GaussianCloud:
    """Return a ball of ``RADIUS`` that stands on z = 0, under a light in the direction ``light``."""
    number = np.arange(3000) + 0.5
    z, angle = 1.0 - 2.0 * number / len(number), np.pi * (1.0 + 5.0**0.5) * number
    level = np.sqrt(1.0 - z * z)
    normals = np.column_stack([level * np.cos(angle), level * np.sin(angle), z])
    samples = SurfaceSamples(RADIUS * normals + [0.0, 0.0, RADIUS], normals, 0.035)
    return _coloured(samples, albedo * (AMBIENT + key * np.clip(normals @ light, 0.0, None)))


def lit_floor(light: np.ndarray, *, key: float = 1.0 - AMBIENT, albedo: float = 0.4) -> GaussianCloud:
    """Return the floor z = 0 with the shadow of the ball."""
    side = np.linspace(-2.4, 2.4, 97)
    flat = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    points = np.column_stack([flat, np.zeros(len(flat))])
    points = points[np.linalg.norm(flat, axis=1) > 0.15]
    samples = SurfaceSamples(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), 0.05)
    return _coloured(samples, albedo * (AMBIENT + key * light[2] * ~in_shadow(points, light)))


def in_shadow(points: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return (n,) bool: True where the ray from a point of the floor, ``points`` (n, 3), to the light meets the
    ball."""
    away = points - [0.0, 0.0, RADIUS]
    along = away @ light
    return (along < 0.0) & ((away * away).sum(axis=1) - along * along < RADIUS**2)


def _coloured(samples: SurfaceSamples, linear: np.ndarray) -> GaussianCloud:
    colour = np.clip(linear, 0.0, 1.0) ** (1.0 / 2.2)
    sh = np.repeat(((colour - 0.5) / SH_BAND_0)[:, None, None], 3, axis=2)
    return flat_gaussians(samples, sh, random=np.random.default_rng(3), device="cpu")
