"""Captures for the tests of readers and writers."""

from __future__ import annotations

import hashlib
import struct
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import zstandard

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io import read_capture, write_compressed_ply, write_ply, write_sog, write_splat, write_spz

ARRAYS = ("means", "rotations", "log_scales", "opacity_logits", "sh")


def make_cloud(count: int, degree: int = 0, *, seed: int = 1, device: str = "cpu") -> GaussianCloud:
    """Return random Gaussians with values that every format can store."""
    rng = np.random.default_rng(seed)
    return GaussianCloud.from_numpy(
        rng.uniform(-2.0, 2.0, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(-8.0, -1.0, (count, 3)),
        rng.uniform(-5.0, 5.0, count),
        rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3)),
        device=device,
    )


def assert_same_bits(actual: GaussianCloud, expected: GaussianCloud) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(actual, name).numpy(), getattr(expected, name).numpy(), err_msg=name)


def digest(cloud: GaussianCloud) -> str:
    """Return the SHA-256 digest of all arrays of the cloud."""
    return hashlib.sha256(b"".join(getattr(cloud, name).numpy().tobytes() for name in ARRAYS)).hexdigest()


def small_cloud() -> GaussianCloud:
    rng = np.random.default_rng(5)
    return GaussianCloud.from_numpy(
        rng.normal(size=(7, 3)),
        rng.normal(size=(7, 4)),
        rng.normal(size=(7, 3)) - 4.0,
        rng.normal(size=7),
        0.3 * rng.normal(size=(7, 4, 3)),
        device="cpu",
    )


def spz_of_streams(plain: bytes, count: int, sh_bytes: int, records: bytes = b"") -> bytes:
    """Return a .spz file of version 4 (header, records, table, streams) with the content of one of version 3.

    ``plain`` is the file of version 3 without its gzip compression.
    """
    ends = 16 + count * np.cumsum([0, 9, 1, 3, 3, 4, sh_bytes])
    blocks = [plain[start:end] for start, end in zip(ends[:-1], ends[1:], strict=True) if end > start]
    streams = [zstandard.ZstdCompressor().compress(block) for block in blocks]
    flags = plain[14] | (2 if records else 0)
    header = struct.pack("<4sI", b"NGSP", 4) + plain[8:14] + bytes([flags, len(blocks)])
    table = b"".join(struct.pack("<QQ", len(s), len(b)) for s, b in zip(streams, blocks, strict=True))
    return header + struct.pack("<I12x", 32 + len(records)) + records + table + b"".join(streams)


WRITERS: dict[str, Callable[..., object]] = {
    "a.ply": write_ply,
    "b.ply": write_compressed_ply,
    "a.spz": write_spz,
    "a.splat": write_splat,
    "a.sog": write_sog,
}


@cache
def good_bytes(name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        WRITERS[name](path, small_cloud())
        return path.read_bytes()


def message(path: Path) -> str:
    """Return the one-line error that reading ``path`` raises, without the path at its start."""
    with pytest.raises(UserError) as caught:
        read_capture(path, device="cpu")
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(f"{path}: ")
    return text.removeprefix(f"{path}: ")


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path
