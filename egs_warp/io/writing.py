"""Writing of captures in all formats, chosen by the ending of the name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError, did_you_mean
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.compressed_ply import write_compressed_ply
from egs_warp.io.glb import write_glb
from egs_warp.io.ply import write_ply
from egs_warp.io.sog_writer import write_sog
from egs_warp.io.splat import write_splat
from egs_warp.io.spz import write_spz

CaptureWriter = Callable[[Path, GaussianCloud], "np.ndarray | None"]
"""Writer of a capture; returns the number (n,) in the cloud of each Gaussian of the file, or None if it keeps the
order."""
WRITERS: dict[str, tuple[str, CaptureWriter]] = {
    "compressed-ply": (".compressed.ply", write_compressed_ply),
    "ply": (".ply", write_ply),
    "spz": (".spz", write_spz),
    "spz4": (".spz", partial(write_spz, version=4)),
    "sog": (".sog", write_sog),
    "splat": (".splat", write_splat),
    "glb": (".glb", write_glb),
}
"""Ending and writer of each kind of splat file. A longer ending comes before a shorter one that it ends in. Of two
kinds with one ending, the first is the default."""


def stored_origin(write: CaptureWriter, origin: np.ndarray | None) -> np.ndarray | None:
    """Return the ``origin`` (3,) of a capture if its file includes it: only .ply and .glb do."""
    return origin if write in (write_ply, write_glb) else None


def write_capture(
    path: Path, cloud: GaussianCloud, write: CaptureWriter, *, origin: np.ndarray | None
) -> np.ndarray | None:
    """Call ``write``, and return what it returns; ``origin`` (3,) of the capture is included if possible
    (``stored_origin``)."""
    if stored_origin(write, origin) is None:
        return write(path, cloud)
    (write_ply if write is write_ply else write_glb)(path, cloud, origin=origin)
    return None


def is_capture_name(path: Path) -> bool:
    """Return True if ``path`` ends as a capture does; it is then the name of a file and not of a folder."""
    return path.name.lower().endswith(tuple(ending for ending, _ in WRITERS.values()))


def writer_of(path: Path, *, kind: str | None = None) -> CaptureWriter:
    """Return the writer for a capture at ``path``, by ``kind``, a key of ``WRITERS``, or by the ending.

    Raises ``UserError`` for a folder, for a name without a known ending, and for one with the ending of another kind.
    """
    endings = dict.fromkeys(ending for ending, _ in WRITERS.values())
    name = path.name.lower()
    ending = next((ending for ending in endings if name.endswith(ending) and name != ending), None)
    allowed = list(endings) if kind is None else [WRITERS[kind][0]]
    if ending not in allowed:
        near = did_you_mean(path.suffix, allowed)
        raise UserError(f"{path}: give a name that ends in {', '.join(allowed)}{near}")
    if path.is_dir():
        raise UserError(f"{path}: is a folder; give the name of a file")
    if kind is not None:
        return WRITERS[kind][1]
    return next(write for known, write in WRITERS.values() if known == ending)
