"""Simulated user clicks, and the overlap of the resulting object with a hand-drawn outline."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from annotated_scenes import DrawnScene, DrawnView
from egs_warp.errors import UserError
from egs_warp.geometry.bitmaps import depth_inside
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.locate_plane import LocatedPlane, locate_plane, with_measured_ground
from egs_warp.pipelines.prepare_scene import SceneOptions, segment_scene
from egs_warp.render import render_gaussians
from egs_warp.segmentation.clearance import StraddlingPolicy
from egs_warp.segmentation.clicks import Click, click_at
from egs_warp.segmentation.object_spec import ObjectSpec
from harness import timed

CLICKED, JUDGED = slice(0, None, 2), slice(1, None, 2)
"""Indices of the views whose outlines may be used for clicks, and of those whose outlines are used to evaluate the
result."""
VISIBLE = 0.01
"""Minimum depth of a region of wrong pixels, which is the largest distance of its pixels from its edge, relative to the
image's shorter side. No click is made on a shallower region."""


def overlap(cloud: GaussianCloud, object_cloud: GaussianCloud, view: DrawnView) -> tuple[float, np.ndarray, np.ndarray]:
    """Compare ``object_cloud``, rendered alone, with the outline of a view.

    Pixels are ignored where neither ``cloud``, the whole scene, nor the object is opaque, and where something hides the
    object.

    Returns:
        IoU; (H, W) bool, pixels inside the outline that the object lacks; (H, W) bool, pixels of the object outside the
            outline.
    """
    alone, whole = (render_gaussians(one, view.camera).alpha.numpy() > 0.5 for one in (object_cloud, cloud))
    counts = whole | alone
    if view.hidden is not None:
        counts &= ~view.hidden
    missing, more = view.mask & ~alone & counts, alone & ~view.mask & counts
    union = (view.mask | alone) & counts
    return float((view.mask & alone).sum() / max(union.sum(), 1)), missing, more


def innermost(mask: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Return the largest distance in pixels of a pixel in ``mask`` (H, W) from the mask's edge, and the position (u, v)
    of this pixel."""
    depth = depth_inside(np.pad(mask, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(depth)), depth.shape)
    return float(depth[row, column]), (column + 0.5, row + 0.5)


def found_by(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    cameras: Sequence[Camera],
    seconds: dict[str, float],
    plane: Plane | None = None,
) -> tuple[LocatedPlane, GaussianCloud, GaussianCloud]:
    """Locate the plane and segment the object that ``spec`` describes.

    Args:
        seconds: receives the time of each stage, s.
        plane: the ground plane; None finds it.

    Returns:
        the plane, the object and the background.
    """
    located, seconds["plane"] = timed(locate_plane, cloud, spec, cameras=cameras, plane=plane)
    located, seconds["ground"] = timed(with_measured_ground, cloud, located, spec, cameras)
    parts, seconds["segment"] = timed(segment_scene, cloud, located, SceneOptions(clearing=StraddlingPolicy.SPLIT))
    return located, parts[0], parts[1]


def clicked(
    annotated: DrawnScene, cloud: GaussianCloud, cameras: Sequence[Camera], count: int
) -> tuple[ObjectSpec, list[str]]:
    """Simulate a user who makes ``count`` clicks, each on the largest remaining error.

    Returns:
        the object's description, and the clicks in the notation of the command line.
    """
    views = annotated.views[CLICKED]
    clicks: list[Click] = []
    written: list[str] = []
    object_cloud: GaussianCloud | None = None
    for number in range(count):
        view = views[number]
        inside, place = True, innermost(view.mask)[1]
        if number:
            spec = ObjectSpec.of_clicks(clicks)
            try:
                object_cloud = found_by(cloud, spec, cameras, {})[1]
            except UserError as error:
                # A user would see a one-line error here and, if there is no object yet, would click on the object
                # again.
                print(f"{annotated.name}: {number} clicks: {error}")
            if object_cloud is not None:
                _, missing, more = overlap(cloud, object_cloud, view)
                (depth, missing_pixel), (extra, extra_pixel) = innermost(missing), innermost(more)
                if max(depth, extra) < VISIBLE * min(view.mask.shape):
                    continue
                inside, place = (True, missing_pixel) if depth >= extra else (False, extra_pixel)
        hit = click_at(cloud, view.camera, *place, inside=inside)
        if hit is not None:
            clicks.append(hit)
            written.append(f"{'+' if inside else '-'}{place[0]:g},{place[1]:g}@{2 * number}")
    return ObjectSpec.of_clicks(clicks), written


def picture(object_cloud: GaussianCloud, view: DrawnView, missing: np.ndarray, more: np.ndarray) -> np.ndarray:
    """Return the image (320, 320, 3) uint8 of the object alone, red where a part is missing, blue where the object
    extends beyond the outline."""
    rendered = render_gaussians(object_cloud, view.camera, background=(0.7, 0.7, 0.7)).colour.numpy()
    picture = np.clip(rendered.astype(np.float32), 0.0, 1.0)
    picture[missing], picture[more] = (1.0, 0.1, 0.1), (0.1, 0.2, 1.0)
    side = min(picture.shape[:2])
    middle = np.argwhere(view.mask).mean(axis=0) if view.mask.any() else np.array(picture.shape[:2]) / 2.0
    top, left = (int(np.clip(middle[k] - side / 2, 0, picture.shape[k] - side)) for k in (0, 1))
    cropped = cv2.resize(
        np.ascontiguousarray(picture[top : top + side, left : left + side]), (320, 320), interpolation=cv2.INTER_AREA
    )
    return np.rint(255.0 * cropped).astype(np.uint8)
