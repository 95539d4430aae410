"""Masks from clicks in many views: a network marks the object where it was clicked on, and what the marks so far mean
is carried into the next view and marked there anew (as SA3D, Cen et al. 2023, does).
"""

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
"""Pixels of the pictures that are marked."""
_LEAST = 0.002
"""Of a picture: where less of the object shows, it is not marked."""
_PROMPTS = 3
"""Places of what is carried that the network is told."""
_CARRIED, _LARGER = 0.5, 3.0
"""A mask that holds less of what was carried, or would be so much larger than every mask before it at the object's
distance, is of something else.
"""
_MOST, _ALIKE = 0.6, 0.5
"""Of a picture: what stands out is less than this. And by how much of both a mask and what all mean overlap."""
_HIDDEN = 0.03
"""Of the depth: a click that lies so far behind what a view shows is out of its sight."""


def masks_of_clicks(
    cloud: GaussianCloud,
    clicks: Sequence[Click],
    cameras: Sequence[Camera],
    model: ClickModel,
    *,
    count: int = 8,
    progress: Callable[[int, int], object] = lambda done, of: None,
) -> list[MaskedView]:
    """Masks in the views that were clicked in, then in others of ``cameras``, well apart, up to ``count`` in all; the
    pictures are renders of ``cloud``. ``progress`` is told how many are looked at.

    A view whose mask does not fit what the others mean is left out. Raises ``UserError`` where nothing on the object
    was clicked on, and where the network marks nothing there.
    """
    seen: dict[int, tuple[Camera, list[Click]]] = {}
    for click in clicks:
        if click.camera is not None:
            seen.setdefault(id(click.camera), (click.camera, []))[1].append(click)
    first = [(camera, own) for camera, own in seen.values() if any(click.inside for click in own)]
    if not first:
        raise UserError("object: no click on it for the network to go by; click on it in a photo")
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
        raise UserError("object: the network marks nothing where it was clicked on; click elsewhere, or leave it out")
    beside = [click for click in clicks if not click.inside]
    for number, camera in enumerate(others, start=len(first)):
        progress(number, len(first) + len(others))
        mask = _propagate_mask(cloud, masks, beside, camera, model)
        if mask is not None:
            masks.append(MaskedView(*mask, f"view {number}"))
    progress(len(first) + len(others), len(first) + len(others))
    return masks


def salient_masks(
    cloud: GaussianCloud, cameras: Sequence[Camera], model: SalientModel, *, count: int = 12
) -> list[MaskedView]:
    """What stands out of renders of ``cloud`` through ``count`` of ``cameras``, well apart; views in which that is
    something else than in most are left out. Raises ``UserError`` where nothing stands out.
    """
    views = []
    for number, camera in enumerate([*cameras[:1], *_well_apart(cameras[:1], cameras, count - 1)]):
        picture, small = _picture(cloud, camera)
        views.append(MaskedView(small, model.mask(picture), f"view {number}"))
    views = [view for view in views if _LEAST < view.mask.mean() < _MOST]
    if not views:
        raise UserError("object: nothing stands out of the pictures; click on it")
    wanted, _ = labels_of_votes(votes_of_masks(cloud, views))
    shown = masks_from_selection(cloud, wanted, [view.camera for view in views])
    alike = [
        (own.mask & view.mask).sum() > _ALIKE * (own.mask | view.mask).sum()
        for own, view in zip(shown, views, strict=True)
    ]
    return [view for view, fits in zip(views, alike, strict=True) if fits] or views


def _propagate_mask(
    cloud: GaussianCloud, masks: Sequence[MaskedView], beside: Sequence[Click], camera: Camera, model: ClickModel
) -> tuple[Camera, np.ndarray] | None:
    """The mask of a further view, and its camera; None where it would be of something else."""
    wanted, _ = labels_of_votes(votes_of_masks(cloud, masks))
    picture, small = _picture(cloud, camera)
    shown = masks_from_selection(cloud, wanted, [small])[0].mask
    if shown.mean() < _LEAST:
        return None
    inside = _innermost(shown, _PROMPTS)
    outside = _in_sight(cloud, [click.point for click in beside], small)
    points = np.concatenate([inside, outside])
    mask = model.mask(picture, points, np.arange(len(points)) < len(inside))
    middle = cloud.means.numpy()[wanted].mean(axis=0)
    before = max(_size(one.mask, one.camera, middle) for one in masks)
    fits = (mask & shown).sum() > _CARRIED * shown.sum() and _size(mask, small, middle) < _LARGER * before
    return (small, mask) if fits else None


def _size(mask: np.ndarray, camera: Camera, middle: np.ndarray) -> float:
    """Area of ``mask`` (H, W) at the distance of ``middle`` (3,), scene units squared."""
    return float(mask.sum()) * (float(np.linalg.norm(camera.centre - middle)) / camera.fx) ** 2


def _picture(cloud: GaussianCloud, camera: Camera) -> tuple[np.ndarray, Camera]:
    small = downscale(camera, _SIDE)
    return np.clip(render_gaussians(cloud, small).colour.numpy(), 0.0, 1.0).astype(np.float32), small


def _well_apart(taken: Sequence[Camera], cameras: Sequence[Camera], count: int) -> list[Camera]:
    """``count`` of ``cameras``, each the furthest from all before, then in an order of small steps from what is
    ``taken``, for what is carried changes little from one to the next.
    """
    left = [camera for camera in cameras if all(camera is not one for one in taken)]
    places = [camera.centre for camera in taken]
    chosen: list[Camera] = []
    for _ in range(min(count, len(left))):
        away = [min(float(np.linalg.norm(camera.centre - place)) for place in places) for camera in left]
        chosen.append(left.pop(int(np.argmax(away))))
        places.append(chosen[-1].centre)
    ordered: list[Camera] = []
    near = [camera.centre for camera in taken]
    while chosen:
        away = [min(float(np.linalg.norm(camera.centre - place)) for place in near) for camera in chosen]
        ordered.append(chosen.pop(int(np.argmin(away))))
        near.append(ordered[-1].centre)
    return ordered


def _innermost(mask: np.ndarray, count: int) -> np.ndarray:
    """(k, 2) pixels: the innermost place of ``mask`` (H, W), then that of what is further from it than its depth."""
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
    """(k, 2) pixels of those of the ``points`` (3,) that ``camera`` sees."""
    if not points:
        return np.zeros((0, 2))
    depth = SeenSurface.of(cloud, camera).depth
    found = []
    for point in points:
        x, y, z = camera.rotation @ point + camera.translation
        if z <= camera.near:
            continue
        u, v = camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z
        if 0.0 <= u < camera.width and 0.0 <= v < camera.height:
            shown = depth[int(v), int(u)]
            if shown == 0.0 or z < (1.0 + _HIDDEN) * shown:
                found.append((u, v))
    return np.array(found).reshape(-1, 2)
