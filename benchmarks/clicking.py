"""What a patient user would click, and how much of a drawn outline the object then covers."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from annotated_scenes import DrawnScene, DrawnView
from egs_warp.errors import UserError
from egs_warp.geometry.bitmaps import depth_inside
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.pipelines.locate_plane import LocatedPlane, locate_plane, with_measured_ground
from egs_warp.pipelines.prepare_scene import SceneOptions, segment_scene
from egs_warp.render import render_gaussians
from egs_warp.segmentation.clearance import StraddlingPolicy
from egs_warp.segmentation.clicks import Click, click_at
from egs_warp.segmentation.object_spec import ObjectSpec
from harness import timed

GIVEN, JUDGED = slice(0, None, 2), slice(1, None, 2)
"""Of a scene's views: whose outlines may be given, and by which others are judged."""
VISIBLE = 0.01
"""Of a picture's shorter side: an error whose innermost place is nearer to its edge than this is not clicked on."""


def overlap(cloud: GaussianCloud, thing: GaussianCloud, view: DrawnView) -> tuple[float, np.ndarray, np.ndarray]:
    """IoU of ``thing``, drawn alone, with the outline; and (H, W) bool of what is missing, and too much."""
    alone, whole = (render_gaussians(one, view.camera).alpha.numpy() > 0.5 for one in (thing, cloud))
    counts = whole | alone
    missing, more = view.mask & ~alone & counts, alone & ~view.mask
    union = (view.mask | alone) & counts
    return float((view.mask & alone).sum() / max(union.sum(), 1)), missing, more


def innermost(mask: np.ndarray) -> tuple[float, tuple[float, float]]:
    """How many pixels the innermost place of ``mask`` (H, W) is from its edge, and where it is, (u, v)."""
    depth = depth_inside(np.pad(mask, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(depth)), depth.shape)
    return float(depth[row, column]), (column + 0.5, row + 0.5)


def found_by(
    cloud: GaussianCloud, spec: ObjectSpec, cameras: Sequence[Camera], seconds: dict[str, float]
) -> tuple[LocatedPlane, GaussianCloud, GaussianCloud]:
    """Where the object is, it and its background; ``seconds`` of each stage."""
    located, seconds["plane"] = timed(locate_plane, cloud, spec, cameras=cameras)
    located, seconds["ground"] = timed(with_measured_ground, cloud, located, spec, cameras)
    parts, seconds["segment"] = timed(segment_scene, cloud, located, SceneOptions(clearing=StraddlingPolicy.SPLIT))
    return located, parts[0], parts[1]


def clicked(
    drawn: DrawnScene, cloud: GaussianCloud, cameras: Sequence[Camera], count: int
) -> tuple[ObjectSpec, list[str]]:
    """What ``count`` clicks tell, and these clicks as the command takes them."""
    views = drawn.views[GIVEN]
    clicks: list[Click] = []
    written: list[str] = []
    thing: GaussianCloud | None = None
    for number in range(count):
        view = views[number]
        inside, place = True, innermost(view.mask)[1]
        if number:
            spec = ObjectSpec.of_clicks(clicks)
            try:
                thing = found_by(cloud, spec, cameras, {})[1]
            except UserError as error:
                # What a user gets is one line; the next click is made on the object.
                print(f"{drawn.name}: {number} clicks: {error}")
            if thing is not None:
                _, missing, more = overlap(cloud, thing, view)
                (depth, lost), (extra, taken) = innermost(missing), innermost(more)
                if max(depth, extra) < VISIBLE * min(view.mask.shape):
                    continue
                inside, place = (True, lost) if depth >= extra else (False, taken)
        hit = click_at(cloud, view.camera, *place, inside=inside)
        if hit is not None:
            clicks.append(hit)
            written.append(f"{'+' if inside else '-'}{place[0]:g},{place[1]:g}@{2 * number}")
    return ObjectSpec.of_clicks(clicks), written


def picture(thing: GaussianCloud, view: DrawnView, missing: np.ndarray, more: np.ndarray) -> np.ndarray:
    """(320, 320, 3) uint8: the object alone, red where it is missing, blue where it is too much."""
    drawn = render_gaussians(thing, view.camera, background=(0.7, 0.7, 0.7)).colour.numpy()
    picture = np.clip(drawn.astype(np.float32), 0.0, 1.0)
    picture[missing], picture[more] = (1.0, 0.1, 0.1), (0.1, 0.2, 1.0)
    side = min(picture.shape[:2])
    middle = np.argwhere(view.mask).mean(axis=0) if view.mask.any() else np.array(picture.shape[:2]) / 2.0
    top, left = (int(np.clip(middle[k] - side / 2, 0, picture.shape[k] - side)) for k in (0, 1))
    cropped = cv2.resize(
        np.ascontiguousarray(picture[top : top + side, left : left + side]), (320, 320), interpolation=cv2.INTER_AREA
    )
    return np.rint(255.0 * cropped).astype(np.uint8)
