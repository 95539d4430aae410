"""Limits for untrusted files, checked before memory is allocated.

The sizes that a file declares (Gaussians, pixels, inflated bytes) are compared with the size of the file and with the
limits of this module; docs/reliability.md lists them.
"""

from __future__ import annotations

import difflib
import io
import os
import stat
import warnings
from pathlib import Path

from egs_warp.errors import UserError, did_you_mean

MAX_TEXT_BYTES = 32 << 20
"""Maximum size of JSON and other text in bytes; once parsed, it takes about thirty times as much memory."""
MAX_PIXELS = 178_956_970
"""Maximum number of pixels of a picture or camera, which is Pillow's limit."""
MAX_SIDE = 1 << 15
"""Maximum side of a picture or camera, pixels."""


MAX_COORDINATE = 1e12
"""Maximum coordinate, scene units."""
MIN_LOG_SCALE = -100.0
"""Minimum logarithm of a standard deviation, whose exponential is nearly 0 in single precision."""
FREE_GAUSSIANS = 1 << 16
"""Number of Gaussians that a packed capture may declare regardless of its size."""
INFLATION = 4
"""Maximum ratio of inflated to packed bytes of a picture in a zip, beyond ``FREE_BYTES``. It is small, because WebP is
hardly compressible."""
FREE_BYTES = 1 << 16
_WIDTH_TAG, _HEIGHT_TAG = 256, 257
"""TIFF tags of the size as stored."""


def check_count(count: int, size: int, source: Path) -> None:
    """Raise ``UserError`` for more Gaussians than a packed file of ``size`` bytes can contain, because each position
    needs at least one byte."""
    if count > size + FREE_GAUSSIANS:
        raise UserError(
            f"{source}: it declares {count} Gaussians, more than its {size} bytes can hold; copy or export it again"
        )


def check_pixels(width: int, height: int, what: str, *, at_most: int = MAX_PIXELS) -> None:
    """Raise ``UserError`` for a picture or camera with too many pixels; the message begins with ``what``."""
    if max(width, height) > MAX_SIDE or width * height > at_most:
        raise UserError(
            f"{what} has {width} x {height} pixels; the limits are {MAX_SIDE} a side and {at_most} in all; make it"
            " smaller"
        )


def picture_size(data: bytes | Path, what: str) -> tuple[int, int] | None:
    """Return width and height as stored, from the header of a picture; None if Pillow does not recognise it.

    Raises ``UserError``, whose message begins with ``what``, for too many pixels.
    """
    from PIL import Image, TiffImagePlugin

    # Pillow would print a warning for large pictures below this limit.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(io.BytesIO(data) if isinstance(data, bytes) else data) as image:
                # For a TIFF, Pillow gives the size after the rotation by its orientation.
                if isinstance(image, TiffImagePlugin.TiffImageFile):
                    return image.tag_v2[_WIDTH_TAG], image.tag_v2[_HEIGHT_TAG]
                return image.size
        except Image.DecompressionBombError:
            raise UserError(f"{what} has more than {MAX_PIXELS} pixels; make it smaller") from None
        # The decoder reads untrusted bytes, and its errors have no common base class.
        except Exception:
            return None


def read_bytes(path: Path | str, *, at_most: int | None = None, missing: str = "check the path") -> bytes:
    """Return the content of a regular file. Raises ``UserError`` for anything else, such as a pipe or a device, whose
    content may be endless.

    Args:
        path: the file.
        at_most: maximum size in bytes.
        missing: advice in the message if there is no such file.
    """
    try:
        # Without O_NONBLOCK, opening a pipe would block until its other end is opened.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise UserError(f"{path}: not a regular file; give a file")
            if at_most is not None and status.st_size > at_most:
                raise UserError(
                    f"{path}: the file has {status.st_size} bytes, the limit is {at_most}; give a smaller one"
                )
            return file.read()
    except FileNotFoundError as error:
        raise missing_error(path, missing) from error
    except IsADirectoryError as error:
        raise UserError(f"{path}: is a folder; give a file") from error
    except UserError:
        raise
    # A path with a null byte raises ValueError.
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise UserError(f"{path}: cannot be read ({reason}); check the path and its permissions") from error


def missing_error(path: Path | str, advice: str = "check the path") -> UserError:
    """Return the error about a missing ``path``, with the most similar name in its folder, if any."""
    missing = Path(path)
    try:
        names = sorted(os.listdir(missing.parent))
    except (OSError, ValueError):
        names = []
    # Names with only their suffix in common are not similar.
    stem = missing.stem.lower()
    names = [name for name in names if difflib.SequenceMatcher(None, stem, Path(name).stem.lower()).ratio() > 0.6]
    return UserError(f"{path}: no such file or folder{did_you_mean(missing.name, names)}; {advice}")
