"""Camera parameters of RealityScan and RealityCapture (*Internal/External camera parameters*, .csv).

The columns are name, x, y, alt, heading, pitch, roll, f, px, py, k1 to k4, t1 and t2. Angles are in degrees. ``f`` is
the focal length in mm for a longer side of 36 mm, and ``px`` and ``py`` are the offset of the principal point relative
to the longer side. In the camera's axes, the optical axis is -z and y points up; Rz(-heading) Rx(pitch) Ry(roll)
rotates these axes to the world.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.lens import Lens
from egs_warp.io.limits import MAX_TEXT_BYTES, read_bytes
from egs_warp.io.photo_files import PhotoAndMask, PhotoFiles
from egs_warp.io.posed_images import (
    ExcludedPhoto,
    PosedImage,
    camera_of_photo,
    convert_each,
    size_of_photo,
)
from egs_warp.io.text import decimal_number, decode_text

_FILM_WIDTH = 36.0
"""Longer side to which ``f`` refers, mm."""
_SEPARATORS = (";", "\t", ",")
_OTHER_NAMES = {"z": "alt", "altitude": "alt"}
_REQUIRED = ("x", "y", "alt", "heading", "pitch", "roll", "f")
_OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_EXPORT = "export Internal/External camera parameters"


def read_reality_scan(source: Path, files: PhotoFiles) -> tuple[list[PosedImage], list[ExcludedPhoto]]:
    """Read the cameras of a .csv, and find their photos and masks in ``files``.

    Invalid rows are excluded, and so are photos that cannot be read, because only the photos contain their sizes.
    Raises ``UserError`` for a file that is malformed or has no valid camera.
    """
    text = decode_text(read_bytes(source, at_most=MAX_TEXT_BYTES), source)
    lines = text.splitlines()
    start = next((at for at, line in enumerate(lines) if {"heading", "pitch"} <= _words(line)), None)
    if start is None:
        raise UserError(
            f"{source}: it has no line with the names of the columns (heading, pitch, roll, ...); {_EXPORT}"
        )
    separator = next((one for one in _SEPARATORS if lines[start].count(one) >= 3), ",")
    columns = [name.strip(' #"').lower() for name in lines[start].split(separator)]
    columns = [_OTHER_NAMES.get(name, name) for name in columns]
    missing = [name for name in ("name", *_REQUIRED) if name not in columns]
    if missing:
        raise UserError(f"{source}: line {start + 1} has no column {', '.join(missing)}; {_EXPORT}")
    rows = []
    try:
        for at, row in enumerate(csv.reader(lines[start + 1 :], delimiter=separator), start=start + 2):
            if any(field.strip() for field in row) and not row[0].startswith("#"):
                rows.append(_Row(source, at, columns, row))
    except csv.Error as error:
        raise UserError(f"{source}: not a table ({error}); {_EXPORT}") from error
    names = [row.name for row in rows]
    places = files.locate(names, (source.parent / "images", source.parent))
    images, excluded = convert_each(
        ((row.name, (row, place)) for row, place in zip(rows, places, strict=True)),
        lambda one: _posed(*one),
        f"{source}: it has no cameras; {_EXPORT}",
    )
    return images, excluded


def _words(line: str) -> set[str]:
    for separator in _SEPARATORS:
        line = line.replace(separator, " ")
    return set(line.lower().replace('"', " ").split())


class _Row:
    """Checked access to the fields of one row of the file."""

    def __init__(self, source: Path, line: int, columns: list[str], fields: list[str]) -> None:
        self.where = f"{source}: line {line}"
        self.name = fields[columns.index("name")].strip() if columns.index("name") < len(fields) else f"line {line}"
        self._columns, self._fields = columns, fields

    def numbers(self, names: tuple[str, ...]) -> list[float]:
        """Return the numbers in the columns ``names``; 0 for missing columns."""
        if len([field for field in self._fields if field.strip()]) > len(self._columns):
            raise UserError(
                f"{self.where} has {len(self._fields)} fields, but there are {len(self._columns)} columns; export"
                " numbers with decimal points"
            )
        numbers = []
        for name in names:
            at = self._columns.index(name) if name in self._columns else None
            text = "0" if at is None else self._fields[at].strip() if at < len(self._fields) else ""
            try:
                numbers.append(decimal_number(text))
            except ValueError:
                numbers.append(np.nan)
            if not np.isfinite(numbers[-1]):
                raise UserError(f"{self.where}: {name} {text[:40]!r} is not a finite number; {_EXPORT} again")
        return numbers


def _posed(row: _Row, place: PhotoAndMask) -> PosedImage:
    x, y, altitude, heading, pitch, roll, focal = row.numbers(_REQUIRED)
    px, py, k1, k2, k3, k4, t1, t2 = row.numbers(_OPTIONAL)
    width, height = size_of_photo(place.image, row.where)
    side = max(width, height)
    rotation = (_turn(2, -heading) @ _turn(0, pitch) @ _turn(1, roll) @ np.diag([1.0, -1.0, -1.0])).T
    camera = camera_of_photo(
        row.where,
        width=width,
        height=height,
        fx=focal * side / _FILM_WIDTH,
        fy=focal * side / _FILM_WIDTH,
        cx=width / 2.0 + px * side,
        cy=height / 2.0 + py * side,
        rotation=rotation,
        translation=-rotation @ np.array([x, y, altitude]),
    )
    lens = Lens(radial=(k1, k2, k3, k4), tangential=(t1, t2))
    return PosedImage(
        row.name,
        camera,
        place.image,
        lens if lens.is_distorted else None,
        place.mask,
        place.missing,
    )


def _turn(axis: int, degrees: float) -> np.ndarray:
    """Return the rotation (3, 3) about a coordinate axis, counterclockwise seen from the tip of the axis."""
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[[first, second], [first, second]] = cosine
    matrix[first, second], matrix[second, first] = -sine, sine
    return matrix
