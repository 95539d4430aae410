"""What the user says about the object on the command line: masks, a box, a point or clicks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import downscale
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.lens import Undistortion
from egs_warp.io.cameras import PosedImage
from egs_warp.io.limits import FURTHEST, check_pixels, picture_size, read_bytes
from egs_warp.segmentation.clicks import Click, click_at
from egs_warp.segmentation.mask_model import OnnxClickModel, SalientModel
from egs_warp.segmentation.object_spec import Box, ObjectSpec
from egs_warp.segmentation.propagated_masks import masks_of_clicks, salient_masks
from egs_warp.segmentation.votes import MaskedView

MAX_MASK_SIDE = 800
"""Pixels: larger masks are read at half, a third, ... of their size."""
_HELP = (
    "give a mask.png, a folder of masks, x,y,z on it, a box x0,y0,z0,x1,y1,z1, a pixel u,v with --view, or clicks "
    "+u,v@photo on it and -u,v@photo beside it"
)
_MOST_DIGITS = 10
"""Of the number of a camera."""
_SALIENT = "salient"
_CLICK = re.compile(r"([+-]?)([0-9.]+),([0-9.]+)@(.+)", re.DOTALL)


def read_object(
    texts: str | Sequence[str],
    cloud: GaussianCloud,
    posed: Sequence[PosedImage] | None,
    *,
    view: str | None = None,
    flag: str = "--object",
    mask_model: Path | None = None,
) -> ObjectSpec:
    """What ``--object TEXT`` means, given once or several times, or that of another ``flag``: a mask's file, a folder
    of masks, a point, a box, or a pixel of the view ``view``; clicks, which alone will do; or ``salient``.

    With ``mask_model``, a network's file, clicks become masks. Masks belong to the camera whose photo has the same
    name. Raises ``UserError`` with one line for anything else.
    """
    given = [texts] if isinstance(texts, str) else list(texts)
    found: list[ObjectSpec] = []
    clicks: list[Click] = []
    for text in given:
        if not text.strip():
            raise UserError(f"{flag}: nothing is given; {_HELP}")
        click = None if _is_there(text) else _CLICK.fullmatch(text)
        if click is not None:
            one = _view_named(posed or (), click[4], text)
            clicks.append(_click(cloud, one, click[2], click[3], text, inside=click[1] != "-"))
        elif not _is_there(text) and text.count(",") == 1:
            clicks.append(_pixel(text, cloud, posed, view, flag))
        elif text == _SALIENT and not _is_there(text):
            found.append(_salient(cloud, posed, flag))
        else:
            found.append(_parse_location(text, posed, view, flag))
    if len(found) > 1:
        raise UserError(
            f"{flag}: {len(found)} places, {given[0]} and others; give one, and clicks +u,v@photo beside it"
        )
    if mask_model is not None:
        if found or not clicks:
            raise UserError(f"--mask-model {mask_model}: it makes masks from clicks; give {flag} +u,v@photo alone")
        model = OnnxClickModel.read(mask_model)
        masks = masks_of_clicks(cloud, clicks, [one.camera for one in posed or ()], model)
        return ObjectSpec(masks=tuple(masks), clicks=tuple(clicks))
    return replace(found[0], clicks=tuple(clicks)) if found else ObjectSpec.of_clicks(clicks)


def _is_there(text: str) -> bool:
    try:
        return Path(text).exists()
    # A name that is too long.
    except OSError:
        return False


def _salient(cloud: GaussianCloud, posed: Sequence[PosedImage] | None, flag: str) -> ObjectSpec:
    """Masks of what stands out of the photos' pictures."""
    if not posed:
        raise UserError(f"{flag} {_SALIENT}: needs pictures to look at; give --cameras, or a point x,y,z")
    masks = salient_masks(cloud, [one.camera for one in posed], SalientModel.installed())
    return ObjectSpec(masks=tuple(masks))


def _parse_location(text: str, posed: Sequence[PosedImage] | None, view: str | None, flag: str) -> ObjectSpec:
    """Masks, a point or a box."""
    if _is_there(text):
        return ObjectSpec(masks=tuple(_read_masks(Path(text), posed, view)))
    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        raise UserError(f"{flag} {text}: no such file, nor numbers; {_HELP}") from None
    if not np.isfinite(numbers).all() or len(numbers) not in (3, 6):
        raise UserError(f"{flag} {text}: {len(numbers)} numbers; {_HELP}")
    if np.abs(numbers).max() > FURTHEST:
        raise UserError(f"{flag} {text}: further than {FURTHEST:g} units from the origin, where nothing lies; {_HELP}")
    if len(numbers) == 3:
        return ObjectSpec(point=numbers)
    low, high = np.minimum(numbers[:3], numbers[3:]), np.maximum(numbers[:3], numbers[3:])
    if (low == high).any():
        raise UserError(f"--object {text}: the box is flat; give two opposite corners")
    return ObjectSpec(box=Box(low, high))


def _pixel(text: str, cloud: GaussianCloud, posed: Sequence[PosedImage] | None, view: str | None, flag: str) -> Click:
    """A click on the object in the view ``view``."""
    u, _, v = text.lstrip("+").partition(",")
    try:
        finite = np.isfinite([float(u), float(v)]).all()
    except ValueError:
        raise UserError(f"{flag} {text}: no such file, nor numbers; {_HELP}") from None
    if not finite:
        raise UserError(f"{flag} {text}: not two numbers; {_HELP}")
    if not posed:
        raise UserError(f"--object {text}: a pixel needs cameras; give --cameras, or a point x,y,z")
    return _click(cloud, _view_named(posed, view, text), u, v, text, inside=True)


def _click(cloud: GaussianCloud, one: PosedImage, u: str, v: str, text: str, *, inside: bool) -> Click:
    camera = one.camera
    try:
        x, y = float(u), float(v)
    except ValueError:
        raise UserError(f"--object {text}: {u},{v} is no pixel; {_HELP}") from None
    if one.lens is not None:
        x, y = Undistortion.of(camera, one.lens).pixel(x, y)
    if not (0.0 <= x < camera.width and 0.0 <= y < camera.height):
        raise UserError(f"--object {text}: outside of the view's {camera.width} x {camera.height} pixels")
    found = click_at(cloud, camera, x, y, inside=inside)
    if found is None:
        raise UserError(f"--object {text}: the capture shows nothing there; click on what is meant")
    return found


def _view_named(posed: Sequence[PosedImage], view: str | None, what: str) -> PosedImage:
    if not posed:
        raise UserError(f"--object {what}: a pixel needs cameras; give --cameras, or a point x,y,z")
    if view is None:
        if len(posed) == 1:
            return posed[0]
        raise UserError(f"--object {what}: {len(posed)} cameras; say which with --view NAME or NUMBER")
    # Digits of other scripts, and thousands of them, are no number of a camera.
    if view.isdecimal() and len(view) < _MOST_DIGITS and int(view) < len(posed):
        return posed[int(view)]
    for one in posed:
        if view in (one.name, Path(one.name).name, Path(one.name).stem):
            return one
    names = ", ".join(Path(one.name).name for one in posed[:3])
    asked = f"--object {what}" if what.endswith(f"@{view}") else f"--view {view}"
    raise UserError(f"{asked}: no such camera; there are {len(posed)}: {names}, ...")


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
            mask = Undistortion.of(camera, one.lens).mask(mask)
        small = downscale(camera, MAX_MASK_SIDE)
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
