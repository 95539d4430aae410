"""The container of .spz version 4: a plain header of 32 bytes, extensions, a table, one Zstandard stream per quantity.

Public description: README of https://github.com/nianticlabs/spz. The header begins as that of versions 1 to 3; its byte
15 is the number of streams, the next four the offset of their table, and twelve are reserved. A row of the table is two
uint64: compressed and uncompressed bytes. The streams follow it in order. Between header and table are extensions, each
a uint32 of its kind, one of its length, and that many bytes.
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
"""Number of bytes that the header shares with those of versions 1 to 3."""
_LEVEL = 12
"""Level out of Zstandard's 22; 19 takes eight times as long for files that are 4 to 6 % smaller."""
_MAX_WINDOW = 1 << 27
"""Maximum memory that a stream may need in addition to its output, bytes: the default of common tools."""
_COORDINATES = 0xADBE0003
"""Extension SPZ_ADOBE_coordinate_system: a uint32 for the directions of the axes."""
_AXES = (
    *("", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)
"""Directions of x, y and z: left or right, up or down, forward or back."""


def inflate_streams(data: bytes, sizes: Sequence[int], source: Path) -> bytes:
    """Decompress the blocks, which have ``sizes`` bytes, and concatenate them. Raises ``UserError`` if the blocks of
    the file have other sizes.

    Only ``sizes`` bytes are inflated, so that a crafted file cannot fill the memory.
    """
    table, count = _table(data, source)
    nonempty = [size for size in sizes if size > 0]
    if count != len(nonempty):
        raise UserError(f"{source}: .spz with {count} streams, expected {len(nonempty)}; export it again")
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
    """Return the parts of a file that contains ``blocks``; empty blocks are left out, as the format requires.

    ``header`` is that of version 3, with another version number; the part after its flags is replaced.
    """
    nonempty = [block for block in blocks if block]
    # The size of the content and a checksum are included, so that damage is detected.
    streams = [zstandard.ZstdCompressor(level=_LEVEL, write_checksum=True).compress(block) for block in nonempty]
    table = b"".join(_ROW.pack(len(packed), len(block)) for packed, block in zip(streams, nonempty, strict=True))
    return [header[:_COMMON] + struct.pack("<BI12x", len(nonempty), _HEADER.size), table, *streams]


def stored_axes(data: bytes, source: Path) -> tuple[np.ndarray, bool] | None:
    """(3,) up, and True if the axes are left-handed, if an extension specifies their directions; None without one."""
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
