"""Parsing of the values that select an object of a scene: masks, a box, a point, a pixel or clicks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError, did_you_mean
from egs_warp.geometry.camera import downscale
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.lens import Undistortion
from egs_warp.io.cameras import PosedImage
from egs_warp.io.limits import MAX_COORDINATE, check_pixels, picture_size, read_bytes
from egs_warp.io.photo_files import photo_stem, stems_of_mask
from egs_warp.io.photos import palette_mask
from egs_warp.io.picked import PickedObject, read_picked
from egs_warp.segmentation.clicks import Click, click_at
from egs_warp.segmentation.mask_model import OnnxClickModel, SalientModel
from egs_warp.segmentation.object_spec import Box, ObjectSpec
from egs_warp.segmentation.propagated_masks import masks_of_clicks, salient_masks
from egs_warp.segmentation.votes import MaskedView

MAX_MASK_SIDE = 800
"""Maximum side of a mask, pixels; larger masks are downscaled by a whole factor."""
_MAX_DIGITS = 10
"""Maximum length of a camera number."""
_SALIENT = "salient"
"""Value that selects the salient object in each photo."""
_CLICK = re.compile(r"([+-]?)([0-9.]+),([0-9.]+)@(.+)", re.DOTALL)
"""Pattern of a click: sign, u, v and photo."""
_PICKED = re.compile(r"(.+\.json)(?::(.+))?", re.DOTALL | re.IGNORECASE)
"""Pattern of the name of a file of ``egs-warp pick`` and, optionally, the name of an object in the file."""


@dataclass(frozen=True)
class SelectionNames:
    """Names of the arguments in messages: those of the library, or the flags of a command."""

    object: str = "object"
    cameras: str = "cameras"
    view: str = "view"
    mask_model: str = "mask_model"

    @property
    def help(self) -> str:
        """Accepted forms of a selection, for messages."""
        return (
            "give a mask.png, a folder of masks, a picked.json, a point x,y,z, a box x0,y0,z0,x1,y1,z1, a pixel u,v"
            f" with {self.view}, or clicks +u,v@photo on the object and -u,v@photo next to it"
        )


def read_object(
    texts: str | Sequence[str],
    cloud: GaussianCloud,
    posed: Sequence[PosedImage] | None,
    *,
    view: str | None = None,
    names: SelectionNames | None = None,
    mask_model: Path | None = None,
) -> ObjectSpec:
    """Parse the selection of an object.

    A value is a mask file, a folder of masks, a point, a box, a pixel, a click or ``salient``. Clicks may be combined
    with one value of another kind. A mask belongs to the camera whose photo has the same name.

    Args:
        texts: the values, in their order.
        cloud: the capture, in which pixels and clicks are located.
        posed: cameras of the capture; None if there are none.
        view: name or number of the camera of a single mask or of a pixel; a name takes precedence.
        names: names of the arguments for messages; None uses those of the library.
        mask_model: file of a network that turns clicks into masks; None uses the clicks themselves.

    Raises:
        UserError: for values of another form, and for cameras that are missing or unknown.
    """
    names = names or SelectionNames()
    values = [texts] if isinstance(texts, str) else list(texts)
    specs: list[ObjectSpec] = []
    clicks: list[Click] = []
    for text in values:
        if not text.strip():
            raise UserError(f"{names.object}: the value is empty; {names.help}")
        click = None if _path_exists(text) else _CLICK.fullmatch(text)
        if click is not None:
            one = _view_named(posed or (), click[4], text, names)
            clicks.append(_click(cloud, one, click[2], click[3], text, names, inside=click[1] != "-"))
        elif not _path_exists(text) and text.count(",") == 1:
            clicks.append(_pixel(text, cloud, posed, view, names))
        elif text == _SALIENT and not _path_exists(text):
            specs.append(_salient(cloud, posed, names))
        else:
            specs.append(_parse_location(text, posed, view, names))
    if len(specs) > 1:
        raise UserError(
            f"{names.object}: {len(specs)} objects are given, {values[0]} and others; give one, and correct it"
            " with clicks"
            " +u,v@photo"
        )
    if mask_model is not None:
        if specs or not clicks:
            raise UserError(
                f"{names.mask_model} {mask_model}: it needs clicks and no other object; give only"
                f" {names.object} +u,v@photo"
            )
        model = OnnxClickModel.read(mask_model)
        masks = masks_of_clicks(cloud, clicks, [one.camera for one in posed or ()], model)
        return ObjectSpec(masks=tuple(masks), clicks=tuple(clicks))
    return replace(specs[0], clicks=tuple(clicks)) if specs else ObjectSpec.of_clicks(clicks)


def picked_object(
    texts: Sequence[str], cloud: GaussianCloud, *, names: SelectionNames | None = None
) -> PickedObject | None:
    """Return the object of the value ``picked.json`` or ``picked.json:NAME``; None for other values.

    Raises ``UserError`` for a damaged file, an unknown name, and if there are further values.
    """
    for text in texts:
        match = _PICKED.fullmatch(text)
        if match is None:
            continue
        if len(texts) > 1:
            what = (names or SelectionNames()).object
            raise UserError(f"{what}: {text} is a whole object; give no other value")
        return read_picked(match[1], cloud).named(match[2], match[1])
    return None


def _path_exists(text: str) -> bool:
    """Return True if ``text`` is the path of an existing file or folder."""
    try:
        return Path(text).exists()
    # This error is raised if the text is too long for a path.
    except OSError:
        return False


def _salient(cloud: GaussianCloud, posed: Sequence[PosedImage] | None, names: SelectionNames) -> ObjectSpec:
    """Return masks of the salient object in the photos."""
    if not posed:
        raise UserError(f"{names.object} {_SALIENT}: needs cameras; give {names.cameras}, or a point x,y,z")
    masks = salient_masks(cloud, [one.camera for one in posed], SalientModel.installed())
    return ObjectSpec(masks=tuple(masks))


def _parse_location(
    text: str, posed: Sequence[PosedImage] | None, view: str | None, names: SelectionNames
) -> ObjectSpec:
    """Parse a mask path, a point or a box."""
    if _path_exists(text):
        return ObjectSpec(masks=tuple(_read_masks(Path(text), posed, view, names)))
    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        if "," not in text and (Path(text).suffix or len(Path(text).parts) > 1):
            raise UserError(f"{names.object} {text}: no such file or folder; check the path") from None
        raise UserError(f"{names.object} {text}: this is neither a file nor numbers; {names.help}") from None
    if not np.isfinite(numbers).all() or len(numbers) not in (3, 6):
        raise UserError(f"{names.object} {text}: these are not three or six finite numbers; {names.help}")
    if np.abs(numbers).max() > MAX_COORDINATE:
        raise UserError(f"{names.object} {text}: further than {MAX_COORDINATE:g} units from the origin; {names.help}")
    if len(numbers) == 3:
        return ObjectSpec(point=numbers)
    low, high = np.minimum(numbers[:3], numbers[3:]), np.maximum(numbers[:3], numbers[3:])
    if (low == high).any():
        raise UserError(f"{names.object} {text}: the box is flat; give two opposite corners")
    return ObjectSpec(box=Box(low, high))


def _pixel(
    text: str, cloud: GaussianCloud, posed: Sequence[PosedImage] | None, view: str | None, names: SelectionNames
) -> Click:
    """Parse a pixel ``u,v`` as a click on the object in ``view``."""
    u, _, v = text.lstrip("+").partition(",")
    try:
        finite = np.isfinite([float(u), float(v)]).all()
    except ValueError:
        raise UserError(f"{names.object} {text}: this is neither a file nor numbers; {names.help}") from None
    if not finite:
        raise UserError(f"{names.object} {text}: these are not two numbers; {names.help}")
    if not posed:
        raise UserError(f"{names.object} {text}: a pixel needs cameras; give {names.cameras}, or a point x,y,z")
    return _click(cloud, _view_named(posed, view, text, names), u, v, text, names, inside=True)


def _click(
    cloud: GaussianCloud, one: PosedImage, u: str, v: str, text: str, names: SelectionNames, *, inside: bool
) -> Click:
    """Locate a click on the capture; ``inside`` is True for a click on the object."""
    camera = one.camera
    try:
        x, y = float(u), float(v)
    except ValueError:
        raise UserError(f"{names.object} {text}: {u},{v} is not a pixel; {names.help}") from None
    if one.lens is not None:
        x, y = Undistortion.of(camera, one.lens).pixel(x, y)
    if not (0.0 <= x < camera.width and 0.0 <= y < camera.height):
        raise UserError(
            f"{names.object} {text}: outside of the {camera.width} x {camera.height} pixels of the view; give a pixel"
            " inside"
        )
    click = click_at(cloud, camera, x, y, inside=inside)
    if click is None:
        raise UserError(f"{names.object} {text}: no Gaussian is visible at this pixel; click on the object")
    return replace(click, text=text)


def _view_named(posed: Sequence[PosedImage], view: str | None, what: str, names: SelectionNames) -> PosedImage:
    """Return the camera with the name ``view``, or else with this number; ``what`` is the text of the selection, for
    messages."""
    if not posed:
        raise UserError(f"{names.object} {what}: a pixel needs cameras; give {names.cameras}, or a point x,y,z")
    if view is None:
        if len(posed) == 1:
            return posed[0]
        raise UserError(
            f"{names.object} {what}: there are {len(posed)} cameras; choose one with {names.view} NAME or NUMBER"
        )
    value = f"{names.object} {what}" if what.endswith(f"@{view}") else f"{names.view} {view}"
    exact = [one for one in posed if view == one.name]
    if exact:
        return exact[0]
    found = [one for one in posed if view in (Path(one.name).name, Path(one.name).stem, photo_stem(one.name))]
    if found:
        return _only(found, value)
    # int() fails for superscript digits, which isdecimal excludes, and for thousands of digits, which the limit
    # excludes.
    if view.isdecimal() and len(view) < _MAX_DIGITS and int(view) < len(posed):
        return posed[int(view)]
    photos = [Path(one.name).name for one in posed]
    raise UserError(
        f"{value}: no such camera{did_you_mean(view, photos)}; the {len(posed)} cameras are"
        f" {', '.join(photos[:3])}, ..."
    )


def _only(candidates: Sequence[PosedImage], what: str) -> PosedImage:
    """Return the only one of the ``candidates``. Raises ``UserError``, whose message begins with ``what``, for several
    of them."""
    if len(candidates) > 1:
        photos = ", ".join([*(one.name for one in candidates[:2]), *(["..."] if len(candidates) > 2 else [])])
        raise UserError(f"{what}: {len(candidates)} photos have this name, {photos}; give one of these names")
    return candidates[0]


def _read_masks(
    path: Path, posed: Sequence[PosedImage] | None, view: str | None, names: SelectionNames
) -> list[MaskedView]:
    """Read a mask file or a folder of masks, undistorted and reduced to at most ``MAX_MASK_SIDE`` pixels."""
    files = [path]
    if path.is_dir():
        files = sorted(one for one in path.iterdir() if one.suffix.lower() == ".png" and not one.name.startswith("."))
    if not files:
        raise UserError(f"{names.object} {path}: this folder has no .png; {names.help}")
    if not posed:
        raise UserError(f"{names.object} {path}: a mask needs its camera; give {names.cameras}, or a point or box")
    masks = []
    for file in files:
        one = _camera_of(file, posed, view if len(files) == 1 else None, names)
        camera = one.camera
        size = mask_size(file)
        # Check the size before decoding, because a small file can contain a very large image.
        if size != (camera.width, camera.height):
            raise UserError(
                f"{file}: the mask has {size[0]} x {size[1]} pixels, but the photo {one.name} has {camera.width} x"
                f" {camera.height}; give a mask of the photo's size"
            )
        mask = read_mask(file)
        if one.lens is not None:
            # The mask was drawn on the distorted photo.
            mask = Undistortion.of(camera, one.lens).mask(mask)
        small = downscale(camera, MAX_MASK_SIDE)
        factor = camera.width // small.width
        # Use the middle pixel of each block; this is as accurate as the edges of masks are.
        mask = mask[factor // 2 :: factor, factor // 2 :: factor][: small.height, : small.width]
        masks.append(MaskedView(small, mask, str(file)))
    return masks


def _camera_of(file: Path, posed: Sequence[PosedImage], view: str | None, names: SelectionNames) -> PosedImage:
    """Return the camera of a mask file: the camera ``view`` if it is given, otherwise the camera whose photo has a
    matching name, or else the only camera."""
    if view is not None:
        return _view_named(posed, view, str(file), names)
    stems = [(photo_stem(one.name), one) for one in posed]
    for mask_stem in stems_of_mask(file.name):
        fitting = [one for stem, one in stems if stem == mask_stem]
        if fitting:
            return _only(fitting, f"{file}")
    if len(posed) == 1:
        return posed[0]
    raise UserError(
        f"{file}: no photo has the name {file.stem} (photos are {stems[0][0]}, {stems[-1][0]}, ...); "
        f"rename the mask, or choose its camera with {names.view}"
    )


def mask_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of a mask file without decoding it. Raises ``UserError`` if it is not an image."""
    size = picture_size(read_bytes(path), f"{path}: it")
    if size is None:
        raise UserError(f"{path}: not a readable picture; give a mask as PNG")
    check_pixels(*size, f"{path}: it")
    return size


def read_mask(path: Path) -> np.ndarray:
    """Read a mask file as (H, W) bool: the values above half of the maximum of its alpha channel, if that is not
    constant, otherwise of ``palette_mask`` or of the sum of its colours.

    Raises ``UserError`` if it is not an image.
    """
    from PIL import Image

    mask_size(path)
    try:
        with Image.open(path) as opened:
            picture = opened if opened.mode in ("1", "L", "I", "I;16", "F") else opened.convert("RGBA")
            values = np.array(picture)
            if values.ndim == 3 and not np.ptp(values[..., 3]):
                palette = palette_mask(opened)
                values = values if palette is None else palette
    # The decoder reads untrusted bytes, and its errors have no common base class.
    except Exception as error:
        raise UserError(f"{path}: not a readable picture; give a mask as PNG") from error
    if values.ndim == 3:
        values = values[..., 3] if np.ptp(values[..., 3]) > 0 else values[..., :3].sum(axis=2, dtype=np.uint16)
    return values > 0.5 * values.max() if values.max() > 0 else np.zeros(values.shape, bool)
