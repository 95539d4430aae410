"""How much a stranger's file may ask for, checked before anything is allocated.

What a file declares (Gaussians, pixels, inflated bytes) is compared with how large the file is and with the limits of
this module; docs/reliability.md lists them.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from egs_warp.errors import UserError

LARGEST_TEXT = 32 << 20
"""Bytes of a JSON or another text: parsed, they take some thirty times as many."""
MOST_PIXELS = 1 << 28
"""Of one picture or camera; the largest phones take 200 megapixels."""
LONGEST_SIDE = 1 << 15
"""Pixels of one side of a picture or camera."""


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
