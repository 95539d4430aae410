"""Selection of video frames to use as photos: sharp, and evenly spread over time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from egs_warp.errors import UserError

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp")
_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")
_MARKS = (b"\x1a\x45\xdf\xa3", b"RIFF")
_SHARPNESS_SIDE = 480
"""Longer side in pixels to which a frame is downscaled before its sharpness is measured; in the downscaled frame, noise
contributes less than edges."""


@dataclass(frozen=True)
class Frame:
    """One frame of a video."""

    number: int
    """Index of the frame, from 0."""
    pixels: np.ndarray
    """(H, W, 3) uint8, BGR, upright."""
    sharpness: float
    """Variance of the Laplacian of the downscaled frame."""


def select_sharp_frames(video: Path, count: int) -> Iterator[Frame]:
    """Yield the sharpest frame of each of ``count`` equal parts of the ``video``; all frames if it has at most
    ``count``.

    Raises ``UserError`` for a file that is not a video.
    """
    _check(video)
    length = _length(video)
    parts = min(count, length)
    best: Frame | None = None
    part = 0
    for number, pixels in enumerate(_frames(video)):
        if number * parts // length > part and part < parts - 1:
            if best is not None:
                yield best
            part, best = part + 1, None
        sharpness = _sharpness(pixels)
        if best is None or sharpness > best.sharpness:
            best = Frame(number, pixels, sharpness)
    if best is not None:
        yield best


def _check(video: Path) -> None:
    """Raise ``UserError`` if the first bytes are not those of a video: a playlist, for example, could refer to other
    files and addresses."""
    if not video.is_file():
        raise UserError(f"{video}: no such file; give a video or a folder of photos")
    try:
        with open(video, "rb") as file:
            start = file.read(12)
    except OSError as error:
        raise UserError(f"{video}: cannot be read ({error.strerror}); check the path") from error
    # QuickTime and MPEG-4 begin with a size and a name, Matroska and RIFF with a magic number, transport streams with
    # the letter G.
    if not (start[4:8] in _BOXES or start[:4] in _MARKS or start[:1] == b"G" or start[4:5] == b"G"):
        raise UserError(f"{video}: not a readable video; give an .mp4 or .mov, or a folder of photos")


def _frames(video: Path) -> Iterator[np.ndarray]:
    reader = cv2.VideoCapture(str(video))
    try:
        while True:
            ok, pixels = reader.read()
            if not ok:
                return
            yield pixels
    finally:
        reader.release()


def _length(video: Path) -> int:
    """Return the number of frames by counting them, because the header may be wrong."""
    reader = cv2.VideoCapture(str(video))
    try:
        length = 0
        while reader.grab():
            length += 1
    finally:
        reader.release()
    if length == 0:
        raise UserError(f"{video}: not a readable video; give an .mp4 or .mov, or a folder of photos")
    return length


def _sharpness(pixels: np.ndarray) -> float:
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    factor = _SHARPNESS_SIDE / max(grey.shape)
    if factor < 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())
