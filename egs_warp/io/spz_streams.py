"""The container of .spz version 4: an uncompressed header of 32 bytes, extensions, a table, and one Zstandard stream
per quantity.

Public description: README of https://github.com/nianticlabs/spz. The first 15 bytes of the header are the same as in
versions 1 to 3. Byte 15 is the number of streams, the next four bytes are the offset of their table, and twelve bytes
are reserved. A row of the table consists of two uint64: compressed and uncompressed size. The streams follow the table
in order. Between header and table are extensions, each with a uint32 for its kind, a uint32 for its length, and its
content.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import zstandard

from egs_warp.errors import UserError

_HEADER = struct.Struct("<IIIBBBBI12x")
_ROW = struct.Struct("<QQ")
_RECORD = struct.Struct("<II")
_COMMON = 15
"""Number of bytes at the beginning of the header that are the same as in versions 1 to 3."""
_LEVEL = 12
"""Compression level of Zstandard, whose maximum is 22; level 19 takes eight times as long for files that are 4 to 6 %
smaller."""
_MAX_WINDOW = 1 << 27
"""Maximum memory, bytes, that decoding a stream may need in addition to its output; this is the default of common
tools."""
_COORDINATES = 0xADBE0003
"""Kind of the extension SPZ_ADOBE_coordinate_system, which contains a uint32 for the directions of the axes."""
_AXES = (
    *("", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)
"""Directions of x, y and z by the value of the extension: left or right, up or down, forward or back."""


def inflate_streams(data: bytes, sizes: Sequence[int], source: Path) -> bytes:
    """Decompress the blocks and concatenate them. Raises ``UserError`` if their sizes in bytes are not ``sizes``.

    Only ``sizes`` bytes are inflated, so that a crafted file cannot fill the memory.
    """
    table, count = _table(data, source)
    nonempty = [size for size in sizes if size > 0]
    if count != len(nonempty):
        raise UserError(f"{source}: the .spz has {count} streams, expected {len(nonempty)}; export it again")
    end = table + count * _ROW.size
    rows = [_ROW.unpack_from(data, table + k * _ROW.size) for k in range(count)]
    blocks = []
    for (packed, unpacked), size in zip(rows, nonempty, strict=True):
        if unpacked != size or end + packed > len(data):
            raise UserError(
                f"{source}: corrupt or truncated .spz: a stream of {packed} bytes for {unpacked}, of which {size} are"
                f" needed and {len(data) - end} are present; copy or export it again"
            )
        try:
            reader = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(data[end : end + packed])
            block = reader.read(size)
        except zstandard.ZstdError as error:
            raise UserError(f"{source}: corrupted .spz data ({error}); copy or export the file again") from error
        if len(block) != size:
            raise UserError(f"{source}: truncated: a stream has {len(block)} of {size} bytes; copy it again")
        blocks.append(block)
        end += packed
    return b"".join(blocks)


def deflate_streams(header: bytes, blocks: Sequence[bytes]) -> list[bytes]:
    """Return the consecutive parts of a file that contains ``blocks``; empty blocks are left out, as the format
    requires.

    ``header`` is a header of version 3 with the version number 4; the part after its flags is replaced.
    """
    nonempty = [block for block in blocks if block]
    # Write the size of the content and a checksum into the stream, so that damage is detected.
    streams = [zstandard.ZstdCompressor(level=_LEVEL, write_checksum=True).compress(block) for block in nonempty]
    table = b"".join(_ROW.pack(len(packed), len(block)) for packed, block in zip(streams, nonempty, strict=True))
    return [header[:_COMMON] + struct.pack("<BI12x", len(nonempty), _HEADER.size), table, *streams]


def stored_axes(data: bytes, source: Path) -> tuple[np.ndarray, bool] | None:
    """Return the up direction (3,), and True if the axes are left-handed; None if no extension specifies the axes."""
    table, _ = _table(data, source)
    place = _HEADER.size
    while place + _RECORD.size <= table:
        kind, size = _RECORD.unpack_from(data, place)
        place += _RECORD.size
        if kind == _COORDINATES and size == 4 and place + 4 <= table:
            (number,) = struct.unpack_from("<I", data, place)
            return _directions(_AXES[number]) if 0 < number < len(_AXES) else None
        place += size
    return None


def _table(data: bytes, source: Path) -> tuple[int, int]:
    """Return the offset of the table and the number of streams."""
    if len(data) < _HEADER.size:
        raise UserError(
            f"{source}: truncated: .spz header of {len(data)} bytes, expected {_HEADER.size}; copy it again"
        )
    *_, count, table = _HEADER.unpack_from(data)
    if table < _HEADER.size or table + count * _ROW.size > len(data):
        raise UserError(f"{source}: corrupt or truncated .spz: its table lies outside the file; copy it again")
    return table, count


def _directions(axes: str) -> tuple[np.ndarray, bool]:
    signs = {letter: 1.0 if letter in "RUB" else -1.0 for letter in axes}
    hand = np.prod([signs[letter] for letter in axes])
    if axes[1] in "FB":
        hand = -hand
    return np.array([signs[letter] if letter in "UD" else 0.0 for letter in axes]), bool(hand < 0)
