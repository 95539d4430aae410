"""What the flags of the commands that start from a scene mean."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from egs_warp.commands.flags import parse_plane, parse_up
from egs_warp.commands.object_flag import read_object
from egs_warp.commands.scene_flags import start_device
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.io.cameras import PosedImage, read_cameras
from egs_warp.io.capture import read_capture
from egs_warp.io.planes import read_planes
from egs_warp.segmentation.object_spec import ObjectSpec

if TYPE_CHECKING:
    from egs_warp.pipelines.prepare_scene import PreparedScene, SceneOptions


@dataclass(frozen=True)
class SceneInput:
    """What the user has given."""

    cloud: GaussianCloud
    posed: Sequence[PosedImage]
    spec: ObjectSpec | None
    up: np.ndarray | None
    plane: Plane | None
    notes: tuple[str, ...]

    @property
    def object(self) -> ObjectSpec:
        """What was said about it. Raises ``UserError`` if nothing was."""
        if self.spec is None:
            raise UserError("--object: nothing is given; say where the object is")
        return self.spec

    @property
    def cameras(self) -> list[Camera]:
        """The capture's own."""
        return [one.camera for one in self.posed]

    def prepared(self, options: SceneOptions) -> PreparedScene:
        """Taken apart, fine-tuned against the photos beside the cameras where there are any: ``prepare_scene``, with a
        bar.
        """
        from egs_warp.pipelines.prepare_scene import prepare_scene
        from egs_warp.pipelines.progress import scene_bar
        from egs_warp.training.photo_colours import photographs_in_colours_of

        with scene_bar(options.stages) as told:
            return prepare_scene(
                self.cloud,
                self.object,
                cameras=self.cameras,
                photographs=photographs_in_colours_of(self.cloud, self.posed),
                up=self.up,
                plane=self.plane,
                options=options,
                progress=told,
            )


def plane_of(text: str) -> Plane:
    """The first plane of a file, or one of four numbers. Raises ``UserError`` otherwise."""
    if text.endswith(".json") or Path(text).is_file():
        return read_planes(text)[0].plane
    return parse_plane(text)


def ground_of(text: str | None, *, flat: bool) -> HeightField | None:
    """The ground that is not flat of the first plane of a file, if it tells of one and ``flat`` does not forbid it."""
    if flat or text is None or not (text.endswith(".json") or Path(text).is_file()):
        return None
    return read_planes(text)[0].ground


def read_scene(chosen: argparse.Namespace) -> SceneInput:
    """Read what the flags name. Raises ``UserError`` with one line for whatever is wrong."""
    start_device(chosen.device)
    up = parse_up(chosen.up) if chosen.up is not None else None
    plane = plane_of(chosen.plane) if chosen.plane is not None else None
    capture = read_capture(chosen.capture, device=chosen.device)
    posed = read_cameras(chosen.cameras) if chosen.cameras else []
    spec = None
    if chosen.object is None and chosen.mask_model is not None:
        raise UserError("--mask-model: it makes masks from clicks; give --object +u,v@photo")
    if chosen.object is not None:
        spec = read_object(chosen.object, capture.cloud, posed, view=chosen.view, mask_model=chosen.mask_model)
    if up is None and capture.up is not None:
        up = np.asarray(capture.up, dtype=float)
    return SceneInput(capture.cloud, posed, spec, up, plane, capture.notes)
