"""A chess pawn of lacquered wood: the surface of revolution of one profile."""

from __future__ import annotations

import numpy as np

from egs_warp.assets.object import BuiltInObject, shade_gaussians
from egs_warp.assets.surface import SurfaceSamples
from egs_warp.geometry.plane import Plane

_UP = np.array([0.0, 0.0, 1.0])

# Cubic Bezier segments (r, z) of the profile of a pawn one unit tall, from the centre of the base to the top.
_PROFILE = (
    ((0.000, 0.000), (0.090, 0.000), (0.180, 0.000), (0.268, 0.000)),
    ((0.268, 0.000), (0.284, 0.000), (0.292, 0.010), (0.292, 0.030)),
    ((0.292, 0.030), (0.292, 0.062), (0.280, 0.076), (0.258, 0.082)),
    ((0.258, 0.082), (0.252, 0.083), (0.250, 0.088), (0.250, 0.094)),
    ((0.250, 0.094), (0.252, 0.128), (0.236, 0.152), (0.204, 0.168)),
    ((0.204, 0.168), (0.190, 0.174), (0.188, 0.182), (0.186, 0.192)),
    ((0.186, 0.192), (0.168, 0.290), (0.112, 0.340), (0.108, 0.560)),
    ((0.108, 0.560), (0.108, 0.572), (0.118, 0.574), (0.126, 0.578)),
    ((0.126, 0.578), (0.142, 0.582), (0.142, 0.604), (0.132, 0.610)),
    ((0.132, 0.610), (0.150, 0.610), (0.186, 0.622), (0.186, 0.640)),
    ((0.186, 0.640), (0.186, 0.658), (0.150, 0.670), (0.116, 0.676)),
    ((0.116, 0.676), (0.106, 0.680), (0.104, 0.684), (0.104, 0.690)),
)
_HEAD_CENTRE = 0.826
_HEAD_RADIUS = 0.174


def pawn(*, gaussian_count: int = 22000, seed: int = 0, device: str | None = None) -> BuiltInObject:
    """Create a pawn of SH degree 3, one unit tall, on the plane z = 0 with about ``gaussian_count`` Gaussians.

    Equal arguments give bitwise equal clouds. Gaussians of the base and its rim straddle the plane as in a real
    capture.
    """
    random = np.random.default_rng(seed)
    samples = _turned_surface(gaussian_count, random)
    vertices, faces = _turned_mesh()
    albedo, gloss = _wood(samples.points)
    cloud = shade_gaussians(samples, vertices, faces, albedo, gloss, random=random, device=device)
    return BuiltInObject("pawn", cloud, Plane(_UP, 0.0))


def _profile(points_per_piece: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Return points (m, 2) as (r, z) along the outline, and the arc length (m,) at each point."""
    t = np.linspace(0.0, 1.0, points_per_piece, endpoint=False)[:, None]
    pieces = [
        (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d
        for a, b, c, d in (map(np.array, piece) for piece in _PROFILE)
    ]
    start = np.arctan2(_PROFILE[-1][3][1] - _HEAD_CENTRE, _PROFILE[-1][3][0])
    angle = np.linspace(start, np.pi / 2.0, 4 * points_per_piece)
    radius = _HEAD_RADIUS + (np.hypot(_PROFILE[-1][3][0], _PROFILE[-1][3][1] - _HEAD_CENTRE) - _HEAD_RADIUS) * (
        1.0 - (angle - start) / (np.pi / 2.0 - start)
    )
    head = np.stack([radius * np.cos(angle), _HEAD_CENTRE + radius * np.sin(angle)], axis=1)
    outline = np.concatenate([*pieces, head])
    steps = np.linalg.norm(np.diff(outline, axis=0), axis=1)
    return outline, np.concatenate([[0.0], np.cumsum(steps)])


def _turned_surface(count: int, random: np.random.Generator) -> SurfaceSamples:
    """Sample rings of evenly spaced points around the axis, with a small jitter so that no grid is visible."""
    outline, arc = _profile()
    area = float(np.sum(np.pi * (outline[1:, 0] + outline[:-1, 0]) * np.diff(arc)))
    spacing = np.sqrt(area / count)
    ring_count = round(arc[-1] / spacing)
    points, normals = [], []
    for ring in range(ring_count):
        around = max(
            3, round(2.0 * np.pi * np.interp((ring + 0.5) * arc[-1] / ring_count, arc, outline[:, 0]) / spacing)
        )
        s = np.clip((ring + 0.5 + random.uniform(-0.3, 0.3, around)) * arc[-1] / ring_count, 0.0, arc[-1])
        angle = 2.0 * np.pi * (np.arange(around) + random.uniform() + random.uniform(-0.3, 0.3, around)) / around
        r, z = np.interp(s, arc, outline[:, 0]), np.interp(s, arc, outline[:, 1])
        # A central difference over 0.012 of the arc length rounds the corners of the profile.
        dr = np.interp(s + 0.006, arc, outline[:, 0]) - np.interp(s - 0.006, arc, outline[:, 0])
        dz = np.interp(s + 0.006, arc, outline[:, 1]) - np.interp(s - 0.006, arc, outline[:, 1])
        length = np.hypot(dr, dz)
        points.append(np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1))
        normals.append(np.stack([dz / length * np.cos(angle), dz / length * np.sin(angle), -dr / length], axis=1))
    return SurfaceSamples(np.concatenate(points), np.concatenate(normals), spacing)


def _turned_mesh(rings: int = 160, around: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (v, 3) and triangles (f, 3) of the pawn, used for shadows only."""
    outline, arc = _profile()
    s = np.linspace(0.0, arc[-1], rings)
    r, z = np.interp(s, arc, outline[:, 0]), np.interp(s, arc, outline[:, 1])
    angle = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    vertices = np.stack(
        [np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle)), np.repeat(z[:, None], around, axis=1)], axis=2
    ).reshape(-1, 3)
    ring, column = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    a = ring * around + column
    b = ring * around + (column + 1) % around
    quads = np.stack([a, b, b + around, a + around], axis=-1).reshape(-1, 4)
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _wood(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return linear albedo (n, 3) and gloss (n,) of wood. The growth rings have a common vertical axis, beside the axis
    of the pawn."""
    x, y, z = points.T
    wobble = 0.012 * np.sin(5.3 * z + 1.0) + 0.006 * np.sin(17.0 * z + 9.0 * x)
    ring_radius = np.hypot(x - 0.42 + wobble, y + 0.23 - 0.6 * wobble)
    rings = ring_radius / 0.034
    phase = rings - np.floor(rings)
    # Late wood darkens slowly and ends abruptly at each growth ring; the edge is softened to the resolution of the
    # Gaussians.
    late = phase**3 * (1.0 - np.clip((phase - 0.88) / 0.12, 0.0, 1.0))
    fibre = 0.5 + 0.5 * np.sin(230.0 * np.arctan2(y + 0.23, x - 0.42) + 6.0 * np.sin(9.0 * z))
    tone = 1.0 - 0.85 * late - 0.10 * fibre - 0.05 * np.sin(3.1 * z + 7.0 * x)
    light_wood, dark_wood = np.array([0.70, 0.40, 0.17]), np.array([0.26, 0.095, 0.028])
    mix = np.clip(tone, 0.0, 1.0)[:, None]
    return dark_wood + (light_wood - dark_wood) * mix, 0.6 + 0.4 * np.clip(tone, 0.0, 1.0)
