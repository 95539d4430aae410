"""Gaussians of the obstacles of a world, so that its film shows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.assets.surface import quaternions_from_normals
from egs_warp.contact.terrain import Solid
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud

_SAMPLES = 90
"""Number of Gaussians along the longest side of an obstacle."""
_WIDTH, _THICKNESS, _LOGIT = 0.62, 0.1, 3.0
"""Standard deviations of a Gaussian along and across its face, in sample spacings, and the logit of its opacity."""
_COLOUR = np.array([0.60, 0.62, 0.66])
"""sRGB colour of a face that looks up."""
_LIGHT = np.array([0.35, -0.45, 0.82])
"""Direction to the light that shades the faces."""
_AMBIENT = 0.62
"""Brightness of a face in the shade, relative to a face that looks at the light."""


def obstacle_cloud(solids: Sequence[Solid], low: np.ndarray, high: np.ndarray, *, device: str) -> GaussianCloud | None:
    """Return opaque grey surfaces of the solids; None if there is nothing to draw. Walls that consist of a single face
    are not drawn, because they would hide the bodies.

    Args:
        solids: Obstacles in the frame of the world, m.
        low, high: (3,) m, corners of the box within which unbounded solids are drawn.
        device: Warp device.
    """
    parts = [_faces(solid, low, high) for solid in solids if len(solid.faces) > 1]
    parts = [part for part in parts if len(part[0])]
    if not parts:
        return None
    points, normals, spacings = (np.concatenate(each) for each in zip(*parts, strict=True))
    shade = _AMBIENT + (1.0 - _AMBIENT) * np.clip(normals @ _LIGHT / np.linalg.norm(_LIGHT), 0.0, 1.0)
    colours = shade[:, None] * _COLOUR
    scales = spacings[:, None] * [_WIDTH, _WIDTH, _THICKNESS]
    return GaussianCloud.from_numpy(
        points,
        quaternions_from_normals(normals, np.zeros(len(normals))),
        np.log(scales),
        np.full(len(points), _LOGIT),
        ((colours - 0.5) / SH_BAND_0)[:, None],
        device=device,
    )


def _faces(solid: Solid, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (n, 3), normals (n, 3) and spacings (n,) of a grid on each face above the ground."""
    spacing = float((high - low).max()) / _SAMPLES
    extent = _extent(solid, low, high)
    if extent is not None:
        low, high = extent
        spacing = float((high - low).max()) / _SAMPLES
    points, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
    middle, reach = 0.5 * (low + high), float(np.linalg.norm(high - low))
    steps = np.arange(-reach, reach + spacing, spacing)
    for face in solid.faces:
        if face.normal[2] < -0.99:
            continue
        first, second = face.tangents()
        centre = middle - float(face.heights(middle)) * face.normal
        grid = centre + (steps[:, None, None] * first + steps[None, :, None] * second).reshape(-1, 3)
        inside = np.all([other.heights(grid) <= 1e-9 for other in solid.faces if other is not face], axis=0)
        inside &= (grid[:, 2] >= 0.0) & np.all((grid >= low - 1e-9) & (grid <= high + 1e-9), axis=1)
        points.append(grid[inside])
        normals.append(np.tile(face.normal, (int(inside.sum()), 1)))
    found = np.concatenate(points)
    return found, np.concatenate(normals), np.full(len(found), spacing)


def _extent(solid: Solid, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the corners of the box around the part of a solid above the ground that lies within the box from ``low``
    to ``high``; None if it has no volume there. Accurate to a hundredth of the box."""
    axes = [np.linspace(a, b, 101) for a, b in zip(low, high, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = np.all([face.heights(lattice) <= 0.0 for face in solid.faces], axis=0)
    cells = np.argwhere(inside)
    if len(cells) == 0:
        return None
    step = (high - low) / 100.0
    return np.maximum(low, low + step * (cells.min(axis=0) - 1)), np.minimum(high, low + step * (cells.max(axis=0) + 1))
