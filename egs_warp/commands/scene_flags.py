"""Flags of the commands that start from a scene, and what they mean."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.commands.flags import check_device, parse_plane, parse_up
from egs_warp.commands.object_flag import read_object
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io.cameras import PosedImage, read_cameras
from egs_warp.io.capture import read_capture
from egs_warp.io.planes import read_planes
from egs_warp.segmentation.object_mask import ObjectSpec


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


def add_object_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say where the object is."""
    parser.add_argument(
        "--object",
        help="mask.png, folder of masks, point x,y,z, box x0,y0,z0,x1,y1,z1, or pixel u,v of --view",
    )
    parser.add_argument(
        "--cameras", type=Path, help="cameras.json, transforms.json or COLMAP model; else a ring is used"
    )
    parser.add_argument("--view", help="name or number of the camera that a mask or pixel belongs to")


def add_scene_flags(parser: argparse.ArgumentParser) -> None:
    """Add everything that the commands before the animation share."""
    parser.add_argument("capture", help=".ply, compressed .ply, .spz, .splat, .sog or an unbundled SOG folder")
    add_object_flags(parser)
    parser.add_argument("--out", required=True, type=Path, help="folder for the result and its picture")
    parser.add_argument(
        "--up", help="axis that points roughly up: x, y, z or with a minus, as --up=-y; else it is guessed"
    )
    parser.add_argument("--plane", help="plane.json of an earlier step, or nx,ny,nz,d; else it is found")
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")


def plane_of(text: str) -> Plane:
    """The first plane of a file, or one of four numbers. Raises ``UserError`` otherwise."""
    if text.endswith(".json") or Path(text).is_file():
        return read_planes(text)[0]
    return parse_plane(text)


def read_scene(chosen: argparse.Namespace) -> SceneInput:
    """Read what the flags name. Raises ``UserError`` with one line for whatever is wrong."""
    check_device(chosen.device)
    up = parse_up(chosen.up) if chosen.up is not None else None
    plane = plane_of(chosen.plane) if chosen.plane is not None else None
    capture = read_capture(chosen.capture, device=chosen.device)
    posed = read_cameras(chosen.cameras) if chosen.cameras else []
    notes = list(capture.notes)
    if capture.infinite_opacities:
        notes.append(f"{capture.infinite_opacities} infinite opacities were read as 0 or 1")
    spec = read_object(chosen.object, capture.cloud, posed, view=chosen.view) if chosen.object is not None else None
    if up is None and capture.up is not None:
        up = np.asarray(capture.up, dtype=float)
    return SceneInput(capture.cloud, posed, spec, up, plane, tuple(notes))


def say(text: str) -> None:
    """A line for the user, beside the command's output."""
    print(f"egs-warp: {text}", file=sys.stderr)
