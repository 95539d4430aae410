"""Numbered .ply files, which SuperSplat and the PlayCanvas player show as an animation."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.atomic import writable_folder
from egs_warp.io.compressed_ply import write_compressed_ply
from egs_warp.io.ply import write_ply


def write_ply_sequence(
    folder: Path | str, clouds: Iterable[GaussianCloud], *, prefix: str = "frame", compressed: bool = False
) -> list[Path]:
    """Write ``frame0001.ply``, ``frame0002.ply``, ... into ``folder``, made where missing; return their paths.

    ``clouds`` may be a generator: one frame is held at a time. ``compressed`` files are a tenth as large and end in
    ``.compressed.ply``. Files of an earlier, longer sequence stay. Raises ``UserError`` if it cannot be written.
    """
    target = writable_folder(folder)
    paths = []
    for number, cloud in enumerate(clouds, start=1):
        path = target / f"{prefix}{number:04d}{'.compressed' if compressed else ''}.ply"
        if compressed:
            write_compressed_ply(path, cloud)
        else:
            write_ply(path, cloud)
        paths.append(path)
    return paths
