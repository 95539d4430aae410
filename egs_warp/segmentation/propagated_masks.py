"""Masks in many views from a few clicks: a network segments the object where it was clicked; then the selected
Gaussians are rendered into the next view, which the network segments from that mask (as in SA3D, Cen et al. 2023)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.bitmaps import depth_inside
from egs_warp.geometry.camera import Camera, downscale
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.labels import labels_of_votes
from egs_warp.segmentation.mask_model import ClickModel, SalientModel
from egs_warp.segmentation.seen_surface import SeenSurface
from egs_warp.segmentation.selection_masks import masks_from_selection
from egs_warp.segmentation.votes import MaskedView, votes_of_masks

_SIDE = 800
"""Longer side of the segmented pictures, pixels."""
_MIN_VISIBLE_FRACTION = 0.002
"""Minimum visible part of the object, as a fraction of the picture, for a picture to be segmented."""
_PROMPTS = 3
"""Number of points inside the propagated mask with which the network is prompted."""
_MIN_COVERED_FRACTION, _MAX_AREA_RATIO = 0.5, 3.0
"""Minimum share of the propagated mask that a new mask must contain, and maximum ratio of the new mask's area to the
largest area of the earlier masks, both at the object's distance. A mask outside these limits shows another object."""
_MAX_SALIENT_FRACTION, _MIN_OVERLAP = 0.6, 0.5
"""Maximum fraction of a picture that a salient region may cover; and the minimum overlap (intersection over union) of a
mask with the consensus of all."""
_HIDDEN = 0.03
"""Distance behind the visible surface, as a fraction of the depth, beyond which a click is hidden in that view."""


def masks_of_clicks(
    cloud: GaussianCloud,
    clicks: Sequence[Click],
    cameras: Sequence[Camera],
    model: ClickModel,
    *,
    count: int = 8,
    progress: Callable[[int, int], object] = lambda done, of: None,
) -> list[MaskedView]:
    """Return masks in the clicked views and then in other well-separated ``cameras``, up to ``count`` in all.

    The pictures are renders of ``cloud``. A view whose mask contradicts the others is left out.

    Args:
        cloud: the capture.
        clicks: clicks on and beside the object.
        cameras: further views.
        model: the network.
        count: maximum number of views.
        progress: called with the number of processed views and the number of all views.

    Raises:
        UserError: no click is on the object, or the network finds nothing there.
    """
    seen: dict[int, tuple[Camera, list[Click]]] = {}
    for click in clicks:
        if click.camera is not None:
            seen.setdefault(id(click.camera), (click.camera, []))[1].append(click)
    first = [(camera, own) for camera, own in seen.values() if any(click.inside for click in own)]
    if not first:
        raise UserError("object: the network needs a click on the object; click on it in a photo")
    others = _well_apart([camera for camera, _ in first], cameras, max(0, count - len(first)))
    masks = []
    for number, (camera, own) in enumerate(first):
        progress(number, len(first) + len(others))
        picture, small = _picture(cloud, camera)
        points = np.array([click.pixel for click in own]) * (small.width / camera.width)
        mask = model.mask(picture, points, np.array([click.inside for click in own]))
        if mask.any():
            masks.append(MaskedView(small, mask, f"view {number}"))
    if not masks:
        raise UserError("object: the network finds nothing at the click; click elsewhere, or do without the network")
    other_clicks = [click for click in clicks if not click.inside]
    for number, camera in enumerate(others, start=len(first)):
        progress(number, len(first) + len(others))
        mask = _propagate_mask(cloud, masks, other_clicks, camera, model)
        if mask is not None:
            masks.append(MaskedView(*mask, f"view {number}"))
    progress(len(first) + len(others), len(first) + len(others))
    return masks


def salient_masks(
    cloud: GaussianCloud, cameras: Sequence[Camera], model: SalientModel, *, count: int = 12
) -> list[MaskedView]:
    """Return the masks of salient regions in renders of ``cloud`` through ``count`` well-separated ``cameras``.

    Views that contradict most others are left out. Raises ``UserError`` if nothing is salient.
    """
    views = []
    for number, camera in enumerate([*cameras[:1], *_well_apart(cameras[:1], cameras, count - 1)]):
        picture, small = _picture(cloud, camera)
        views.append(MaskedView(small, model.mask(picture), f"view {number}"))
    views = [view for view in views if _MIN_VISIBLE_FRACTION < view.mask.mean() < _MAX_SALIENT_FRACTION]
    if not views:
        raise UserError("object: nothing is salient in the pictures; click on the object")
    selected, _ = labels_of_votes(votes_of_masks(cloud, views))
    projected = masks_from_selection(cloud, selected, [view.camera for view in views])
    agreeing = [
        (own.mask & view.mask).sum() > _MIN_OVERLAP * (own.mask | view.mask).sum()
        for own, view in zip(projected, views, strict=True)
    ]
    return [view for view, fits in zip(views, agreeing, strict=True) if fits] or views


def _propagate_mask(
    cloud: GaussianCloud, masks: Sequence[MaskedView], other_clicks: Sequence[Click], camera: Camera, model: ClickModel
) -> tuple[Camera, np.ndarray] | None:
    """Return the camera and the mask of a further view; None if the object is hardly visible in this view or the mask
    shows another object."""
    selected, _ = labels_of_votes(votes_of_masks(cloud, masks))
    picture, small = _picture(cloud, camera)
    projected = masks_from_selection(cloud, selected, [small])[0].mask
    if projected.mean() < _MIN_VISIBLE_FRACTION:
        return None
    inside = _innermost(projected, _PROMPTS)
    outside = _in_sight(cloud, [click.point for click in other_clicks], small)
    points = np.concatenate([inside, outside])
    mask = model.mask(picture, points, np.arange(len(points)) < len(inside))
    middle = cloud.means.numpy()[selected].mean(axis=0)
    before = max(_size(one.mask, one.camera, middle) for one in masks)
    fits = (mask & projected).sum() > _MIN_COVERED_FRACTION * projected.sum() and _size(
        mask, small, middle
    ) < _MAX_AREA_RATIO * before
    return (small, mask) if fits else None


def _size(mask: np.ndarray, camera: Camera, middle: np.ndarray) -> float:
    """Return the area of ``mask`` (H, W) at the distance of ``middle`` (3,) from the camera, scene units squared."""
    return float(mask.sum()) * (float(np.linalg.norm(camera.centre - middle)) / camera.fx) ** 2


def _picture(cloud: GaussianCloud, camera: Camera) -> tuple[np.ndarray, Camera]:
    small = downscale(camera, _SIDE)
    return np.clip(render_gaussians(cloud, small).colour.numpy(), 0.0, 1.0).astype(np.float32), small


def _well_apart(chosen_before: Sequence[Camera], cameras: Sequence[Camera], count: int) -> list[Camera]:
    """Return ``count`` of ``cameras`` by farthest-point sampling. They are ordered such that each is near an earlier
    one or near one of ``chosen_before``, because a mask changes little between neighbouring views."""
    left = [camera for camera in cameras if all(camera is not one for one in chosen_before)]
    places = [camera.centre for camera in chosen_before]
    chosen: list[Camera] = []
    for _ in range(min(count, len(left))):
        away = [min(float(np.linalg.norm(camera.centre - place)) for place in places) for camera in left]
        chosen.append(left.pop(int(np.argmax(away))))
        places.append(chosen[-1].centre)
    ordered: list[Camera] = []
    near = [camera.centre for camera in chosen_before]
    while chosen:
        away = [min(float(np.linalg.norm(camera.centre - place)) for place in near) for camera in chosen]
        ordered.append(chosen.pop(int(np.argmin(away))))
        near.append(ordered[-1].centre)
    return ordered


def _innermost(mask: np.ndarray, count: int) -> np.ndarray:
    """Return at most ``count`` pixels (k, 2): the innermost point of ``mask`` (H, W), and then repeatedly the innermost
    of the remaining points. Points within twice the depth of an earlier one are excluded."""
    places = []
    depth = depth_inside(np.pad(mask, 1))[1:-1, 1:-1]
    rows, columns = np.indices(mask.shape)
    deepest = float(depth.max())
    for _ in range(count):
        row, column = np.unravel_index(int(np.argmax(depth)), depth.shape)
        if depth[row, column] <= 0.25 * deepest:
            break
        places.append((column + 0.5, row + 0.5))
        depth = np.where(np.hypot(rows - row, columns - column) < 2.0 * depth[row, column], 0.0, depth)
    return np.array(places).reshape(-1, 2)


def _in_sight(cloud: GaussianCloud, points: Sequence[np.ndarray], camera: Camera) -> np.ndarray:
    """Return the pixels (k, 2) of those ``points`` (3,) that are visible to ``camera``."""
    if not points:
        return np.zeros((0, 2))
    depth = SeenSurface.of(cloud, camera).depth
    pixels = []
    for point in points:
        x, y, z = camera.rotation @ point + camera.translation
        if z <= camera.near:
            continue
        u, v = camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z
        if 0.0 <= u < camera.width and 0.0 <= v < camera.height:
            projected = depth[int(v), int(u)]
            if projected == 0.0 or z < (1.0 + _HIDDEN) * projected:
                pixels.append((u, v))
    return np.array(pixels).reshape(-1, 2)
