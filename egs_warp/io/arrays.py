"""Named arrays in one file: ``.npz`` files as written by ``numpy.savez``.

Such files may be damaged or untrusted. Therefore the sizes that a file declares are compared with the size of the file
before memory is allocated.
"""

from __future__ import annotations

import lzma
import math
import struct
import zipfile
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np

READ_ERRORS = (
    *(OSError, EOFError, RuntimeError, KeyError, IndexError, ValueError, TypeError, OverflowError),
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error),
)
"""Errors that reading a damaged file of arrays, or using its content, may raise."""
_NUMBERS = "biufU"
"""Kinds of arrays that are read: numbers, booleans and text."""


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of the file. Raises ``READ_ERRORS``."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise ValueError("its arrays are compressed")
        # Members of a crafted file may overlap, and each would be read completely.
        if sum(member.file_size for member in members) > path.stat().st_size:
            raise ValueError("its arrays are larger than the file")
        # Each member is read completely, which verifies its checksum, before its content is used.
        return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}


def _array(data: bytes) -> np.ndarray:
    member = BytesIO(data)
    version = np.lib.format.read_magic(member)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"an array of format {version[0]}.{version[1]}, not 1.0 or 2.0")
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = header(member)
    if dtype.kind not in _NUMBERS or dtype.itemsize == 0:
        raise ValueError(f"an array of type {dtype}, not of numbers")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(data) - member.tell():
        raise ValueError(f"an array of shape {str(shape)[:80]} does not match its number of bytes")
    member.seek(0)
    return np.lib.format.read_array(member, allow_pickle=False)
