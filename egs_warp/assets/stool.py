"""A four-legged stool with a low back and a cushion."""

from __future__ import annotations

import numpy as np

from egs_warp.assets.object import BuiltInObject, shade_gaussians
from egs_warp.assets.solids import even_samples, rounded_box, smooth_union, surface_mesh, tapered_rod
from egs_warp.geometry.plane import Plane

_UP = np.array([0.0, 0.0, 1.0])
_LOW, _HIGH = np.array([-0.42, -0.42, -0.06]), np.array([0.42, 0.42, 1.06])
_SEAT = 0.56


def stool(*, gaussian_count: int = 24000, seed: int = 0, device: str | None = None) -> BuiltInObject:
    """Create a stool of SH degree 3, one unit tall, on the plane z = 0 and facing -y. Equal arguments give bitwise
    equal clouds."""
    random = np.random.default_rng(seed)
    vertices, faces = surface_mesh(_distance, _LOW, _HIGH, 0.012)
    samples = even_samples(_distance, vertices, faces, gaussian_count, random)
    albedo, gloss = _paint(samples.points)
    cloud = shade_gaussians(samples, vertices, faces, albedo, gloss, random=random, device=device)
    return BuiltInObject("stool", cloud, Plane(_UP, 0.0))


def _frame(points: np.ndarray) -> np.ndarray:
    """Return the signed distance to the union of legs, seat board and back."""
    mirrored = np.abs(points[:, :2])
    folded = np.column_stack([mirrored, points[:, 2]])
    leg = tapered_rod(folded, np.array([0.30, 0.30, -0.06]), np.array([0.225, 0.225, _SEAT]), 0.040, 0.052)
    board = rounded_box(points, np.array([0.0, 0.0, _SEAT]), np.array([0.30, 0.30, 0.042]), 0.03)
    sides = np.column_stack([np.abs(points[:, 0]), points[:, 1:]])
    post = tapered_rod(sides, np.array([0.225, 0.25, _SEAT]), np.array([0.235, 0.32, 0.93]), 0.042, 0.036)
    # The top rail of the back bows backwards.
    bowed = points + np.outer(1.0 - (points[:, 0] / 0.27) ** 2, [0.0, -0.035, 0.0])
    rail = rounded_box(bowed, np.array([0.0, 0.315, 0.90]), np.array([0.275, 0.034, 0.098]), 0.03)
    frame = smooth_union(smooth_union(leg, board, 0.03), post, 0.03)
    return smooth_union(frame, rail, 0.025)


def _cushion(points: np.ndarray) -> np.ndarray:
    puff = (
        0.022
        * np.cos(np.clip(points[:, 0] / 0.27, -1, 1) * np.pi / 2)
        * np.cos(np.clip(points[:, 1] / 0.24, -1, 1) * np.pi / 2)
    )
    box = rounded_box(points, np.array([0.0, -0.02, _SEAT + 0.068]), np.array([0.265, 0.235, 0.04]), 0.038)
    return box - puff


def _distance(points: np.ndarray) -> np.ndarray:
    solid = np.minimum(_frame(points), _cushion(points))
    return np.maximum(solid, -points[:, 2])


def _paint(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x, y, z = points.T
    grain = 0.5 + 0.5 * np.sin(55.0 * (x + 0.4 * y) + 3.0 * np.sin(4.0 * z) + 1.5 * np.sin(23.0 * y))
    wood = np.array([0.60, 0.34, 0.15]) * (0.78 + 0.30 * grain[:, None])
    weave = 0.5 + 0.5 * np.sin(150.0 * x) * np.sin(150.0 * y)
    stripe = (np.abs((x / 0.088) - np.rint(x / 0.088)) < 0.14)[:, None]
    cloth = np.where(stripe, [0.80, 0.74, 0.60], [0.07, 0.25, 0.30]) * (0.85 + 0.2 * weave[:, None])
    is_cloth = _cushion(points) < _frame(points)
    return np.where(is_cloth[:, None], cloth, wood), np.where(is_cloth, 0.1, 0.6)
