"""Photos with poses, read as views to train on.

Imports torch through ``egs_warp.training.finetune``, so import it only where something is trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.io.cameras import read_cameras
from egs_warp.training.finetune import TrainingView


def read_views(posed: Path | str, *, max_side: int | None = None) -> list[TrainingView]:
    """Photos and cameras; photos larger than ``max_side`` pixels are reduced.

    Alpha is the photo's own or, as COLMAP has it, that of ``masks/PHOTO.png`` (or ``masks/`` with the photo's own name)
    beside the photos' folder: white is kept. Raises ``UserError`` for a photo or mask that is unreadable or of another
    shape than its camera, and for a missing photo.
    """
    views = []
    for entry in read_cameras(posed):
        if entry.image is None:
            raise UserError(f"{posed}: the photo {entry.name} is not beside the poses; put the images there")
        pixels = cv2.imread(str(entry.image), cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise UserError(f"{entry.image}: not a readable picture; export it again as PNG or JPEG")
        full = {"uint8": 255.0, "uint16": 65535.0}.get(pixels.dtype.name, 1.0)
        values = np.atleast_3d(np.asarray(pixels, dtype=np.float32)) / full
        colour = values[:, :, :3][:, :, ::-1] if values.shape[2] >= 3 else np.repeat(values[:, :, :1], 3, axis=2)
        alpha = values[:, :, 3] if values.shape[2] == 4 else _mask_of(entry.image, entry.name, colour.shape[:2])
        camera = _scaled(entry.camera, colour.shape[1], colour.shape[0], entry.image)
        side = max(camera.width, camera.height)
        if max_side is not None and side > max_side:
            width, height = (max(1, round(s * max_side / side)) for s in (camera.width, camera.height))
            if alpha is not None:
                # Transparent pixels hold any colour: it must not bleed into their neighbours.
                colour = cv2.resize(colour * alpha[:, :, None], (width, height), interpolation=cv2.INTER_AREA)
                alpha = cv2.resize(alpha, (width, height), interpolation=cv2.INTER_AREA)
                colour = colour / np.maximum(alpha, 1e-6)[:, :, None]
            else:
                colour = cv2.resize(colour, (width, height), interpolation=cv2.INTER_AREA)
            camera = _scaled(camera, width, height, entry.image, exact=False)
        image = np.ascontiguousarray(colour, dtype=np.float32)
        views.append(TrainingView(camera, image, alpha, name=entry.name))
    return views


def _mask_of(image: Path, name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """(H, W) float32 from the photo's mask file, if there is one."""
    # COLMAP's names may hold folders, which the masks repeat.
    depth = min(len(Path(name).parts), len(image.parents) - 1)
    relative = image.relative_to(image.parents[depth - 1])
    places = (
        place
        for folder, file in ((image.parents[depth] / "masks", relative), (image.parent.parent / "masks", image.name))
        for place in (folder / f"{file}.png", (folder / file).with_suffix(".png"), folder / file)
    )
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        return None
    pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise UserError(f"{path}: not a readable picture; export the mask again")
    if pixels.shape != shape:
        raise UserError(
            f"{path}: {pixels.shape[1]} x {pixels.shape[0]} pixels, but its photo has {shape[1]} x {shape[0]};"
            " make the mask from the same photo"
        )
    return pixels.astype(np.float32) / 255.0


def laid_over(view: TrainingView, background: tuple[float, float, float]) -> TrainingView:
    """``view`` without alpha, its picture over one colour."""
    if view.alpha is None:
        return view
    alpha = view.alpha[:, :, None]
    behind = np.asarray(background, dtype=np.float32)
    return replace(view, image=view.image * alpha + (1 - alpha) * behind, alpha=None)


def backdrop_colour(views: Sequence[TrainingView]) -> tuple[float, float, float]:
    """White for photos with alpha; else the mean colour along the borders of all photos."""
    if any(view.alpha is not None for view in views):
        return (1.0, 1.0, 1.0)
    rims = []
    for view in views:
        image = view.image
        rims.append(np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]).mean(axis=0))
    red, green, blue = np.mean(rims, axis=0).tolist()
    return (red, green, blue)


def _scaled(camera: Camera, width: int, height: int, image: Path, *, exact: bool = True) -> Camera:
    """The camera for its photo at another size; poses are often of the full photo and images reduced."""
    x, y = width / camera.width, height / camera.height
    if exact and abs(x / y - 1) > 0.01:
        raise UserError(
            f"{image}: {width} x {height} pixels, but its camera has {camera.width} x {camera.height};"
            " use the photos that the poses were made from"
        )
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=camera.cx * x,
        cy=camera.cy * y,
    )
