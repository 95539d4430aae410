"""What looks wrong about an object that was taken out of a scene, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.locate_plane import LocatedPlane
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.segmentation.plane_search import lies_along

_EDGE = 0.02
"""Of a picture's shorter side: so much of the object along its edge is no floater."""
_FREE = 0.03
"""Of the object's size: what hangs higher above what it stands on has lost its foot."""
_BAND = 0.03
"""Of the object's size, up and down: what lies flat so near to the plane is of the floor."""
_TAKEN = 0.05
"""Of the floor within the object's size of its middle: less is its own underside."""


def segmentation_warnings(
    cloud: GaussianCloud, located: LocatedPlane, thing: GaussianCloud, cameras: Sequence[Camera]
) -> list[str]:
    """One line for each thing that looks wrong: ``thing``, out of ``cloud``, touches the edge of a picture that
    ``cameras`` take, rests on nothing, or has part of the floor with it.
    """
    words = []
    edges = sum(_touches_edge(thing, camera) for camera in cameras)
    if edges:
        words.append(f"touches the picture's edge in {edges} of {len(cameras)} views: is it whole?")
    found = located.segmentation
    means = cloud.means.numpy().astype(np.float64)
    ground = located.ground or located.plane
    lowest = float(np.quantile(ground.heights(means[found.object_mask]), 0.002))
    if lowest > _FREE * found.size:
        percent = 100.0 * lowest / found.size
        words.append(f"rests on nothing: its lowest part is {percent:.0f} % of its size above the ground")
    share = _floor_taken(cloud, located.plane, found.object_mask, located.centre, found.size)
    if share > _TAKEN:
        words.append(f"taken along: {100 * share:.0f} % of the floor about it")
    return words


def _touches_edge(thing: GaussianCloud, camera: Camera) -> bool:
    seen = render_gaussians(thing, camera).alpha.numpy() > 0.5
    rim = int(seen[0].sum() + seen[-1].sum() + seen[:, 0].sum() + seen[:, -1].sum())
    return rim > _EDGE * min(camera.width, camera.height)


def _floor_taken(cloud: GaussianCloud, plane: Plane, object_mask: np.ndarray, centre: np.ndarray, size: float) -> float:
    """Share of the area of what lies flat at ``plane``, within ``size`` of ``centre`` (3,), that is in the object."""
    means = cloud.means.numpy().astype(np.float64)
    heights = plane.heights(means)
    away = means - centre
    across = np.linalg.norm(away - (away @ plane.normal)[:, None] * plane.normal, axis=1)
    floor = lies_along(cloud, plane) & (np.abs(heights) < _BAND * size) & (across < size)
    broad = np.sort(cloud.log_scales.numpy().astype(np.float64), axis=1)[:, 1:].sum(axis=1)
    area = cloud.opacities() * np.exp(broad) * floor
    return float(area[object_mask].sum() / max(area.sum(), 1e-300))
