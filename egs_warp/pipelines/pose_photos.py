"""Where photos were taken from: what ``egs-warp pose`` calls. The reconstruction is COLMAP's, by pycolmap."""

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
from egs_warp.io.cameras import read_cameras, read_points
from egs_warp.io.frames import VIDEO_SUFFIXES, select_sharp_frames
from egs_warp.io.photos import apply_orientation, decoded, orientation
from egs_warp.io.run_folder import check_run_folder, run_folder

_PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_MAX_EXHAUSTIVE = 400
"""More photos than this are matched with their neighbours in the order of their names alone."""
_NEIGHBOURS = 20
_LEAST_PHOTOS = 3
_CAMERA_MODEL = "SIMPLE_RADIAL"
_WRITES = ("images", "sparse")
_WORKPLACE = ".egs-pose-"
_LOOKS_EACH_SECOND = 2.0


@dataclass(frozen=True)
class PoseResult:
    """What the reconstruction gave."""

    photos: int
    """That could be read."""
    registered: int
    """That have a pose."""
    without_pose: tuple[str, ...]
    """Names of the rest."""
    unreadable: tuple[str, ...]
    """Reasons, one a file."""
    points: int
    error: float
    """Mean reprojection error, pixels."""


def pose_photos(
    source: Path | str,
    out: Path | str,
    *,
    frames: int = 150,
    max_side: int = 1600,
    seed: int = 0,
    overwrite: bool = False,
    stage: Callable[[str], None] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> PoseResult:
    """Find the poses of the photos in the folder ``source``, or of ``frames`` sharp frames of the video ``source``.

    ``out`` then holds ``images`` (upright: EXIF's turn is done) and COLMAP's ``sparse/0``: what ``train`` reads.
    Features are found at no more than ``max_side`` pixels. The folder belongs to one run (``egs_warp.io.run_folder``);
    an earlier one is moved aside with ``overwrite``. ``stage`` is called with what begins, ``progress`` with a
    stage's name, how much of it is done, and of how much. Raises ``UserError`` where pycolmap is not installed, where
    ``out`` has an earlier run or photos already or cannot be written, and where fewer than three photos can be posed.
    """
    try:
        import pycolmap  # type: ignore[import-not-found]
    except ImportError as error:
        raise UserError("pose: pycolmap is not installed; pip install 'egs-warp[pose]'") from error
    source, say = Path(source), stage or (lambda _text: None)
    tell = progress or (lambda _stage, _done, _of: None)
    is_video = source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES
    if not source.is_dir() and not is_video:
        raise UserError(f"{source}: neither a folder of photos nor a video ({', '.join(VIDEO_SUFFIXES)})")
    check_run_folder(out, overwrite=overwrite, writes=_WRITES)
    with run_folder(out, command="pose", overwrite=overwrite) as run, _workplace(run.path) as work:
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
        if len(names) < _LEAST_PHOTOS:
            raise UserError(f"{source}: {len(names)} photos that can be read; give at least {_LEAST_PHOTOS}")
        try:
            model = _reconstructed(
                pycolmap, work, names, in_order=is_video, max_side=max_side, seed=seed, say=say, tell=tell
            )
        except RuntimeError as error:
            # Of its database, where the disk is full.
            reason = next(iter(str(error).splitlines()), "no reason told")
            raise UserError(f"pose: COLMAP cannot go on ({reason}); is there room in {out}?") from error
        _write_model(model, work / "sparse" / "0", out)
        try:
            for part in _WRITES:
                os.replace(work / part, run.folder(part))
        except OSError as error:
            raise UserError(f"{out}: cannot be written ({error.strerror}); choose another place") from error
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
    """Write it and read it again: on a full disk COLMAP leaves a part of it and keeps silent."""
    folder.mkdir(parents=True)
    model.write_binary(str(folder))
    try:
        read_cameras(folder)
        read_points(folder)
    except UserError as error:
        raise UserError(
            f"{out}: COLMAP's model is not whole, most likely the disk is full; free space, or choose another place"
        ) from OSError(errno.ENOSPC, str(error))


@contextmanager
def _workplace(folder: Path) -> Iterator[Path]:
    """A folder for what is not finished, in the locked ``folder``; of killed runs it is taken away."""
    for left in folder.glob(f"{_WORKPLACE}*"):
        shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=_WORKPLACE) as work:
        yield Path(work)


def _copied(source: Path, images: Path) -> tuple[str, ...]:
    """Put the photos below ``source`` into ``images``, upright; returns why others are not there."""
    unreadable = []
    found = sorted(path for path in source.rglob("*") if path.suffix.lower() in _PHOTO_SUFFIXES and path.is_file())
    for path in found:
        if any(part.startswith(".") for part in path.relative_to(source).parts):
            continue
        target = images / path.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            pixels = decoded(path)
        except UserError as error:
            unreadable.append(str(error))
            continue
        turn = orientation(path)
        if turn == 1:
            shutil.copyfile(path, target)
        else:
            # Written without the tag: programs differ in whether they heed it.
            _write_picture(target, apply_orientation(pixels, turn), quality=97)
    return tuple(unreadable)


def _write_picture(path: Path, pixels: np.ndarray, *, quality: int) -> None:
    """(H, W, 3) uint8 BGR. OpenCV's own writer keeps silent about a full disk."""
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
    tell: Callable[[str, int, int], None],
) -> Any:
    """The largest model of the photos ``names`` in ``work/images``."""
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
    watch = _Watch(database, tell)
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

    def one_more() -> None:
        nonlocal placed
        placed += 1
        tell("poses", min(placed + 2, count), count)

    models_folder = work / "models"
    models_folder.mkdir()
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.random_seed = seed
    models = pycolmap.incremental_mapping(
        str(database), str(images), str(models_folder), mapping, next_image_callback=one_more
    )
    if not models:
        raise UserError(
            "pose: no photo could be posed; take more photos that overlap, of something with texture, from places apart"
        )
    best = max(models.values(), key=lambda model: model.num_reg_images())
    if best.num_reg_images() < _LEAST_PHOTOS:
        raise UserError(f"pose: only {best.num_reg_images()} photos could be posed; take more photos that overlap")
    return best


class _Watch:
    """Tells how far pycolmap is, which says nothing itself, by the rows of its database."""

    def __init__(self, database: Path, tell: Callable[[str, int, int], None]) -> None:
        self._database = database
        self._tell = tell

    def count(self, stage: str, table: str, expected: int) -> _Counting:
        """A context in which the rows of ``table`` are told."""
        return _Counting(self._database, table, lambda done: self._tell(stage, min(done, expected), expected))


class _Counting:
    def __init__(self, database: Path, table: str, tell: Callable[[int], None]) -> None:
        self._query = f"select count(*) from {table}"
        self._database = database
        self._tell = tell
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_error: object) -> None:
        self._ended.set()
        self._thread.join()
        self._once()

    def _look(self) -> None:
        while not self._ended.wait(1.0 / _LOOKS_EACH_SECOND):
            self._once()

    def _once(self) -> None:
        try:
            reader = sqlite3.connect(f"file:{self._database}?mode=ro", uri=True, timeout=0.1)
            try:
                self._tell(int(reader.execute(self._query).fetchone()[0]))
            finally:
                reader.close()
        except sqlite3.Error:
            # Not made yet, or being written.
            return
