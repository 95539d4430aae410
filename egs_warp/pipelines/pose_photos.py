"""Camera poses of photos (``egs-warp pose``), reconstructed by COLMAP through pycolmap."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from egs_warp.errors import UserError
from egs_warp.installation import install_command
from egs_warp.io.cameras import read_cameras, read_points
from egs_warp.io.frames import VIDEO_SUFFIXES, select_sharp_frames
from egs_warp.io.orientation import apply_orientation, orientation
from egs_warp.io.photo_files import UNREADABLE_SUFFIXES, without_masks
from egs_warp.io.photos import decoded
from egs_warp.io.run_folder import check_run_folder, run_folder

_PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_MAX_EXHAUSTIVE = 400
"""Maximum number of photos for which all pairs are matched; more photos are matched only with their neighbours in the
order of their names."""
_NEIGHBOURS = 20
"""Number of neighbours with which a photo is matched."""
_MIN_PHOTOS = 3
_CAMERA_MODEL = "SIMPLE_RADIAL"
_WRITES = ("images", "sparse")
"""Folders that a run writes."""
_WORK_PREFIX = ".egs-pose-"
"""Prefix of the temporary folder."""
_POLL_RATE = 2.0
"""Rate at which the progress is read, Hz."""


_MAX_NAMES = 5
"""Maximum number of photos without a pose that a summary lists by name; if there are more, only their number is
given."""


@dataclass(frozen=True)
class PoseResult:
    """Summary of a reconstruction."""

    photos: int
    """Number of photos that could be read."""
    registered: int
    """Number of photos that have a pose."""
    without_pose: tuple[str, ...]
    """Names of the photos without a pose."""
    unreadable: tuple[str, ...]
    """Reasons why files were left out, one per file, and one per folder of masks."""
    points: int
    """Number of triangulated points."""
    error: float
    """Mean reprojection error, pixels."""

    def summary(self) -> list[str]:
        """Return lines for the terminal."""
        lines = [
            f"estimated the poses of {self.registered} of {self.photos} photos"
            f" ({100 * self.registered / self.photos:.0f} %), {self.points} points, reprojection error"
            f" {self.error:.2f} pixels"
        ]
        if self.without_pose:
            more = len(self.without_pose) - _MAX_NAMES
            names = ", ".join(self.without_pose[:_MAX_NAMES])
            lines.append(f"without a pose: {names}{f' and {more} more' if more > 0 else ''}")
        return lines


def pose_photos(
    source: Path | str,
    out: Path | str,
    *,
    frames: int = 150,
    max_side: int = 1600,
    seed: int = 0,
    overwrite: bool = False,
    resume: bool | None = None,
    stage: Callable[[str], None] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> PoseResult:
    """Determine the poses of the photos in a folder, or of sharp frames of a video.

    ``out`` receives ``images`` (with the EXIF rotation applied) and COLMAP's ``sparse/0``, which ``train`` reads. The
    folder belongs to one run (``egs_warp.io.run_folder``).

    Args:
        source: Folder of photos, or a video.
        out: Folder of the run.
        frames: Number of frames to choose from a video.
        max_side: Maximum length of the longer side of the images in which features are detected, pixels.
        seed: Seed of COLMAP.
        overwrite: True to move an earlier run in ``out`` aside.
        resume: True to reuse the features and matches of an interrupted run with the same arguments. If this run is
            interrupted, its features and matches are kept if ``resume`` is True or False, and deleted if it is None.
        stage: Called with a description of each stage as it starts.
        progress: Called with the name of a stage, the number of its finished items, and their total number.

    Raises:
        UserError: pycolmap is not installed, ``out`` has an earlier run or photos or cannot be written, or fewer than
            three photos can be posed.
    """
    try:
        import pycolmap  # type: ignore[import-not-found]
    except ImportError as error:
        raise UserError(f"pose: pycolmap is not installed; {install_command('pose')}") from error
    source, say = Path(source), stage or (lambda _text: None)
    report = progress or (lambda _stage, _done, _of: None)
    is_video = source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES
    if not source.is_dir() and not is_video:
        raise UserError(f"{source}: neither a folder of photos nor a video ({', '.join(VIDEO_SUFFIXES)}); give one")
    check_run_folder(out, overwrite=overwrite, writes=_WRITES)
    with run_folder(out, command="pose", overwrite=overwrite) as run, _work_folder(run.path, resume) as work:
        images = work / "images"
        images.mkdir()
        say(f"choosing {frames} frames of {source}" if is_video else f"reading {source}")
        unreadable = () if is_video else _copied(source, images)
        if is_video:
            for frame in select_sharp_frames(source, frames):
                _write_picture(images / f"frame_{frame.number:06d}.jpg", frame.pixels, quality=95)
        for reason in unreadable:
            say(f"left out {reason}")
        names = sorted(path.relative_to(images).as_posix() for path in images.rglob("*") if path.is_file())
        if len(names) < _MIN_PHOTOS:
            raise UserError(f"{source}: only {len(names)} readable photos were found; give at least {_MIN_PHOTOS}")
        try:
            model = _reconstructed(
                pycolmap, work, names, in_order=is_video, max_side=max_side, seed=seed, say=say, report=report
            )
        except RuntimeError as error:
            # COLMAP raises this error if its database fails, for example because the disk is full.
            reason = next(iter(str(error).splitlines()), "no reason given")
            raise UserError(
                f"pose: COLMAP cannot continue ({reason}); check that there is free space in {out}"
            ) from error
        _write_model(model, work / "sparse" / "0", out)
        try:
            for part in _WRITES:
                os.replace(work / part, run.folder(part))
        except OSError as error:
            raise UserError(f"{out}: cannot be written ({error.strerror}); choose another path") from error
        run.finish()
    posed = {image.name for image in model.images.values() if image.has_pose}
    return PoseResult(
        photos=len(names),
        registered=len(posed),
        without_pose=tuple(name for name in names if name not in posed),
        unreadable=tuple(unreadable),
        points=model.num_points3D(),
        error=float(model.compute_mean_reprojection_error()),
    )


def _write_model(model: Any, folder: Path, out: Path | str) -> None:
    """Write ``model`` and read it back, because COLMAP reports no error if its files are truncated on a full disk."""
    folder.mkdir(parents=True)
    model.write_binary(str(folder))
    try:
        read_cameras(folder)
        read_points(folder)
    except UserError as error:
        raise UserError(
            f"{out}: COLMAP's model is incomplete, most likely because the disk is full; free space, or choose"
            " another place"
        ) from OSError(errno.ENOSPC, str(error))


@contextmanager
def _work_folder(folder: Path, resume: bool | None) -> Iterator[Path]:
    """Remove temporary folders of killed runs, and create one in the locked ``folder``.

    If ``resume`` is True, the database of an interrupted run is reused. If it is True or False, the temporary folder
    remains if a signal or a crash ends the run.
    """
    kept = folder / f"{_WORK_PREFIX}kept"
    for remnant in folder.glob(f"{_WORK_PREFIX}*"):
        if remnant != kept or not resume:
            shutil.rmtree(remnant, ignore_errors=True)
    if resume is None:
        with tempfile.TemporaryDirectory(dir=folder, prefix=_WORK_PREFIX) as work:
            yield Path(work)
        return
    kept.mkdir(exist_ok=True)
    # Copy the photos again, because the existing copies may be incomplete. COLMAP does not recompute features and
    # matches that are already in its database.
    for part in ("images", "models", "sparse"):
        shutil.rmtree(kept / part, ignore_errors=True)
    try:
        yield kept
    except Exception:
        shutil.rmtree(kept, ignore_errors=True)
        raise
    shutil.rmtree(kept)


def _copied(source: Path, images: Path) -> tuple[str, ...]:
    """Copy the photos below ``source`` upright into ``images``; return the reasons why files were left out."""
    suffixes = (*_PHOTO_SUFFIXES, *UNREADABLE_SUFFIXES)
    found = sorted(path for path in source.rglob("*") if path.suffix.lower() in suffixes and path.is_file())
    found = [path for path in found if not any(part.startswith(".") for part in path.relative_to(source).parts)]
    paths, others = without_masks(found, source)
    left_out = [
        f"{folder}: {count} files skipped: their names look like masks or depth images"
        if count > 1
        else f"{folder}: 1 file skipped: its name looks like a mask or depth image"
        for folder, count in others.items()
    ]
    for path in paths:
        target = images / path.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            pixels = decoded(path)
        except UserError as error:
            left_out.append(str(error))
            continue
        exif_orientation = orientation(path)
        if exif_orientation == 1:
            shutil.copyfile(path, target)
        else:
            # The orientation is applied to the pixels, because not all programs apply the EXIF tag.
            _write_picture(target, apply_orientation(pixels, exif_orientation), quality=97)
    return tuple(left_out)


def _write_picture(path: Path, pixels: np.ndarray, *, quality: int) -> None:
    """Write ``pixels`` (H, W, 3) uint8 BGR without OpenCV's writer, which does not report a full disk."""
    _, data = cv2.imencode(path.suffix.lower(), pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    path.write_bytes(data.tobytes())


def _reconstructed(
    pycolmap: Any,
    work: Path,
    names: list[str],
    *,
    in_order: bool,
    max_side: int,
    seed: int,
    say: Callable[[str], None],
    report: Callable[[str, int, int], None],
) -> Any:
    """Reconstruct the photos ``names`` in ``work/images`` and return the largest model.

    Args:
        pycolmap: The module.
        work: Temporary folder.
        names: Paths of the photos below ``work/images``.
        in_order: True for frames of a video, which are matched sequentially.
        max_side: Maximum length of the longer side of the images in which features are detected, pixels.
        seed: Seed of COLMAP.
        say: Called with a description of each stage.
        report: Called with the name of a stage, the number of its finished items, and their total number.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    pycolmap.set_random_seed(seed)
    images, database = work / "images", work / "database.db"
    count = len(names)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = max_side
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = _CAMERA_MODEL
    sizes = {
        picture.shape
        for name in names
        if (picture := cv2.imread(str(images / name), cv2.IMREAD_REDUCED_GRAYSCALE_8)) is not None
    }
    mode = pycolmap.CameraMode.SINGLE if len(sizes) == 1 else pycolmap.CameraMode.PER_IMAGE
    say(f"finding features in {count} photos")
    watch = _DatabaseWatch(database, report)
    with watch.count("features", "keypoints", count):
        pycolmap.extract_features(
            str(database),
            str(images),
            image_names=names,
            camera_mode=mode,
            reader_options=reader,
            extraction_options=extraction,
        )
    if in_order or count > _MAX_EXHAUSTIVE:
        say("matching neighbours in the order of their names")
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap, pairing.quadratic_overlap = _NEIGHBOURS, True
        with watch.count("matches", "two_view_geometries", count * _NEIGHBOURS):
            pycolmap.match_sequential(str(database), pairing_options=pairing)
    else:
        say("matching every photo with every other")
        with watch.count("matches", "two_view_geometries", count * (count - 1) // 2):
            pycolmap.match_exhaustive(str(database))
    say("finding poses")
    placed = 0

    def report_pose() -> None:
        nonlocal placed
        placed += 1
        report("poses", min(placed + 2, count), count)

    models_folder = work / "models"
    models_folder.mkdir()
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.random_seed = seed
    models = pycolmap.incremental_mapping(
        str(database), str(images), str(models_folder), mapping, next_image_callback=report_pose
    )
    if not models:
        raise UserError(
            "pose: no photo could be posed; take more overlapping photos of a textured scene, from different positions"
        )
    best = max(models.values(), key=lambda model: model.num_reg_images())
    if best.num_reg_images() < _MIN_PHOTOS:
        raise UserError(f"pose: only {best.num_reg_images()} photos could be posed; take more overlapping photos")
    return best


class _DatabaseWatch:
    """Progress of pycolmap, estimated from the number of rows in its database, because pycolmap does not report it."""

    def __init__(self, database: Path, report: Callable[[str, int, int], None]) -> None:
        self._database = database
        self._report = report

    def count(self, stage: str, table: str, expected: int) -> _RowCounter:
        """Return a context that reports the rows of ``table`` while it is open."""
        return _RowCounter(self._database, table, lambda done: self._report(stage, min(done, expected), expected))


class _RowCounter:
    """Context manager that runs a thread which counts the rows of a table at a fixed rate."""

    def __init__(self, database: Path, table: str, report: Callable[[int], None]) -> None:
        self._query = f"select count(*) from {table}"
        self._database = database
        self._report = report
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._poll, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_error: object) -> None:
        self._ended.set()
        self._thread.join()
        self._report_count()

    def _poll(self) -> None:
        while not self._ended.wait(1.0 / _POLL_RATE):
            self._report_count()

    def _report_count(self) -> None:
        try:
            reader = sqlite3.connect(f"file:{self._database}?mode=ro", uri=True, timeout=0.1)
            try:
                self._report(int(reader.execute(self._query).fetchone()[0]))
            finally:
                reader.close()
        except sqlite3.Error:
            # The database does not exist yet, or is locked.
            return
