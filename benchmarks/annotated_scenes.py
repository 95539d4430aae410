"""Hand-drawn annotations of the object and the ground in real scenes, read from ``tests/data/rooms``.

Each scene has eight views: cameras on a ring around the object, or photos of it. In each view a person drew the
object's outline by hand, before any method was run on the scene, and marked six points on the supporting surface. The
outlines are polygons, refined by GrabCut by at most five pixels towards image edges, and then checked.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.lens import Undistortion
from egs_warp.io import read_cameras
from harness import data_folder

FOLDER = Path(__file__).resolve().parents[1] / "tests" / "data" / "rooms"
NAMES = ("koala", "fox", "narcissus", "playbot", "bonsai")


@dataclass(frozen=True)
class DrawnView:
    """An annotated image, undistorted if its lens has distortion."""

    camera: Camera
    mask: np.ndarray
    """(H, W) bool, True on the object."""
    ground: np.ndarray
    """(k, 2) pixels that show the supporting surface."""
    hidden: np.ndarray | None = None
    """(H, W) bool, pixels in which something in front hides the object, which are ignored; None if there are none."""


@dataclass(frozen=True)
class DrawnScene:
    """An annotated scene with its views."""

    name: str
    capture: Path | None
    """Path of the capture; None if a capture has to be trained from photos first."""
    photos: Path | None
    """Path of the posed photos; None if the scene has only a capture."""
    views: tuple[DrawnView, ...]

    @property
    def is_here(self) -> bool:
        """True if the scene's data are available on this machine."""
        place = self.capture or self.photos
        return place is not None and place.exists()


def read_drawn(name: str) -> DrawnScene:
    """Read the annotations of the scene ``name``; ``views`` is empty if the scene's data are not available on this
    machine."""
    tree = json.loads((FOLDER / f"{name}.json").read_text())
    capture, photos = (None if tree[key] is None else data_folder() / tree[key] for key in ("capture", "photos"))
    scene = DrawnScene(name, capture, photos, ())
    if not scene.is_here:
        return scene
    posed = {Path(one.name).name: one for one in read_cameras(photos)} if photos else {}
    views = []
    for view in tree["views"]:
        mask, ground = _mask(view), np.array(view["ground"], float)
        if photos is None:
            views.append(DrawnView(_camera(view), mask, ground))
            continue
        one = posed[view["name"]]
        if one.lens is not None:
            straight = Undistortion.of(one.camera, one.lens)
            mask = straight.mask(mask)
            ground = np.array([straight.pixel(u, v) for u, v in ground])
        views.append(DrawnView(one.camera, mask, ground))
    return DrawnScene(name, capture, photos, tuple(views))


def _mask(view: dict[str, Any]) -> np.ndarray:
    """Return the mask (H, W) bool of the area within the outlines; an outline inside another one is a hole."""
    mask = np.zeros((view["height"], view["width"]), np.uint8)
    cv2.fillPoly(mask, [np.array(outline, np.int32).reshape(-1, 2) for outline in view["outline"]], 1)
    return mask > 0


def _camera(view: dict[str, Any]) -> Camera:
    width, height, rotation = view["width"], view["height"], np.array(view["rotation"], float)
    centre = np.array(view["centre"], float)
    away = float(np.linalg.norm(centre))
    return Camera(
        *(width, height, view["focal"], view["focal"], width / 2.0, height / 2.0),
        rotation=rotation,
        translation=-rotation @ centre,
        near=0.01 * away,
    )
