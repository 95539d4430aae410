"""A snake that lies in a shallow bend, with its head slightly raised."""

from __future__ import annotations

import numpy as np

from egs_warp.assets.object import BuiltInObject, shade_gaussians
from egs_warp.assets.solids import ellipsoid, even_samples, smooth_union, surface_mesh
from egs_warp.geometry.plane import Plane

_UP = np.array([0.0, 0.0, 1.0])
_LOW, _HIGH = np.array([-0.26, -1.16, -0.04]), np.array([0.26, 1.06, 0.32])
_TAIL = 1.0


def snake(*, gaussian_count: int = 22000, seed: int = 0, device: str | None = None) -> BuiltInObject:
    """Create a snake of SH degree 3, two units long, on the plane z = 0 and facing -y. Equal arguments give bitwise
    equal clouds."""
    random = np.random.default_rng(seed)
    vertices, faces = surface_mesh(_distance, _LOW, _HIGH, 0.012)
    samples = even_samples(_distance, vertices, faces, gaussian_count, random)
    albedo, gloss = _paint(samples.points)
    cloud = shade_gaussians(samples, vertices, faces, albedo, gloss, random=random, device=device)
    return BuiltInObject("snake", cloud, Plane(_UP, 0.0))


def _bend(y: np.ndarray) -> np.ndarray:
    """Return x of the centre line at ``y`` (n,)."""
    return 0.045 * np.sin(2.0 * np.pi * y / 1.3)


def _straight(points: np.ndarray) -> np.ndarray:
    """Remove the bend from ``points`` (n, 3): the centre line becomes the y axis."""
    return points - np.outer(_bend(points[:, 1]), [1.0, 0.0, 0.0])


def _distance(points: np.ndarray) -> np.ndarray:
    straight = _straight(points)
    y = straight[:, 1]
    # 0 at the neck, 1 at the tip of the tail.
    along = np.clip((y + 0.9) / (_TAIL + 0.9), 0.0, 1.0)
    radius = 0.115 * (1.0 - along**3) + 0.055 * along**3 - 0.02 * np.exp(-(((y + 0.8) / 0.12) ** 2))
    past = y - np.clip(y, -0.9, _TAIL - 0.06)
    trunk = np.linalg.norm(np.column_stack([straight[:, 0], past, straight[:, 2] - 0.85 * radius]), axis=1) - radius
    head = ellipsoid(straight, np.array([0.0, -0.95, 0.125]), np.array([0.135, 0.18, 0.105]))
    brow = ellipsoid(_folded(straight), np.array([0.075, -0.98, 0.20]), np.array([0.042, 0.05, 0.042]))
    solid = smooth_union(smooth_union(trunk, head, 0.05), brow, 0.02)
    return np.maximum(solid, -points[:, 2])


def _folded(points: np.ndarray) -> np.ndarray:
    """Mirror ``points`` (n, 3) to x >= 0, because the straightened snake is symmetric about x = 0."""
    return np.column_stack([np.abs(points[:, 0]), points[:, 1:]])


def _paint(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return albedo (n, 3) and gloss (n,): green back with dark-edged ochre saddles, cream belly, amber slit eyes."""
    straight = _straight(points)
    side = _folded(straight)
    x, y, z = straight.T
    angle = np.arctan2(x, np.maximum(z - 0.09, -0.2))
    scales = 0.90 + 0.10 * np.sin(95.0 * y + 14.0 * angle) * np.sin(95.0 * y - 14.0 * angle)
    saddle = np.abs(y / 0.23 - np.rint(y / 0.23)) - 0.34 * np.clip(1.0 - np.abs(angle) / 1.9, 0.0, 1.0)
    albedo = np.where((saddle < 0.0)[:, None], [0.62, 0.40, 0.10], [0.10, 0.27, 0.07])
    albedo = np.where((np.abs(saddle) < 0.055)[:, None], [0.03, 0.06, 0.02], albedo)
    belly = np.clip((0.075 - z) / 0.03, 0.0, 1.0)[:, None]
    albedo = (albedo * (1.0 - belly) + np.array([0.66, 0.58, 0.36]) * belly) * scales[:, None]
    gloss = np.full(len(points), 0.75)

    def dab(where: np.ndarray, colour: tuple[float, float, float]) -> None:
        albedo[where] = colour

    dab((y < -0.80) & (z > 0.075), (0.09, 0.24, 0.06))
    eye = ellipsoid(side, np.array([0.098, -1.0, 0.205]), np.array([0.034, 0.042, 0.040]))
    dab(eye < 0.0, (0.80, 0.42, 0.03))
    dab((eye < 0.0) & (np.abs(side[:, 1] + 1.0) < 0.011), (0.01, 0.01, 0.01))
    mouth = (y < -0.93) & (np.abs(z - 0.075 - 0.12 * (y + 1.02) ** 2) < 0.008)
    dab(mouth, (0.16, 0.03, 0.03))
    nostril = ellipsoid(side, np.array([0.035, -1.118, 0.145]), np.array([0.013, 0.02, 0.011]))
    dab(nostril < 0.0, (0.02, 0.02, 0.02))
    return albedo, gloss
