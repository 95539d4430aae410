"""The planes of a scene, as the command asks for them: under the object, in a mask, and the other wide ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.commands.object_flag import read_object
from egs_warp.commands.scene_input import SceneInput
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
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.segmentation.plane_fit import PlaneView, fit_plane
from egs_warp.segmentation.plane_search import further_planes
from egs_warp.segmentation.seen_surface import SeenSurface


@dataclass(frozen=True)
class ScenePlanes:
    """What was found; scene units."""

    known: list[PlaneRecord]
    """The one that was asked for, then others."""
    centre: np.ndarray
    """(3,) of the object, or of what the masks show."""
    size: float
    notes: tuple[str, ...]

    @property
    def planes(self) -> list[Plane]:
        """The planes alone."""
        return [one.plane for one in self.known]

    def write(self, path: Path) -> None:
        """``plane.json``."""
        write_planes(path, self.known)


def planes_of_scene(given: SceneInput, *, plane_mask: str | None, view: str | None, count: int) -> ScenePlanes:
    """The plane under the object of ``given``, or in ``plane_mask``; and up to ``count`` - 1 other wide level ones.

    Raises ``UserError`` where there is none in sight.
    """
    if plane_mask is None:
        assert given.spec is not None
        located = locate_plane(given.cloud, given.spec, cameras=given.cameras, up=given.up, plane=given.plane)
        first, centre, size, notes = located.known(), located.centre, located.size, located.notes
    else:
        masks = read_object(plane_mask, given.cloud, given.posed, view=view, flag="--plane-mask").masks
        if not masks:
            raise UserError(f"--plane-mask {plane_mask}: give a mask.png or a folder of masks")
        seen = [SeenSurface.of(given.cloud, mask.camera) for mask in masks]
        fit = fit_plane([PlaneView(one.camera, one.depth, mask.mask) for one, mask in zip(seen, masks, strict=True)])
        views = [
            PlaneView(one.camera, one.depth_over(fit.plane), mask.mask) for one, mask in zip(seen, masks, strict=True)
        ]
        fit = fit_plane(views)
        points = np.concatenate(
            [
                one.camera.centre + one.depth[held][:, None] * camera_rays(one.camera)[held]
                for one in views
                for held in [one.mask & (one.depth > 0.0)]
            ]
        )
        first, centre = known_of_fit(fit), np.median(points, axis=0)
        size = 2.0 * float(np.median(np.linalg.norm(points - centre, axis=1)))
        notes = ()
    others = further_planes(given.cloud, first.plane, size, count - 1) if count > 1 else []
    known = [first, *(PlaneRecord(one.plane, support=one.support) for one in others)]
    if len(known) < count:
        notes = (*notes, f"{len(known)} of {count} planes found")
    return ScenePlanes(known, centre, size, notes)


def write_ring(run: RunFolder, cloud: GaussianCloud, plane: Plane, centre: np.ndarray, size: float) -> None:
    """``cameras.json`` and ``images/`` of a ring about the object, for a segmenter to make masks of."""
    cameras = ring_cameras(plane, centre, 0.6 * size, count=12, size=512)
    names = [f"ring{number:02d}.png" for number in range(len(cameras))]
    images = writable_folder(run.folder("images"))
    for name, camera in zip(names, cameras, strict=True):
        write_png(images / name, render_gaussians(cloud, camera).colour_srgb8())
    write_cameras(run.file("cameras.json"), cameras, names)
