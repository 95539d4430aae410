"""Camera poses of a capture's photos, in the OpenCV axes and pixel centres of ``Camera``."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.lens import Lens
from egs_warp.io.atomic import atomic_write
from egs_warp.io.colmap import SparsePoints, read_colmap_model, read_colmap_points
from egs_warp.io.limits import MAX_COORDINATE, MAX_TEXT_BYTES, check_pixels, picture_size, read_bytes
from egs_warp.io.ply import read_point_ply
from egs_warp.io.text import whole_number

_IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".webp")
_DISTORTIONS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_LENSES = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
)
"""Values of ``camera_model`` in transforms.json."""
_JSON_NAMES = ("cameras.json", "transforms.json", "transforms_train.json")
_MAX_FOCAL = 1e3
"""Maximum focal length in sides of the photo; the minimum is the reciprocal."""
_MAX_CENTRE = 10.0
"""Maximum distance of the principal point, in sides of the photo."""
_COLMAP_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")


@dataclass(frozen=True)
class PosedImage:
    """A photo and its camera."""

    name: str
    camera: Camera
    image: Path | None
    """The photo's file; None if it is not beside the poses."""
    lens: Lens | None = None
    """Distortion of the photo; ``camera`` is then that of the undistorted photo, of the same size."""


def read_cameras(path: Path | str) -> list[PosedImage]:
    """Read INRIA ``cameras.json``, NeRF-synthetic or nerfstudio ``transforms.json``, or a COLMAP sparse model.

    ``path`` is the .json, the folder of a COLMAP model (text or binary), or a folder that contains one of these. Poses
    stay in the file's world frame; nerfstudio's ``applied_transform`` is not undone. Raises ``UserError`` for missing
    or malformed files and for unknown lens models.
    """
    source = _pose_file(Path(path))
    if source.is_dir():
        return _from_colmap(source)
    tree = _tree(source)
    if isinstance(tree, list):
        posed = [_inria(source, number, entry) for number, entry in enumerate(tree)]
    elif isinstance(tree, dict) and isinstance(tree.get("frames"), list):
        frames = tree["frames"]
        size = _shared_size(source, tree)
        posed = [_transform(source, number, tree | size, entry) for number, entry in enumerate(frames)]
    else:
        raise UserError(f"{source}: neither a list of cameras nor frames; give a cameras.json or a transforms.json")
    if not posed:
        raise UserError(f"{source}: it has no cameras; export the poses again")
    return posed


def read_points(path: Path | str) -> SparsePoints | None:
    """Read the points triangulated from the photos of ``path``; None if there are none.

    They are COLMAP's, or the .ply that nerfstudio (``ply_file_path``) and INRIA (``input.ply``) place beside their
    poses. Raises ``UserError`` for malformed files.
    """
    source = _pose_file(Path(path))
    if source.is_dir():
        return read_colmap_points(source)
    tree = _tree(source)
    name = tree.get("ply_file_path") if isinstance(tree, dict) else "input.ply"
    if not isinstance(name, str) or not _is_inside(name) or not os.path.isfile(source.parent / name):
        return None
    positions, colours = read_point_ply(source.parent / name)
    return SparsePoints(positions, colours) if len(positions) else None


def _tree(source: Path) -> Any:
    """Parse a .json of poses."""
    data = read_bytes(source, at_most=MAX_TEXT_BYTES)
    try:
        return json.loads(data, parse_int=whole_number)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{source}: not readable JSON; give a cameras.json or a transforms.json") from error


def _is_inside(name: str) -> bool:
    """Return True if the relative path ``name`` does not leave its folder."""
    path = PurePath(name)
    return "\0" not in name and not path.is_absolute() and not path.drive and ".." not in path.parts


def _checked(camera: Camera, what: str) -> Camera:
    """Return ``camera`` if its values are plausible. Raises ``UserError``, whose message begins with ``what``."""
    check_pixels(camera.width, camera.height, what)
    side = max(camera.width, camera.height)
    focal = np.array([camera.fx, camera.fy]) / side
    middle = np.array([camera.cx, camera.cy]) / side
    if not ((focal > 1.0 / _MAX_FOCAL) & (focal < _MAX_FOCAL)).all() or not (abs(middle) < _MAX_CENTRE).all():
        raise UserError(
            f"{what}: focal lengths {camera.fx:g}, {camera.fy:g} and middle {camera.cx:g}, {camera.cy:g} fit no photo"
            f" of {camera.width} x {camera.height} pixels; export the poses again"
        )
    if not (abs(camera.translation) < MAX_COORDINATE).all():
        raise UserError(f"{what}: it lies more than {MAX_COORDINATE:g} units from the origin; export the poses again")
    return camera


def _pose_file(source: Path) -> Path:
    """Return the folder of a COLMAP model, or the .json, that ``source`` is or contains."""
    if not source.is_dir():
        return source
    for folder in (source / name for name in _COLMAP_FOLDERS):
        if any((folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    found = [source / name for name in _JSON_NAMES if (source / name).is_file()]
    if not found:
        raise UserError(f"{source}: no camera poses; give a COLMAP model, a cameras.json or a transforms.json")
    return found[0]


def _from_colmap(folder: Path) -> list[PosedImage]:
    posed = []
    for view in read_colmap_model(folder):
        w, x, y, z = view.quaternion / np.linalg.norm(view.quaternion)
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        camera = Camera(
            width=view.width,
            height=view.height,
            fx=view.fx,
            fy=view.fy,
            cx=view.cx,
            cy=view.cy,
            rotation=rotation,
            translation=view.translation,
        )
        _checked(camera, f"{folder}: the camera of image {view.name}")
        # COLMAP does not store the photos' folder; these are the common places around sparse/0.
        places = [parent / "images" for parent in (folder, folder.parent, folder.parent.parent)]
        places = places if _is_inside(view.name) else []
        image = next((place / view.name for place in places if os.path.isfile(place / view.name)), None)
        posed.append(PosedImage(view.name, camera, image, view.lens))
    return posed


def _inria(source: Path, number: int, entry: object) -> PosedImage:
    """Convert a camera: ``position`` and ``rotation`` are camera to world, in OpenCV axes."""
    record = _Record(source, f"camera {number}", entry)
    name = record.text("img_name")
    width, height = record.size("width"), record.size("height")
    rotation = record.rotation(record.numbers("rotation", (3, 3))).T
    camera = Camera(
        width=width,
        height=height,
        fx=record.focal("fx"),
        fy=record.focal("fy"),
        cx=width / 2.0,
        cy=height / 2.0,
        rotation=rotation,
        translation=-rotation @ record.numbers("position", (3,)),
    )
    return PosedImage(name, _checked(camera, f"{source}: {record.where}"), _find_image(source.parent / "images", name))


def _transform(source: Path, number: int, shared: dict, entry: object) -> PosedImage:
    """Convert a frame: ``transform_matrix`` is camera to world, y up and z backwards; intrinsics are in the frame or
    shared."""
    own = entry if isinstance(entry, dict) else {}
    record = _Record(source, f"frame {number}", {**shared, **own})
    name = record.text("file_path")
    image = _find_image(source.parent, name)
    lens = _lens(record)
    width, height = record.size("w"), record.size("h")
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
    matrix = record.numbers("transform_matrix", (4, 4))
    rotation = np.diag([1.0, -1.0, -1.0]) @ record.rotation(matrix[:3, :3]).T
    camera = Camera(
        width=width,
        height=height,
        fx=float(fx),
        fy=float(fy),
        cx=float(record.numbers("cx", ())) if "cx" in record.fields else width / 2.0,
        cy=float(record.numbers("cy", ())) if "cy" in record.fields else height / 2.0,
        rotation=rotation,
        translation=-rotation @ matrix[:3, 3],
    )
    return PosedImage(name, _checked(camera, f"{source}: {record.where}"), image, lens)


def _lens(record: _Record) -> Lens | None:
    model = record.fields.get("camera_model", "OPENCV_FISHEYE" if record.fields.get("is_fisheye") else "OPENCV")
    if model not in _LENSES:
        raise UserError(
            f"{record.source}: {record.where} has the unknown lens model {model!r}; give one of {', '.join(_LENSES)}"
        )
    values = {key: float(record.numbers(key, ())) for key in _DISTORTIONS if record.fields.get(key)}
    return Lens.named(model, values)


def _find_image(folder: Path, name: str) -> Path | None:
    """Return the photo ``name`` in ``folder``; None if it is not there. Other folders are not searched."""
    if not _is_inside(name):
        return None
    path = folder / name
    # os.path returns False where Path.is_file raises: for names that are too long or invalid.
    return next((Path(f"{path}{suffix}") for suffix in _IMAGE_SUFFIXES if os.path.isfile(f"{path}{suffix}")), None)


def _shared_size(source: Path, tree: dict) -> dict[str, int]:
    """Return ``w`` and ``h`` for files without them: those of the first readable photo."""
    frames = [frame for frame in tree["frames"] if isinstance(frame, dict)]
    if "w" in tree or all("w" in frame for frame in frames):
        return {}
    for frame in frames:
        name = frame.get("file_path")
        image = _find_image(source.parent, name) if isinstance(name, str) else None
        size = picture_size(image, f"{image}: it") if image is not None else None
        if size is not None:
            return {"w": size[0], "h": size[1]}
    raise UserError(f"{source}: it has no w and h, and none of its photos can be read; add w and h, or the photos")


class _Record:
    """Checked access to one camera's fields: every mistake becomes a ``UserError`` that names camera and field."""

    def __init__(self, source: Path, where: str, fields: object) -> None:
        self.source = source
        self.where = where
        if not isinstance(fields, dict):
            raise UserError(f"{source}: {where} is not a record of fields; export the poses again")
        self.fields: dict = fields

    def numbers(self, key: str, shape: tuple[int, ...]) -> np.ndarray:
        """Return an array of ``shape``, float64, finite."""
        try:
            values = np.array(self.fields.get(key), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            values = np.array(np.nan)
        if values.shape != shape or not np.isfinite(values).all():
            count = int(np.prod(shape))
            raise self._wrong(key, "a finite number" if count == 1 else f"{count} finite numbers")
        return values

    def focal(self, key: str) -> float:
        """Return a length in pixels."""
        value = float(self.numbers(key, ()))
        if value <= 0:
            raise self._wrong(key, "a positive number")
        return value

    def angle(self, key: str) -> float:
        """Return a field of view in rad."""
        value = float(self.numbers(key, ()))
        if not 0 < value < np.pi:
            raise self._wrong(key, "an angle between 0 and pi")
        return value

    def size(self, key: str) -> int:
        """Return a number of pixels."""
        value = float(self.numbers(key, ()))
        if value < 1 or value != int(value):
            raise self._wrong(key, "a number of pixels")
        return int(value)

    def text(self, key: str) -> str:
        """Return a name."""
        value = self.fields.get(key)
        if not isinstance(value, str) or not value or "\0" in value:
            raise self._wrong(key, "a name")
        return value

    def rotation(self, matrix: np.ndarray) -> np.ndarray:
        """Return ``matrix`` (3, 3) if it is a rotation."""
        if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
            raise UserError(f"{self.source}: {self.where}: the pose is not a rotation; export the poses again")
        return matrix

    def _wrong(self, key: str, expected: str) -> UserError:
        return UserError(f"{self.source}: {self.where}: {key} is not {expected}; export the poses again")


def write_cameras(path: Path | str, cameras: Sequence[Camera], names: Sequence[str]) -> None:
    """Write INRIA ``cameras.json``, which ``read_cameras`` and most tools read. Principal points must be in the
    middle."""
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
