"""Reading and writing of files: captures (the paper's input), camera poses, planes, text, pictures and videos.

Input: paths. Output: the records of ``geometry``. Each file is written completely or not at all.
"""

from egs_warp.io.atomic import atomic_write, writable_folder
from egs_warp.io.cameras import PosedImage, read_cameras
from egs_warp.io.capture import Capture, read_capture
from egs_warp.io.compressed_ply import write_compressed_ply
from egs_warp.io.ply import write_ply
from egs_warp.io.sequence import write_ply_sequence
from egs_warp.io.sog_writer import write_sog
from egs_warp.io.splat import write_splat
from egs_warp.io.spz import write_spz

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
