"""Reading of photos in all file formats, and their undistortion to photos of pinhole cameras."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.lens import Undistortion
from egs_warp.io.limits import MAX_PIXELS, check_pixels, picture_size
from egs_warp.io.orientation import apply_orientation, orientation
from egs_warp.io.photo_files import UNREADABLE_SUFFIXES
from egs_warp.io.posed_images import PosedImage

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

_PNG = b"\x89PNG\r\n\x1a\n"
_CHUNK = 12
"""Number of bytes of a PNG chunk beyond its content."""
_MAX_SIDE_RATIO = 16
"""Maximum ratio of the side of a photo to the side of its camera's image."""
MAX_MASK_RATIO = _MAX_SIDE_RATIO**2
"""Maximum ratio of the number of pixels of a mask to the number of pixels of its camera's image."""
_MAX_FLOAT = 1.1
"""Maximum value of a picture of floating-point numbers, which ranges from 0 to 1 except for overshoot of filters."""
_ORIENTATION_TAG, _EXTRA_SAMPLES_TAG = 274, 338
_SAME_ASPECT = 0.01
"""Maximum relative difference between the aspect ratios of a photo and its camera if the photo is a scaled image of the
camera."""


@dataclass(frozen=True)
class Photo:
    """A photo, undistorted and with the orientation of its camera."""

    camera: Camera
    """The camera, scaled to the size of the photo."""
    colour: np.ndarray
    """(H, W, 3) float32, 0 to 1, display-referred."""
    alpha: np.ndarray | None
    """(H, W) float32, alpha of the photo or of its mask, or the minimum of both; None if there is neither."""
    known: np.ndarray | None
    """(H, W) bool, False for pixels of the undistorted photo that lie outside the view of the lens; None if there are
    none."""
    is_opaque: bool = False
    """True if the photo has an alpha channel that is opaque everywhere. It is ignored in ``alpha``, because many
    programs write such a channel into ordinary photos."""


def read_photo(posed: PosedImage, *, max_side: int | None = None, is_mask_inverted: bool = False) -> Photo:
    """Read the photo of ``posed``, downscaled to at most ``max_side`` pixels.

    The EXIF orientation is applied only if the pixels would not fit the camera otherwise. The alpha is the minimum of
    the photo's own alpha, unless it is opaque everywhere, and of the mask. White is opaque in a mask; with
    ``is_mask_inverted``, black is. Raises ``UserError`` for a photo that is missing, unreadable or does not fit its
    camera.
    """
    if posed.image is None:
        raise UserError(f"{posed.name}: {posed.missing or 'the photo is not beside the poses; put it there'}")
    size = picture_size(posed.image, f"{posed.image}: it")
    if size is not None:
        # Check the size before decoding, because a small file may contain a very large picture.
        limit = _MAX_SIDE_RATIO**2 * posed.camera.width * posed.camera.height
        check_pixels(*size, f"{posed.image}: it", at_most=min(limit, MAX_PIXELS))
        _orientation_to_fit(posed, size[::-1])
    pixels = decoded(posed.image)
    turn = _orientation_to_fit(posed, pixels.shape[:2])
    shape = pixels.shape[:2]
    pixels = apply_orientation(pixels, turn)
    values = np.atleast_3d(_fractions(pixels, posed.image))
    colour = values[:, :, :3][:, :, ::-1] if values.shape[2] >= 3 else np.repeat(values[:, :, :1], 3, axis=2)
    colour = np.ascontiguousarray(colour)
    alpha = values[:, :, 3] if values.shape[2] == 4 else None
    is_opaque = alpha is not None and alpha.min() >= 1.0
    alpha = None if is_opaque else alpha
    if posed.mask is not None:
        mask = _oriented_mask(posed.mask, shape, turn)
        mask = 1.0 - mask if is_mask_inverted else mask
        alpha = mask if alpha is None else np.minimum(alpha, mask)
    camera = at_size(posed.camera, colour.shape[1], colour.shape[0])
    known = None
    if posed.lens is not None:
        straight = Undistortion.of(camera, posed.lens)
        colour = straight.picture(colour)
        alpha = None if alpha is None else straight.picture(np.ascontiguousarray(alpha))
        known = None if straight.known.all() else straight.known
    side = max(camera.width, camera.height)
    if max_side is not None and side > max_side:
        width, height = (max(1, round(s * max_side / side)) for s in (camera.width, camera.height))
        camera = at_size(camera, width, height)
        cover = None if alpha is None and known is None else np.ones(colour.shape[:2], np.float32)
        if cover is not None:
            # Weight colours by coverage: transparent and unknown pixels may have any colour, which must not bleed into
            # others.
            cover = cover * (1.0 if alpha is None else alpha) * (1.0 if known is None else known)
            reduced = cv2.resize(cover, (width, height), interpolation=cv2.INTER_AREA)
            colour = cv2.resize(colour * cover[:, :, None], (width, height), interpolation=cv2.INTER_AREA)
            colour = colour / np.maximum(reduced, 1e-6)[:, :, None]
        else:
            colour = cv2.resize(colour, (width, height), interpolation=cv2.INTER_AREA)
        if alpha is not None:
            alpha = cv2.resize(alpha, (width, height), interpolation=cv2.INTER_AREA)
        if known is not None:
            known = cv2.resize(known.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.5
    return Photo(camera, np.ascontiguousarray(colour, dtype=np.float32), alpha, known, is_opaque)


def _fractions(pixels: np.ndarray, image: Path) -> np.ndarray:
    """Return ``pixels`` from 0 to 1. Raises ``UserError`` if the range of their type is unknown."""
    full = {"uint8": 255.0, "uint16": 65535.0, "float32": 1.0, "float64": 1.0}.get(pixels.dtype.name)
    if full is None or not pixels.max() <= _MAX_FLOAT * full:
        raise UserError(
            f"{image}: its values are of the type {pixels.dtype.name} and reach {pixels.max():g}; save it with 8 or 16"
            " bits per channel"
        )
    return np.clip(np.asarray(pixels, dtype=np.float32) / np.float32(full), 0.0, 1.0)


def at_size(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera for its photo at another size. Often the poses were determined for the original photos, but the
    image files are downscaled."""
    x, y = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=camera.cx * x,
        cy=camera.cy * y,
    )


def decoded(image: Path) -> np.ndarray:
    """Return the pixels (H, W) or (H, W, C) of a picture as stored: BGR, not rotated. Raises ``UserError`` if it is
    damaged."""
    from PIL import Image

    if image.suffix.lower() in UNREADABLE_SUFFIXES:
        raise UserError(f"{image}: HEIC is not read; convert the photos to JPEG, and keep their names")
    size = picture_size(image, f"{image}: it")
    if size is not None:
        check_pixels(*size, f"{image}: it")
    pixels = _pixels(image, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise UserError(f"{image}: not a readable picture; export it again as PNG or JPEG")
    if image.suffix.lower() in (".jpg", ".jpeg"):
        try:
            # Pillow reports an error for a truncated JPEG, whose missing pixels OpenCV would fill with grey.
            with Image.open(image) as opened:
                opened.load()
        except Exception as error:
            raise UserError(f"{image}: the picture is cut short; copy it again") from error
    return pixels


def _pixels(image: Path, flags: int) -> np.ndarray | None:
    """Decode a file with OpenCV; return None if OpenCV cannot decode it.

    OpenCV allocates the size that a PNG chunk declares, so the sizes of chunks are checked first.
    """
    with open(image, "rb") as file:
        left = os.fstat(file.fileno()).st_size - len(_PNG)
        start = file.read(len(_PNG))
        if start[:4] in (b"II*\0", b"MM\0*"):
            return cv2.imdecode(np.frombuffer(_plain_tiff(start + file.read()), np.uint8), flags)
        if start == _PNG:
            while len(start := file.read(8)) == 8:
                length = int.from_bytes(start[:4], "big")
                left -= _CHUNK + length
                if left < 0:
                    raise UserError(f"{image}: the picture is cut short; copy it again")
                if start[4:] == b"IEND":
                    break
                file.seek(length + 4, os.SEEK_CUR)
    return cv2.imread(str(image), flags)


def _plain_tiff(data: bytes) -> bytes:
    """Return a TIFF without orientation, and with its alpha declared as associated, so that OpenCV returns the values
    as stored. OpenCV would rotate the picture or fail, and multiply colours by an unassociated alpha."""
    order, plain = "<" if data[:2] == b"II" else ">", bytearray(data)
    try:
        (start,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, start)
        for place in range(start + 2, start + 2 + 12 * count, 12):
            tag, _kind, _count, value = struct.unpack_from(f"{order}HHIH", data, place)
            if tag == _ORIENTATION_TAG or (tag, value) == (_EXTRA_SAMPLES_TAG, 2):
                struct.pack_into(f"{order}H", plain, place + 8, 1)
    except struct.error:
        # The decoder reports that the file is damaged.
        return data
    return bytes(plain)


def _orientation_to_fit(posed: PosedImage, shape: tuple[int, ...]) -> int:
    """Return the EXIF orientation to apply. Raises ``UserError`` if the photo does not fit its camera in either
    orientation."""
    assert posed.image is not None
    camera, (height, width) = posed.camera, shape
    if _same_aspect(camera, width, height):
        return 1
    turn = orientation(posed.image)
    if turn >= 5 and _same_aspect(camera, height, width):
        return turn
    raise UserError(
        f"{posed.image}: the photo has {width} x {height} pixels, but its camera has {camera.width} x {camera.height};"
        " use the photos that the poses were made from"
    )


def _same_aspect(camera: Camera, width: int, height: int) -> bool:
    return _is_scaled((camera.width, camera.height), (width, height))


def _is_scaled(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return True if two pictures have the same aspect ratio."""
    return abs(other[0] / size[0] / (other[1] / size[1]) - 1) <= _SAME_ASPECT


def _oriented_mask(path: Path, shape: tuple[int, ...], turn: int) -> np.ndarray:
    """Return the mask (H, W) float32 of a photo.

    Args:
        path: file of the mask. A mask of another size is scaled.
        shape: height and width of the photo as stored.
        turn: EXIF orientation that has been applied to the photo.
    """
    height, width = shape
    size = picture_size(path, f"{path}: it")
    if size is None:
        raise UserError(f"{path}: not a readable picture; export the mask again")
    is_stored = _is_scaled((width, height), size)
    if not is_stored and not (turn >= 5 and _is_scaled((height, width), size)):
        raise UserError(
            f"{path}: the mask has {size[0]} x {size[1]} pixels, but its photo has {width} x {height}; make the"
            " mask from the same"
            " photo"
        )
    mask = read_mask_file(path, at_most=min(MAX_MASK_RATIO * width * height, MAX_PIXELS))
    target = (width, height) if is_stored else (height, width)
    if mask.shape != target[::-1]:
        is_larger = mask.size > width * height
        mask = cv2.resize(mask, target, interpolation=cv2.INTER_AREA if is_larger else cv2.INTER_LINEAR)
    # Rotate the mask like the photo, if it was drawn on the photo as stored.
    return apply_orientation(mask, turn) if is_stored else mask


def read_mask_file(path: Path, *, at_most: int = MAX_PIXELS) -> np.ndarray:
    """Return a mask (H, W) float32 from 0 to 1 as stored: its alpha channel if that is not opaque everywhere, otherwise
    the values of ``palette_mask`` or its grey values.

    Raises ``UserError`` if the file is not a readable picture, or has more than ``at_most`` pixels.
    """
    from PIL import Image

    size = picture_size(path, f"{path}: it")
    if size is not None:
        check_pixels(*size, f"{path}: it", at_most=at_most)
    pixels = None
    try:
        with Image.open(path) as opened:
            if "A" in opened.getbands() or "transparency" in opened.info:
                pixels = np.asarray(opened.convert("RGBA"))[:, :, 3]
            if pixels is None or pixels.min() == pixels.max():
                pixels = palette_mask(opened)
    # The decoder reads untrusted bytes, and its errors have no common base class.
    except Exception as error:
        raise UserError(f"{path}: not a readable picture; export the mask again") from error
    if pixels is None:
        pixels = _pixels(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise UserError(f"{path}: not a readable picture; export the mask again")
    # Label masks contain only the values 0 and 1, or black and the colour of the label.
    levels = np.flatnonzero(np.bincount(pixels.ravel(), minlength=256))
    is_label = levels[-1] == 1 or (len(levels) == 2 and levels[0] == 0)
    return pixels.astype(np.float32) / (float(levels[-1]) if is_label else 255.0)


def palette_mask(picture: Picture) -> np.ndarray | None:
    """Return the mask (H, W) uint8, 0 to 255, of a picture with a palette of colours; None for other pictures.

    Black is the background, and the brightest channel is the value of the other colours, so that labels of all hues
    count. If no pixel is black, the first colour of the palette is the background.
    """
    if picture.mode != "P":
        return None
    colours = np.asarray(picture.convert("RGB"))
    if not np.ptp(colours, axis=2).any():
        return None
    brightest = colours.max(axis=2)
    if brightest.min() > 0:
        return np.where(np.asarray(picture) > 0, np.uint8(255), np.uint8(0))
    return np.rint(brightest * (255.0 / brightest.max())).astype(np.uint8)
