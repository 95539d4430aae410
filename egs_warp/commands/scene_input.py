"""Read the scene that the flags describe: capture, cameras, object, plane and up direction."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from egs_warp.commands.flags import names_plane_file, parse_plane, parse_up
from egs_warp.commands.scene_flags import print_note, start_device
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.main_light import MainLight
from egs_warp.geometry.plane import Plane
from egs_warp.io.cameras import PosedImage, read_posed_images
from egs_warp.io.capture import read_capture
from egs_warp.io.planes import read_planes
from egs_warp.pipelines.object_selection import SelectionNames, picked_object, read_object
from egs_warp.segmentation.object_spec import ObjectSpec

if TYPE_CHECKING:
    from egs_warp.pipelines.prepare_scene import PreparedScene, SceneOptions

SELECTION_FLAGS = SelectionNames("--object", "--cameras", "--view", "--mask-model")
"""Flags that select an object, for messages."""
_MAX_REST = 0.05
"""Maximum share of a capture's total opacity outside the object for the object to count as the whole capture. For an
object on a white desk or a turntable, the share of the haze after a short training run is 0.01 to 0.03."""


@dataclass(frozen=True)
class SceneInput:
    """Scene with the user's selections, in scene units."""

    cloud: GaussianCloud
    """The whole scene, with the metadata of its file (``Capture``)."""
    posed: Sequence[PosedImage]
    """Cameras of ``--cameras`` with their photos; empty without that flag."""
    spec: ObjectSpec | None
    """Selection of ``--object``; None without that flag."""
    up: np.ndarray | None
    """(3,) unit vector, from ``--up``; None without that flag."""
    plane: Plane | None
    """Plane of ``--plane``, or of a picked object; None to estimate it."""
    notes: tuple[str, ...]
    """Notes for the user about the files that were read."""
    front: np.ndarray | None = None
    """(3,) facing direction of a picked object; None to estimate it."""

    @property
    def object(self) -> ObjectSpec:
        """Selection of the object. Raises ``UserError`` without ``--object``."""
        if self.spec is None:
            raise UserError("--object: the value is missing; select the object of the scene")
        return self.spec

    @cached_property
    def object_alone(self) -> GaussianCloud | None:
        """The picked object if it is nearly the whole capture, so that there is no scene from which to separate it.

        The rest is haze, and is left out: it hides nothing, but would move with the object, or remain as its ghost.
        None if the rest is a scene.
        """
        if self.spec is None or self.spec.picked is None:
            return None
        opacities = self.cloud.opacities()
        is_alone = float(opacities[~self.spec.picked].sum()) < _MAX_REST * float(opacities.sum())
        return self.cloud.subset(self.spec.picked) if is_alone else None

    @property
    def cameras(self) -> list[Camera]:
        """The cameras of ``posed``, without their photos."""
        return [one.camera for one in self.posed]

    def prepared(
        self, options: SceneOptions, *, begin_stage: Callable[[str], object] = lambda stage: None
    ) -> PreparedScene:
        """Prepare the scene with ``prepare_scene`` and show a progress bar, or read the result from the cache
        (``egs_warp.pipelines.scene_cache``).

        The fine-tuning uses photos next to the cameras, if there are any. ``begin_stage`` is called with the name of
        each stage as it starts.
        """
        from egs_warp.pipelines.prepare_scene import prepare_scene
        from egs_warp.pipelines.progress import scene_bar
        from egs_warp.pipelines.scene_cache import cache_folder, read_scene, scene_key, write_scene
        from egs_warp.training.photo_colours import photographs_in_colours_of

        key = scene_key(self.cloud, self.object, posed=self.posed, up=self.up, plane=self.plane, options=options)
        scene = read_scene(key)
        if scene is not None:
            print_note(f"reading the prepared scene from {cache_folder()}")
            return scene
        with scene_bar(options.costs(self.cloud.count)) as bar:

            def progress(stage: str, done: float) -> None:
                bar.update(stage, done)
                if done == 0.0:
                    begin_stage(stage)

            scene = prepare_scene(
                self.cloud,
                self.object,
                cameras=self.cameras,
                photographs=photographs_in_colours_of(self.cloud, self.posed),
                up=self.up,
                plane=self.plane,
                options=options,
                progress=progress,
                expect_costs=bar.expect,
            )
        note = write_scene(key, scene)
        if note is not None:
            print_note(note)
        return scene


def plane_of(text: str) -> Plane:
    """Return the first plane of a plane.json, or the plane ``nx,ny,nz,d``. Raises ``UserError`` for other texts."""
    if names_plane_file(text):
        return read_planes(text)[0].plane
    return parse_plane(text)


def ground_of(text: str | None, *, flat: bool) -> HeightField | None:
    """Return the uneven ground of the first plane of a plane.json; None if it has none or ``flat`` is True."""
    if flat or text is None or not names_plane_file(text):
        return None
    return read_planes(text)[0].ground


def light_of(text: str | None) -> MainLight | None:
    """Return the main light of the first plane of a plane.json; None if it has none."""
    if text is None or not names_plane_file(text):
        return None
    return read_planes(text)[0].light


def read_scene(args: argparse.Namespace) -> SceneInput:
    """Select the device and read the files that the flags name. Raises ``UserError`` for invalid flags and files."""
    start_device(args.device)
    up = parse_up(args.up) if args.up is not None else None
    plane = plane_of(args.plane) if args.plane is not None else None
    capture = read_capture(args.capture, device=args.device)
    poses = read_posed_images(args.cameras).relative_to(capture.origin) if args.cameras else None
    posed = poses.images if poses is not None else ()
    spec, front = None, None
    if args.object is None and args.mask_model is not None:
        raise UserError("--mask-model: it needs clicks; give --object +u,v@photo")
    picked = picked_object(args.object or (), capture.cloud, names=SELECTION_FLAGS)
    if picked is not None:
        if args.mask_model is not None:
            raise UserError("--mask-model: it needs clicks, but --object is a picked object; leave --mask-model out")
        spec, front = ObjectSpec(picked=picked.gaussians), picked.front
        plane = picked.plane.plane if plane is None and up is None else plane
    elif args.object is not None:
        spec = read_object(
            args.object, capture.cloud, posed, view=args.view, names=SELECTION_FLAGS, mask_model=args.mask_model
        )
    notes = capture.notes
    if poses is not None:
        notes = (*notes, *poses.messages)
    return SceneInput(capture, posed, spec, up, plane, notes, front)
