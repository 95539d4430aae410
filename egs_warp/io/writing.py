"""Writing of captures in the format that the ending of the file name selects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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


@dataclass(frozen=True)
class CaptureWriter:
    """Writer for one kind of splat file."""

    ending: str
    """Name ending of the files."""
    function: Callable[..., np.ndarray | None]
    """Function that writes the file, called with the path, the cloud and, if the format stores it, ``origin``. It
    returns the index (n,) in the cloud of each Gaussian of the file, or None if the order is the same."""
    stores_origin: bool = False
    """True if the format includes the offset of a georeferenced capture (``Capture.origin``)."""

    def stored_origin(self, origin: np.ndarray | None) -> np.ndarray | None:
        """Return the ``origin`` (3,) of a capture if the format includes it, otherwise None."""
        return origin if self.stores_origin else None

    def __call__(self, path: Path, cloud: GaussianCloud, *, origin: np.ndarray | None = None) -> np.ndarray | None:
        """Write ``cloud``, with the ``origin`` (3,) of its capture if the format includes it, and return the result of
        ``function``."""
        return self.function(path, cloud, origin=origin) if self.stores_origin else self.function(path, cloud)


WRITERS: dict[str, CaptureWriter] = {
    "compressed-ply": CaptureWriter(".compressed.ply", write_compressed_ply),
    "ply": CaptureWriter(".ply", write_ply, stores_origin=True),
    "spz": CaptureWriter(".spz", write_spz),
    "spz4": CaptureWriter(".spz", partial(write_spz, version=4)),
    "sog": CaptureWriter(".sog", write_sog),
    "splat": CaptureWriter(".splat", write_splat),
    "glb": CaptureWriter(".glb", write_glb, stores_origin=True),
}
"""Writers by kind of splat file. The first writer whose ending matches the name is used: ``.compressed.ply`` comes
before ``.ply``, and of two kinds with the same ending, the first is the default."""


def is_capture_name(path: Path) -> bool:
    """Return True if ``path`` has the ending of a capture; it is then the name of a file, not of a folder."""
    return path.name.lower().endswith(tuple(write.ending for write in WRITERS.values()))


def capture_stem(path: Path) -> str:
    """Return the name of a capture without its ending: cat.v2 for ``cat.v2.compressed.ply``."""
    name = path.name.lower()
    endings = [write.ending for write in WRITERS.values() if name.endswith(write.ending)]
    return path.name[: -len(endings[0])] if endings else path.stem


def writer_of(path: Path, *, kind: str | None = None) -> CaptureWriter:
    """Return the writer for a capture at ``path``, selected by ``kind`` (a key of ``WRITERS``) or else by the ending of
    the name.

    Raises ``UserError`` for a folder, a name without a known ending, and a name with the ending of another kind.
    """
    endings = dict.fromkeys(write.ending for write in WRITERS.values())
    name = path.name.lower()
    ending = next((ending for ending in endings if name.endswith(ending) and name != ending), None)
    allowed = list(endings) if kind is None else [WRITERS[kind].ending]
    if ending not in allowed:
        near = did_you_mean(path.suffix, allowed)
        raise UserError(f"{path}: give a name that ends in {', '.join(allowed)}{near}")
    if path.is_dir():
        raise UserError(f"{path}: is a folder; give the name of a file")
    if kind is not None:
        return WRITERS[kind]
    return next(write for write in WRITERS.values() if write.ending == ending)
