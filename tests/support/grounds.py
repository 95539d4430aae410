"""Objects on known ground: a ball in a furnished room, and a ball on a folded cloth."""

from __future__ import annotations

import numpy as np

from egs_warp.assets.surface import quaternions_from_normals
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from tests.support.waves import wave

RADIUS = 0.5
"""Radius of the ball, whose height is 1."""


def sheet(points: np.ndarray, normals: np.ndarray, spacing: float, colour: tuple[float, float, float]) -> GaussianCloud:
    """Return flat opaque Gaussians at ``points`` (n, 3), orthogonal to ``normals`` (n, 3)."""
    scales = np.full((len(points), 3), np.log(0.62 * spacing))
    scales[:, 2] = np.log(0.05 * spacing)
    dc = (np.tile(colour, (len(points), 1)) - 0.5) / 0.28209479
    return GaussianCloud.from_numpy(
        points, quaternions_from_normals(normals, np.zeros(len(points))), scales, np.full(len(points), 3.0), dc[:, None]
    )


def level(low: tuple[float, float], high: tuple[float, float], height: float, spacing: float) -> np.ndarray:
    """Return points (n, 3) of a rectangle at ``height``."""
    sides = [np.arange(a + 0.5 * spacing, b, spacing) for a, b in zip(low, high, strict=True)]
    flat = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    return np.column_stack([flat, np.full(len(flat), height)])


def ball(lift: float = 0.0) -> GaussianCloud:
    """Return a ball that touches z = ``lift``."""
    random = np.random.default_rng(3)
    normals = random.normal(size=(5000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return sheet(RADIUS * normals + [0.0, 0.0, RADIUS + lift], normals, 0.035, (0.8, 0.3, 0.2))


def furnished_room() -> GaussianCloud:
    """Return a ball on a table of 2.4 x 2 with its top at z = 0, a floor of 8 x 8 at z = -1.5, a cupboard and a
    wall."""
    up = np.array([[0.0, 0.0, 1.0]])

    def flat(points: np.ndarray, spacing: float, colour: tuple[float, float, float]) -> GaussianCloud:
        return sheet(points, np.repeat(up, len(points), axis=0), spacing, colour)

    parts = [
        ball(),
        flat(level((-1.2, -1.0), (1.2, 1.0), 0.0, 0.018), 0.018, (0.5, 0.35, 0.2)),
        # Two layers are needed, because a single one would transmit a twentieth of the light from below.
        flat(level((-1.2, -1.0), (1.2, 1.0), -0.02, 0.05), 0.05, (0.5, 0.35, 0.2)),
        flat(level((-4.0, -4.0), (4.0, 4.0), -1.5, 0.08), 0.08, (0.4, 0.4, 0.45)),
        flat(level((2.2, 1.5), (3.8, 3.8), 0.6, 0.08), 0.08, (0.7, 0.7, 0.65)),
    ]
    wall = level((-4.0, -1.5), (4.0, 2.5), 4.0, 0.1)[:, [0, 2, 1]]
    parts.append(sheet(wall, np.tile([0.0, -1.0, 0.0], (len(wall), 1)), 0.1, (0.8, 0.8, 0.75)))
    whole = parts[0]
    for part in parts[1:]:
        whole = concatenate(whole, part)
    return whole


def on_folds(
    amplitude: float, *, length: float = 0.8, reach: float = 2.2, lift: float = 0.0
) -> tuple[GaussianCloud, np.ndarray]:
    """Return a ball on a folded cloth, and (n,) bool, True for the Gaussians of the ball.

    The ball touches the cloth at the highest point under it, or hangs higher by ``lift``.
    """
    points = level((-reach, -reach), (reach, reach), 0.0, 0.03)
    points[:, 2] = wave(points[:, :2], amplitude, length)
    step = 1e-4
    slopes = [
        (wave(points[:, :2] + e, amplitude, length) - wave(points[:, :2] - e, amplitude, length)) / (2.0 * step)
        for e in step * np.eye(2)
    ]
    normals = np.column_stack([-slopes[0], -slopes[1], np.ones(len(points))])
    cloth = sheet(points, normals / np.linalg.norm(normals, axis=1, keepdims=True), 0.03, (0.3, 0.4, 0.6))
    shell = ball().means.numpy().astype(np.float64)
    rest = float((wave(shell[:, :2], amplitude, length) - shell[:, 2]).max())
    lifted = ball(rest + lift)
    return concatenate(lifted, cloth), np.arange(lifted.count + cloth.count) < lifted.count
