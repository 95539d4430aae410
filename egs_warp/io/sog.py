"""SOG: Gaussians as pixels of WebP images, described by meta.json, in a folder or in a zip (.sog).

Public description: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog (version 2, code books)
and https://github.com/playcanvas/sogs (version 1, linear ranges). The axes of the file are kept. According to the
description, +y is up, but the authors' own tool keeps the axes of the .ply that it reads, so the up direction is
unreliable.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.io.limits import check_count, check_pixels, picture_size
from egs_warp.io.raw import BAND_4, SH_COUNTS, RawCapture, bands_note, full_bands, largest_restored, logits_from_bytes
from egs_warp.io.text import load_json

_SH_COUNTS = (*SH_COUNTS, BAND_4)
LABELS_PER_ROW = 64
_MAX_LABELS = 1 << 16
_PIXELS_PER_VALUE, _FREE_PIXELS = 2, 1 << 12
"""Maximum number of pixels of a picture: factor on the number of values, and constant."""
FIRST_TAG = 252


@dataclass(frozen=True)
class SogFiles:
    """Access to the files of one SOG, in a folder or a zip."""

    source: Path
    """Name of the capture, for messages."""
    read: Callable[[str], bytes]
    """Function that returns the bytes of a file by its name in meta.json. It raises ``UserError`` if the file is
    missing or corrupted."""

    def image(self, name: str, count: int) -> np.ndarray:
        """Return the pixels (pixels, 4) uint8 RGBA of a lossless image of ``count`` values, row by row from the top."""
        return self.image_rows(name, at_most=_PIXELS_PER_VALUE * count + _FREE_PIXELS).reshape(-1, 4)

    def image_rows(self, name: str, *, at_most: int) -> np.ndarray:
        """Return the pixels (height, width, 4) uint8 RGBA of an image of at most ``at_most`` pixels."""
        # Imported here because only this format needs it.
        from PIL import Image

        data = self.read(name)
        size = picture_size(data, f"{self.source}: {name}")
        if size is not None:
            check_pixels(*size, f"{self.source}: {name}", at_most=at_most)
        try:
            with Image.open(io.BytesIO(data)) as image:
                return np.asarray(image.convert("RGBA"))
        # The decoder reads untrusted bytes, and its errors have no common base class.
        except Exception as error:
            raise UserError(f"{self.source}: {name} is not a readable image; export the capture again") from error


class SogMeta:
    """Checked access to meta.json: every mistake becomes a ``UserError`` that names the entry."""

    def __init__(self, data: bytes, source: Path) -> None:
        self.source = source
        try:
            self.tree = load_json(data)
        except ValueError as error:
            raise UserError(f"{source}: meta.json is not readable JSON; copy or export the capture again") from error

    def entry(self, *keys: str) -> object:
        """Return the value under the nested ``keys``; None if there is none."""
        value: object = self.tree
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return value

    @property
    def antialiased(self) -> bool:
        """True if the capture was trained with antialiasing: stated by the entry ``antialias`` according to the
        description, or by the entry ``model`` as splat-transform writes it."""
        return self.entry("antialias") is True or self.entry("model") == "antialiased"

    def numbers(self, *keys: str, count: int) -> np.ndarray:
        """Return the finite numbers (count,) float64 under the nested ``keys``."""
        value = self.entry(*keys)
        values = value if isinstance(value, list) else [value]
        numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e38]
        if not len(numbers) == len(values) == count:
            raise self._wrong(*keys, expected=f"{count} finite numbers")
        return np.array(numbers, dtype=np.float64)

    def code_book(self, key: str) -> np.ndarray:
        """Return the code book (256,) float64. If its first entry is empty, as in files of an early writer, the entry
        is extrapolated."""
        book = self.entry(key, "codebook")
        if isinstance(book, list) and len(book) == 256 and book[0] is None:
            rest = SogMeta(json.dumps({key: {"codebook": book[1:]}}).encode(), self.source)
            values = rest.numbers(key, "codebook", count=255)
            return np.concatenate([[values[0] + (values[0] - values[-1]) / 255.0], values])
        return self.numbers(key, "codebook", count=256)

    def files(self, key: str, count: int) -> list[str]:
        """Return the ``count`` file names of the entry ``key``."""
        names = self.entry(key, "files")
        if not isinstance(names, list) or len(names) != count or not all(isinstance(name, str) for name in names):
            raise self._wrong(key, "files", expected=f"{count} file names")
        return names

    def integer(self, *keys: str) -> int:
        """Return the non-negative integer under the nested ``keys``."""
        value = self.entry(*keys)
        if not isinstance(value, int) or isinstance(value, bool) or value < 0:
            raise self._wrong(*keys, expected="an integer of at least 0")
        return value

    def _wrong(self, *keys: str, expected: str) -> UserError:
        return UserError(f"{self.source}: {'.'.join(keys)} in meta.json is not {expected}; export the capture again")


def decode_sog(meta_json: bytes, files: SogFiles) -> RawCapture:
    """Decode a SOG of version 1 or 2. Raises ``UserError`` if it is incomplete or malformed."""
    meta = SogMeta(meta_json, files.source)
    version = meta.integer("version") if meta.entry("version") is not None else 1
    if version not in (1, 2):
        raise UserError(f"{files.source}: SOG version {version}, expected 1 or 2; export it as version 2 or as .ply")
    count = meta.integer("count") if version == 2 else max(0, int(meta.numbers("means", "shape", count=2)[0]))

    check_count(count, sum(len(files.read(name)) for name in meta.files("means", 2)), files.source)

    def pixels(name: str) -> np.ndarray:
        values = files.image(name, count)
        if len(values) < count:
            raise UserError(
                f"{files.source}: truncated: {count} Gaussians, but {name} has {len(values)} pixels; export it again"
            )
        return values[:count]

    low, high = (pixels(name)[:, :3].astype(np.float64) for name in meta.files("means", 2))
    mins, maxs = meta.numbers("means", "mins", count=3), meta.numbers("means", "maxs", count=3)
    logs = mins + (maxs - mins) * ((low + 256.0 * high) / 65535.0)
    means = (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)
    quaternions = pixels(*meta.files("quats", 1))
    scales = pixels(*meta.files("scales", 1))[:, :3]
    colours = pixels(*meta.files("sh0", 1))
    if version == 2:
        log_scales = meta.code_book("scales")[scales]
        f_dc = meta.code_book("sh0")[colours[:, :3]]
        opacity_logits = logits_from_bytes(colours[:, 3])
    else:
        log_scales = _lerp(meta, "scales", scales)
        f_dc, opacity_logits = np.split(_lerp(meta, "sh0", colours), [3], axis=1)
        opacity_logits = opacity_logits[:, 0]
    rest = (
        _decode_rest(meta, files, version, pixels)
        if meta.entry("shN") is not None
        else np.empty((count, 0, 3), np.float32)
    )
    return RawCapture(
        format=f"SOG version {version}",
        means=means,
        rotations=_decode_quaternions(quaternions),
        log_scales=log_scales.astype(np.float32),
        opacity_logits=opacity_logits.astype(np.float32),
        sh=np.concatenate([f_dc.astype(np.float32)[:, None], rest[:, : full_bands(rest.shape[1])]], axis=1),
        antialiased=meta.antialiased,
        notes=bands_note(rest.shape[1]),
    )


def _lerp(meta: SogMeta, key: str, values: np.ndarray) -> np.ndarray:
    columns = values.shape[1]
    mins, maxs = meta.numbers(key, "mins", count=columns), meta.numbers(key, "maxs", count=columns)
    return mins + (maxs - mins) * (values / 255.0)


def _decode_quaternions(pixels: np.ndarray) -> np.ndarray:
    tags = pixels[:, 3].astype(np.int64) - FIRST_TAG
    three = (pixels[:, :3] / 255.0 * 2.0 - 1.0) / np.sqrt(2.0)
    quaternions = largest_restored(three, np.maximum(tags, 0))
    # Replace invalid rotations by the identity rotation.
    quaternions[tags < 0] = (1.0, 0.0, 0.0, 0.0)
    return quaternions


def _decode_rest(meta: SogMeta, files: SogFiles, version: int, pixels: Callable[[str], np.ndarray]) -> np.ndarray:
    """Return the SH coefficients (n, K-1, 3) above band 0.

    The file contains a palette of coefficient sets, 64 in each row of its image, and for each Gaussian an index into
    the palette.
    """
    centroids_name, labels_name = meta.files("shN", 2)
    centroids = files.image_rows(centroids_name, at_most=_MAX_LABELS * max(_SH_COUNTS))[:, :, :3]
    height, width = centroids.shape[:2]
    coefficients = width // LABELS_PER_ROW
    if version == 2:
        bands = meta.integer("shN", "bands")
        coefficients = _SH_COUNTS[bands] if bands < len(_SH_COUNTS) else -1
    if coefficients not in _SH_COUNTS or width != LABELS_PER_ROW * coefficients:
        raise UserError(
            f"{files.source}: {centroids_name} is {width} pixels wide, expected 192, 512, 960 or 1536 (SH degree"
            " 1 to 4); export the capture again"
        )
    if version == 2:
        values = meta.code_book("shN")
    else:
        low, high = meta.numbers("shN", "mins", count=1), meta.numbers("shN", "maxs", count=1)
        values = low + (high - low) * (np.arange(256) / 255.0)
    palette = centroids.reshape(height * LABELS_PER_ROW, coefficients, 3)
    label_pixels = pixels(labels_name).astype(np.int64)
    labels = label_pixels[:, 0] + 256 * label_pixels[:, 1]
    if len(labels) and labels.max() >= len(palette):
        raise UserError(
            f"{files.source}: {labels_name} refers to SH set {labels.max()} of {len(palette)}; export the capture again"
        )
    return values.astype(np.float32)[palette[labels]]
