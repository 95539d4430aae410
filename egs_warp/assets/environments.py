"""Environments of the built-in objects: complete floors without the object."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from egs_warp.assets.object import KEY_LIGHT
from egs_warp.assets.surface import (
    BakedLight,
    SurfaceSamples,
    flat_gaussians,
    highlight_directions,
    lit_colour,
    sh_from_colour,
)
from egs_warp.geometry.gaussians import GaussianCloud, concatenate

Paint = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function that maps points (n, 3) to linear albedo (n, 3) and gloss (n,)."""

SQUARE = 0.7
"""Side of a square of the chess board, as a multiple of the pawn's height; the pawn's base is five sixths as wide as a
square."""


def chess_board(*, squares: int = 8, seed: int = 1, device: str | None = None) -> GaussianCloud:
    """Create a wooden board with a frame on z = 0.

    The origin is the centre of a dark square of the first row; the board has ``squares`` squares along +x.
    """
    random = np.random.default_rng(seed)
    spacing = SQUARE / 18
    frame = 0.35
    low = np.array([-0.5 * SQUARE - frame, -0.5 * squares * SQUARE - frame])
    high = np.array([(squares - 0.5) * SQUARE + frame, 0.5 * squares * SQUARE + frame])
    # The pawn's row is in the middle of the board. Without jitter, no sample would lie exactly on a line between two
    # squares.
    shift = np.array([0.0, 0.5 * SQUARE])
    top = _level(low + shift, high + shift, spacing, random, jitter=0.0)

    def paint(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        column, row = np.floor(points[:, 0] / SQUARE + 0.5), np.floor(points[:, 1] / SQUARE + 0.5)
        inside = (column >= 0) & (column < squares) & (np.abs(points[:, 1] - shift[1]) < 0.5 * squares * SQUARE)
        dark = (column + row) % 2 == 0
        along = np.where(dark, points[:, 0], points[:, 1])
        across = np.where(dark, points[:, 1], points[:, 0])
        tone = _grain(along + 3.7 * row, across + 1.3 * column)[:, None]
        maple, walnut, edge = (
            np.array([0.66, 0.47, 0.26]),
            np.array([0.135, 0.060, 0.028]),
            np.array([0.20, 0.085, 0.035]),
        )
        colour = np.where(inside[:, None], np.where(dark[:, None], walnut, maple), edge)
        return colour * (0.72 + 0.36 * tone), np.full(len(points), 0.5)

    return _paint_level(top, paint, random, device)


def bedroom(*, seed: int = 1, device: str | None = None) -> GaussianCloud:
    """Create a floor of oak planks with a woven rug on z = 0, and walls with skirting boards at y = 2.4 and x =
    -2.6."""
    random = np.random.default_rng(seed)
    spacing = 0.035
    floor = _level(np.array([-2.6, -2.4]), np.array([2.6, 2.4]), spacing, random)
    back = _wall(np.array([-2.6, 2.4]), np.array([2.6, 2.4]), 2.2, 0.05, random)
    side = _wall(np.array([-2.6, -2.4]), np.array([-2.6, 2.4]), 2.2, 0.05, random)

    def floor_paint(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, _ = points.T
        plank = np.floor(y / 0.24)
        seam = np.abs(y / 0.24 - plank - 0.5) > 0.475
        butt = np.abs((x + 0.77 * plank) / 1.6 - np.rint((x + 0.77 * plank) / 1.6)) < 0.009
        tone = _grain(x + 2.1 * plank, 1.2 * y)
        oak = np.array([0.46, 0.27, 0.125]) * (0.62 + 0.45 * tone + 0.12 * np.sin(12.9 * plank))[:, None]
        oak = np.where((seam | butt)[:, None], 0.35 * oak, oak)
        radius = np.hypot(x / 1.35, y / 1.15)
        weave = 0.86 + 0.14 * np.sin(2 * np.pi * x / 0.105) * np.sin(2 * np.pi * y / 0.105)
        ring = np.floor(radius * 7.0).astype(int)
        palette = np.array([[0.62, 0.55, 0.43], [0.12, 0.19, 0.25], [0.60, 0.53, 0.41], [0.48, 0.16, 0.10]])
        rug = palette[np.clip(ring, 0, 99) % 4] * weave[:, None]
        on_rug = radius < 1.0
        return np.where(on_rug[:, None], rug, oak), np.where(on_rug, 0.05, 0.45)

    def wall_paint(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        skirting = points[:, 2] < 0.17
        colour = np.where(skirting[:, None], [0.62, 0.60, 0.56], [0.36, 0.42, 0.40])
        return colour * (0.97 + 0.03 * np.sin(31.0 * points.sum(axis=1)))[:, None], np.full(len(points), 0.1)

    return concatenate(
        _paint_level(floor, floor_paint, random, device),
        _paint_level(back, wall_paint, random, device),
        _paint_level(side, wall_paint, random, device),
    )


def cloth_table(*, radius: float = 1.7, seed: int = 1, device: str | None = None) -> GaussianCloud:
    """Create a round table under a checked cloth that hangs down in folds; the top is at z = 0."""
    random = np.random.default_rng(seed)
    spacing = 0.03
    top = _level(np.full(2, -radius), np.full(2, radius), spacing, random)
    keep = np.hypot(top.points[:, 0], top.points[:, 1]) < radius - 0.02
    top = SurfaceSamples(top.points[keep], top.normals[keep], spacing)
    rows = np.arange(0.0, 0.95, 0.8 * spacing)
    around = round(2.0 * np.pi * radius / spacing)
    angle = np.tile(np.linspace(0.0, 2.0 * np.pi, around, endpoint=False), len(rows))
    drop = np.repeat(rows, around)

    def drape(angle: np.ndarray, drop: np.ndarray) -> np.ndarray:
        fold = np.clip(drop / 0.5, 0.0, 1.0) * 0.085 * np.sin(17.0 * angle + 1.5 * np.sin(3.0 * angle))
        edge = radius - 0.04 * np.exp(-drop / 0.03) + 0.06 * drop + fold
        return np.stack([edge * np.cos(angle), edge * np.sin(angle), -drop], axis=1)

    tangent_a = drape(angle + 1e-4, drop) - drape(angle - 1e-4, drop)
    tangent_d = drape(angle, drop + 1e-4) - drape(angle, drop - 1e-4)
    normal = np.cross(tangent_d, tangent_a)
    skirt = SurfaceSamples(drape(angle, drop), normal / np.linalg.norm(normal, axis=1, keepdims=True), spacing)

    def paint(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # Texture coordinates of the cloth: on the overhang, the pattern continues over the length that hangs down.
        flat = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-9)
        stretch = np.minimum((np.minimum(flat, radius) - points[:, 2]) / flat, 3.0)
        u, v = points[:, 0] * stretch / 0.28, points[:, 1] * stretch / 0.28
        bands = (np.floor(u) % 2 + np.floor(v) % 2)[:, None] / 2.0
        colour = np.array([0.74, 0.70, 0.62]) * (1.0 - bands) + np.array([0.13, 0.27, 0.42]) * bands
        weave = 0.95 + 0.05 * np.sin(2 * np.pi * u * 2.5) * np.sin(2 * np.pi * v * 2.5)
        return colour * weave[:, None], np.full(len(points), 0.03)

    return concatenate(_paint_level(top, paint, random, device), _paint_level(skirt, paint, random, device))


def _grain(along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return the wood grain, 0 to 1, at coordinates along and across the wood fibres."""
    ring = 7.0 * across + 0.5 * np.sin(1.7 * along + 2.0) + 0.22 * np.sin(4.1 * along + 9.0 * across)
    return np.clip(0.55 + 0.30 * np.sin(2 * np.pi * ring) + 0.15 * np.sin(2 * np.pi * (3.1 * ring + along)), 0.0, 1.0)


def _level(
    low: np.ndarray, high: np.ndarray, spacing: float, random: np.random.Generator, *, jitter: float = 0.25
) -> SurfaceSamples:
    """Sample a rectangle in z = 0 on a grid that starts half a spacing from its edges."""
    counts = np.rint((high - low) / spacing).astype(int)
    grid = np.indices(tuple(counts)).reshape(2, -1).T + 0.5
    flat = low + (high - low) / counts * (grid + random.uniform(-jitter, jitter, grid.shape))
    return SurfaceSamples(
        np.column_stack([flat, np.zeros(len(flat))]), np.tile([0.0, 0.0, 1.0], (len(flat), 1)), spacing
    )


def _wall(
    start: np.ndarray, end: np.ndarray, height: float, spacing: float, random: np.random.Generator
) -> SurfaceSamples:
    """Sample an upright wall from ``start`` to ``end`` (2,), with its normal to the right of that direction."""
    along = (end - start) / np.linalg.norm(end - start)
    flat = _level(np.zeros(2), np.array([np.linalg.norm(end - start), height]), spacing, random).points
    points = np.column_stack([start + flat[:, :1] * along, flat[:, 1]])
    return SurfaceSamples(points, np.tile([along[1], -along[0], 0.0], (len(points), 1)), spacing)


def _paint_level(
    samples: SurfaceSamples, paint: Paint, random: np.random.Generator, device: str | None
) -> GaussianCloud:
    """Create the Gaussians of a level surface without shadows."""
    light = KEY_LIGHT / np.linalg.norm(KEY_LIGHT)
    rise = samples.normals[:, 2]
    baked = BakedLight(0.5 + 0.5 * rise, 0.5 - 0.5 * rise, np.clip(samples.normals @ light, 0.0, None))
    albedo, gloss = paint(samples.points)
    sh = sh_from_colour(
        lit_colour(albedo, baked), highlight_directions(samples.normals, KEY_LIGHT), 0.12 * gloss * baked.key + 0.01
    )
    return flat_gaussians(samples, sh, random=random, thickness=0.08, device=device)
