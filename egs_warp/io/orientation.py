"""Orientation of pictures as cameras store it in EXIF."""

from __future__ import annotations

from pathlib import Path

import numpy as np

_ORIENTATION = 0x0112
"""EXIF tag of the orientation: how a viewer must rotate or mirror the stored picture."""


def orientation(image: Path) -> int:
    """Return the EXIF orientation of the file, 1 (unchanged) to 8."""
    from PIL import Image

    try:
        with Image.open(image) as opened:
            turn = opened.getexif().get(_ORIENTATION, 1)
    # The decoder reads untrusted bytes, and its errors have no common base class.
    except Exception:
        return 1
    return turn if turn in range(1, 9) else 1


def apply_orientation(pixels: np.ndarray, turn: int) -> np.ndarray:
    """Return stored ``pixels`` (H, W, ...) turned upright according to the EXIF orientation ``turn`` (1 to 8)."""
    if turn >= 5:
        pixels = pixels.swapaxes(0, 1)
    # Directions in which rows and columns are read, after the axes have been swapped if necessary.
    rows = -1 if turn in (3, 4, 7, 8) else 1
    columns = -1 if turn in (2, 3, 6, 7) else 1
    return np.ascontiguousarray(pixels[::rows, ::columns])
