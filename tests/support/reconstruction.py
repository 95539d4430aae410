"""Photos, and a substitute for pycolmap's estimation of camera poses."""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image

_OBSERVATION = struct.pack("<Q2dq", 1, 3.0, 4.0, 1)
COLMAP_BIN = {
    "cameras.bin": struct.pack("<QiiQQ4d", 1, 1, 1, 24, 16, 30.0, 30.0, 12.0, 8.0),
    "images.bin": struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 2, 1) + b"a.png\0" + _OBSERVATION,
    "points3D.bin": struct.pack("<QQ3d3Bd", 1, 1, 0.5, 0.5, 2.0, 255, 128, 0, 0.3) + struct.pack("<Q2i", 1, 1, 0),
}
"""Files of a binary COLMAP model with one photo, ``a.png``, and two points, by name."""


def photos_of_noise(folder: Path) -> Path:
    """Write three photos of 64 x 48 pixels, of a few kilobytes each."""
    folder.mkdir()
    random = np.random.default_rng(0)
    for number in range(3):
        Image.fromarray(random.integers(0, 256, (48, 64, 3), dtype=np.uint8)).save(folder / f"{number}.png")
    return folder


def model(*_: object, capacity: int | None = None, **__: object) -> SimpleNamespace:
    """Return a substitute for COLMAP's reconstruction, which truncates each file to ``capacity`` bytes, as on a full
    disk."""

    def write_binary(folder: str) -> None:
        for name, data in COLMAP_BIN.items():
            (Path(folder) / name).write_bytes(data[:capacity])

    return SimpleNamespace(
        images={},
        write_binary=write_binary,
        num_points3D=lambda: 5,
        compute_mean_reprojection_error=lambda: 0.5,
    )


def reconstruct_by(patch: pytest.MonkeyPatch, reconstructed: Callable[..., object]) -> None:
    """Make the command ``pose`` call ``reconstructed`` in place of pycolmap."""
    patch.setitem(sys.modules, "pycolmap", ModuleType("pycolmap"))
    patch.setattr("egs_warp.pipelines.pose_photos._reconstructed", reconstructed)
