"""Search for the file of camera poses in a folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from egs_warp.errors import UserError
from egs_warp.io.colmap import read_colmap_model
from egs_warp.io.photo_files import has_photos

_JSON_NAMES = ("cameras.json", "transforms.json", "transforms_train.json")
_MODEL_FOLDERS = ("sparse", "colmap/sparse", "colmap")
"""Folders that may contain COLMAP models or numbered folders of models, in order of preference."""
_DISTORTED = "distorted/sparse"
"""Folder of the COLMAP model of the original photos, before their undistortion."""
_BETWEEN = ("sparse", "colmap", "distorted")
"""Names of folders that may lie between the model and the folder of the data set."""
_MAX_DEPTH = 3
"""Maximum depth to which other folders are searched."""
_START_BYTES = 4096
"""Number of bytes at the beginning of .csv and .xml files from which their format is recognised."""


@dataclass(frozen=True)
class PoseSource:
    """The poses of a data set."""

    path: Path
    """A file, or the folder of a COLMAP model."""
    root: Path
    """Folder of the data set, which contains photos and masks."""
    notes: tuple[str, ...] = ()
    """Messages for the user about the choice among several files."""


def find_poses(source: Path) -> PoseSource:
    """Find the camera poses in the file or folder ``source``. If there are several COLMAP models of one kind, the one
    with the most photos is used.

    Raises ``UserError`` if there are none.
    """
    if not source.is_dir():
        return PoseSource(source, source.parent)
    models = _model_folders(source)
    if models:
        model, note = _largest(models, source)
        return PoseSource(model, _data_folder(model, source), (note,) if note else ())
    for path in (*(source / name for name in _JSON_NAMES), *_exports(source)):
        if path.is_file():
            return PoseSource(path, source)
    below = [folder for folder in _folders(source) if _has_model(folder)]
    if below:
        model, note = _largest(below, source)
        return PoseSource(model, _data_folder(model, source), (note,) if note else ())
    for folder in _folders(source):
        for path in (*(folder / name for name in _JSON_NAMES), *_exports(folder)):
            if path.is_file():
                return PoseSource(path, source, (f"poses are read from {path}",))
    raise UserError(
        f"{source}: it contains no camera poses; give a COLMAP model, a cameras.json, a transforms.json,"
        " RealityScan's camera"
        " parameters (.csv) or Metashape's cameras (.xml)"
    )


def _has_model(folder: Path) -> bool:
    return any(os.path.isfile(folder / f"images{suffix}") for suffix in (".bin", ".txt"))


def _model_folders(source: Path) -> list[Path]:
    """Return the folders of COLMAP models, in order of preference. Models of the photos before the undistortion are
    returned only if there are no others."""
    places = [source, *_numbered(source)]
    for name in _MODEL_FOLDERS:
        # Numbered folders come before a model that was later placed above them.
        places += [*_numbered(source / name), source / name]
    found = [folder for folder in places if _has_model(folder)]
    return found or [folder for folder in (*_numbered(source / _DISTORTED), source / _DISTORTED) if _has_model(folder)]


def _numbered(folder: Path) -> list[Path]:
    """Return the folders 0, 1, 2, ... in ``folder``."""
    numbered = [one for one in _content(folder) if one.name.isdecimal() and one.is_dir()]
    return sorted(numbered, key=lambda one: (len(one.name), one.name))


def _content(folder: Path) -> list[Path]:
    """Return the entries of ``folder``; none if it cannot be read."""
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _folders(source: Path) -> Iterator[Path]:
    """Iterate over the folders below ``source`` in a fixed order, without hidden folders."""
    for folder, folders, _names in os.walk(source):
        depth = len(Path(folder).relative_to(source).parts)
        folders[:] = sorted(one for one in folders if not one.startswith(".")) if depth < _MAX_DEPTH else []
        if depth:
            yield Path(folder)


def _largest(models: list[Path], source: Path) -> tuple[Path, str]:
    """Return the folder of the model with the most photos, and a note, which is empty if there is only one model."""
    if len(models) == 1:
        return models[0], ""
    counts: dict[Path, int] = {}
    failed: dict[Path, UserError] = {}
    for model in models:
        try:
            counts[model] = len(read_colmap_model(model).views)
        except UserError as error:
            failed[model] = error
    if not counts:
        raise failed[models[0]]
    best = max(counts, key=lambda model: counts[model])
    names = {model: model.relative_to(source).as_posix() for model in models}
    rest = [f"{names[model]} ({count} photos)" for model, count in counts.items() if model != best]
    rest += [f"{names[model]} (not readable)" for model in failed]
    return best, (
        f"of {len(models)} COLMAP models, the largest is used: {names[best]} with {counts[best]} photos;"
        f" not used: {', '.join(rest)}"
    )


def _data_folder(model: Path, source: Path) -> Path:
    """Return the folder of the data set to which a COLMAP model belongs, above the folders that contain only models."""
    folder = model.absolute()
    if folder.name.isdecimal() and folder.parent.name in _BETWEEN:
        folder = folder.parent
    while folder.name in _BETWEEN:
        folder = folder.parent
    # Use the folder that the user has named if it is the found folder or a parent of it, or if it contains photos
    # itself.
    if folder.is_relative_to(source.absolute()) or has_photos(source):
        return source
    return folder


def _exports(folder: Path) -> Iterator[Path]:
    """Iterate over the files of RealityScan and Metashape in ``folder``."""
    for path in _content(folder):
        if path.suffix.lower() in (".csv", ".xml") and path.is_file():
            try:
                with open(path, "rb") as file:
                    # In UTF-16, each of these letters is accompanied by a zero byte.
                    start = file.read(_START_BYTES).replace(b"\0", b"").lower()
            except OSError:
                continue
            words = (b"name", b"heading", b"pitch") if path.suffix.lower() == ".csv" else (b"<document", b"<chunk")
            if all(word in start for word in words):
                yield path
