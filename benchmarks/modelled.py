"""Bodies modelled for the benchmarks as signed distances: on two to six legs, on one base, on none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bodies import Body
from egs_warp.assets.object import light_and_paint
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
    """An egg with a head on ``count`` legs in a ring, one of which may be 3 % too short."""

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
}


def modelled(name: str) -> Body:
    """One of ``MODELLED`` on the plane z = 0, about 1 high."""
    given, random = MODELLED[name], np.random.default_rng(0)

    def distance(points: np.ndarray) -> np.ndarray:
        return np.maximum(given(points), -points[:, 2])

    vertices, faces = surface_mesh(distance, -_REACH * [1.0, 1.0, 0.05], _REACH, 0.02)
    samples = even_samples(distance, vertices, faces, _GAUSSIANS, random)
    grey, gloss = np.full((len(samples.points), 3), 0.5), np.full(len(samples.points), 0.1)
    cloud = light_and_paint(samples, vertices, faces, grey, gloss, random=random, device="cpu")
    return Body(name, cloud, Plane(np.array([0.0, 0.0, 1.0]), 0.0), "modelled")
