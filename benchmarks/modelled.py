"""Bodies for the benchmarks, modelled by signed distance functions, with two to eight legs, one base or no feet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmark_bodies import Body
from egs_warp.assets.object import shade_gaussians
from egs_warp.assets.solids import ellipsoid, even_samples, rounded_box, smooth_union, surface_mesh, tapered_rod
from egs_warp.geometry.plane import Plane

_GAUSSIANS = 12000
_REACH = np.array([1.25, 0.65, 1.1])
Distance = Callable[[np.ndarray], np.ndarray]


def _rod(
    points: np.ndarray, start: list[float], end: list[float], start_radius: float, end_radius: float
) -> np.ndarray:
    return tapered_rod(points, np.array(start), np.array(end), start_radius, end_radius)


def _legged(count: int, *, leg: float = 0.05, spread: float = 0.3, short: int | None = None) -> Distance:
    """Return an egg with a head on a ring of ``count`` legs, of which the leg ``short`` is 3 % too short."""

    def distance(points: np.ndarray) -> np.ndarray:
        out = ellipsoid(points, np.array([0.0, 0.0, 0.62]), np.array([0.32, 0.32, 0.16]))
        for k in range(count):
            angle = 2.0 * np.pi * k / count + np.pi / count
            x, y = np.cos(angle), np.sin(angle)
            low = 0.08 if k == short else -0.06
            foot = _rod(points, [spread * x, spread * y, low], [0.22 * x, 0.22 * y, 0.58], leg, 1.2 * leg)
            out = smooth_union(out, foot, 0.03)
        head = ellipsoid(points, np.array([0.0, -0.25, 0.82]), np.array([0.14, 0.16, 0.16]))
        return smooth_union(out, head, 0.05)

    return distance


def _bottle(points: np.ndarray) -> np.ndarray:
    neck = _rod(points, [0.0, 0.0, 0.6], [0.0, 0.0, 0.93], 0.07, 0.06)
    return smooth_union(_rod(points, [0.0, 0.0, 0.1], [0.0, 0.0, 0.6], 0.16, 0.15), neck, 0.06)


def _box(points: np.ndarray) -> np.ndarray:
    return rounded_box(points, np.array([0.0, 0.0, 0.5]), np.array([0.22, 0.15, 0.5]), 0.03)


def _snake(points: np.ndarray) -> np.ndarray:
    return _rod(points, [-1.0, 0.0, 0.1], [1.0, 0.0, 0.1], 0.08, 0.115)


def _ball(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points - [0.0, 0.0, 0.49], axis=1) - 0.5


def _chair(points: np.ndarray) -> np.ndarray:
    """Four slender legs under a thick seat with a high back."""
    out = rounded_box(points, np.array([0.0, 0.0, 0.49]), np.array([0.24, 0.22, 0.05]), 0.02)
    back = rounded_box(points, np.array([-0.2, 0.0, 0.75]), np.array([0.045, 0.2, 0.24]), 0.02)
    for x, y in ((0.19, 0.17), (0.19, -0.17), (-0.19, 0.17), (-0.19, -0.17)):
        out = np.minimum(out, _rod(points, [1.1 * x, 1.1 * y, -0.05], [x, y, 0.48], 0.032, 0.035))
    return smooth_union(out, back, 0.02)


def _soldier(points: np.ndarray) -> np.ndarray:
    """A figure with one foot ahead of the other and a pole in one hand."""
    out = ellipsoid(points, np.array([0.0, 0.0, 0.62]), np.array([0.09, 0.13, 0.19]))
    head = ellipsoid(points, np.array([0.01, 0.0, 0.9]), np.array([0.075, 0.065, 0.09]))
    for x, y in ((0.07, 0.08), (-0.06, -0.07)):
        leg = smooth_union(
            _rod(points, [x, y, 0.05], [0.3 * x, 0.8 * y, 0.5], 0.042, 0.06),
            _rod(points, [x - 0.03, y, 0.025], [x + 0.07, 1.1 * y, 0.025], 0.04, 0.035),
            0.03,
        )
        out = smooth_union(out, leg, 0.03)
    right = _rod(points, [0.0, -0.13, 0.74], [0.12, -0.19, 0.58], 0.045, 0.035)
    left = _rod(points, [0.0, 0.13, 0.74], [0.02, 0.17, 0.45], 0.045, 0.035)
    pole = _rod(points, [0.12, -0.2, 0.4], [0.13, -0.2, 0.86], 0.03, 0.03)
    for part in (head, right, left, pole):
        out = smooth_union(out, part, 0.03)
    return out


def _guitar(points: np.ndarray) -> np.ndarray:
    """A slab with a slender neck, which leans back against a narrow stand with three feet."""
    lower = ellipsoid(points, np.array([0.0, 0.0, 0.27]), np.array([0.09, 0.2, 0.19]))
    upper = ellipsoid(points, np.array([-0.03, 0.0, 0.47]), np.array([0.08, 0.15, 0.14]))
    neck = _rod(points, [-0.04, 0.0, 0.5], [-0.1, 0.0, 0.92], 0.045, 0.035)
    head = rounded_box(points, np.array([-0.105, 0.0, 0.94]), np.array([0.03, 0.06, 0.06]), 0.015)
    out = smooth_union(smooth_union(lower, upper, 0.06), smooth_union(neck, head, 0.02), 0.03)
    for foot in ([0.13, 0.14, -0.02], [0.13, -0.14, -0.02], [-0.15, 0.0, -0.02]):
        out = smooth_union(out, _rod(points, foot, [-0.02, 0.4 * foot[1], 0.25], 0.035, 0.04), 0.02)
    return out


def _lamp(points: np.ndarray) -> np.ndarray:
    """A wide shade on a stem that stands on a small disc."""
    foot = _rod(points, [0.0, 0.0, 0.0], [0.0, 0.0, 0.05], 0.15, 0.13)
    stem = _rod(points, [0.0, 0.0, 0.05], [0.0, 0.0, 0.7], 0.045, 0.04)
    shade = _rod(points, [0.0, 0.0, 0.76], [0.0, 0.0, 0.9], 0.2, 0.1)
    return smooth_union(smooth_union(foot, stem, 0.04), shade, 0.03)


def _table(points: np.ndarray) -> np.ndarray:
    """A thick top, longer than wide, on four slender legs."""
    out = rounded_box(points, np.array([0.0, 0.0, 0.92]), np.array([0.7, 0.42, 0.07]), 0.02)
    for x, y in ((0.6, 0.33), (0.6, -0.33), (-0.6, 0.33), (-0.6, -0.33)):
        out = np.minimum(out, _rod(points, [x, y, -0.05], [x, y, 0.9], 0.04, 0.05))
    return out


MODELLED: dict[str, Distance] = {
    "biped": _legged(2, leg=0.1),
    "tripod": _legged(3),
    "short leg": _legged(4, short=1),
    "five legs": _legged(5, leg=0.04),
    "six legs": _legged(6, leg=0.04),
    "bottle": _bottle,
    "box": _box,
    "snake": _snake,
    "ball": _ball,
    "chair": _chair,
    "soldier": _soldier,
    "guitar": _guitar,
    "lamp": _lamp,
    "table": _table,
}


def _toadstool(points: np.ndarray) -> np.ndarray:
    """A heavy cap on a stem."""
    stem = _rod(points, [0.0, 0.0, 0.0], [0.0, 0.0, 0.6], 0.17, 0.1)
    return smooth_union(stem, ellipsoid(points, np.array([0.0, 0.0, 0.72]), np.array([0.38, 0.38, 0.2])), 0.05)


def _giraffe(points: np.ndarray) -> np.ndarray:
    """Four long legs under a short trunk, and a neck as long as the legs."""
    out = ellipsoid(points, np.array([0.0, 0.0, 0.52]), np.array([0.26, 0.13, 0.12]))
    for x, y in ((0.2, 0.11), (0.2, -0.11), (-0.2, 0.11), (-0.2, -0.11)):
        out = smooth_union(out, _rod(points, [x, 1.2 * y, -0.05], [0.9 * x, 0.8 * y, 0.5], 0.045, 0.06), 0.03)
    neck = _rod(points, [0.2, 0.0, 0.55], [0.36, 0.0, 0.95], 0.075, 0.05)
    head = _rod(points, [0.36, 0.0, 0.97], [0.5, 0.0, 0.92], 0.06, 0.045)
    return smooth_union(smooth_union(out, neck, 0.05), head, 0.03)


def _ostrich(points: np.ndarray) -> np.ndarray:
    """Two legs with long feet under a horizontal trunk, and a neck at the front."""
    out = ellipsoid(points, np.array([-0.04, 0.0, 0.6]), np.array([0.26, 0.19, 0.16]))
    for y in (0.12, -0.12):
        leg = _rod(points, [0.0, 1.1 * y, 0.05], [-0.02, y, 0.55], 0.055, 0.075)
        foot = _rod(points, [-0.08, 1.1 * y, 0.03], [0.2, 1.2 * y, 0.03], 0.055, 0.05)
        out = smooth_union(out, smooth_union(leg, foot, 0.03), 0.03)
    neck = _rod(points, [0.15, 0.0, 0.66], [0.22, 0.0, 0.95], 0.06, 0.05)
    return smooth_union(out, neck, 0.05)


def _spider(points: np.ndarray) -> np.ndarray:
    """A flat trunk between eight legs whose span is larger than the body's height."""
    out = ellipsoid(points, np.array([0.0, 0.0, 0.42]), np.array([0.28, 0.2, 0.14]))
    for k in range(8):
        x, y = np.cos(np.pi * (k + 0.5) / 4.0), np.sin(np.pi * (k + 0.5) / 4.0)
        knee = [0.42 * x, 0.36 * y, 0.6]
        thigh = _rod(points, [0.18 * x, 0.14 * y, 0.42], knee, 0.05, 0.045)
        shin = _rod(points, knee, [0.62 * x, 0.52 * y, -0.04], 0.045, 0.04)
        out = smooth_union(out, smooth_union(thigh, shin, 0.02), 0.03)
    return out


def _dachshund(points: np.ndarray) -> np.ndarray:
    """A trunk twice as long as high on four short legs."""
    out = _rod(points, [-0.7, 0.0, 0.45], [0.6, 0.0, 0.48], 0.19, 0.2)
    for x, y in ((0.5, 0.13), (0.5, -0.13), (-0.6, 0.13), (-0.6, -0.13)):
        out = smooth_union(out, _rod(points, [x, y, -0.05], [x, 0.9 * y, 0.4], 0.075, 0.085), 0.03)
    head = ellipsoid(points, np.array([0.78, 0.0, 0.78]), np.array([0.22, 0.14, 0.16]))
    neck = _rod(points, [0.55, 0.0, 0.5], [0.72, 0.0, 0.74], 0.14, 0.11)
    return smooth_union(smooth_union(out, neck, 0.05), head, 0.04)


UNSEEN: dict[str, Distance] = {
    "toadstool": _toadstool,
    "giraffe": _giraffe,
    "ostrich": _ostrich,
    "spider": _spider,
    "dachshund": _dachshund,
}
"""Held-out bodies, which were not used to tune any motion."""


def modelled(name: str) -> Body:
    """Build the body of this name in ``MODELLED`` or ``UNSEEN`` on the plane z = 0, about 1 high."""
    body_distance, random = (MODELLED | UNSEEN)[name], np.random.default_rng(0)

    def distance(points: np.ndarray) -> np.ndarray:
        return np.maximum(body_distance(points), -points[:, 2])

    vertices, faces = surface_mesh(distance, -_REACH * [1.0, 1.0, 0.05], _REACH, 0.02)
    samples = even_samples(distance, vertices, faces, _GAUSSIANS, random)
    grey, gloss = np.full((len(samples.points), 3), 0.5), np.full(len(samples.points), 0.1)
    cloud = shade_gaussians(samples, vertices, faces, grey, gloss, random=random, device="cpu")
    return Body(name, cloud, Plane(np.array([0.0, 0.0, 1.0]), 0.0), "modelled")
