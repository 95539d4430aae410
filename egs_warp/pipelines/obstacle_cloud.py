"""Gaussians of the obstacles of a world, which show the obstacles in the film of the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from egs_warp.assets.surface import quaternions_from_normals
from egs_warp.contact.terrain import Solid
from egs_warp.geometry.gaussians import ARRAYS, SH_BAND_0, GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.render.shadow import ShadowMap
from egs_warp.short_repr import short_repr

_SAMPLES = 120
"""Number of Gaussians along the longest side of an obstacle."""
_WIDTH, _THICKNESS, _LOGIT = 0.62, 0.1, 3.0
"""Standard deviations of a Gaussian along and across its face, in units of the sample spacing; and the logit of its
opacity."""
_COLOUR = np.array([0.60, 0.62, 0.66])
"""sRGB colour of a face that faces the light."""
_LIGHT = np.array([0.35, -0.45, 0.82])
"""Direction towards the light that shades the faces."""
_MIN_UPWARD = 0.3
"""Minimum vertical component of the normal of a face on which bodies cast contact shadows."""
_AMBIENT = 0.62
"""Brightness of a face in the shade, relative to a face that faces the light."""


@dataclass(frozen=True)
class Obstacles:
    """Gaussians of the obstacles of a world, face by face."""

    __repr__ = short_repr

    cloud: GaussianCloud
    """Gaussians of all faces, without view-dependent colour."""
    colours: np.ndarray
    """(n, 3) sRGB colours without shadows."""
    faces: tuple[tuple[Plane, slice], ...]
    """Plane and Gaussians of each face."""


def make_obstacles(solids: Sequence[Solid], low: np.ndarray, high: np.ndarray, *, device: str) -> Obstacles | None:
    """Return a cloud that shows the solids as opaque grey surfaces; None if there is nothing to draw. Solids with a
    single face, such as walls, are not drawn, because they would hide the bodies.

    Args:
        solids: Obstacles in the frame of the world, m.
        low, high: (3,) m, corners of the box outside which nothing is drawn.
        device: Warp device.
    """
    parts = [part for solid in solids if len(solid.faces) > 1 for part in _faces(solid, low, high)]
    if not parts:
        return None
    points = np.concatenate([points for _, points, _ in parts])
    normals = np.concatenate([np.tile(face.normal, (len(points), 1)) for face, points, _ in parts])
    spacings = np.concatenate([np.full(len(points), spacing) for _, points, spacing in parts])
    shade = _AMBIENT + (1.0 - _AMBIENT) * np.clip(normals @ _LIGHT / np.linalg.norm(_LIGHT), 0.0, 1.0)
    colours = shade[:, None] * _COLOUR
    cloud = GaussianCloud.from_numpy(
        points,
        quaternions_from_normals(normals, np.zeros(len(normals))),
        np.log(spacings[:, None] * [_WIDTH, _WIDTH, _THICKNESS]),
        np.full(len(points), _LOGIT),
        _band_0(colours)[:, None],
        device=device,
    )
    ends = np.cumsum([len(points) for _, points, _ in parts])
    faces = [(face, slice(end - len(points), end)) for (face, points, _), end in zip(parts, ends, strict=True)]
    return Obstacles(cloud, colours, tuple(faces))


class ObstacleShadows:
    """Contact shadows of the bodies on the upper faces of the obstacles."""

    def __init__(self, obstacles: Obstacles, first: int, *, blur_radius: float, height: float) -> None:
        """Create a shadow map for each upper face.

        Args:
            obstacles: The obstacles.
            first: Index of the first Gaussian of the obstacles in the joint cloud, where they follow the Gaussians of
                the bodies.
            blur_radius: Blur radius of the bodies (``shadow_blur_radius``), m.
            height: Height of the highest body, m.
        """
        self._obstacles, self._first = obstacles, first
        device, means = obstacles.cloud.device, obstacles.cloud.means.numpy().astype(np.float64)
        self._receivers = []
        for face, rows in obstacles.faces:
            if face.normal[2] < _MIN_UPWARD:
                continue
            points = means[rows]
            centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
            reach = float(np.linalg.norm(points - centre, axis=1).max())
            shadow = ShadowMap(face, centre=centre, reach=reach, device=device, blur_radius=blur_radius, height=height)
            texels = wp.array(shadow.texels(points).astype(np.float32), dtype=wp.vec2, device=device)
            self._receivers.append((shadow, rows, texels, wp.full(len(points), 1.0, dtype=wp.float32, device=device)))

    def draw(self, joint: GaussianCloud) -> None:
        """Darken the Gaussians of the obstacles in the ``joint`` cloud where the bodies cast shadows."""
        if not self._receivers:
            return
        first = self._first
        bodies = replace(joint, **{name: getattr(joint, name)[:first] for name in ARRAYS})
        colours = self._obstacles.colours.copy()
        for shadow, rows, texels, strength in self._receivers:
            colours[rows] *= 1.0 - shadow.cover(shadow.of(bodies), texels, strength).numpy()[:, None]
        sh = np.zeros((len(colours), joint.sh.shape[1], 3), np.float32)
        sh[:, 0] = _band_0(colours)
        rows: Any = joint.sh[first:]
        wp.copy(rows, wp.array(sh, dtype=wp.vec3, device=joint.device))


def _band_0(colours: np.ndarray) -> np.ndarray:
    """Return the SH coefficients of band 0 (n, 3) of ``colours`` (n, 3)."""
    return (colours - 0.5) / SH_BAND_0


def _faces(solid: Solid, low: np.ndarray, high: np.ndarray) -> list[tuple[Plane, np.ndarray, float]]:
    """Return the plane, the points (n, 3) of a grid and their spacing for each face of ``solid`` that is visible above
    the ground."""
    spacing = float((high - low).max()) / _SAMPLES
    extent = _extent(solid, low, high)
    if extent is not None:
        low, high = extent
        spacing = float((high - low).max()) / _SAMPLES
    parts = []
    middle, reach = 0.5 * (low + high), float(np.linalg.norm(high - low))
    steps = np.arange(-reach, reach + spacing, spacing)
    for face in solid.faces:
        if face.normal[2] < -0.99:
            continue
        first, second = face.tangents()
        centre = middle - float(face.heights(middle)) * face.normal
        grid = centre + (steps[:, None, None] * first + steps[None, :, None] * second).reshape(-1, 3)
        grid = np.concatenate([grid, *(_on_edge(grid, face, other, spacing) for other in solid.faces)])
        inside = np.all([other.heights(grid) <= 1e-9 for other in solid.faces if other is not face], axis=0)
        inside &= (grid[:, 2] >= 0.0) & np.all((grid >= low - 1e-9) & (grid <= high + 1e-9), axis=1)
        if inside.any():
            parts.append((face, grid[inside], spacing))
    return parts


def _on_edge(points: np.ndarray, face: Plane, other: Plane, spacing: float) -> np.ndarray:
    """Return the ``points`` (n, 3) of a ``face`` that are at most ``spacing`` beyond its edge with the face ``other``.
    Points beyond the edge are moved onto it, so that slanted edges are straight."""
    along = other.normal - (other.normal @ face.normal) * face.normal
    slope = float(np.linalg.norm(along))
    if other is face or slope < 1e-6:
        return np.zeros((0, 3))
    beyond = other.heights(points) / slope
    near = (beyond > 0.0) & (beyond < spacing)
    return points[near] - beyond[near, None] * along / slope


def _extent(solid: Solid, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the corners of the box around the part of a solid that lies within the box from ``low`` to ``high``; None
    if this part has no volume. The error is at most a hundredth of the size of the box."""
    axes = [np.linspace(a, b, 101) for a, b in zip(low, high, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = np.all([face.heights(lattice) <= 0.0 for face in solid.faces], axis=0)
    cells = np.argwhere(inside)
    if len(cells) == 0:
        return None
    step = (high - low) / 100.0
    return np.maximum(low, low + step * (cells.min(axis=0) - 1)), np.minimum(high, low + step * (cells.max(axis=0) + 1))
