"""What the user says about the object on the command line: masks, a box, a point or a click."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera, camera_rays, shrunk
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.lens import Straightening
from egs_warp.io.cameras import PosedImage
from egs_warp.io.limits import check_pixels, picture_size, read_bytes
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.segmentation.object_mask import Box, ObjectSpec
from egs_warp.segmentation.votes import MaskedView

MAX_MASK_SIDE = 800
"""Pixels: larger masks are read at half, a third, ... of their size."""
_HELP = "give a mask.png, a folder of masks, x,y,z on it, a box x0,y0,z0,x1,y1,z1, or a pixel u,v with --view"


def read_object(
    text: str,
    cloud: GaussianCloud,
    posed: Sequence[PosedImage] | None,
    *,
    view: str | None = None,
    flag: str = "--object",
) -> ObjectSpec:
    """What ``--object text`` means, or that of another ``flag``: a mask's file, a folder of masks, a point, a box, or a
    pixel of the view ``view``.

    Masks belong to the camera whose photo has the same name. Raises ``UserError`` with one line for anything else.
    """
    if not text.strip():
        raise UserError(f"{flag}: nothing is given; {_HELP}")
    if Path(text).exists():
        return ObjectSpec(masks=tuple(_read_masks(Path(text), posed, view)))
    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        raise UserError(f"{flag} {text}: no such file, nor numbers; {_HELP}") from None
    if not np.isfinite(numbers).all() or len(numbers) not in (2, 3, 6):
        raise UserError(f"{flag} {text}: {len(numbers)} numbers; {_HELP}")
    if len(numbers) == 3:
        return ObjectSpec(point=numbers)
    if len(numbers) == 6:
        low, high = np.minimum(numbers[:3], numbers[3:]), np.maximum(numbers[:3], numbers[3:])
        if (low == high).any():
            raise UserError(f"--object {text}: the box is flat; give two opposite corners")
        return ObjectSpec(box=Box(low, high))
    if not posed:
        raise UserError(f"--object {text}: a pixel needs cameras; give --cameras, or a point x,y,z")
    one = _view_named(posed, view, text)
    u, v = float(numbers[0]), float(numbers[1])
    if one.lens is not None:
        u, v = Straightening.of(one.camera, one.lens).pixel(u, v)
    return ObjectSpec(point=point_at(cloud, one.camera, u, v))


def point_at(cloud: GaussianCloud, camera: Camera, u: float, v: float) -> np.ndarray:
    """(3,) what pixel (u, v), from the top left corner, shows. Raises ``UserError`` where it shows nothing."""
    if not (0.0 <= u < camera.width and 0.0 <= v < camera.height):
        raise UserError(f"--object {u:g},{v:g}: outside of the view's {camera.width} x {camera.height} pixels")
    small = shrunk(camera, MAX_MASK_SIDE)
    column, row = int(u * small.width / camera.width), int(v * small.height / camera.height)
    image = render_gaussians(cloud, small)
    if image.alpha.numpy()[row, column] < 0.5:
        raise UserError(f"--object {u:g},{v:g}: the capture shows nothing there; click on the object")
    return small.centre + float(image.depth.numpy()[row, column]) * camera_rays(small)[row, column]


def _view_named(posed: Sequence[PosedImage], view: str | None, what: str) -> PosedImage:
    if view is None:
        if len(posed) == 1:
            return posed[0]
        raise UserError(f"--object {what}: {len(posed)} cameras; say which with --view NAME or NUMBER")
    if view.isdigit() and int(view) < len(posed):
        return posed[int(view)]
    for one in posed:
        if view in (one.name, Path(one.name).name, Path(one.name).stem):
            return one
    names = ", ".join(Path(one.name).name for one in posed[:3])
    raise UserError(f"--view {view}: no such camera; there are {len(posed)}: {names}, ...")


def _read_masks(path: Path, posed: Sequence[PosedImage] | None, view: str | None) -> list[MaskedView]:
    files = sorted(path.glob("*.png")) if path.is_dir() else [path]
    if not files:
        raise UserError(f"--object {path}: no .png in this folder; {_HELP}")
    if not posed:
        raise UserError(
            f"--object {path}: a mask needs the camera that it was drawn in; give --cameras, or a point or box"
        )
    masks = []
    for file in files:
        one = _camera_of(file, posed, view if len(files) == 1 else None)
        camera = one.camera
        size = mask_size(file)
        # Before it is decoded: a small file may hold a very large picture.
        if size != (camera.width, camera.height):
            raise UserError(
                f"{file}: the mask is {size[0]} x {size[1]} pixels, the photo {one.name} "
                f"{camera.width} x {camera.height}; make it at the photo's size"
            )
        mask = read_mask(file)
        if one.lens is not None:
            # Drawn on the photo as the lens bent it.
            mask = Straightening.of(camera, one.lens).mask(mask)
        small = shrunk(camera, MAX_MASK_SIDE)
        factor = camera.width // small.width
        # The middle pixel of each block; a mask's edge is not known better than that.
        mask = mask[factor // 2 :: factor, factor // 2 :: factor][: small.height, : small.width]
        masks.append(MaskedView(small, mask, str(file)))
    return masks


def _camera_of(file: Path, posed: Sequence[PosedImage], view: str | None) -> PosedImage:
    if view is not None:
        return _view_named(posed, view, str(file))
    stems = [(Path(one.name).stem, one) for one in posed]
    for stem, one in stems:
        if stem == file.stem:
            return one
    # Segmenters add to the photo's name: IMG_01_mask.png, IMG_01.jpg.png.
    longer = [(stem, one) for stem, one in stems if stem and file.stem.startswith(stem)]
    if longer:
        return max(longer, key=lambda entry: len(entry[0]))[1]
    if len(posed) == 1:
        return posed[0]
    raise UserError(
        f"{file}: no camera's photo is called {file.stem} (there are {stems[0][0]}, {stems[-1][0]}, ...); "
        "rename the mask, or say which with --view"
    )


def mask_size(path: Path) -> tuple[int, int]:
    """Width and height of a mask's file, not decoded. Raises ``UserError`` for what is no picture."""
    size = picture_size(read_bytes(path), f"{path}: it")
    if size is None:
        raise UserError(f"{path}: not a readable picture; give a mask as PNG")
    check_pixels(*size, f"{path}: it")
    return size


def read_mask(path: Path) -> np.ndarray:
    """(H, W) bool of a mask's file: its alpha where it has one, else the brighter half of its values.

    Raises ``UserError`` for what is no picture.
    """
    from PIL import Image

    mask_size(path)
    try:
        with Image.open(path) as opened:
            picture = opened if opened.mode in ("P", "1", "L", "I", "I;16", "F") else opened.convert("RGBA")
            values = np.array(picture)
    # The decoder is handed a stranger's bytes, and its errors share no base class.
    except Exception as error:
        raise UserError(f"{path}: not a readable picture; give a mask as PNG") from error
    if values.ndim == 3:
        values = values[..., 3] if np.ptp(values[..., 3]) > 0 else values[..., :3].sum(axis=2, dtype=np.uint16)
    return values > 0.5 * values.max() if values.max() > 0 else np.zeros(values.shape, bool)
