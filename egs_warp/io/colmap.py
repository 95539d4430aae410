"""COLMAP sparse models: ``cameras`` and ``images``, as text or binary.

Public description: https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError

# Name and number of parameters of each camera model by its number in the binary format; focal lengths and the principal
# point come first, distortion after them.
_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
)
_ONE_FOCAL_LENGTH = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
# Without distortion these are pinhole cameras; a fisheye never is.
_PINHOLE_AT_ZERO = (*_ONE_FOCAL_LENGTH, "PINHOLE", "OPENCV", "FULL_OPENCV")
_POINT_BYTES = 24


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


@dataclass(frozen=True)
class _Intrinsics:
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class _Pose:
    name: str
    camera: int
    values: tuple[float, ...]


def read_colmap_model(folder: Path) -> list[ColmapView]:
    """The photos of the model in ``folder``, in the order of its file; binary where both kinds exist.

    Raises ``UserError`` for a model that is incomplete, malformed or has lens distortion.
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
                f"{images_file}: image {pose.name} has camera {pose.camera}, missing in {cameras_file.name}"
            )
        values = np.array(pose.values)
        if not np.isfinite(values).all() or not 1e-3 < np.abs(values[:4]).max() < 1e3:
            raise UserError(f"{images_file}: image {pose.name} has no valid pose; reconstruct the scene again")
        camera = cameras[pose.camera]
        one = camera.model in _ONE_FOCAL_LENGTH
        fx, fy, cx, cy = (camera.parameters[0], *camera.parameters[:3]) if one else camera.parameters[:4]
        views.append(ColmapView(pose.name, camera.width, camera.height, fx, fy, cx, cy, values[:4], values[4:]))
    return views


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); a COLMAP model needs it") from error


def _intrinsics(
    path: Path, number: int, model: str, width: int, height: int, parameters: tuple[float, ...]
) -> _Intrinsics:
    counts = dict(_MODELS)
    if model not in counts or len(parameters) != counts[model]:
        raise UserError(f"{path}: camera {number} of model {model} with {len(parameters)} parameters is not known")
    first = 3 if model in _ONE_FOCAL_LENGTH else 4
    if model not in _PINHOLE_AT_ZERO or any(parameters[first:]):
        raise UserError(f"{path}: camera {number} has lens distortion ({model}); run colmap image_undistorter first")
    if width < 1 or height < 1 or not np.isfinite(parameters).all() or min(parameters[: first - 2]) <= 0:
        raise UserError(f"{path}: camera {number} has no valid size and focal length; reconstruct the scene again")
    return _Intrinsics(model, width, height, parameters)


def _text_lines(data: bytes, path: Path) -> list[str]:
    try:
        return [line for line in data.decode().splitlines() if not line.startswith("#")]
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not a text file; export the model again") from error


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
    lines = iter(_text_lines(data, path))
    for line in lines:
        if not line.strip():
            continue
        words = line.strip().split(maxsplit=9)
        try:
            name = words[9]
            poses.append(_Pose(name, int(words[8]), tuple(float(word) for word in words[1:8])))
        except (ValueError, IndexError) as error:
            raise UserError(f"{path}: malformed image line {line[:60]!r}; export the model again") from error
        # The points seen in the image follow on a line of their own, which may be empty.
        next(lines, None)
    return poses


class _Cursor:
    """Reads a binary file from front to back."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.data = data
        self.path = path
        self.offset = 0

    def take(self, layout: str) -> tuple:
        """The next values of ``struct`` layout."""
        try:
            values = struct.unpack_from("<" + layout, self.data, self.offset)
        except struct.error as error:
            raise self.truncated() from error
        self.offset += struct.calcsize("<" + layout)
        return values

    def text(self) -> str:
        """The next null-terminated string."""
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.truncated()
        start, self.offset = self.offset, end + 1
        return self.data[start:end].decode(errors="replace")

    def skip(self, size: int) -> None:
        """Leave out ``size`` bytes."""
        self.offset += size
        if self.offset > len(self.data):
            raise self.truncated()

    def truncated(self) -> UserError:
        """The error of a file that is too short."""
        return UserError(f"{self.path}: truncated at {len(self.data)} bytes; copy or export it again")


def _binary_cameras(data: bytes, path: Path) -> dict[int, _Intrinsics]:
    cursor = _Cursor(data, path)
    cameras = {}
    for _ in range(cursor.take("Q")[0]):
        number, model, width, height = cursor.take("iiQQ")
        if not 0 <= model < len(_MODELS):
            raise UserError(f"{path}: camera {number} has unknown model {model}; undistort the photos first")
        name, count = _MODELS[model]
        cameras[number] = _intrinsics(path, number, name, width, height, cursor.take(f"{count}d"))
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
