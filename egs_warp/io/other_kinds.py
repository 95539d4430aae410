"""Recognition of files and folders that are given as a capture although they are something else, with what to do."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path

from egs_warp.io.gltf import MESH_REMEDY
from egs_warp.io.photo_files import PICTURE_SUFFIXES, has_photos
from egs_warp.io.run_folder import CONFIG, MANIFEST

_CAPTURES = (".ply", ".spz", ".splat", ".sog", ".glb", ".gltf")
_MESHES = (".obj", ".stl", ".off", ".fbx", ".dae", ".blend")
_TETRAHEDRA = (".msh", ".mesh", ".vtu", ".vtk")
_SPLATS = (".usd", ".usda", ".usdc", ".usdz", ".ksplat", ".rad", ".lcc")
_CHECKPOINTS = (".pt", ".pth", ".ckpt")
_POINTS = (".las", ".laz", ".e57", ".pcd", ".xyz", ".pts")
_POSES = ("cameras.json", "transforms.json", "transforms_train.json")
_COLMAP = ("cameras", "images", "points3d")
_PICTURES = (b"\xff\xd8\xff", b"\x89PNG\r\n", b"II*\0", b"MM\0*")
"""First bytes of JPEG, PNG and TIFF files."""


@cache
def _text_by_suffix() -> Mapping[str, str]:
    """Return for each suffix what a file is and what to do; ``{}`` stands for the suffix."""
    # Imported here because it imports OpenCV, which captures do not need.
    from egs_warp.io.frames import VIDEO_SUFFIXES

    photos = "egs-warp from-photos makes a capture and a film from"
    texts = {
        PICTURE_SUFFIXES: f"a picture is not a capture; {photos} a folder of photos",
        VIDEO_SUFFIXES: f"a video is not a capture; {photos} it",
        _MESHES: f"a {{}} file is a mesh, which has no Gaussians; {MESH_REMEDY}",
        _TETRAHEDRA: "a {} file is a mesh of tetrahedra, which has no Gaussians; give a capture; egs-warp animate takes"
        " such a file as the cage around its object",
        _SPLATS: "{} files are not read; export the Gaussians as .ply, .spz or .sog, for example with SuperSplat",
        _CHECKPOINTS: "a {} file is a checkpoint of a training; export the Gaussians as .ply with the program that"
        " trained them",
        _POINTS: "a {} file is a point cloud, which has no Gaussians; train a capture from photos",
        (".npz", ".npy"): "a {} file contains arrays, not a capture; give a .ply, .spz, .splat, .sog or .glb",
        (".egs",): "a bundle plays a finished run on a web page; give the capture from which the run was made",
        (".yaml", ".yml"): "a {} file contains the flags of a run or a world, not a capture; only egs-warp animate"
        " reads it",
    }
    return {suffix: text for suffixes, text in texts.items() for suffix in suffixes}


def other_file(source: Path, data: bytes) -> str | None:
    """Return what the file ``source`` is and what to do; None if it is unknown. ``data`` are its first bytes."""
    name, suffix = source.name.lower(), source.suffix.lower()
    if source.name != MANIFEST and _names_a_run(source.parent) and suffix in (".npz", ".json", ".vtu"):
        return f"it is a file of a finished run; give the capture; egs-warp view {source.parent} shows the run"
    if data.startswith(_PICTURES) or (data[:4] == b"RIFF" and data[8:12] == b"WEBP"):
        suffix = PICTURE_SUFFIXES[0]
    if name in _POSES or (source.stem.lower() in _COLMAP and suffix in (".bin", ".txt")):
        return (
            "it contains camera poses, not a capture; egs-warp from-photos makes a capture and a film from the folder"
            " with the poses and the photos"
        )
    text = _text_by_suffix().get(suffix)
    return None if text is None else text.format(suffix)


def other_folder(folder: Path) -> str | None:
    """Return what the folder ``folder`` contains instead of an unbundled SOG, and what to do; None if it is unknown."""
    if _names_a_run(folder):
        return f"the folder is a finished run; give the capture from which it was made; egs-warp view {folder} shows it"
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    captures = [name for name in names if name.lower().endswith(_CAPTURES)]
    if captures:
        photos = f", or train one from its photos with egs-warp from-photos {folder}" if has_photos(folder) else ""
        return f"the folder is no capture, but contains {_some(captures)}; give one of these files{photos}"
    if any(name.lower().endswith(_MESHES) for name in names):
        return f"the folder contains a mesh, which has no Gaussians; {MESH_REMEDY}"
    if has_photos(folder) or any(name in _POSES for name in names):
        return f"the folder contains photos; egs-warp from-photos {folder} makes a capture and a film from them"
    return None


def _names_a_run(folder: Path) -> bool:
    return (folder / CONFIG).is_file() or (folder / MANIFEST).is_file()


def _some(names: list[str]) -> str:
    return ", ".join([*names[:3], *(["..."] if len(names) > 3 else [])])
