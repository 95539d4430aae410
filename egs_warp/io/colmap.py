"""COLMAP sparse models: ``cameras`` and ``images``, as text or binary.

Public description: https://colmap.github.io/format.html
"""

from __future__ import annotations

import io
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.lens import Lens
from egs_warp.io.limits import read_bytes

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
    14: ("SIMPLE_FISHEYE", "f cx cy"),
    15: ("FISHEYE", "fx fy cx cy"),
}
_PARAMETERS = {name: parameters.split() for name, parameters in _MODELS.values()}
_POINT_BYTES = 24
"""Bytes of one point in the list of a photo."""
_TRACK_BYTES = 8
"""Bytes of one photo in the list of a point."""


@dataclass(frozen=True)
class ColmapView:
    """One registered photo."""

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    quaternion: np.ndarray
    """(4,) w x y z, world to camera, far from zero."""
    translation: np.ndarray
    """(3,) world to camera."""
    lens: Lens | None
    """Distortion of the photo; None for a pinhole."""


@dataclass(frozen=True)
class SparsePoints:
    """Points triangulated from the photos."""

    positions: np.ndarray
    """(n, 3) float64, world units."""
    colours: np.ndarray
    """(n, 3) float64, 0 to 1."""


@dataclass(frozen=True)
class _Intrinsics:
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens | None


@dataclass(frozen=True)
class _Pose:
    name: str
    camera: int
    values: tuple[float, ...]


def read_colmap_model(folder: Path) -> list[ColmapView]:
    """Read the photos of the model in ``folder``, in the order of its file; binary files are preferred.

    Raises ``UserError`` for a model that is incomplete or malformed, and for unknown lens models.
    """
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    cameras_file, images_file = folder / f"cameras{suffix}", folder / f"images{suffix}"
    cameras = (_binary_cameras if suffix == ".bin" else _text_cameras)(_read(cameras_file), cameras_file)
    poses = (_binary_poses if suffix == ".bin" else _text_poses)(_read(images_file), images_file)
    if not poses:
        raise UserError(f"{images_file}: it has no images; reconstruct the scene again")
    views = []
    for pose in poses:
        if pose.camera not in cameras:
            raise UserError(
                f"{images_file}: image {pose.name} has camera {pose.camera}, which is missing in"
                f" {cameras_file.name}; export the model again"
            )
        values = np.array(pose.values)
        if not np.isfinite(values).all() or not 1e-3 < np.abs(values[:4]).max() < 1e3:
            raise UserError(f"{images_file}: image {pose.name} has no valid pose; reconstruct the scene again")
        views.append(ColmapView(pose.name, quaternion=values[:4], translation=values[4:], **vars(cameras[pose.camera])))
    return views


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


def _intrinsics(
    path: Path, number: int, model: str, width: int, height: int, parameters: tuple[float, ...]
) -> _Intrinsics:
    names = _PARAMETERS.get(model)
    if names is None or len(parameters) != len(names):
        raise UserError(
            f"{path}: camera {number} of model {model} with {len(parameters)} parameters is unknown;"
            f" give one of {', '.join(_PARAMETERS)}"
        )
    values = dict(zip(names, parameters, strict=True))
    fx, fy = values.get("fx", values.get("f", 0.0)), values.get("fy", values.get("f", 0.0))
    if width < 1 or height < 1 or not np.isfinite(parameters).all() or min(fx, fy) <= 0:
        raise UserError(f"{path}: camera {number} has no valid size and focal length; reconstruct the scene again")
    return _Intrinsics(width, height, fx, fy, values["cx"], values["cy"], Lens.named(model, values))


def _text_lines(data: bytes, path: Path) -> Iterator[str]:
    """Return the lines one at a time, as a list of all would take far more memory than the file."""
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not a text file; export the model again") from error
    return (line.rstrip("\r\n") for line in io.StringIO(text) if not line.startswith("#"))


def _text_cameras(data: bytes, path: Path) -> dict[int, _Intrinsics]:
    cameras = {}
    for line in _text_lines(data, path):
        words = line.split()
        if not words:
            continue
        try:
            number, width, height = int(words[0]), int(words[2]), int(words[3])
            parameters = tuple(float(word) for word in words[4:])
        except (ValueError, IndexError) as error:
            raise UserError(f"{path}: malformed camera line {line[:60]!r}; export the model again") from error
        cameras[number] = _intrinsics(path, number, words[1], width, height, parameters)
    return cameras


def _text_poses(data: bytes, path: Path) -> list[_Pose]:
    poses = []
    lines = _text_lines(data, path)
    for line in lines:
        if not line.strip():
            continue
        words = line.strip().split(maxsplit=9)
        try:
            name = words[9]
            poses.append(_Pose(name, int(words[8]), tuple(float(word) for word in words[1:8])))
        except (ValueError, IndexError) as error:
            raise UserError(f"{path}: malformed image line {line[:60]!r}; export the model again") from error
        # The points seen in the image are on the next line, which may be empty.
        next(lines, None)
    return poses


class _Cursor:
    """Reads a binary file sequentially."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.data = data
        self.path = path
        self.offset = 0

    def take(self, layout: str) -> tuple:
        """Return the next values of ``struct`` layout."""
        try:
            values = struct.unpack_from("<" + layout, self.data, self.offset)
        except struct.error as error:
            raise self.truncated() from error
        self.offset += struct.calcsize("<" + layout)
        return values

    def text(self) -> str:
        """Return the next null-terminated string."""
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.truncated()
        start, self.offset = self.offset, end + 1
        return self.data[start:end].decode(errors="replace")

    def skip(self, size: int) -> None:
        """Skip ``size`` bytes."""
        self.offset += size
        if self.offset > len(self.data):
            raise self.truncated()

    def truncated(self) -> UserError:
        """Return the error for a file that is too short."""
        return UserError(f"{self.path}: truncated at {len(self.data)} bytes; copy or export it again")


def _binary_cameras(data: bytes, path: Path) -> dict[int, _Intrinsics]:
    cursor = _Cursor(data, path)
    cameras = {}
    for _ in range(cursor.take("Q")[0]):
        number, model, width, height = cursor.take("iiQQ")
        if model not in _MODELS:
            raise UserError(
                f"{path}: camera {number} has model {model}, which is unknown; give one of {', '.join(_PARAMETERS)}"
            )
        name = _MODELS[model][0]
        cameras[number] = _intrinsics(path, number, name, width, height, cursor.take(f"{len(_PARAMETERS[name])}d"))
    return cameras


def _binary_poses(data: bytes, path: Path) -> list[_Pose]:
    cursor = _Cursor(data, path)
    poses = []
    for _ in range(cursor.take("Q")[0]):
        values = cursor.take("i7di")
        name = cursor.text()
        poses.append(_Pose(name, values[8], values[1:8]))
        cursor.skip(_POINT_BYTES * cursor.take("Q")[0])
    return poses


def _binary_points(data: bytes, path: Path) -> np.ndarray:
    """(n, 6) position and colour."""
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
    for line in _text_lines(data, path):
        words = line.split()
        if not words:
            continue
        try:
            values = [float(word) for word in words[1:7]]
            if len(values) != 6:
                raise ValueError
            points.extend(values)
        except ValueError as error:
            raise UserError(f"{path}: malformed point line {line[:60]!r}; export the model again") from error
    return np.array(points, dtype=float).reshape(-1, 6)
