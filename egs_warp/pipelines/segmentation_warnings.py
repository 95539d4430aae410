"""Warnings about the segmentation of an object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.locate_plane import LocatedPlane
from egs_warp.pipelines.standing_object import MIN_LEDGE
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.segmentation.outline import ledge_around
from egs_warp.segmentation.plane_search import lies_along

_MIN_EDGE_SHARE = 0.02
"""Length along which the object touches an edge of a picture, as a fraction of the picture's shorter side, above which
a warning is given. A shorter part may be a floater."""
_ALL_ROUND = 3
"""Number of the four edges of a picture that an object must touch to be considered as surrounding the camera."""
_MAX_SHARE = 1.0 / 3.0
"""Fraction of the capture's Gaussians above which an object is large if it is also wide. An object that stands free in
a small capture may have more of them."""
_MAX_EXTENT = 0.6
"""Ratio of the diagonal of an object along the ground to that of the capture above which the object is wide."""
_REMEDY = "click with a minus on what does not belong to it, or mark it with masks"
_MAX_GAP = 0.03
"""Distance between the object and the ground above which the foot of the object is missing, as a fraction of its
size."""
_FLOOR_DISTANCE = 0.03
"""Distance from the plane within which flat Gaussians belong to the floor, as a fraction of the object's size."""
_MAX_FLOOR_SHARE = 0.05
"""Fraction of the floor around the object that is included in the object above which a warning is given. A smaller part
is the object's underside."""


_MAX_SHARED_COLOURS = 0.16
"""Value of ``Segmentation.shared_colours`` above which a part of the object may be missing. It is at most 0.12 for
complete objects in procedural rooms, except for one of 0.17, and 0.21 or more for the bonsai without a part of its
crown or pot."""


def segmentation_warnings(
    cloud: GaussianCloud, located: LocatedPlane, object_cloud: GaussianCloud, cameras: Sequence[Camera]
) -> list[str]:
    """Return one line for each warning: the object touches a picture's edge, hangs in the air, may be incomplete,
    is cut by its box, includes floor, or is a large and wide part of the capture that its ground does not surround.

    Args:
        cloud: The capture.
        located: Plane and segmentation.
        object_cloud: The object.
        cameras: Views in which the object is tested.
    """
    warnings = []
    all_round, any_edge = views_at_edges(object_cloud, cameras)
    if all_round:
        warnings.append(
            f"touches the picture's edges all round in {all_round} of {len(cameras)} views: its surroundings are"
            f" included; {_REMEDY}"
        )
    elif any_edge:
        warnings.append(f"touches the picture's edge in {any_edge} of {len(cameras)} views: is it whole?")
    segmentation = located.segmentation
    means = cloud.means.numpy().astype(np.float64)
    ground = located.ground or located.plane
    lowest = float(np.quantile(ground.heights(means[segmentation.object_mask]), 0.002))
    # Neither the gap nor the floor can be measured if no view shows the ground.
    if located.in_sight and lowest > _MAX_GAP * segmentation.size:
        percent = 100.0 * lowest / segmentation.size
        warnings.append(f"rests on nothing: its lowest part is {percent:.0f} % of its size above the ground")
    if segmentation.shared_colours > _MAX_SHARED_COLOURS:
        percent = 100.0 * segmentation.shared_colours
        warnings.append(
            f"may be incomplete: {percent:.0f} % of it has colours that continue in what is connected to it but stayed"
            " behind; if that belongs to it, click on it, too"
        )
    if segmentation.cut_sides:
        sides = ", ".join(segmentation.cut_sides)
        warnings.append(
            f"is cut: what is connected to it continues beyond these sides of the box: {sides}; if that belongs to it,"
            " enlarge the box"
        )
    share = _floor_share(cloud, located.plane, segmentation.object_mask, located.centre, segmentation.size)
    if located.in_sight and share > _MAX_FLOOR_SHARE:
        warnings.append(f"includes {100 * share:.0f} % of the floor around it")
    elif (
        located.in_sight
        and all_round == 0
        and is_large(means, segmentation.object_mask, located.plane)
        and ledge_around(cloud, located.plane, segmentation) < MIN_LEDGE
    ):
        percent = 100.0 * segmentation.object_mask.mean()
        warnings.append(f"has {percent:.0f} % of the capture's Gaussians; if this is more than the object, {_REMEDY}")
    return warnings


def is_large(means: np.ndarray, object_mask: np.ndarray, plane: Plane, *, whole: np.ndarray | None = None) -> bool:
    """Return True if the object is so large and wide a part of the capture that it may include its surroundings.

    Args:
        means: (n, 3) means of the capture.
        object_mask: (n,) bool, the object.
        plane: The ground.
        whole: (k, 3) points that have the extent of the capture; None uses the means.
    """
    if object_mask.mean() <= _MAX_SHARE:
        return False
    along = np.stack(plane.tangents(), axis=1)
    extent, capture_extent = (
        float(np.linalg.norm(np.subtract(*np.quantile(points @ along, [0.99, 0.01], axis=0))))
        for points in (means[object_mask], means if whole is None else whole)
    )
    return extent > _MAX_EXTENT * capture_extent


def views_at_edges(object_cloud: GaussianCloud, cameras: Sequence[Camera]) -> tuple[int, int]:
    """Return the number of ``cameras`` in whose pictures the object touches nearly all edges (``_ALL_ROUND``), and the
    number of those in whose pictures it touches any edge."""
    touched = [_touched_edges(object_cloud, camera) for camera in cameras]
    return sum(edges >= _ALL_ROUND for edges in touched), sum(edges > 0 for edges in touched)


def _touched_edges(object_cloud: GaussianCloud, camera: Camera) -> int:
    """Return the number of the picture's edges at which the object is visible."""
    is_opaque = render_gaussians(object_cloud, camera).alpha.numpy() > 0.5
    edges = np.array([edge.sum() for edge in (is_opaque[0], is_opaque[-1], is_opaque[:, 0], is_opaque[:, -1])])
    least = _MIN_EDGE_SHARE * min(camera.width, camera.height)
    # If no single edge has enough visible pixels, all edges together may count as one.
    return int((edges > least).sum()) or int(edges.sum() > least)


def _floor_share(cloud: GaussianCloud, plane: Plane, object_mask: np.ndarray, centre: np.ndarray, size: float) -> float:
    """Return the fraction of the flat floor at ``plane``, within the distance ``size`` of ``centre`` (3,), that is in
    the object."""
    means = cloud.means.numpy().astype(np.float64)
    heights = plane.heights(means)
    arms = means - centre
    across = np.linalg.norm(arms - (arms @ plane.normal)[:, None] * plane.normal, axis=1)
    floor = lies_along(cloud, plane) & (np.abs(heights) < _FLOOR_DISTANCE * size) & (across < size)
    log_areas = np.sort(cloud.log_scales.numpy().astype(np.float64), axis=1)[:, 1:].sum(axis=1)
    area = cloud.opacities() * np.exp(log_areas) * floor
    return float(area[object_mask].sum() / max(area.sum(), 1e-300))
