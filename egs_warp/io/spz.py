"""Niantic's .spz: gzip around a 16-byte header and one block of bytes for each quantity.

Public description: README of https://github.com/nianticlabs/spz. Versions 1 (half-float positions), 2 (24-bit
fixed-point positions), 3 (smallest-three rotations) and 4 (the blocks of version 3 as Zstandard streams,
``spz_streams``) are read; versions 2 to 4 are written. The format defines its axes as right, up, back, so +y is up;
files of version 4 may specify other axes. The axes of the file are kept.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.affine import transformed_colours, transformed_shapes
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.atomic import atomic_write
from egs_warp.io.limits import check_count
from egs_warp.io.raw import (
    BAND_4,
    SH_COUNTS,
    RawCapture,
    bands_note,
    byte,
    bytes_from_logits,
    full_bands,
    largest_dropped,
    largest_restored,
    logits_from_bytes,
)
from egs_warp.io.spz_streams import deflate_streams, inflate_streams, stored_axes

_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")
_COLOUR_SCALE = 0.15
_FRACTIONAL_BITS = 12
"""Number of fractional bits of a position in captures whose size is at least ``_SMALL`` units."""
_SMALL = 0.25
_MIN_LOG_SCALE, _LOG_SCALE_STEPS = -10.0, 16.0
"""Log scale of the byte value 0, and number of steps per unit: a log scale is stored as a byte, in steps of 1/16 from
-10."""
_ANTIALIASED, _HAS_EXTENSIONS = 1, 2
_MAX_EXTENSION_BYTES = 1 << 20
_MAX_FRACTIONAL_BITS = 24
_SH_COUNTS = (*SH_COUNTS, BAND_4)
# Quantisation steps of SH coefficients above band 0, as in the reference writer. Finer steps would reduce the rounding
# error, but increase the compressed size.
_BAND1_STEP, _REST_STEP = 8, 16


@dataclass(frozen=True)
class _Layout:
    version: int
    count: int
    sh_count: int
    fractional_bits: int
    flags: int

    @property
    def widths(self) -> tuple[int, ...]:
        """Number of bytes of one Gaussian in each block: positions, alphas, colours, scales, rotations, SH."""
        return 6 if self.version == 1 else 9, 1, 3, 3, 4 if self.version >= 3 else 3, 3 * self.sh_count

    @property
    def size(self) -> int:
        return _HEADER.size + self.count * sum(self.widths)


def decode_spz(data: bytes, source: Path) -> RawCapture:
    """Decode a .spz, gzipped or not. Raises ``UserError`` if it is corrupt, truncated or of an unknown version."""
    # Inflate no more than the size that the header declares, so that a crafted file cannot fill the memory.
    inflate = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    gzipped = data[:2] == b"\x1f\x8b"
    header = _inflated(inflate, data, _HEADER.size, source) if gzipped else data[: _HEADER.size]
    layout = _layout(header, gzipped, source)
    axes = None
    if layout.version == 4:
        if gzipped:
            raise UserError(f"{source}: the gzip data contain a .spz of version 4; unpack it first")
        check_count(layout.count, len(data), source)
        body = header + inflate_streams(data, [layout.count * width for width in layout.widths], source)
        axes = stored_axes(data, source) if layout.flags & _HAS_EXTENSIONS else None
    elif gzipped:
        check_count(layout.count, len(data), source)
        body = header + _inflated(inflate, inflate.unconsumed_tail, layout.size - len(header), source)
        # zlib verifies the checksum only at the end of the stream.
        _inflated(inflate, inflate.unconsumed_tail, _MAX_EXTENSION_BYTES, source)
    else:
        body = data
    if len(body) < layout.size:
        raise _truncated(source, layout, str(len(body)))
    up, is_left_handed = axes or (np.array([0.0, 1.0, 0.0]), False)
    raw = _decode(body, layout, up)
    return _mirrored(raw) if is_left_handed else raw


def _mirrored(raw: RawCapture) -> RawCapture:
    """Return ``raw`` mirrored along its first axis, which points to the left or right in all axis systems of .spz."""
    mirror = np.diag([-1.0, 1.0, 1.0])
    rotations, log_scales = transformed_shapes(raw.rotations, raw.log_scales, mirror)
    return replace(
        raw,
        means=raw.means * np.array([-1.0, 1.0, 1.0], dtype=np.float32),
        rotations=rotations,
        log_scales=log_scales,
        sh=transformed_colours(raw.sh, mirror),
        notes=(*raw.notes, "left-handed axes: x was reversed"),
    )


def _inflated(inflate: zlib._Decompress, data: bytes, size: int, source: Path) -> bytes:
    parts = []
    try:
        while size > 0 and not inflate.eof:
            parts.append(inflate.decompress(data, size))
            data = inflate.unconsumed_tail
            size -= len(parts[-1])
            if not parts[-1] and not data:
                break
    except zlib.error as error:
        raise UserError(f"{source}: corrupted gzip data ({error}); copy or export the file again") from error
    return b"".join(parts)


def _truncated(source: Path, layout: _Layout, size: str) -> UserError:
    return UserError(
        f"{source}: truncated: {layout.count} Gaussians need {layout.size} bytes, found {size}; copy it again"
    )


def _layout(header: bytes, gzipped: bool, source: Path) -> _Layout:
    if len(header) < _HEADER.size:
        raise UserError(
            f"{source}: truncated: .spz header of {len(header)} bytes, expected {_HEADER.size}; copy it again"
        )
    magic, version, count, degree, fractional_bits, flags, _ = _HEADER.unpack(header)
    if magic != _MAGIC:
        raise UserError(f"{source}: gzip data, but no .spz inside; unpack it first if it holds another format")
    if version not in (1, 2, 3, 4):
        raise UserError(f"{source}: the .spz has version {version}, expected 1 to 4; export it as version 4 or as .ply")
    if degree >= len(_SH_COUNTS):
        raise UserError(f"{source}: the .spz has SH degree {degree}, expected 0 to 4; export it with a lower degree")
    if version > 1 and fractional_bits > _MAX_FRACTIONAL_BITS:
        raise UserError(
            f"{source}: the .spz has {fractional_bits} fractional bits, but a position has 24 bits; export it again"
        )
    return _Layout(version, count, _SH_COUNTS[degree], fractional_bits, flags)


def _decode(body: bytes, layout: _Layout, up: np.ndarray) -> RawCapture:
    ends = _HEADER.size + layout.count * np.cumsum((0, *layout.widths))
    raw = np.frombuffer(body, np.uint8)
    positions, alphas, colours, scales, rotations, sh = (
        raw[start:end].reshape(layout.count, width)
        for start, end, width in zip(ends[:-1], ends[1:], layout.widths, strict=True)
    )
    if layout.version == 1:
        means = positions.copy().view("<f2").astype(np.float32)
    else:
        low, middle, high = positions.reshape(-1, 3, 3).astype(np.int32).transpose(2, 0, 1)
        # Shifting left and back extends the sign bit.
        fixed = ((low << 8 | middle << 16 | high << 24) >> 8).astype(np.float64)
        means = np.ldexp(fixed, -layout.fractional_bits).astype(np.float32)
    rest = (
        sh.reshape(layout.count, layout.sh_count, 3)[:, : full_bands(layout.sh_count)] - np.float32(128.0)
    ) / np.float32(128.0)
    f_dc = ((colours / 255.0 - 0.5) / _COLOUR_SCALE).astype(np.float32)
    notes = [*bands_note(layout.sh_count)]
    if layout.flags & _HAS_EXTENSIONS:
        notes.append("vendor extensions left out")
    return RawCapture(
        format=f".spz version {layout.version}",
        means=means,
        rotations=_quaternions(rotations, layout.version),
        log_scales=scales.astype(np.float32) / np.float32(_LOG_SCALE_STEPS) + np.float32(_MIN_LOG_SCALE),
        opacity_logits=logits_from_bytes(alphas[:, 0]),
        sh=np.concatenate([f_dc[:, None], rest], axis=1),
        up=up,
        antialiased=bool(layout.flags & _ANTIALIASED),
        notes=tuple(notes),
    )


def _quaternions(packed: np.ndarray, version: int) -> np.ndarray:
    if version < 3:
        xyz = packed / 127.5 - 1.0
        w = np.sqrt(np.maximum(0.0, 1.0 - np.einsum("ni,ni->n", xyz, xyz)))
        return np.concatenate([w[:, None], xyz], axis=1).astype(np.float32)
    words = packed.copy().view("<u4")[:, 0]
    fields = np.stack([(words >> np.uint32(shift)) & np.uint32(1023) for shift in (20, 10, 0)], axis=1)
    three = (fields & 511) / 511.0 * np.sqrt(0.5) * np.where(fields & 512, -1.0, 1.0)
    xyzw = largest_restored(three, words >> np.uint32(30))
    return xyzw[:, [3, 0, 1, 2]]


def write_spz(path: Path | str, cloud: GaussianCloud, *, version: int = 3) -> None:
    """Write ``cloud`` as a .spz of version 2 to 4. Axes are written unchanged; viewers of the format assume that +y is
    up.

    Versions 3 and 4 contain the same numbers; files of version 4 are smaller, but fewer programs read them.

    The format is lossy: positions are rounded to 2^-13 units, or to 2^-13 of the size of a small capture, with fewer
    bits if far positions would not fit; log scales to 1/32 within -10 ... 5.9; and opacity and colour to 1/255. Raises
    ``UserError`` if the file cannot be written, or if most Gaussians are too small or too large for the format.
    """
    if version not in (2, 3, 4):
        raise UserError(f"{path}: .spz version {version} cannot be written; choose 2, 3 or 4")
    means = cloud.means.numpy().astype(np.float64)
    reach = float(np.abs(means).max())
    bits = _fractional_bits(means, reach)
    if reach * 2**bits > 2**23 - 1:
        raise UserError(
            f"{path}: a mean lies {reach:g} units from the origin, the limit of .spz is {2**23 - 1}; scale the"
            " capture down"
        )
    _check_sizes(cloud.log_scales.numpy(), path)
    fixed = np.rint(np.ldexp(means, bits)).astype(np.int32)
    sh = cloud.sh.numpy()
    header = _HEADER.pack(_MAGIC, version, cloud.count, cloud.sh_degree, bits, _ANTIALIASED * cloud.antialiased, 0)
    quaternions = cloud.rotations.numpy()
    if version >= 3:
        three, largest = largest_dropped(quaternions[:, [1, 2, 3, 0]])
        sizes = np.rint(np.abs(three) / np.sqrt(0.5) * 511.0).clip(0, 511).astype(np.uint32)
        fields = sizes | np.where(three < 0, np.uint32(512), np.uint32(0))
        rotations = largest << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
        packed_rotations = rotations.astype("<u4").tobytes()
    else:
        positive = quaternions * np.where(quaternions[:, :1] < 0, -1.0, 1.0)
        packed_rotations = byte(positive[:, 1:] * 127.5 + 127.5).tobytes()
    blocks = (
        fixed.astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3].tobytes(),
        bytes_from_logits(cloud.opacity_logits.numpy()).tobytes(),
        byte((sh[:, 0].astype(np.float64) * _COLOUR_SCALE + 0.5) * 255.0).tobytes(),
        byte((cloud.log_scales.numpy() - _MIN_LOG_SCALE) * _LOG_SCALE_STEPS).tobytes(),
        packed_rotations,
        _packed_rest(sh[:, 1:]).tobytes(),
    )
    packed = deflate_streams(header, blocks) if version == 4 else _deflated((header, *blocks))
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        for part in packed:
            file.write(part)


def _fractional_bits(means: np.ndarray, reach: float) -> int:
    """Return the number of fractional bits of positions. It is sufficient for the size of the capture, the median
    distance from its middle along each axis, unless the farthest position, at ``reach``, would not fit."""
    size = 2.0 * float(np.median(np.abs(means - np.median(means, axis=0)).max(axis=1)))
    bits = _FRACTIONAL_BITS
    if 0.0 < size < _SMALL:
        bits = int(np.ceil(_FRACTIONAL_BITS - np.log2(size)))
    if reach > 0.0:
        bits = min(bits, int(np.floor(np.log2((2**23 - 1) / reach))))
    return int(np.clip(bits, 0, _MAX_FRACTIONAL_BITS))


def _check_sizes(log_scales: np.ndarray, path: Path | str) -> None:
    """Raise ``UserError`` if most Gaussians are smaller or larger than the format can store."""
    high = _MIN_LOG_SCALE + 255.0 / _LOG_SCALE_STEPS
    typical = float(np.median(log_scales.max(axis=1)))
    if not _MIN_LOG_SCALE - 0.5 / _LOG_SCALE_STEPS <= typical <= high + 0.5 / _LOG_SCALE_STEPS:
        factor = 10.0 ** np.rint(np.log10(np.exp(0.5 * (_MIN_LOG_SCALE + high) - typical)))
        raise UserError(
            f"{path}: .spz stores standard deviations from {np.exp(_MIN_LOG_SCALE):.2g} to {np.exp(high):.3g} units,"
            f" those of the capture are about {np.exp(typical):.2g}; scale it by {factor:g}, or choose another format"
        )


def _deflated(blocks: tuple[bytes, ...]) -> Iterator[bytes]:
    """Compress ``blocks`` into one gzip stream."""
    deflate = zlib.compressobj(wbits=zlib.MAX_WBITS | 16)
    for block in blocks:
        yield deflate.compress(block)
    yield deflate.flush()


def _packed_rest(rest: np.ndarray) -> np.ndarray:
    """Return the SH coefficients ``rest`` (n, K-1, 3) as uint8, rounded to steps that are coarser than one unit."""
    step = np.where(np.arange(rest.shape[1]) < 3, _BAND1_STEP, _REST_STEP)[None, :, None]
    return byte(np.rint((rest * 128.0 + 128.0) / step) * step)
