"""Camera poses of a capture's photos, in the OpenCV axes and pixel centres of ``Camera``."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from egs_warp.io.colmap import ColmapView, SparsePoints, read_colmap_model, read_colmap_points
from egs_warp.io.metashape import read_metashape
from egs_warp.io.paths import stays_inside
from egs_warp.io.photo_files import PhotoAndMask, PhotoFiles
from egs_warp.io.ply import read_point_ply
from egs_warp.io.pose_files import PoseSource, find_poses
from egs_warp.io.pose_json import parse_pose_json, read_pose_json, write_cameras
from egs_warp.io.posed_images import (
    PosedImage,
    PosedImages,
    camera_of_photo,
    convert_each,
    near_origin,
    with_distance_note,
)
from egs_warp.io.reality_scan import read_reality_scan

__all__ = ["PosedImage", "PosedImages", "read_cameras", "read_points", "read_posed_images", "write_cameras"]


def read_cameras(path: Path | str) -> list[PosedImage]:
    """Read camera poses like ``read_posed_images``, but return only the cameras with valid poses."""
    return list(read_posed_images(path).images)


def read_posed_images(path: Path | str) -> PosedImages:
    """Read camera poses, and find photos and masks.

    The formats are COLMAP sparse models (text or binary), INRIA's ``cameras.json``, the ``transforms.json`` of
    NeRF-synthetic and nerfstudio, the camera parameters of RealityScan (.csv) and the cameras of Metashape (.xml).
    ``path`` is the file, the folder of a COLMAP model, or a folder that contains one of these. If there are several
    COLMAP models, the one with the most photos is read. Poses stay in the world frame of the file, but the offset of
    georeferenced cameras of RealityScan and Metashape is subtracted. nerfstudio's ``applied_transform`` is not
    inverted.

    Raises ``UserError`` for missing or malformed files, and if no pose is valid.
    """
    source = find_poses(Path(path))
    suffix = source.path.suffix.lower()
    if source.path.is_dir():
        return _from_colmap(source)
    files = PhotoFiles(source.root)
    notes: list[str] = []
    if suffix == ".xml":
        images, excluded, notes = read_metashape(source.path, files)
    else:
        images, excluded = (read_reality_scan if suffix == ".csv" else read_pose_json)(source.path, files)
    poses = PosedImages(source.path, tuple(images), tuple(excluded), (*source.notes, *notes))
    return near_origin(poses) if suffix in (".csv", ".xml") else with_distance_note(poses)


def read_points(path: Path | str) -> SparsePoints | None:
    """Read the points that were triangulated from the photos of ``path``; None if there are none.

    The points are read from the COLMAP model, or from its ``points3D.ply`` if it contains none, or from the .ply beside
    the poses of nerfstudio (``ply_file_path``) and INRIA (``input.ply``). Raises ``UserError`` for malformed files.
    """
    source = find_poses(Path(path)).path
    if source.is_dir():
        points = read_colmap_points(source)
        if points is not None or not os.path.isfile(source / "points3D.ply"):
            return points
        return _points_of_ply(source / "points3D.ply")
    if source.suffix.lower() in (".csv", ".xml"):
        return None
    tree = parse_pose_json(source)
    name = tree.get("ply_file_path") if isinstance(tree, dict) else "input.ply"
    name = name.replace("\\", "/") if isinstance(name, str) else None
    if name is None or not stays_inside(name) or not os.path.isfile(source.parent / name):
        return None
    return _points_of_ply(source.parent / name)


def _points_of_ply(path: Path) -> SparsePoints | None:
    positions, colours = read_point_ply(path)
    return SparsePoints(positions, colours) if len(positions) else None


def _from_colmap(source: PoseSource) -> PosedImages:
    folder = source.path
    model = read_colmap_model(folder)
    # COLMAP does not store the folder of the photos; these are the common locations relative to sparse/0. A model in
    # ``distorted`` refers to the photos before the undistortion.
    is_distorted = "distorted" in folder.absolute().relative_to(source.root.absolute()).parts
    preferred = ("input",) if is_distorted else ()
    places = [source.root / name for name in preferred]
    places += [parent / "images" for parent in (folder, folder.parent, folder.parent.parent)]
    places += [folder, source.root]
    located = PhotoFiles(source.root, preferred=preferred).locate([view.name for view in model.views], places)
    images, excluded = convert_each(
        ((view.name, (view, place)) for view, place in zip(model.views, located, strict=True)),
        lambda one: _posed_view(folder, *one),
        f"{folder}: it has no images; reconstruct the scene again",
    )
    return with_distance_note(PosedImages(folder, tuple(images), (*model.excluded, *excluded), source.notes))


def _posed_view(folder: Path, view: ColmapView, place: PhotoAndMask) -> PosedImage:
    w, x, y, z = view.quaternion / np.linalg.norm(view.quaternion)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    camera = camera_of_photo(
        f"{folder}: the camera of image {view.name}",
        width=view.width,
        height=view.height,
        fx=view.fx,
        fy=view.fy,
        cx=view.cx,
        cy=view.cy,
        rotation=rotation,
        translation=view.translation,
    )
    return PosedImage(view.name, camera, place.image, view.lens, place.mask, place.missing)
