"""Flags of the commands that start from a scene, and what they mean."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from egs_warp.commands.flags import check_device, parse_plane, parse_up
from egs_warp.commands.object_flag import read_object, shrunk
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io.cameras import PosedImage, read_cameras
from egs_warp.io.capture import read_capture
from egs_warp.io.planes import read_planes
from egs_warp.segmentation.object_mask import ObjectSpec

if TYPE_CHECKING:
    from egs_warp.training.finetune import TrainingView

_PHOTO_SIDE = 320
"""Pixels: enough for the few Gaussians at the object's foot."""
_MATCHING_ROUNDS, _MATCHED_PIXELS = 20, 10_000
"""Of choosing the pixels that agree, when a photo's colours are matched to the capture's, and out of how many."""
_OPAQUE = 0.98
"""Where less of the capture covers a pixel, it does not tell the photo's colours."""
_OPEN = 1e-5
"""Pull of the mixing matrix towards that of the gains alone."""


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
    def cameras(self) -> list[Camera]:
        """The capture's own."""
        return [one.camera for one in self.posed]

    def photographs(self) -> list[TrainingView]:
        """The photos beside the cameras, reduced to ``_PHOTO_SIDE`` pixels and in the capture's colours; none without
        PyTorch."""
        import cv2

        from egs_warp.pipelines.prepare_scene import has_torch
        from egs_warp.render.rasteriser import render

        if not has_torch():
            return []
        from egs_warp.training.finetune import TrainingView

        views = []
        for one in self.posed:
            picture = None if one.image is None else cv2.imread(str(one.image), cv2.IMREAD_COLOR)
            # Photos that do not fit their cameras have been replaced by something else.
            if picture is None or picture.shape[:2] != (one.camera.height, one.camera.width):
                continue
            small = shrunk(one.camera, _PHOTO_SIDE)
            reduced = cv2.resize(picture, (small.width, small.height), interpolation=cv2.INTER_AREA)
            image = render(self.cloud, small, background=(0.0, 0.0, 0.0))
            photo = reduced[..., ::-1].astype(np.float32) / 255.0
            matched = in_colours_of(np.clip(image.colour.numpy(), 0.0, 1.0), photo, image.alpha.numpy() > _OPAQUE)
            views.append(TrainingView(small, matched))
        return views


def in_colours_of(reference: np.ndarray, photo: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32: ``photo`` (H, W, 3) with the exposure and white balance of ``reference`` (H, W, 3), as the pixels
    ``shared`` (H, W) bool tell them: what is trained against it must not change colour beside what is not.

    The three channels are mixed linearly, by least squares over the three quarters that agree best; without 100 shared
    pixels nothing changes.
    """
    if shared.sum() < 100:
        return photo
    few = slice(None, None, -(-int(shared.sum()) // _MATCHED_PIXELS))
    seen, wanted = photo[shared][few], reference[shared][few]
    rows = np.column_stack([seen, np.ones(len(seen))])
    gain = np.median(wanted, axis=0) / np.maximum(np.median(seen, axis=0), 1e-3)
    plain = np.concatenate([np.diag(gain), np.zeros((1, 3))])
    mixing = plain
    for _ in range(_MATCHING_ROUNDS):
        off = np.linalg.norm(rows @ mixing - wanted, axis=1)
        agreeing = off <= np.quantile(off, 0.75)
        chosen, rest = rows[agreeing], wanted[agreeing] - rows[agreeing] @ plain
        # What few colours leave open stays with the gain of each channel.
        mixing = plain + np.linalg.solve(chosen.T @ chosen + _OPEN * len(chosen) * np.eye(4), chosen.T @ rest)
    return np.clip(photo @ mixing[:3] + mixing[3], 0.0, 1.0).astype(np.float32)


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
