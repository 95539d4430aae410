"""How much a stranger's file may ask for, checked before anything is allocated.

What a file declares (Gaussians, pixels, inflated bytes) is compared with how large the file is and with the limits of
this module; docs/reliability.md lists them.
"""

from __future__ import annotations

import io
import os
import stat
import warnings
from pathlib import Path

from egs_warp.errors import UserError

LARGEST_TEXT = 32 << 20
"""Bytes of a JSON or another text: parsed, they take some thirty times as many."""
MOST_PIXELS = 178_956_970
"""Of one picture or camera: Pillow's own bound."""
LONGEST_SIDE = 1 << 15
"""Pixels of one side of a picture or camera."""


FURTHEST = 1e12
"""Units: nothing lies further out."""
FREE_GAUSSIANS = 1 << 16
"""So many Gaussians a packed capture may hold whatever its size."""
INFLATION = 4
"""A picture in a zip inflates to at most so many times its bytes, and ``FREE_BYTES``: WebP hardly deflates."""
FREE_BYTES = 1 << 16


def check_count(count: int, size: int, source: Path) -> None:
    """Refuse more Gaussians than a packed file of ``size`` bytes can hold: positions do not pack below a byte each."""
    if count > size + FREE_GAUSSIANS:
        raise UserError(f"{source}: it says that it has {count} Gaussians, in {size} bytes; copy or export it again")


def check_pixels(width: int, height: int, what: str, *, at_most: int = MOST_PIXELS) -> None:
    """Refuse a picture or camera of too many pixels; ``what`` begins the message."""
    if max(width, height) > LONGEST_SIDE or width * height > at_most:
        raise UserError(
            f"{what} has {width} x {height} pixels; at most {LONGEST_SIDE} a side and {at_most} in all are read"
        )


def picture_size(data: bytes | Path, what: str) -> tuple[int, int] | None:
    """Width and height that the header of a picture says; None where Pillow knows no such picture.

    Raises ``UserError``, which begins with ``what``, for too many pixels.
    """
    from PIL import Image

    # Its warning of large pictures comes before our limit.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(io.BytesIO(data) if isinstance(data, bytes) else data) as image:
                return image.size
        except Image.DecompressionBombError:
            raise UserError(f"{what} has more than {MOST_PIXELS} pixels; make it smaller") from None
        # The decoder is handed a stranger's bytes, and its errors share no base class.
        except Exception:
            return None


def read_bytes(path: Path | str, *, at_most: int | None = None, missing: str = "check the path") -> bytes:
    """What a regular file holds. Raises ``UserError`` for anything else: folders, pipes and devices never end.

    ``missing`` says what to do where there is no such file; files of more than ``at_most`` bytes are refused.
    """
    try:
        # A pipe would wait for its other end.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise UserError(f"{path}: not a regular file; give a file")
            if at_most is not None and status.st_size > at_most:
                raise UserError(
                    f"{path}: {status.st_size} bytes, of which at most {at_most} are read; give a smaller one"
                )
            return file.read()
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file or folder; {missing}") from error
    except IsADirectoryError as error:
        raise UserError(f"{path}: is a folder; give a file") from error
    except UserError:
        raise
    # ValueError: a path with a null byte.
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise UserError(f"{path}: cannot be read ({reason}); check the path and its permissions") from error
