"""A toy bear standing on two broad feet."""

from __future__ import annotations

import numpy as np

from egs_warp.assets.object import BuiltInObject, shade_gaussians
from egs_warp.assets.solids import ellipsoid, even_samples, smooth_union, surface_mesh, tapered_rod
from egs_warp.geometry.plane import Plane

_UP = np.array([0.0, 0.0, 1.0])
_LOW, _HIGH = np.array([-0.46, -0.40, -0.06]), np.array([0.46, 0.40, 1.06])


def figurine(*, gaussian_count: int = 22000, seed: int = 0, device: str | None = None) -> BuiltInObject:
    """Create a bear of SH degree 3, one unit tall, on the plane z = 0 and facing -y. Equal arguments give bitwise equal
    clouds."""
    random = np.random.default_rng(seed)
    vertices, faces = surface_mesh(_distance, _LOW, _HIGH, 0.012)
    samples = even_samples(_distance, vertices, faces, gaussian_count, random)
    albedo, gloss = _paint(samples.points)
    cloud = shade_gaussians(samples, vertices, faces, albedo, gloss, random=random, device=device)
    return BuiltInObject("figurine", cloud, Plane(_UP, 0.0))


def _folded(points: np.ndarray) -> np.ndarray:
    """Mirror ``points`` (n, 3) to x >= 0, because the figure is symmetric about x = 0."""
    return np.column_stack([np.abs(points[:, 0]), points[:, 1:]])


def _distance(points: np.ndarray) -> np.ndarray:
    side = _folded(points)
    body = ellipsoid(points, np.array([0.0, 0.0, 0.38]), np.array([0.235, 0.205, 0.26]))
    leg = tapered_rod(side, np.array([0.135, -0.01, 0.08]), np.array([0.11, 0.0, 0.25]), 0.105, 0.115)
    foot = ellipsoid(side, np.array([0.15, -0.06, 0.035]), np.array([0.125, 0.18, 0.095]))
    arm = tapered_rod(side, np.array([0.20, -0.01, 0.52]), np.array([0.335, -0.08, 0.36]), 0.085, 0.075)
    head = ellipsoid(points, np.array([0.0, -0.01, 0.76]), np.array([0.235, 0.21, 0.205]))
    ear = ellipsoid(side, np.array([0.17, 0.01, 0.915]), np.array([0.082, 0.05, 0.082]))
    snout = ellipsoid(points, np.array([0.0, -0.205, 0.715]), np.array([0.098, 0.085, 0.075]))
    solid = smooth_union(smooth_union(body, leg, 0.05), foot, 0.04)
    solid = smooth_union(smooth_union(solid, head, 0.05), arm, 0.05)
    solid = smooth_union(smooth_union(solid, ear, 0.025), snout, 0.02)
    return np.maximum(solid, -points[:, 2])


def _paint(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return albedo (n, 3) and gloss (n,): brown plastic, cream belly and snout, black eyes and nose, red scarf."""
    side = _folded(points)
    x, y, z = points.T
    albedo = np.broadcast_to([0.42, 0.19, 0.07], (len(points), 3)) * (
        0.92 + 0.08 * np.sin(40.0 * z + 9.0 * np.sin(17.0 * x) + 7.0 * y)[:, None]
    )
    gloss = np.full(len(points), 0.8)

    def dab(where: np.ndarray, colour: tuple[float, float, float]) -> None:
        albedo[where] = colour

    front = y < 0.0
    dab(
        front & (ellipsoid(points, np.array([0.0, -0.20, 0.36]), np.array([0.145, 0.12, 0.175])) < 0.0),
        (0.72, 0.54, 0.33),
    )
    dab(ellipsoid(points, np.array([0.0, -0.23, 0.715]), np.array([0.10, 0.085, 0.08])) < 0.0, (0.72, 0.54, 0.33))
    dab(
        front & (ellipsoid(side, np.array([0.17, -0.045, 0.92]), np.array([0.05, 0.04, 0.05])) < 0.0),
        (0.72, 0.40, 0.30),
    )
    dab(
        front & (ellipsoid(points, np.array([0.0, -0.287, 0.745]), np.array([0.038, 0.03, 0.027])) < 0.0),
        (0.02, 0.02, 0.02),
    )
    dab(
        front & (ellipsoid(side, np.array([0.088, -0.19, 0.80]), np.array([0.026, 0.04, 0.030])) < 0.0),
        (0.02, 0.02, 0.02),
    )
    neck = (np.abs(z - 0.575 - 0.02 * np.sin(2.0 * np.arctan2(y, x))) < 0.033) & (np.hypot(x, y) < 0.225)
    dab(neck, (0.62, 0.05, 0.045))
    return albedo, gloss
