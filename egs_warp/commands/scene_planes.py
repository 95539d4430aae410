"""The planes of a scene, as the command asks for them: under the object, in a mask, and the other wide ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.commands.object_flag import read_object
from egs_warp.commands.scene_flags import SceneInput
from egs_warp.errors import UserError
from egs_warp.geometry.bitmaps import connected_parts
from egs_warp.geometry.camera_ring import ring_cameras, write_cameras
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.inpainting.rectified import near_plane
from egs_warp.io.atomic import writable_folder
from egs_warp.io.planes import write_planes
from egs_warp.io.video import write_png
from egs_warp.pipelines.prepare_scene import locate_plane
from egs_warp.render.rasteriser import render
from egs_warp.segmentation.object_mask import lies_along
from egs_warp.segmentation.plane_fit import PlaneView, camera_rays, fit_plane
from egs_warp.segmentation.plane_search import FoundPlane, find_planes

_MIN_SUPPORT = 0.005
"""Of the visible surface that lies level: less is no plane but an accident."""
_CELL = 0.1
"""Of the object's size: cells of the grid on which a plane must be one patch."""
_COVERED = 0.3
"""Of a cell, for it to be part of the patch."""


@dataclass(frozen=True)
class ScenePlanes:
    """What was found; scene units."""

    planes: list[Plane]
    """The one that was asked for, then others."""
    facts: list[Mapping[str, object]]
    centre: np.ndarray
    """(3,) of the object, or of what the masks show."""
    size: float
    notes: tuple[str, ...]

    def write(self, path: Path) -> None:
        """``plane.json``."""
        write_planes(path, self.planes, facts=self.facts)


def planes_of_scene(given: SceneInput, *, plane_mask: str | None, view: str | None, count: int) -> ScenePlanes:
    """The plane under the object of ``given``, or in ``plane_mask``; and up to ``count`` - 1 other wide level ones.

    Raises ``UserError`` where there is none in sight.
    """
    if plane_mask is None:
        assert given.spec is not None
        located = locate_plane(given.cloud, given.spec, cameras=given.cameras, up=given.up, plane=given.plane)
        plane, centre, size, notes = located.plane, located.centre, located.size, located.notes
        facts: dict[str, object] = located.facts()
    else:
        masks = read_object(plane_mask, given.cloud, given.posed, view=view).masks
        if not masks:
            raise UserError(f"--plane-mask {plane_mask}: give a mask.png or a folder of masks")
        views = [
            PlaneView(mask.camera, np.where(image.alpha.numpy() > 0.5, image.depth.numpy(), 0.0), mask.mask)
            for mask in masks
            for image in [render(given.cloud, mask.camera)]
        ]
        fit = fit_plane(views)
        points = np.concatenate(
            [
                one.camera.centre + one.depth[held][:, None] * camera_rays(one.camera)[held]
                for one in views
                for held in [one.mask & (one.depth > 0.0)]
            ]
        )
        plane, centre = fit.plane, np.median(points, axis=0)
        size = 2.0 * float(np.median(np.linalg.norm(points - centre, axis=1)))
        notes = ()
        facts = {"noise": fit.noise, "inlier_share": fit.inlier_share, "pixels": fit.pixel_count}
    others = _further(given.cloud, plane, size, count - 1) if count > 1 else []
    planes = [plane, *(one.plane for one in others)]
    if len(planes) < count:
        notes = (*notes, f"{len(planes)} of {count} planes found")
    return ScenePlanes(planes, [facts, *({"support": one.support} for one in others)], centre, size, notes)


def _further(cloud: GaussianCloud, plane: Plane, size: float, count: int) -> list[FoundPlane]:
    """At most ``count`` other planes level with ``plane``, widest first."""
    # Without this, slices of walls and of the object count, too.
    lying = lies_along(cloud, plane)
    if not lying.any():
        return []
    level = cloud.subset(lying)
    return [
        one
        for one in find_planes(level, plane.normal, count=count + 4, tilt_degrees=5.0)
        if one.support > _MIN_SUPPORT
        and _differ(one.plane, plane, size)
        and _is_one_patch(level, one.plane, _CELL * size)
    ][:count]


def _is_one_patch(level: GaussianCloud, plane: Plane, cell: float) -> bool:
    """Whether one patch of well covered cells (scene units) holds most of what lies near ``plane``."""
    near = level.subset(near_plane(level, plane, 0.5 * cell))
    flat = near.means.numpy() @ np.stack(plane.tangents(), axis=1)
    area = near.opacities() * np.exp(np.sort(near.log_scales.numpy(), axis=1)[:, 1:].sum(axis=1))
    place = np.floor((flat - flat.min(axis=0)) / cell).astype(int)
    cover = np.zeros(place.max(axis=0) + 1)
    np.add.at(cover, tuple(place.T), area / cell**2)
    parts, _ = connected_parts(cover > _COVERED)
    return bool(np.bincount(parts.ravel(), cover.ravel())[1:].max(initial=0.0) > 0.5 * cover.sum())


def _differ(a: Plane, b: Plane, size: float) -> bool:
    apart = abs(float(a.offset / (a.normal @ b.normal) - b.offset))
    return bool(a.normal @ b.normal < np.cos(np.radians(5.0)) or apart > 0.05 * size)


def write_ring(folder: Path, cloud: GaussianCloud, plane: Plane, centre: np.ndarray, size: float) -> None:
    """``cameras.json`` and ``images/`` of a ring about the object, for a segmenter to make masks of."""
    cameras = ring_cameras(plane, centre, 0.6 * size, count=12, size=512)
    names = [f"ring{number:02d}.png" for number in range(len(cameras))]
    images = writable_folder(folder / "images")
    for name, camera in zip(names, cameras, strict=True):
        write_png(images / name, render(cloud, camera).colour_srgb8())
    write_cameras(folder / "cameras.json", cameras, names)
