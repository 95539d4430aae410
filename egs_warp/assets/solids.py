"""Signed distance functions of the built-in objects, and evenly spaced samples of their zero level sets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree
from skimage import measure

from egs_warp.assets.surface import SurfaceSamples

Distance = Callable[[np.ndarray], np.ndarray]
"""Function that maps points (m, 3) to their signed distances (m,), negative inside."""


def rounded_box(points: np.ndarray, centre: np.ndarray, half: np.ndarray, radius: float) -> np.ndarray:
    """Return the distance (m,) to a box with half sides ``half`` (3,) and edges rounded by ``radius``."""
    q = np.abs(points - centre) - (np.asarray(half) - radius)
    outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
    return outside + np.minimum(q.max(axis=1), 0.0) - radius


def tapered_rod(
    points: np.ndarray, start: np.ndarray, end: np.ndarray, start_radius: float, end_radius: float
) -> np.ndarray:
    """Return the distance (m,) to a rod from ``start`` to ``end`` (3,) with round ends and a linearly changing
    radius."""
    axis = np.asarray(end, float) - start
    t = np.clip((points - start) @ axis / (axis @ axis), 0.0, 1.0)
    return np.linalg.norm(points - start - t[:, None] * axis, axis=1) - (start_radius + t * (end_radius - start_radius))


def ellipsoid(points: np.ndarray, centre: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return the distance (m,) to an ellipsoid, exact to first order at the surface."""
    q = points - centre
    k0, k1 = np.linalg.norm(q / radii, axis=1), np.linalg.norm(q / np.square(radii), axis=1)
    return k0 * (k0 - 1.0) / np.maximum(k1, 1e-12)


def smooth_union(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Return the signed distance to the union of ``a`` and ``b``, with a fillet of about ``width``."""
    h = np.clip(0.5 + 0.5 * (b - a) / width, 0.0, 1.0)
    return b + (a - b) * h - width * h * (1.0 - h)


def surface_mesh(distance: Distance, low: np.ndarray, high: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (v, 3) and triangles (f, 3) of the surface inside the box, by marching cubes."""
    counts = np.ceil((high - low) / step).astype(int) + 1
    lattice = low + step * np.indices(tuple(counts)).reshape(3, -1).T
    values = distance(lattice).reshape(counts)
    vertices, faces, _, _ = measure.marching_cubes(values, 0.0)
    return low + step * vertices, faces


def even_samples(
    distance: Distance, vertices: np.ndarray, faces: np.ndarray, count: int, random: np.random.Generator
) -> SurfaceSamples:
    """Sample ``count`` points evenly: draw points by area, then repel neighbours along the surface and project the
    points onto it."""
    corners = vertices[faces]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    spacing = float(np.sqrt(areas.sum() / count))
    # Stratify along the cumulative area, so that the initial points do not cluster on some faces.
    drawn = np.searchsorted(np.cumsum(areas), areas.sum() * (np.arange(count) + random.uniform(size=count)) / count)
    u = random.uniform(size=(count, 2))
    u = np.where(u.sum(axis=1, keepdims=True) > 1.0, 1.0 - u, u)
    chosen = corners[np.minimum(drawn, len(faces) - 1)]
    points = chosen[:, 0] + u[:, :1] * (chosen[:, 1] - chosen[:, 0]) + u[:, 1:] * (chosen[:, 2] - chosen[:, 0])
    normals = _gradient(distance, points, 0.25 * spacing)
    for _ in range(8):
        gap, neighbour = (np.asarray(found) for found in KDTree(points).query(points, k=7))
        away = points[:, None] - points[neighbour[:, 1:]]
        gap = np.maximum(gap[:, 1:], 1e-3 * spacing)
        push = (away / gap[:, :, None] * np.clip(1.2 * spacing - gap, 0.0, None)[:, :, None]).sum(axis=1)
        push -= np.sum(push * normals, axis=1, keepdims=True) * normals
        points = points + 0.3 * push
        normals = _gradient(distance, points, 0.25 * spacing)
        points = points - distance(points)[:, None] * normals
    return SurfaceSamples(points, _gradient(distance, points, 0.5 * spacing), spacing)


def _gradient(distance: Distance, points: np.ndarray, step: float) -> np.ndarray:
    """Return the unit gradient (m, 3), computed by central differences; a large ``step`` rounds the edges."""
    gradient = np.stack([distance(points + step * axis) - distance(points - step * axis) for axis in np.eye(3)], axis=1)
    return gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
