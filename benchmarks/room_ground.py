"""Error of the ground plane, relative to the truth in built-in scenes and to marked points in real scenes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from annotated_scenes import DrawnScene, DrawnView
from clicking import CLICKED, JUDGED
from egs_warp.assets import scene
from egs_warp.geometry.camera import camera_rays
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.locate_plane import LocatedPlane, locate_plane
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.segmentation.seen_surface import SeenSurface
from harness import Row


def marked_plane(cloud: GaussianCloud, views: Sequence[DrawnView], up: np.ndarray) -> Plane:
    """Fit a plane to the marked ground points of ``views``, without the worst fifth of them.

    The height at a mark is the height of the splats there, because a height from rendered depth would be too large.
    """
    surfaces = [SeenSurface.of(cloud, view.camera) for view in views]
    plane = _through(surfaces, views, up, None)
    return _through(surfaces, views, up, plane)


def _through(surfaces: Sequence[SeenSurface], views: Sequence[DrawnView], up: np.ndarray, about: Plane | None) -> Plane:
    """Fit a plane to the marks at their rendered depth or, with ``about``, at the height of the splats over that
    plane."""
    places = []
    for surface, view in zip(surfaces, views, strict=True):
        depth = surface.depth if about is None else surface.depth_over(about)
        column, row = view.ground.astype(int).T
        away = depth[row, column]
        valid = away > 0.0
        places.append(view.camera.centre + away[valid, None] * camera_rays(view.camera)[row[valid], column[valid]])
    points = np.concatenate(places)
    for _ in range(2):
        plane = _fitted(points, up)
        off = np.abs(plane.heights(points))
        points = points[off <= np.quantile(off, 0.9)]
    return _fitted(points, up)


def _fitted(points: np.ndarray, up: np.ndarray) -> Plane:
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle)[2][2]
    normal *= np.sign(normal @ up)
    return Plane(normal, float(-normal @ middle))


def apart(first: Plane, second: Plane, foot: np.ndarray, height: float) -> tuple[float, float]:
    """Return the angle between two planes, degrees, and their distance at ``foot`` (3,), in heights of the object."""
    cosine = float(np.clip(first.normal @ second.normal, -1.0, 1.0))
    return float(np.degrees(np.arccos(cosine))), abs(float(first.heights(foot) - second.heights(foot))) / height


def real_ground(annotated: DrawnScene, cloud: GaussianCloud, located: LocatedPlane) -> Row:
    """Compare our plane, or our ground if it is not flat, with the mean of two markings, and the two markings with each
    other."""
    plane = located.plane
    foot = located.centre - plane.heights(located.centre) * plane.normal
    height = float(np.quantile(plane.heights(cloud.means.numpy()[located.segmentation.object_mask]), 0.995))
    even, odd = (marked_plane(cloud, annotated.views[half], plane.normal) for half in (CLICKED, JUDGED))
    between = even.normal + odd.normal
    middle = foot - 0.5 * (even.heights(foot) + odd.heights(foot)) * plane.normal
    between /= np.linalg.norm(between)
    degrees, offset = apart(plane, Plane(between, float(-between @ middle)), foot, height)
    if located.ground is not None:
        # Where the ground is not flat, it differs from the plane under the object.
        offset = abs(float(located.ground.heights(middle[None])[0])) / height
    markings_degrees, markings_offset = apart(even, odd, foot, height)
    row = {"scene": annotated.name, "how": "ground", "degrees": degrees, "offset": offset}
    return {**row, "markings_degrees": markings_degrees, "markings_offset": markings_offset}


def known_ground(name: str, device: str) -> Row:
    """Compare the plane that is located from a point in the middle of a built-in object with the true plane."""
    made = scene(name, device=device)
    cloud, truth = made.whole()
    heights = made.plane.heights(cloud.means.numpy()[truth])
    low, high = np.quantile(cloud.means.numpy()[truth], [0.01, 0.99], axis=0)
    middle = 0.5 * (low + high)
    located = locate_plane(cloud, ObjectSpec(point=middle))
    foot = middle - made.plane.heights(middle) * made.plane.normal
    degrees, offset = apart(located.plane, made.plane, foot, float(heights.max()))
    return {"scene": name, "how": "ground", "degrees": degrees, "offset": offset}


def judged_ground(rows: Sequence[Row]) -> bool:
    """Return True if every plane is within the tolerances of the aim ``ground``."""
    return all(
        row["degrees"] <= 2.0 * row["markings_degrees"] and row["offset"] <= 2.0 * row["markings_offset"]
        if "markings_degrees" in row
        else row["degrees"] <= 1.0 and row["offset"] <= 0.005
        for row in rows
        if row.get("how") == "ground"
    )
