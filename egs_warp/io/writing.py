"""Writing a capture of any format, told by the ending of its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.compressed_ply import write_compressed_ply
from egs_warp.io.glb import write_glb
from egs_warp.io.ply import write_ply
from egs_warp.io.sog_writer import write_sog
from egs_warp.io.splat import write_splat
from egs_warp.io.spz import write_spz

CaptureWriter = Callable[[Path, GaussianCloud], None]
WRITERS: dict[str, tuple[str, CaptureWriter]] = {
    "compressed-ply": (".compressed.ply", write_compressed_ply),
    "ply": (".ply", write_ply),
    "spz": (".spz", write_spz),
    "sog": (".sog", write_sog),
    "splat": (".splat", write_splat),
    "glb": (".glb", write_glb),
}
"""Ending and writer of each kind of splat file; an ending comes before those that it ends in."""


def writer_of(path: Path) -> CaptureWriter:
    """What writes a capture to ``path``. Raises ``UserError`` for a folder, or a name without a known ending."""
    for ending, write in WRITERS.values():
        if path.name.lower().endswith(ending) and path.name.lower() != ending:
            if path.is_dir():
                raise UserError(f"{path}: is a folder; give the name of a file")
            return write
    raise UserError(f"{path}: give a name that ends in {', '.join(ending for ending, _ in WRITERS.values())}")
