"""Reading and writing of files: captures (the paper's input), camera poses, planes, text, pictures and videos.

Input: paths. Output: the records of ``geometry``. Each file is written completely or not at all.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from egs_warp.io.atomic import atomic_write, writable_folder
    from egs_warp.io.cameras import PosedImage, read_cameras
    from egs_warp.io.capture import Capture, read_capture
    from egs_warp.io.compressed_ply import write_compressed_ply
    from egs_warp.io.ply import write_ply
    from egs_warp.io.sequence import write_ply_sequence
    from egs_warp.io.sog_writer import write_sog
    from egs_warp.io.splat import write_splat
    from egs_warp.io.spz import write_spz

_MODULE_OF = {
    "Capture": "capture",
    "PosedImage": "cameras",
    "atomic_write": "atomic",
    "read_cameras": "cameras",
    "read_capture": "capture",
    "writable_folder": "atomic",
    "write_compressed_ply": "compressed_ply",
    "write_ply": "ply",
    "write_ply_sequence": "sequence",
    "write_sog": "sog_writer",
    "write_splat": "splat",
    "write_spz": "spz",
}
"""Module of each name, imported at its first use, so that commands can check a path without loading Warp; the imports
above declare the same for type checkers."""

__all__ = [
    "Capture",
    "PosedImage",
    "atomic_write",
    "read_cameras",
    "read_capture",
    "writable_folder",
    "write_compressed_ply",
    "write_ply",
    "write_ply_sequence",
    "write_sog",
    "write_splat",
    "write_spz",
]


def __getattr__(name: str) -> Any:
    """Import and return ``name`` (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'egs_warp.io' has no attribute {name!r}", name=name)
    globals()[name] = value = getattr(import_module(f"egs_warp.io.{_MODULE_OF[name]}"), name)
    return value
