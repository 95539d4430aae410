"""PlayCanvas compressed .ply: chunks of 256 Gaussians, each value is quantised between the chunk's minimum and maximum.

Public description: https://blog.playcanvas.com/compressing-gaussian-splats and the SuperSplat documentation. A chunk
has 18 floats: the bounds of position, log scale and colour. A Gaussian has four uint32: position and scale with 11, 10
and 11 bits, rotation with 2 bits for the index of the largest component and 10 for each of the others, and colour and
opacity with 8 bits each. Coefficients of f_rest are uint8 and cover the range -4 to 4.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io.atomic import atomic_write
from egs_warp.io.morton import morton_order
from egs_warp.io.ply import PlyHeader, channel_major, coefficient_major, columns_as_float32, read_elements
from egs_warp.io.ply_comments import ANTIALIASED_LINE, antialiased_of, up_of
from egs_warp.io.raw import (
    RawCapture,
    bands_note,
    bit_field,
    byte,
    bytes_from_logits,
    full_bands,
    largest_dropped,
    largest_restored,
    logits_from_bytes,
)

_CHUNK = 256
_BOUNDS = [
    f"{end}_{quantity}"
    for quantities in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for quantity in quantities
]
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_POSITION_FIELDS = ((21, 11), (11, 10), (0, 11))
_ROTATION_FIELDS = ((20, 10), (10, 10), (0, 10))
_COLOUR_FIELDS = ((24, 8), (16, 8), (8, 8))
_SH_RANGE = 8.0
# Like other writers of this format, clamp log scales to this magnitude, so that one erroneous Gaussian does not reduce
# the precision of its whole chunk.
_SCALE_LIMIT = 20.0


def is_compressed(header: PlyHeader) -> bool:
    """Return True if ``header`` belongs to a compressed .ply."""
    vertex = header.element("vertex")
    return (
        header.element("chunk") is not None
        and vertex is not None
        and vertex.dtype is not None
        and "packed_position" in (vertex.dtype.names or ())
    )


def decode_compressed_ply(data: bytes, header: PlyHeader, source: Path) -> RawCapture:
    """Decode the Gaussians. Raises ``UserError`` for a file that is truncated or lacks a property."""
    sh_element = header.element("sh")
    # At degree 0, gsplat writes an SH element without properties, and other programs write one without rows.
    has_rest = sh_element is not None and sh_element.count > 0 and (sh_element.dtype is None or sh_element.dtype.names)
    elements = read_elements(data, header, ["chunk", "vertex"] + (["sh"] if has_rest else []), source)
    chunk, vertex = elements.get("chunk"), elements.get("vertex")
    chunk_names = (chunk.dtype.names or ()) if chunk is not None else ()
    vertex_names = (vertex.dtype.names or ()) if vertex is not None else ()
    # Files written in 2023 have no bounds of colour; their colours range from 0 to 1.
    bounds = _BOUNDS if "min_r" in chunk_names else _BOUNDS[:12]
    missing = [n for n in bounds if n not in chunk_names] + [n for n in _PACKED if n not in vertex_names]
    if chunk is None or vertex is None or missing:
        raise UserError(f"{source}: the compressed .ply has no {', '.join(missing)}; export it again")
    if len(chunk) * _CHUNK < len(vertex):
        raise UserError(
            f"{source}: {len(vertex)} Gaussians need {-(-len(vertex) // _CHUNK)} chunks, found {len(chunk)}; "
            "export it again"
        )
    limits = np.tile(np.array([0, 0, 0, 1, 1, 1], np.float32), (len(chunk), 3))
    limits[:, : len(bounds)] = columns_as_float32(chunk, bounds)
    limits = limits.reshape(-1, 3, 2, 3)[np.arange(len(vertex)) // _CHUNK]
    # Packed integers are float64 if they come from a text .ply, and big-endian if they come from a big-endian .ply.
    words = {name: vertex[name].astype(np.uint32) for name in _PACKED}
    means = _between(limits[:, 0], _fields(words["packed_position"], _POSITION_FIELDS))
    log_scales = _between(limits[:, 1], _fields(words["packed_scale"], _POSITION_FIELDS))
    colours = _between(limits[:, 2], _fields(words["packed_color"], _COLOUR_FIELDS))
    three = (_fields(words["packed_rotation"], _ROTATION_FIELDS) - 0.5) * np.sqrt(2.0)
    f_dc = ((colours - 0.5) / SH_BAND_0).astype(np.float32)
    f_rest, notes = np.empty((len(vertex), 0), np.float32), ()
    if "sh" in elements:
        f_rest, notes = _decode_rest(elements["sh"], len(vertex), source)
    up, axis = up_of(header.comments)
    return RawCapture(
        format="compressed .ply",
        means=means.astype(np.float32),
        rotations=largest_restored(three, words["packed_rotation"] >> np.uint32(30)),
        log_scales=log_scales.astype(np.float32),
        opacity_logits=logits_from_bytes(words["packed_color"] & np.uint32(255)),
        sh=coefficient_major(f_dc, f_rest),
        up=up,
        vertical_axis=axis,
        antialiased=antialiased_of(header.comments),
        notes=notes,
    )


def _fields(words: np.ndarray, fields: tuple[tuple[int, int], ...]) -> np.ndarray:
    return np.stack([bit_field(words, shift, bits) for shift, bits in fields], axis=1)


def _between(limits: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    return limits[:, 0] * (1.0 - fraction) + limits[:, 1] * fraction


def _decode_rest(rows: np.ndarray, count: int, source: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return ``f_rest`` (n, 3 (K-1)) of the complete bands, channel by channel, and a note if further coefficients are
    left out."""
    names = rows.dtype.names or ()
    if len(rows) != count or set(names) != {f"f_rest_{i}" for i in range(len(names))} or len(names) % 3:
        raise UserError(
            f"{source}: element sh has {len(rows)} rows of {len(names)} properties, "
            f"expected {count} of 9, 24 or 45 (f_rest_0 ...); export it again"
        )
    rest = len(names) // 3
    levels = np.arange(256)
    fraction = np.where(levels == 0, 0.0, np.where(levels == 255, 1.0, (levels + 0.5) / 256.0))
    table = (_SH_RANGE * (fraction - 0.5)).astype(np.float32)
    kept = [f"f_rest_{c * rest + k}" for c in range(3) for k in range(full_bands(rest))]
    packed = columns_as_float32(rows, kept)
    return table[np.clip(packed, 0, 255).astype(np.uint8)], bands_note(rest)


def write_compressed_ply(path: Path | str, cloud: GaussianCloud, *, keep_order: bool = False) -> np.ndarray:
    """Write ``cloud`` as a compressed .ply: about 16 bytes per Gaussian and one for each SH coefficient above band 0.

    The format is lossy: it rounds positions to 1/1024 of their chunk's size, SH to 1/32 and opacity to 1/255. Gaussians
    are sorted in space, which keeps chunks small, unless ``keep_order`` is set. Returns the index (n,) in ``cloud`` of
    each Gaussian of the file. Raises ``UserError`` if the file cannot be written.
    """
    means = cloud.means.numpy()
    order = np.arange(cloud.count) if keep_order else morton_order(means)
    sh = cloud.sh.numpy()[order]
    colours = sh[:, 0].astype(np.float64) * SH_BAND_0 + 0.5
    log_scales = np.clip(cloud.log_scales.numpy()[order].astype(np.float64), -_SCALE_LIMIT, _SCALE_LIMIT)
    bounds = []
    words = {}
    for name, values, fields in (
        ("packed_position", means[order].astype(np.float64), _POSITION_FIELDS),
        ("packed_scale", log_scales, _POSITION_FIELDS),
        ("packed_color", colours, _COLOUR_FIELDS),
    ):
        starts = np.arange(0, len(values), _CHUNK)
        limits = np.stack([np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)], axis=1)
        limits = limits.astype(np.float32)
        bounds.append(limits.reshape(-1, 6))
        low, high = np.repeat(limits.astype(np.float64), _CHUNK, axis=0)[: len(values)].transpose(1, 0, 2)
        words[name] = _packed((values - low) / np.maximum(high - low, 1e-20), fields)
    words["packed_color"] |= bytes_from_logits(cloud.opacity_logits.numpy()[order]).astype(np.uint32)
    three, largest = largest_dropped(cloud.rotations.numpy()[order])
    words["packed_rotation"] = _packed(three / np.sqrt(2.0) + 0.5, _ROTATION_FIELDS) | (largest << np.uint32(30))

    rest = byte(np.floor((channel_major(sh) / _SH_RANGE + 0.5) * 256.0))
    chunks = np.concatenate(bounds, axis=1).astype("<f4")
    header = "ply\nformat binary_little_endian 1.0\ncomment Generated by egs_warp\n"
    header += ANTIALIASED_LINE * cloud.antialiased
    header += f"element chunk {len(chunks)}\n" + "".join(f"property float {name}\n" for name in _BOUNDS)
    header += f"element vertex {cloud.count}\n" + "".join(f"property uint {name}\n" for name in _PACKED)
    if rest.shape[1]:
        header += f"element sh {cloud.count}\n" + "".join(f"property uchar f_rest_{i}\n" for i in range(rest.shape[1]))
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(header.encode() + b"end_header\n" + chunks.tobytes())
        file.write(np.stack([words[name] for name in _PACKED], axis=1).astype("<u4").tobytes())
        file.write(rest.tobytes())
    return order


def _packed(fractions: np.ndarray, fields: tuple[tuple[int, int], ...]) -> np.ndarray:
    words = np.zeros(len(fractions), np.uint32)
    for column, (shift, bits) in enumerate(fields):
        top = (1 << bits) - 1
        words |= np.clip(np.rint(fractions[:, column] * top), 0, top).astype(np.uint32) << np.uint32(shift)
    return words
