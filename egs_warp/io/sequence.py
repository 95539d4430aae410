"""Writing and finding of numbered captures, which SuperSplat and the PlayCanvas player show as animations."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.atomic import writable_folder
from egs_warp.io.compressed_ply import write_compressed_ply
from egs_warp.io.ply import write_ply
from egs_warp.io.run_folder import MANIFEST


def write_ply_sequence(
    folder: Path | str, clouds: Iterable[GaussianCloud], *, prefix: str = "frame", compressed: bool = False
) -> list[Path]:
    """Write ``frame0001.ply``, ``frame0002.ply``, ... into ``folder``, which is created if it is missing. Returns the
    paths of the files.

    ``clouds`` may be a generator, so that only one frame is in memory at a time. ``compressed`` files have a quarter of
    the size and end in ``.compressed.ply``. Surplus files of an earlier, longer sequence are not removed. Raises
    ``UserError`` if a file cannot be written.
    """
    target = writable_folder(folder)
    paths = []
    for number, cloud in enumerate(clouds, start=1):
        path = target / f"{prefix}{number:04d}{'.compressed' if compressed else ''}.ply"
        if compressed:
            write_compressed_ply(path, cloud)
        else:
            write_ply(path, cloud)
        paths.append(path)
    return paths


def frame_paths(folder: Path | str, numbers: Iterable[int], ending: str, *, alone: bool = True) -> list[Path]:
    """Return the path of each of the ``numbers`` in ``folder``, such as ``frame0000`` + ``ending``; the folder is
    created if it is missing.

    With ``alone``, raises ``UserError`` if the folder contains frames with this ending whose numbers are not the first
    of ``numbers``, as an earlier or interrupted export of the same frames leaves them: players would show the others as
    part of the sequence. The contents of the files are not compared.
    """
    if (Path(folder) / MANIFEST).is_file():
        raise UserError(
            f"{folder}: it is the folder of a run, and the frames would be mixed with its files; choose another folder"
        )
    paths = [Path(folder) / f"frame{number:04d}{ending}" for number in numbers]
    writable_folder(folder)
    existing = {
        path for path in Path(folder).iterdir() if re.fullmatch(rf"frame\d{{4,}}{re.escape(ending)}", path.name)
    }
    if alone and (others := sorted(existing - set(paths[: len(existing)]))):
        raise UserError(f"{folder}: it has other frames ({others[0].name}, ...); choose another folder")
    return paths


_NUMBERED = re.compile(
    r"(?P<prefix>.*?)(?P<number>\d{1,12})(?P<ending>(\.compressed)?\.(ply|spz|splat|sog|glb))", re.IGNORECASE
)


def numbered_captures(folder: Path | str) -> list[Path]:
    """Return the files of a sequence in ``folder``, in the order of their numbers: ``frame0001.ply``,
    ``frame0002.ply``, ...

    Gaps are allowed; hidden files and files with other names are ignored. ``read_capture`` can read each file. Raises
    ``UserError`` if there are no such files, or files of two sequences.
    """
    place = Path(folder)
    if not place.is_dir():
        raise UserError(f"{folder}: not a folder; give a folder of numbered captures")
    shown = [path for path in place.iterdir() if not path.name.startswith(".")]
    found = [(match, path) for path in shown if (match := _NUMBERED.fullmatch(path.name)) and path.is_file()]
    kinds = sorted({(match["prefix"], match["ending"].lower()) for match, _ in found})
    if not kinds:
        raise UserError(f"{folder}: it has no numbered captures such as frame0001.ply; give a folder that has some")
    if len(kinds) > 1:
        names = " and ".join(f"{prefix}0001{ending}" for prefix, ending in kinds[:2])
        raise UserError(f"{folder}: it has two sequences ({names}); put each into a folder of its own")
    ordered = sorted((int(match["number"]), path) for match, path in found)
    for (number, path), (following, other) in pairwise(ordered):
        if number == following:
            raise UserError(f"{folder}: {path.name} and {other.name} have the same number; remove one of them")
    return [path for _, path in ordered]
