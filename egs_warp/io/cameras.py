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
from egs_warp.io.limits import FURTHEST, LARGEST_TEXT, check_pixels, picture_size, read_bytes
from egs_warp.io.ply import read_point_ply
from egs_warp.io.text import whole_number

_IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".webp")
_DISTORTIONS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_LENSES = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
)
"""Of ``camera_model`` in transforms.json."""
_JSON_NAMES = ("cameras.json", "transforms.json", "transforms_train.json")
_LONGEST_FOCAL = 1e3
"""Sides of the photo; the shortest focal length is as small a part."""
_FURTHEST_MIDDLE = 10.0
"""Sides of the photo."""
_COLMAP_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")


@dataclass(frozen=True)
class PosedImage:
    """One photo and where it was taken from."""

    name: str
    camera: Camera
    image: Path | None
    """The photo's file; None where it is not beside the poses."""
    lens: Lens | None = None
    """What bends the photo's lines; ``camera`` is then that of the photo straightened, at the same size."""


def read_cameras(path: Path | str) -> list[PosedImage]:
    """Read INRIA ``cameras.json``, NeRF-synthetic or nerfstudio ``transforms.json``, or a COLMAP sparse model.

    ``path`` is the .json, the folder of a COLMAP model (text or binary), or a folder that holds one of these. Poses are
    kept in the file's world frame; nerfstudio's ``applied_transform`` is not undone. Raises ``UserError`` for missing
    or malformed files and for lenses that are not known here.
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
    """The points triangulated from the photos of ``path``; None where there are none.

    COLMAP's, or the .ply that nerfstudio (``ply_file_path``) and INRIA (``input.ply``) put beside their poses. Raises
    ``UserError`` for malformed files.
    """
    source = _pose_file(Path(path))
    if source.is_dir():
        return read_colmap_points(source)
    tree = _tree(source)
    name = tree.get("ply_file_path") if isinstance(tree, dict) else "input.ply"
    if not isinstance(name, str) or not _below(name) or not os.path.isfile(source.parent / name):
        return None
    positions, colours = read_point_ply(source.parent / name)
    return SparsePoints(positions, colours) if len(positions) else None


def _tree(source: Path) -> Any:
    """What a .json of poses holds."""
    data = read_bytes(source, at_most=LARGEST_TEXT)
    try:
        return json.loads(data, parse_int=whole_number)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{source}: not readable JSON; give a cameras.json or a transforms.json") from error


def _below(name: str) -> bool:
    """Whether ``name`` stays in the folder that it is relative to."""
    path = PurePath(name)
    return "\0" not in name and not path.is_absolute() and not path.drive and ".." not in path.parts


def _checked(camera: Camera, what: str) -> Camera:
    """``camera``, if one can have taken a photo with it; ``what`` begins the message."""
    check_pixels(camera.width, camera.height, what)
    side = max(camera.width, camera.height)
    focal = np.array([camera.fx, camera.fy]) / side
    middle = np.array([camera.cx, camera.cy]) / side
    if (
        not ((focal > 1.0 / _LONGEST_FOCAL) & (focal < _LONGEST_FOCAL)).all()
        or not (abs(middle) < _FURTHEST_MIDDLE).all()
    ):
        raise UserError(
            f"{what}: focal lengths {camera.fx:g}, {camera.fy:g} and middle {camera.cx:g}, {camera.cy:g} fit no photo"
            f" of {camera.width} x {camera.height} pixels; export the poses again"
        )
    if not (abs(camera.translation) < FURTHEST).all():
        raise UserError(f"{what}: it lies further than {FURTHEST:g} units out; export the poses again")
    return camera


def _pose_file(source: Path) -> Path:
    """The folder of a COLMAP model, or the .json, that ``source`` is or holds."""
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
        # COLMAP keeps the photos' folder to itself; these are the usual places around sparse/0.
        places = [parent / "images" for parent in (folder, folder.parent, folder.parent.parent)]
        places = places if _below(view.name) else []
        image = next((place / view.name for place in places if os.path.isfile(place / view.name)), None)
        posed.append(PosedImage(view.name, camera, image, view.lens))
    return posed


def _inria(source: Path, number: int, entry: object) -> PosedImage:
    """``position`` and ``rotation`` are camera to world, in OpenCV axes."""
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
    """``transform_matrix`` is camera to world, y up and z backwards; intrinsics stand in the frame or are shared."""
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
            f"{record.source}: {record.where} has the lens model {model!r}, which is not known;"
            f" give one of {', '.join(_LENSES)}"
        )
    given = {key: float(record.numbers(key, ())) for key in _DISTORTIONS if record.fields.get(key)}
    return Lens.named(model, given)


def _find_image(folder: Path, name: str) -> Path | None:
    """The photo ``name`` in ``folder``; None where it is not there: what lies elsewhere is not looked for."""
    if not _below(name):
        return None
    path = folder / name
    # os.path answers False where Path.is_file raises: names too long or not of this world.
    return next((Path(f"{path}{suffix}") for suffix in _IMAGE_SUFFIXES if os.path.isfile(f"{path}{suffix}")), None)


def _shared_size(source: Path, tree: dict) -> dict[str, int]:
    """``w`` and ``h`` of sets that leave them out: those of the first photo that can be read."""
    frames = [frame for frame in tree["frames"] if isinstance(frame, dict)]
    if "w" in tree or all("w" in frame for frame in frames):
        return {}
    for frame in frames:
        name = frame.get("file_path")
        image = _find_image(source.parent, name) if isinstance(name, str) else None
        size = picture_size(image, f"{image}: it") if image is not None else None
        if size is not None:
            return {"w": size[0], "h": size[1]}
    raise UserError(f"{source}: it has no w and h, and none of its photos can be read; add either")


class _Record:
    """Checked access to one camera's fields: every mistake becomes a ``UserError`` that names camera and field."""

    def __init__(self, source: Path, where: str, fields: object) -> None:
        self.source = source
        self.where = where
        if not isinstance(fields, dict):
            raise UserError(f"{source}: {where} is not a record of fields; export the poses again")
        self.fields: dict = fields

    def numbers(self, key: str, shape: tuple[int, ...]) -> np.ndarray:
        """Array of ``shape``, float64, finite."""
        try:
            values = np.array(self.fields.get(key), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            values = np.array(np.nan)
        if values.shape != shape or not np.isfinite(values).all():
            count = int(np.prod(shape))
            raise self._wrong(key, "a finite number" if count == 1 else f"{count} finite numbers")
        return values

    def focal(self, key: str) -> float:
        """A length in pixels."""
        value = float(self.numbers(key, ()))
        if value <= 0:
            raise self._wrong(key, "a positive number")
        return value

    def angle(self, key: str) -> float:
        """A field of view in radians."""
        value = float(self.numbers(key, ()))
        if not 0 < value < np.pi:
            raise self._wrong(key, "an angle between 0 and pi")
        return value

    def size(self, key: str) -> int:
        """A number of pixels."""
        value = float(self.numbers(key, ()))
        if value < 1 or value != int(value):
            raise self._wrong(key, "a number of pixels")
        return int(value)

    def text(self, key: str) -> str:
        """A name."""
        value = self.fields.get(key)
        if not isinstance(value, str) or not value or "\0" in value:
            raise self._wrong(key, "a name")
        return value

    def rotation(self, matrix: np.ndarray) -> np.ndarray:
        """``matrix`` (3, 3), if it is a rotation."""
        if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
            raise UserError(f"{self.source}: {self.where}: the pose is not a rotation; export the poses again")
        return matrix

    def _wrong(self, key: str, expected: str) -> UserError:
        return UserError(f"{self.source}: {self.where}: {key} is not {expected}; export the poses again")


def write_cameras(path: Path | str, cameras: Sequence[Camera], names: Sequence[str]) -> None:
    """INRIA ``cameras.json``, which ``read_cameras`` and most tools read; principal points must be in the middle."""
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
