"""Camera poses in JSON: INRIA's ``cameras.json`` and the ``transforms.json`` of NeRF-synthetic and nerfstudio."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.lens import Lens
from egs_warp.io.atomic import atomic_write
from egs_warp.io.limits import MAX_TEXT_BYTES, read_bytes
from egs_warp.io.orientation import orientation
from egs_warp.io.photo_files import PhotoAndMask, PhotoFiles
from egs_warp.io.posed_images import (
    ExcludedPhoto,
    PosedImage,
    camera_of_photo,
    convert_each,
    is_rotation,
    size_of_photo,
)
from egs_warp.io.text import decimal_number, decode_text, load_json, whole_number

_DISTORTIONS = (
    *("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"),
    *("k", "omega", "alpha", "beta", "sx1", "sy1", "s1", "s2", "s3", "s4"),
)
LENSES = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "FOV"),
    *("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE", "THIN_PRISM_FISHEYE"),
    *("RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "EUCM"),
)
"""Values of ``camera_model`` in transforms.json."""
_TOKEN = re.compile(r'"(?:\\.|[^"\\])*"|[-+]?\b(?:nan(?:\(\w*\))?|inf(?:inity)?)(?![\w(])', re.IGNORECASE)
"""Pattern of a string, or of a non-finite number in the notation of C and C++."""


def parse_pose_json(source: Path) -> Any:
    """Parse a JSON file of poses. Raises ``UserError`` if it is not JSON."""
    text = decode_text(read_bytes(source, at_most=MAX_TEXT_BYTES), source)
    try:
        return load_json(text, parse_int=whole_number)
    except ValueError as error:
        # Replace numbers that JSON does not define by NaN, so that only the photos that use them become invalid.
        repaired = _TOKEN.sub(lambda token: token[0] if token[0].startswith('"') else "NaN", text)
        if repaired != text:
            try:
                return load_json(repaired, parse_int=whole_number)
            except ValueError:
                pass
        where = f" at line {error.lineno} ({error.msg})" if isinstance(error, json.JSONDecodeError) else ""
        raise UserError(f"{source}: not readable JSON{where}; give a cameras.json or a transforms.json") from error


def read_pose_json(source: Path, files: PhotoFiles) -> tuple[list[PosedImage], list[ExcludedPhoto]]:
    """Read the cameras of a JSON file, and find their photos and masks in ``files``. Invalid cameras are excluded.

    Raises ``UserError`` for a file that is malformed, or has no valid camera.
    """
    tree = parse_pose_json(source)
    empty = f"{source}: it has no cameras; export the poses again"
    if isinstance(tree, list):
        names = _names(tree, "img_name")
        places = files.locate(names, (source.parent / "images", source.parent))
        entries = _entries(source, "camera", tree, places)
        return convert_each(zip(names, entries, strict=True), _inria, empty)
    if not isinstance(tree, dict) or not isinstance(tree.get("frames"), list):
        raise UserError(f"{source}: neither a list of cameras nor frames; give a cameras.json or a transforms.json")
    frames = tree["frames"]
    names = _names(frames, "file_path")
    places = files.locate(names, (source.parent,), _names(frames, "mask_path", default=""))
    sizes = _sizes(tree, places, source)
    entries = zip(_entries(source, "frame", frames, places), sizes, strict=True)
    return convert_each(zip(names, entries, strict=True), lambda one: _transform(one[0], tree, one[1]), empty)


@dataclass(frozen=True)
class _Entry:
    """A camera of the file."""

    source: Path
    where: str
    fields: object
    place: PhotoAndMask


def _entries(source: Path, kind: str, entries: Sequence[object], places: Sequence[PhotoAndMask]) -> list[_Entry]:
    return [
        _Entry(source, f"{kind} {number}", fields, place)
        for number, (fields, place) in enumerate(zip(entries, places, strict=True))
    ]


def _names(entries: list, key: str, default: str | None = None) -> list[str]:
    """Return the name of each entry; entries without a name get ``default`` or the number of the entry."""
    named = [entry.get(key) if isinstance(entry, dict) else None for entry in entries]
    return [
        name if isinstance(name, str) else (f"number {number}" if default is None else default)
        for number, name in enumerate(named)
    ]


def _inria(entry: _Entry) -> PosedImage:
    """Convert a camera of INRIA's format: ``position`` and ``rotation`` map the axes of the camera, which are OpenCV's,
    to the world."""
    record = _Record(entry.source, entry.where, entry.fields)
    name = record.text("img_name")
    width, height = record.size("width"), record.size("height")
    rotation = record.rotation(record.numbers("rotation", (3, 3))).T
    camera = camera_of_photo(
        f"{entry.source}: {entry.where}",
        width=width,
        height=height,
        fx=record.focal("fx"),
        fy=record.focal("fy"),
        cx=record.centre("cx", width),
        cy=record.centre("cy", height),
        rotation=rotation,
        translation=-rotation @ record.numbers("position", (3,)),
    )
    return PosedImage(name, camera, entry.place.image, None, entry.place.mask, entry.place.missing)


def _transform(entry: _Entry, shared: dict, size: tuple[int, int] | None) -> PosedImage:
    """Convert a frame of transforms.json: ``transform_matrix`` maps the axes of the camera, with y up and z backwards,
    to the world.

    Args:
        entry: the frame.
        shared: intrinsics that apply to frames without their own.
        size: size of the photo as stored, for a file without sizes.
    """
    if not isinstance(entry.fields, dict):
        raise UserError(f"{entry.source}: {entry.where} is not a JSON object; export the poses again")
    record = _Record(entry.source, entry.where, _known(shared) | _known(entry.fields))
    name = record.text("file_path")
    lens = _lens(record)
    if "w" in record.fields and "h" in record.fields:
        width, height = record.size("w"), record.size("h")
    else:
        width, height = _oriented_size(record, entry.place.image, size)
    if "fl_x" in record.fields:
        fx = record.focal("fl_x")
    else:
        fx = 0.5 * width / np.tan(0.5 * record.angle("camera_angle_x"))
    if "fl_y" in record.fields:
        fy = record.focal("fl_y")
    elif "camera_angle_y" in record.fields:
        fy = 0.5 * height / np.tan(0.5 * record.angle("camera_angle_y"))
    else:
        fy = fx
    matrix = record.matrix("transform_matrix")
    axes = matrix[:3, :3]
    if not is_rotation(axes):
        # The matrix of a camera object in Blender contains the scale of the object.
        axes = axes / np.maximum(np.linalg.norm(axes, axis=0), 1e-30)
    rotation = np.diag([1.0, -1.0, -1.0]) @ record.rotation(axes).T
    camera = camera_of_photo(
        f"{entry.source}: {entry.where}",
        width=width,
        height=height,
        fx=float(fx),
        fy=float(fy),
        cx=record.centre("cx", width),
        cy=record.centre("cy", height),
        rotation=rotation,
        translation=-rotation @ matrix[:3, 3],
    )
    return PosedImage(name, camera, entry.place.image, lens, entry.place.mask, entry.place.missing)


def _lens(record: _Record) -> Lens | None:
    model = record.fields.get("camera_model", "OPENCV_FISHEYE" if record.fields.get("is_fisheye") else "OPENCV")
    model = model.upper() if isinstance(model, str) else model
    if model not in LENSES:
        raise UserError(
            f"{record.source}: {record.where} has the unknown lens model {model!r}; give one of {', '.join(LENSES)}"
        )
    values = {key: float(record.numbers(key, ())) for key in _DISTORTIONS if record.fields.get(key)}
    try:
        return Lens.named(model, values)
    except ValueError as error:
        raise UserError(
            f"{record.source}: {record.where} has no valid lens ({error}); export the poses again"
        ) from None


def _oriented_size(record: _Record, image: Path | None, size: tuple[int, int] | None) -> tuple[int, int]:
    """Return the size of the photo: as stored, or after applying its EXIF orientation if the principal point fits only
    then.

    Raises the error of the photo if its ``size`` is unknown.
    """
    width, height = size or size_of_photo(image, f"{record.source}: {record.where}")
    if image is not None and "cx" in record.fields and "cy" in record.fields and orientation(image) >= 5:
        cx, cy = float(record.numbers("cx", ())), float(record.numbers("cy", ()))
        if np.hypot(cx - height / 2, cy - width / 2) < np.hypot(cx - width / 2, cy - height / 2):
            return height, width
    return width, height


def _sizes(tree: dict, places: Sequence[PhotoAndMask], source: Path) -> list[tuple[int, int] | None]:
    """Return the size of each photo as stored, for a file without sizes. If all readable photos have the same size,
    this size is assumed for the others, too."""
    frames = [frame for frame in tree["frames"] if isinstance(frame, dict)]
    if all((tree | _known(frame)).get(key) is not None for frame in frames for key in ("w", "h")):
        return [None] * len(places)
    sizes: list[tuple[int, int] | None] = [None] * len(places)
    for number, place in enumerate(places):
        with suppress(UserError):
            sizes[number] = size_of_photo(place.image, "")
    known = {size for size in sizes if size is not None}
    if not known:
        raise UserError(f"{source}: it has no w and h, and none of its photos can be read; add w and h, or the photos")
    common = known.pop() if len(known) == 1 else None
    return [size or common for size in sizes]


class _Record:
    """Checked access to one camera's fields: every mistake becomes a ``UserError`` that names camera and field."""

    def __init__(self, source: Path, where: str, fields: object) -> None:
        self.source = source
        self.where = where
        if not isinstance(fields, dict):
            raise UserError(f"{source}: {where} is not a JSON object; export the poses again")
        self.fields = _known(fields)

    def numbers(self, key: str, shape: tuple[int, ...]) -> np.ndarray:
        """Return an array of ``shape``, float64, finite."""
        values = self._array(key)
        if values.shape != shape or not np.isfinite(values).all():
            count = int(np.prod(shape))
            raise self._wrong(key, "a finite number" if count == 1 else f"{count} finite numbers")
        return values

    def matrix(self, key: str) -> np.ndarray:
        """Return the first three rows (3, 4) of an affine map whose last row may be missing."""
        values = self._array(key)
        if values.shape in ((12,), (16,)):
            values = values.reshape(-1, 4)
        if values.shape not in ((3, 4), (4, 4)) or not np.isfinite(values).all():
            raise self._wrong(key, "a matrix of 3 or 4 rows of 4 finite numbers")
        return values[:3]

    def _array(self, key: str) -> np.ndarray:
        """Return the numbers of a field; NaN if it does not contain numbers."""
        try:
            return np.array(_with_decimal_points(self.fields.get(key)), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            return np.array(np.nan)

    def focal(self, key: str) -> float:
        """Return a focal length in pixels."""
        value = float(self.numbers(key, ()))
        if value <= 0:
            raise self._wrong(key, "a positive number")
        return value

    def angle(self, key: str) -> float:
        """Return a field of view, rad."""
        value = float(self.numbers(key, ()))
        if not 0 < value < np.pi:
            raise self._wrong(key, "an angle between 0 and pi")
        return value

    def centre(self, key: str, size: int) -> float:
        """Return a coordinate of the principal point in pixels; the middle of ``size`` if the field is missing."""
        return float(self.numbers(key, ())) if key in self.fields else size / 2.0

    def size(self, key: str) -> int:
        """Return a width or height in pixels."""
        value = float(self.numbers(key, ()))
        if value < 1 or value != int(value):
            raise self._wrong(key, "a number of pixels")
        return int(value)

    def text(self, key: str) -> str:
        """Return the nonempty text of ``key``."""
        value = self.fields.get(key)
        if not isinstance(value, str) or not value or "\0" in value:
            raise self._wrong(key, "a name")
        return value

    def rotation(self, matrix: np.ndarray) -> np.ndarray:
        """Return ``matrix`` (3, 3) if it is a rotation."""
        if not is_rotation(matrix):
            raise UserError(f"{self.source}: {self.where}: the pose is not a rotation; export the poses again")
        return matrix

    def _wrong(self, key: str, expected: str) -> UserError:
        value = self.fields.get(key)
        if isinstance(value, list):
            given = f" of shape {self._array(key).shape}"
        else:
            given = f" {value!s:.60}" if isinstance(value, str | int | float) else ""
        return UserError(f"{self.source}: {self.where}: {key}{given} is not {expected}; export the poses again")


def _known(fields: dict) -> dict:
    """Return ``fields`` without those of null, which some programs write for what they do not know."""
    return {key: value for key, value in fields.items() if value is not None}


def _with_decimal_points(value: object) -> object:
    """Return ``value`` with texts such as "0,5" replaced by the numbers that they represent."""
    if isinstance(value, list):
        return [_with_decimal_points(one) for one in value]
    return decimal_number(value) if isinstance(value, str) else value


def write_cameras(path: Path | str, cameras: Sequence[Camera], names: Sequence[str]) -> None:
    """Write INRIA's ``cameras.json``, which ``read_cameras`` and most tools read. Principal points must be in the
    middle of the images."""
    entries = [
        {
            "id": number,
            "img_name": name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.centre.tolist(),
            "rotation": camera.rotation.T.tolist(),
            "fx": camera.fx,
            "fy": camera.fy,
        }
        for number, (camera, name) in enumerate(zip(cameras, names, strict=True))
    ]
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(entries, indent=1))
