"""Polygon File Format: header, elements, and the INRIA layout of a 3DGS capture, with its variants.

Public description: Kerbl et al. 2023, https://github.com/graphdeco-inria/gaussian-splatting (properties of
``point_cloud.ply``); PLY itself: G. Turk 1994.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io.activation import with_filter, with_logarithms
from egs_warp.io.atomic import atomic_write
from egs_warp.io.limits import MIN_LOG_SCALE, read_bytes
from egs_warp.io.ply_comments import ANTIALIASED_LINE, antialiased_of, up_of
from egs_warp.io.raw import RawCapture, bands_note, full_bands, logits_from_opacities, property_names

_TYPES = {
    **dict.fromkeys(("char", "int8", "i1"), "i1"),
    **dict.fromkeys(("uchar", "uint8", "u1"), "u1"),
    **dict.fromkeys(("short", "int16", "i2"), "i2"),
    **dict.fromkeys(("ushort", "uint16", "u2"), "u2"),
    **dict.fromkeys(("int", "int32", "i4"), "i4"),
    **dict.fromkeys(("uint", "uint32", "u4"), "u4"),
    **dict.fromkeys(("int64", "i8"), "i8"),
    **dict.fromkeys(("uint64", "u8"), "u8"),
    **dict.fromkeys(("half", "float16", "f2"), "f2"),
    **dict.fromkeys(("float", "float32", "f4"), "f4"),
    **dict.fromkeys(("double", "float64", "f8"), "f8"),
}
"""Types of properties by name: the original names of G. Turk, names with the number of bits, NumPy's names, and half
floats, which Babylon.js writes."""
_BYTE_ORDERS = {b"binary_little_endian": "<", b"binary_big_endian": ">", b"ascii": None}
_SHOWN = 5
"""Maximum number of names that a note lists."""
# Number of rows of a block, small enough for the cache while its columns are gathered one by one.
_BLOCK_ROWS = 16384
_FEW_COLUMNS = 8


@dataclass(frozen=True)
class PlyElement:
    """One ``element`` of a .ply header."""

    name: str
    count: int
    """Number of rows that the header declares."""
    dtype: np.dtype | None
    """Structured type of one row, possibly without fields; None if it contains a list, so that its size is unknown."""


@dataclass(frozen=True)
class PlyHeader:
    """Header of a .ply."""

    byte_order: str | None
    """``<`` (little-endian) or ``>`` (big-endian); None for a text file."""
    elements: tuple[PlyElement, ...]
    size: int
    """Size of the header in bytes."""
    comments: tuple[str, ...] = ()
    """Texts of the ``comment`` and ``obj_info`` lines."""

    def element(self, name: str) -> PlyElement | None:
        """Return the element called ``name``, or None."""
        return next((element for element in self.elements if element.name == name), None)


def read_header(data: bytes, source: Path) -> PlyHeader:
    """Parse a .ply header. Raises ``UserError`` if it is truncated or malformed."""
    end = re.search(rb"^end_header[ \t]*\r?\n", data, re.MULTILINE)
    if end is None:
        raise UserError(f"{source}: truncated: the .ply header has no end_header line; copy or export the file again")
    byte_order: str | None = ""
    elements: list[tuple[str, int, list[tuple[str, str | None]]]] = []
    comments: list[str] = []
    for line in data[: end.start()].splitlines()[1:]:
        words = line.split()
        match words:
            case []:
                continue
            case [b"comment" | b"obj_info", *_]:
                comments.append(line.strip().partition(b" ")[2].decode("latin-1").strip())
            case [b"format", kind, _] if kind in _BYTE_ORDERS:
                byte_order = _BYTE_ORDERS[kind]
            case [b"element", name, count] if count.isdigit() and len(count) < 16:
                elements.append((name.decode("latin-1"), int(count), []))
            case [b"property", b"list", _, _, name] if elements:
                elements[-1][2].append((name.decode("latin-1"), None))
            case [b"property", kind, name] if elements and kind.decode("latin-1") in _TYPES:
                elements[-1][2].append((name.decode("latin-1"), _TYPES[kind.decode("latin-1")]))
            case _:
                shown = line[:60].decode("latin-1").strip()
                raise UserError(f"{source}: malformed .ply header, line {shown!r}; export the file again")
    twice = _repeated([name for name, _, _ in elements])
    if twice is not None:
        raise UserError(f"{source}: malformed .ply header, element {twice} occurs twice; export the file again")
    if byte_order == "":
        raise UserError(f"{source}: malformed .ply header, no format line; export the file again")
    declared = tuple(_element(source, byte_order, *element) for element in elements)
    return PlyHeader(byte_order, declared, end.end(), tuple(comments))


def _repeated(names: list[str]) -> str | None:
    """Return the first name that occurs more than once; None if there is none."""
    return next((name for name, count in Counter(names).items() if count > 1), None)


def _element(
    source: Path, byte_order: str | None, name: str, count: int, properties: list[tuple[str, str | None]]
) -> PlyElement:
    twice = _repeated([property_name for property_name, _ in properties])
    if twice is not None:
        raise UserError(
            f"{source}: malformed .ply header, element {name} repeats property {twice}; export the file again"
        )
    if any(kind is None for _, kind in properties):
        return PlyElement(name, count, None)
    return PlyElement(name, count, np.dtype([(n, f"{byte_order or '<'}{kind}") for n, kind in properties]))


def read_elements(data: bytes, header: PlyHeader, names: list[str], source: Path) -> dict[str, np.ndarray]:
    """Return structured arrays of the elements ``names``. Raises ``UserError`` for data that are truncated or not
    numeric."""
    if header.byte_order is None:
        return _read_text(data, header, names, source)
    arrays: dict[str, np.ndarray] = {}
    offset = header.size
    for element in header.elements:
        if not set(names) - set(arrays):
            break
        if element.dtype is None:
            raise UserError(f"{source}: element {element.name} before the Gaussians holds a list; export it again")
        end = offset + element.count * element.dtype.itemsize
        if end > len(data):
            raise UserError(
                f"{source}: truncated: {element.count} rows of element {element.name} need a file of {end} bytes, "
                f"found {len(data)}; copy or export it again"
            )
        if element.name in names:
            arrays[element.name] = np.frombuffer(data, element.dtype, element.count, offset)
        offset = end
    return arrays


def _read_text(data: bytes, header: PlyHeader, names: list[str], source: Path) -> dict[str, np.ndarray]:
    # Read one line at a time: a list of all lines would take far more memory than the file.
    lines = re.finditer(rb"[^\r\n]*[^\s][^\r\n]*", memoryview(data)[header.size :])
    arrays: dict[str, np.ndarray] = {}
    end = 0
    for element in header.elements:
        if not set(names) - set(arrays):
            break
        if element.dtype is not None and not element.dtype.names:
            # The rows of an element without properties are empty lines.
            continue
        count, start = 0, end
        for line in islice(lines, element.count):
            count, end = count + 1, line.end()
        if element.name not in names or element.dtype is None:
            continue
        if count < element.count:
            raise UserError(
                f"{source}: truncated: element {element.name} needs {element.count} lines, found {count}; "
                "copy or export it again"
            )
        columns = len(element.dtype.names or ())
        with warnings.catch_warnings():
            # Old versions of NumPy only warn about text that is not a number; newer ones raise ValueError.
            warnings.simplefilter("error", DeprecationWarning)
            try:
                text: Any = bytes(memoryview(data)[header.size + start : header.size + end])
                values = np.fromstring(text, dtype=np.float64, sep=" ")
            except (DeprecationWarning, ValueError):
                values = np.empty(0)
        if len(values) != element.count * columns:
            raise UserError(
                f"{source}: element {element.name} is not {element.count} lines of {columns} numbers; export it again"
            )
        arrays[element.name] = values.view([(name, "f8") for name in element.dtype.names or ()])
    return arrays


def columns_as_float32(rows: np.ndarray, names: list[str]) -> np.ndarray:
    """Return the fields ``names`` of the structured array ``rows`` as (n, len(names)) float32."""
    out = np.empty((len(rows), len(names)), np.float32)
    layout: Any = rows.dtype.fields or {}
    fields = [layout[name] for name in names]
    aligned = rows.dtype.itemsize % 4 == 0 and all(kind == "<f4" and place % 4 == 0 for kind, place, *_ in fields)
    if aligned and len(names) > _FEW_COLUMNS:
        # Copying all columns in a single pass over the rows takes a quarter of the time of one pass per column.
        words = rows.view("<f4").reshape(len(rows), rows.dtype.itemsize // 4)
        columns = [place // 4 for _, place, *_ in fields]
        for start in range(0, len(rows), _BLOCK_ROWS):
            block = slice(start, start + _BLOCK_ROWS)
            np.take(words[block], columns, axis=1, out=out[block], mode="clip")
        return out
    for start in range(0, len(rows), _BLOCK_ROWS):
        block = rows[start : start + _BLOCK_ROWS]
        for column, name in enumerate(names):
            out[start : start + _BLOCK_ROWS, column] = block[name]
    return out


_FILTER = "filter_3D"
"""Property of the size of the 3D filter of Mip-Splatting and of methods that are based on it."""
_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
"""Names of colour properties that are not SH coefficients."""


def decode_ply(data: bytes, header: PlyHeader, source: Path) -> RawCapture:
    """Decode the INRIA layout: the Gaussians are the rows of element ``vertex``, with properties in any order and of
    any numeric type.

    Without ``scale_2``, the Gaussians are flat, as in 2D Gaussian Splatting. Instead of SH coefficients, colours may be
    red, green and blue; instead of the logit of the opacity, there may be alpha. The 3D filter of Mip-Splatting is
    applied. Raises ``UserError`` if the file does
    not contain Gaussians in this layout.
    """
    vertex = header.element("vertex")
    kinds = vertex.dtype if vertex is not None and vertex.dtype is not None else np.dtype([])
    present = kinds.names or ()
    columns = property_names(1)
    flat = "scale_2" not in present
    if flat:
        columns["log_scales"] = columns["log_scales"][:2]
    colours = None
    if not set(columns["sh"]) <= set(present):
        colours = next((list(names) for names in _COLOURS if set(names) <= set(present)), None)
    if "opacity" not in present and "alpha" in present:
        columns["opacity_logits"] = ["alpha"]
    rest = 0
    if colours:
        columns["sh"] = colours
    else:
        rest = _rest_count(present, source)
        columns["sh"] += [f"f_rest_{c * rest + k}" for k in range(full_bands(rest)) for c in range(3)]
    missing = [name for names in columns.values() for name in names if name not in present]
    if missing:
        raise _not_gaussians(header, missing, source)
    rows = read_elements(data, header, ["vertex"], source)["vertex"]
    arrays = {array: columns_as_float32(rows, names) for array, names in columns.items()}
    if colours:
        arrays["sh"] = (_fractions(arrays["sh"], kinds[colours[0]]) - np.float32(0.5)) / np.float32(SH_BAND_0)
    logits, opacity = arrays["opacity_logits"][:, 0], columns["opacity_logits"][0]
    if opacity == "alpha" or kinds[opacity].kind == "u":
        logits = logits_from_opacities(_fractions(logits, kinds[opacity]))
    scales = arrays["log_scales"]
    if flat:
        scales = np.pad(scales, ((0, 0), (0, 1)), constant_values=MIN_LOG_SCALE)
    used = [name for names in columns.values() for name in names]
    double = {name for name in used if kinds[name].kind == "f" and kinds[name].itemsize == 8}
    bands = [name for name in present if name.startswith("f_rest_")] if not colours else []
    is_filtered = _FILTER in present and not flat
    used += [_FILTER] * is_filtered
    up, axis = up_of(header.comments)
    raw = RawCapture(
        format="INRIA .ply" if header.byte_order else "INRIA .ply (text)",
        means=_columns_as_float64(rows, columns["means"]) if double & set(columns["means"]) else arrays["means"],
        rotations=arrays["rotations"],
        log_scales=scales,
        opacity_logits=logits,
        sh=arrays["sh"].reshape(len(rows), len(columns["sh"]) // 3, 3),
        up=up,
        vertical_axis=axis,
        antialiased=antialiased_of(header.comments),
        notes=(
            *bands_note(rest),
            *(("no scale_2: read as flat Gaussians (2DGS)",) if flat else ()),
            *_rounding_notes(rows, [name for name in used if name in double and name not in columns["means"]]),
            *_omission_notes(header, set(present).difference(used, bands, ("nx", "ny", "nz"))),
        ),
    )
    raw = with_logarithms(raw)
    return with_filter(raw, columns_as_float32(rows, [_FILTER])[:, 0]) if is_filtered else raw


def _rest_count(present: Sequence[str], source: Path) -> int:
    """Return the number of SH coefficients above band 0 of each colour channel."""
    numbers = {int(name[7:]) for name in present if re.fullmatch(r"f_rest_\d{1,6}", name)}
    if numbers != set(range(len(numbers))) or len(numbers) % 3:
        raise UserError(
            f"{source}: {len(numbers)} f_rest properties, expected three times 0, 3, 8 or 15, counted from f_rest_0;"
            " export it again"
        )
    return len(numbers) // 3


def _fractions(values: np.ndarray, kind: np.dtype) -> np.ndarray:
    """Return colours or opacities scaled to the range 0 to 1. Integers cover the range of their type, floats 0 to 1 or
    0 to 255."""
    if kind.kind == "u":
        return values / np.float32(np.iinfo(kind).max)
    return values / np.float32(255.0) if np.nanmax(values, initial=0.0) > 1.0 else values


def _not_gaussians(header: PlyHeader, missing: list[str], source: Path) -> UserError:
    """Return the error for a .ply whose vertices lack the properties ``missing``."""
    vertex = header.element("vertex")
    if vertex is None:
        names = ", ".join(element.name for element in header.elements) or "none"
        return UserError(
            f"{source}: not a 3DGS capture: no element vertex (elements: {names}); give a .ply of Gaussians"
        )
    if vertex.dtype is None:
        return UserError(
            f"{source}: not a 3DGS capture: element vertex has a list property; give a .ply of Gaussians without one"
        )
    lacking = f"{source}: not a 3DGS capture: element vertex has no {', '.join(missing)}"
    if any(re.match(r"(f_dc|scale|rot|opacity)", name) for name in vertex.dtype.names or ()):
        return UserError(f"{lacking}, but other properties of Gaussians; export it with all of them")
    faces = next((element.count for element in header.elements if element.name in ("face", "tristrips")), 0)
    if faces:
        return UserError(
            f"{lacking}; it is a mesh of {faces} faces, which cannot be animated: train or export it as Gaussians"
        )
    return UserError(f"{lacking}; it is a point cloud, which cannot be animated: train or export it as Gaussians")


def _rounding_notes(rows: np.ndarray, names: list[str]) -> list[str]:
    """Return a note that names the fields among ``names`` whose values change in single precision."""
    rounded = [name for name in names if not np.array_equal(rows[name], rows[name].astype(np.float32))]
    return [f"rounded to single precision: {_listed(rounded)}"] if rounded else []


def _omission_notes(header: PlyHeader, properties: set[str]) -> list[str]:
    """Return notes on what is left out: elements other than ``vertex``, and unused ``properties`` of the Gaussians."""
    notes = [f"properties left out: {_listed(sorted(properties))}"] if properties else []
    elements = [element.name for element in header.elements if element.name != "vertex" and element.count]
    return [*notes, *([f"elements left out: {_listed(elements)}"] if elements else [])]


def _listed(names: list[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")


def _columns_as_float64(rows: np.ndarray, names: list[str]) -> np.ndarray:
    return np.stack([rows[name] for name in names], axis=1).astype(np.float64)


def read_point_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions (n, 3) float64 and colours (n, 3) float64, 0 to 1, of a .ply of points; points without colours are
    grey.

    Raises ``UserError`` if it is malformed or has no positions.
    """
    data = read_bytes(path)
    header = read_header(data, path)
    rows = read_elements(data, header, ["vertex"], path).get("vertex")
    names = () if rows is None else rows.dtype.names or ()
    if rows is None or not {"x", "y", "z"} <= set(names):
        raise UserError(f"{path}: it has no vertices with x, y and z; export it again")
    positions = np.stack([rows[name] for name in ("x", "y", "z")], axis=1).astype(float)
    colours = np.full(positions.shape, 0.5)
    vertex, found = header.element("vertex"), [three for three in _COLOURS if set(three) <= set(names)]
    if found and vertex is not None and vertex.dtype is not None:
        # Text files contain the values of their types, too.
        colours = _fractions(_columns_as_float64(rows, list(found[0])), vertex.dtype[found[0][0]])
    finite = np.isfinite(positions).all(axis=1) & np.isfinite(colours).all(axis=1)
    return positions[finite], colours[finite]


def write_ply(path: Path | str, cloud: GaussianCloud, *, origin: np.ndarray | None = None) -> None:
    """Write ``cloud`` as an INRIA .ply, binary little-endian, float32: reading it again gives bitwise equal values.

    Normals, always 0, are included because some viewers rely on the position of each property. Raises ``UserError`` if
    the file cannot be written.

    Args:
        path: The file.
        cloud: The Gaussians.
        origin: (3,) Offset that is added to the positions (``Capture.origin``), which are then written as doubles.
    """
    rest_count = 3 * ((cloud.sh_degree + 1) ** 2 - 1)
    names = [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(rest_count)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    kinds = ["float" if origin is None else "double"] * 3 + ["float"] * (len(names) - 3)
    header = "ply\nformat binary_little_endian 1.0\n" + ANTIALIASED_LINE * cloud.antialiased
    header += f"element vertex {cloud.count}\n"
    header += "".join(f"property {kind} {name}\n" for kind, name in zip(kinds, names, strict=True)) + "end_header\n"
    means, sh = cloud.means.numpy(), cloud.sh.numpy()
    logits, log_scales, rotations = (a.numpy() for a in (cloud.opacity_logits, cloud.log_scales, cloud.rotations))
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(header.encode())
        for start in range(0, cloud.count, _BLOCK_ROWS):
            block = slice(start, start + _BLOCK_ROWS)
            rows = np.zeros((len(means[block]), len(names)), "<f4")
            rows[:, 0:3] = means[block]
            rows[:, 6:9] = sh[block, 0]
            rows[:, 9 : 9 + rest_count] = channel_major(sh[block])
            rows[:, -8] = logits[block]
            rows[:, -7:-4] = log_scales[block]
            rows[:, -4:] = rotations[block]
            if origin is None:
                file.write(rows.data)
            else:
                places = (means[block] + origin).astype("<f8")
                file.write(np.concatenate([places.view("u1"), rows[:, 3:].copy().view("u1")], axis=1).data)


def channel_major(sh: np.ndarray) -> np.ndarray:
    """Return ``f_rest`` (n, 3 (K-1)) of the coefficients ``sh`` (n, K, 3): all of red, then green, then blue."""
    return np.ascontiguousarray(sh[:, 1:].transpose(0, 2, 1)).reshape(len(sh), -1)


def coefficient_major(f_dc: np.ndarray, f_rest: np.ndarray) -> np.ndarray:
    """Return coefficients (n, K, 3) from ``f_dc`` (n, 3) and ``f_rest`` (n, 3 (K-1)); inverse of ``channel_major``."""
    rest = f_rest.reshape(len(f_rest), 3, -1).transpose(0, 2, 1)
    return np.concatenate([f_dc[:, None], rest], axis=1)
