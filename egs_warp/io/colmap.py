"""COLMAP sparse models: ``cameras`` and ``images``, as text or binary.

Public description: https://colmap.github.io/format.html
"""

from __future__ import annotations

import io
import re
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.lens import Lens
from egs_warp.io.limits import read_bytes
from egs_warp.io.posed_images import ExcludedPhoto, convert_each
from egs_warp.io.text import decimal_number, decode_text

# Name and parameters of each camera model by its number in the binary format.
_MODELS = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fx fy cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    7: ("FOV", "fx fy cx cy omega"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    10: ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4"),
    12: ("SIMPLE_DIVISION", "f cx cy k"),
    13: ("DIVISION", "fx fy cx cy k"),
    14: ("SIMPLE_FISHEYE", "f cx cy"),
    15: ("FISHEYE", "fx fy cx cy"),
    16: ("EUCM", "fx fy cx cy alpha beta"),
}
_PARAMETERS = {name: parameters.split() for name, parameters in _MODELS.values()}
_IMAGE_LINE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_IMAGE_START = 300
"""Number of characters at the beginning of a line that suffice to contain all values of an image."""
_POINT_BYTES = 24
"""Number of bytes of one point in the list of a photo."""
_TRACK_BYTES = 8
"""Number of bytes of one photo in the list of a point."""


@dataclass(frozen=True)
class _Intrinsics:
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens | None
    """Distortion of the photo; None for a pinhole camera."""


@dataclass(frozen=True)
class ColmapView(_Intrinsics):
    """One registered photo."""

    name: str
    quaternion: np.ndarray
    """(4,) w x y z, rotation from world to camera; not normalised, but not near zero."""
    translation: np.ndarray
    """(3,) translation from world to camera, world units."""


@dataclass(frozen=True)
class ColmapModel:
    """Photos of a sparse model, from ``cameras`` and ``images``."""

    views: tuple[ColmapView, ...]
    """Photos in the order of the file, at least one."""
    excluded: tuple[ExcludedPhoto, ...]
    """Photos without a valid pose or camera."""


@dataclass(frozen=True)
class SparsePoints:
    """Points that were triangulated from the photos."""

    positions: np.ndarray
    """(n, 3) float64, world units."""
    colours: np.ndarray
    """(n, 3) float64, 0 to 1."""


@dataclass(frozen=True)
class _Camera:
    """A camera as stored in the file. It is checked only if a photo uses it."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]
    line: int = 0
    """Line number of the camera; 0 in binary files."""


@dataclass(frozen=True)
class _Pose:
    name: str
    camera: int
    values: tuple[float, ...]


def read_colmap_model(folder: Path) -> ColmapModel:
    """Read the photos of the model in ``folder``; binary files are preferred.

    Photos without a valid pose or camera are excluded. Raises ``UserError`` for a model that is incomplete or
    malformed, and if no photo is valid.
    """
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    cameras_file, images_file = folder / f"cameras{suffix}", folder / f"images{suffix}"
    cameras = (_binary_cameras if suffix == ".bin" else _text_cameras)(_read(cameras_file), cameras_file)
    poses = (_binary_poses if suffix == ".bin" else _text_poses)(_read(images_file), images_file)

    known: dict[int, _Intrinsics] = {}

    def view(pose: _Pose) -> ColmapView:
        where = f"{images_file}: image {pose.name}"
        if pose.camera not in cameras:
            raise UserError(
                f"{where} has camera {pose.camera}, which is missing in {cameras_file.name}; export the model again"
            )
        values = np.array(pose.values)
        if not np.isfinite(values).all() or not 1e-3 < np.abs(values[:4]).max() < 1e3:
            numbers = " ".join(f"{value:g}" for value in pose.values)
            raise UserError(f"{where} has no valid pose ({numbers}); reconstruct the scene again")
        if pose.camera not in known:
            known[pose.camera] = _intrinsics(cameras_file, pose.camera, cameras[pose.camera])
        return ColmapView(**vars(known[pose.camera]), name=pose.name, quaternion=values[:4], translation=values[4:])

    empty = f"{images_file}: it has no images; reconstruct the scene again"
    views, excluded = convert_each(((pose.name, pose) for pose in poses), view, empty)
    return ColmapModel(tuple(views), tuple(excluded))


def read_colmap_points(folder: Path) -> SparsePoints | None:
    """Read the points of the model in ``folder``; None if it has none. Raises ``UserError`` for a malformed file."""
    for name, parse in (("points3D.bin", _binary_points), ("points3D.txt", _text_points)):
        if (folder / name).is_file():
            values = parse(_read(folder / name), folder / name)
            values = values[np.isfinite(values).all(axis=1)]
            return SparsePoints(values[:, :3], values[:, 3:] / 255.0) if len(values) else None
    return None


def _read(path: Path) -> bytes:
    return read_bytes(path, missing="a COLMAP model needs it")


def _intrinsics(path: Path, number: int, camera: _Camera) -> _Intrinsics:
    names = _PARAMETERS.get(camera.model)
    where = f"{path}: camera {number}" + (f" (line {camera.line})" if camera.line else "")
    if names is None or len(camera.parameters) != len(names):
        raise UserError(
            f"{where} of model {camera.model} with {len(camera.parameters)} parameters is unknown; undistort the photos"
            f" with `colmap image_undistorter`, or give one of {', '.join(_PARAMETERS)}"
        )
    values = dict(zip(names, camera.parameters, strict=True))
    fx, fy = values.get("fx", values.get("f", 0.0)), values.get("fy", values.get("f", 0.0))
    if min(camera.width, camera.height) < 1 or not np.isfinite(camera.parameters).all() or min(fx, fy) <= 0:
        numbers = " ".join((f"{camera.width} x {camera.height},", *(f"{value:g}" for value in camera.parameters)))
        raise UserError(f"{where} has no valid size and focal length ({numbers}); reconstruct the scene again")
    try:
        lens = Lens.named(camera.model, values)
    except ValueError as error:
        raise UserError(f"{where} has no valid lens ({error}); reconstruct the scene again") from error
    return _Intrinsics(camera.width, camera.height, fx, fy, values["cx"], values["cy"], lens)


def _text_lines(data: bytes, path: Path) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line that is neither empty nor a comment. A list of all lines would take far more
    memory than the file."""
    lines = io.StringIO(decode_text(data, path))
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if text and not text.startswith("#"):
            yield number, text


def _text_cameras(data: bytes, path: Path) -> dict[int, _Camera]:
    cameras = {}
    for at, line in _text_lines(data, path):
        words = line.split()
        try:
            number, width, height = int(words[0]), _pixels(words[2]), _pixels(words[3])
            parameters = tuple(_camera_number(word) for word in words[4:])
        except (ValueError, IndexError) as error:
            raise UserError(f"{path}: malformed camera in line {at}, {line[:60]!r}; export the model again") from error
        cameras[number] = _Camera(words[1], width, height, parameters, at)
    return cameras


def _pixels(word: str) -> int:
    """Parse a number of pixels, which some scripts write with a decimal point. Raises ``ValueError``."""
    value = decimal_number(word)
    if not value.is_integer():
        raise ValueError(word)
    return int(value)


def _camera_number(word: str) -> float:
    """Parse a number or NaN, also as Windows writes NaN: a camera without photos may have invalid values."""
    try:
        return decimal_number(word)
    except ValueError:
        if re.fullmatch(r"[+-]?nan\(\w*\)|[+-]?1\.#\w+", word):
            return np.nan
        raise


def _text_poses(data: bytes, path: Path) -> list[_Pose]:
    """Read the poses. For each image, COLMAP writes a second line with points, which other tools omit or leave empty.
    Therefore each line is classified by its content."""
    poses = []
    may_be_points = False
    for at, line in _text_lines(data, path):
        # Split only the beginning: lines of points are long, and few of them begin like the line of an image.
        words = line[:_IMAGE_START].split(maxsplit=9)
        if may_be_points and not words[0].isdecimal() and _is_point_line(words[:3]):
            may_be_points = False
            continue
        words = line.split(maxsplit=9)
        if may_be_points and _is_point_line(words):
            may_be_points = False
            continue
        try:
            values = tuple(_camera_number(word) for word in words[1:8])
            poses.append(_Pose(words[9], int(words[8]), values))
            int(words[0])
        except (ValueError, IndexError) as error:
            raise UserError(
                f"{path}: malformed image in line {at}, {line[:60]!r}; a line has {_IMAGE_LINE}, or the points of the"
                " image in the line before"
            ) from error
        may_be_points = True
    return poses


def _is_point_line(words: list[str]) -> bool:
    """Return True if a line contains the points of an image: triples of two coordinates and an index. ``words`` are
    the first words of the line, at most nine; if there is a tenth string, it is the rest of the line."""
    try:
        for word in words[:9]:
            _camera_number(word)
    except ValueError:
        return False
    if len(words) < 10:
        return len(words) % 3 == 0
    # Unlike most lines of points, the line of an image begins with an integer, and has an integer and a name after the
    # pose.
    if not (words[0].isdecimal() and words[8].isdecimal()):
        return True
    rest = words[9].split()
    try:
        return len(rest) % 3 == 0 and all(np.isfinite(_camera_number(word)) for word in rest)
    except ValueError:
        return False


class _Cursor:
    """Sequential reader of a binary file."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.data = data
        self.path = path
        self.offset = 0

    def take(self, layout: str) -> tuple:
        """Return the next values in the ``struct`` format ``layout``."""
        try:
            values = struct.unpack_from("<" + layout, self.data, self.offset)
        except struct.error as error:
            raise self.truncated() from error
        self.offset += struct.calcsize("<" + layout)
        return values

    def text(self) -> str:
        """Return the next null-terminated string, in UTF-8 or, as COLMAP writes it in Windows, in the local code page,
        which is assumed to be the western one."""
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.truncated()
        start, self.offset = self.offset, end + 1
        try:
            return self.data[start:end].decode()
        except UnicodeDecodeError:
            return self.data[start:end].decode("cp1252", errors="replace")

    def skip(self, size: int) -> None:
        """Skip ``size`` bytes."""
        self.offset += size
        if self.offset > len(self.data):
            raise self.truncated()

    def truncated(self) -> UserError:
        """Return the error for a file that is too short."""
        return UserError(f"{self.path}: truncated at {len(self.data)} bytes; copy or export it again")


def _binary_cameras(data: bytes, path: Path) -> dict[int, _Camera]:
    cursor = _Cursor(data, path)
    cameras = {}
    for _ in range(cursor.take("Q")[0]):
        number, model, width, height = cursor.take("iiQQ")
        if model not in _MODELS:
            raise UserError(
                f"{path}: camera {number} has model {model}, which is unknown; undistort the photos with"
                f" `colmap image_undistorter`, or give one of {', '.join(_PARAMETERS)}"
            )
        name = _MODELS[model][0]
        cameras[number] = _Camera(name, width, height, cursor.take(f"{len(_PARAMETERS[name])}d"))
    return cameras


def _binary_poses(data: bytes, path: Path) -> list[_Pose]:
    """Read the poses; some writers omit the points and their number."""
    try:
        return _binary_records(_Cursor(data, path), with_points=True)
    except UserError:
        cursor = _Cursor(data, path)
        try:
            poses = _binary_records(cursor, with_points=False)
        except UserError:
            poses = []
        if not poses or cursor.offset != len(data):
            raise
        return poses


def _binary_records(cursor: _Cursor, *, with_points: bool) -> list[_Pose]:
    poses = []
    for _ in range(cursor.take("Q")[0]):
        values = cursor.take("i7di")
        name = cursor.text()
        poses.append(_Pose(name, values[8], values[1:8]))
        if with_points:
            cursor.skip(_POINT_BYTES * cursor.take("Q")[0])
    return poses


def _binary_points(data: bytes, path: Path) -> np.ndarray:
    """Return position and colour (n, 6) of the points."""
    cursor = _Cursor(data, path)
    count = cursor.take("Q")[0]
    points = array("d")
    for _ in range(count):
        _number, *values = cursor.take("Q3d3Bd")
        points.extend(values[:6])
        cursor.skip(_TRACK_BYTES * cursor.take("Q")[0])
    return np.array(points, dtype=float).reshape(-1, 6)


def _text_points(data: bytes, path: Path) -> np.ndarray:
    points = array("d")
    for at, line in _text_lines(data, path):
        try:
            values = [decimal_number(word) for word in line.split(maxsplit=7)[1:7]]
            if len(values) != 6:
                raise ValueError
            points.extend(values)
        except ValueError as error:
            raise UserError(f"{path}: malformed point in line {at}, {line[:60]!r}; export the model again") from error
    return np.array(points, dtype=float).reshape(-1, 6)
