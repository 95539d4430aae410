"""Plane search of ``egs-warp plane``: the plane under the object or in a mask, then other wide planes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egs_warp.commands.scene_input import SELECTION_FLAGS, SceneInput
from egs_warp.errors import UserError
from egs_warp.geometry.camera import camera_rays
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io.atomic import writable_folder
from egs_warp.io.cameras import write_cameras
from egs_warp.io.planes import PlaneRecord, write_planes
from egs_warp.io.run_folder import RunFolder
from egs_warp.io.video import write_png
from egs_warp.pipelines.locate_plane import known_of_fit, locate_plane
from egs_warp.pipelines.object_selection import read_object
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.segmentation.plane_fit import PlaneView, fit_plane
from egs_warp.segmentation.plane_search import further_planes
from egs_warp.segmentation.seen_surface import SeenSurface


@dataclass(frozen=True)
class ScenePlanes:
    """Planes of a scene, in scene units."""

    known: list[PlaneRecord]
    """The requested plane, followed by the others."""
    centre: np.ndarray
    """(3,) centre of the object, or of the masked ground."""
    size: float
    """Size of the object, or of the masked ground."""
    notes: tuple[str, ...]
    """Notes for the user."""

    @property
    def planes(self) -> list[Plane]:
        """The planes of ``known``, in the same order."""
        return [one.plane for one in self.known]

    def write(self, path: Path) -> None:
        """Write the planes as ``plane.json``."""
        write_planes(path, self.known)


def planes_of_scene(scene: SceneInput, *, plane_mask: str | None, view: str | None, count: int) -> ScenePlanes:
    """Find the requested plane and up to ``count`` - 1 other wide planes parallel to it.

    Args:
        scene: the scene; without ``plane_mask`` it must contain the selection of an object.
        plane_mask: mask file or folder of masks to which the plane is fitted; None for the plane under the object.
        view: name or number of the camera of a single mask.
        count: maximum number of planes, at least 1.

    Raises:
        UserError: if no plane is visible, or ``plane_mask`` is not a mask.
    """
    if plane_mask is None:
        assert scene.spec is not None
        located = locate_plane(scene.cloud, scene.spec, cameras=scene.cameras, up=scene.up, plane=scene.plane)
        first, centre, size, notes = located.known(), located.centre, located.size, located.notes
    else:
        masks = read_object(
            plane_mask, scene.cloud, scene.posed, view=view, names=replace(SELECTION_FLAGS, object="--plane-mask")
        ).masks
        if not masks:
            raise UserError(f"--plane-mask {plane_mask}: give a mask.png or a folder of masks")
        seen = [SeenSurface.of(scene.cloud, mask.camera) for mask in masks]
        fit = fit_plane([PlaneView(one.camera, one.depth, mask.mask) for one, mask in zip(seen, masks, strict=True)])
        views = [
            PlaneView(one.camera, one.depth_over(fit.plane), mask.mask) for one, mask in zip(seen, masks, strict=True)
        ]
        fit = fit_plane(views)
        points = np.concatenate(
            [
                one.camera.centre + one.depth[valid][:, None] * camera_rays(one.camera)[valid]
                for one in views
                for valid in [one.mask & (one.depth > 0.0)]
            ]
        )
        first, centre = known_of_fit(fit), np.median(points, axis=0)
        size = 2.0 * float(np.median(np.linalg.norm(points - centre, axis=1)))
        notes = ()
    others = further_planes(scene.cloud, first.plane, size, count - 1) if count > 1 else []
    known = [first, *(PlaneRecord(one.plane, support=one.support) for one in others)]
    if len(known) < count:
        notes = (*notes, f"found {len(known)} of {count} planes")
    return ScenePlanes(known, centre, size, notes)


def write_ring(run: RunFolder, cloud: GaussianCloud, plane: Plane, centre: np.ndarray, size: float) -> None:
    """Write ``cameras.json`` and ``images/`` of a ring of cameras around the object, on which masks can be drawn."""
    cameras = ring_cameras(plane, centre, 0.6 * size, count=12, size=512)
    names = [f"ring{number:02d}.png" for number in range(len(cameras))]
    images = writable_folder(run.folder("images"))
    for name, camera in zip(names, cameras, strict=True):
        write_png(images / name, render_gaussians(cloud, camera).colour_srgb8())
    write_cameras(run.file("cameras.json"), cameras, names)
