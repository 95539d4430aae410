"""Export of a finished run to numbered splat files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
from tqdm import tqdm

from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import ArgumentError, nearest_name
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud, with_degree
from egs_warp.io.run_folder import check_no_file_of_a_run
from egs_warp.io.sequence import frame_paths
from egs_warp.io.writing import WRITERS, is_capture_name, writer_of

Y_UP = BodyFrame(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.zeros(3), 1.0)
"""Axes of glTF in the frame of a body."""


class ExportedRun(Protocol):
    """Finished run of a single capture or of a world, as a source of splats for export."""

    @property
    def frame_count(self) -> int:
        """Number of frames at 60 Hz."""
        ...

    @property
    def capture_frame(self) -> BodyFrame:
        """Transform of the splats to the frame and units of the export."""
        ...

    def frame_number(self, frame: int, *, argument: str) -> int:
        """Return the number of ``frame``, counted from 0."""
        ...

    def splats_of(self) -> Callable[[int], GaussianCloud]:
        """Return the function that computes the splats of a frame."""
        ...


def chosen_frames(run: ExportedRun, *, frame: int | None, every: int) -> np.ndarray:
    """Return the indices of the frames at 60 Hz to export: only ``frame``, or every ``every``-th frame.

    Raises ``UserError`` if the run does not have ``frame`` or ``every`` is below 1.
    """
    if every < 1:
        raise ArgumentError("every", "give a whole number of at least 1", value=every)
    if frame is None:
        return np.arange(0, run.frame_count, every)
    return np.array([run.frame_number(frame, argument="frame")])


def export_splats(
    run: ExportedRun,
    out: Path | str,
    kind: str,
    *,
    frame: int | None = None,
    every: int = 1,
    degree: int | None = None,
    quiet: bool = False,
    announce: Callable[[int], object] = lambda size: None,
) -> list[Path]:
    """Write ``frame0000.ply`` and so on into ``out``, numbered at 60 Hz, or one ``frame`` to the file ``out``; return
    the paths.

    Files are in the frame and units of the capture, so that they match its background. Files of a world contain all
    bodies, in metres and in the frame of the world. ``glb`` files are in metres with y up, as glTF requires.

    Args:
        run: The run to export.
        out: Folder for the files; for a single ``frame`` also the name of a file with the ending of its kind.
        kind: A key of ``WRITERS``.
        frame: Number of the only frame to export; negative numbers count from the end. None exports all frames.
        every: Interval of the exported frames, in frames at 60 Hz.
        degree: SH degree of the colours; None keeps the degree of the capture.
        quiet: True to show no progress bar.
        announce: Called with the expected size of all files, bytes, when the first of several is written.

    Raises:
        UserError: The run does not have ``frame``; ``out`` contains other frames, or is the name of a file although
            several frames are exported; its ending belongs to another kind; or it is a file of a run.
    """
    write = WRITERS[kind]
    frames, target = chosen_frames(run, frame=frame, every=every), Path(out)
    if (is_capture_name(target) or (frame is not None and _resembles_ending(target.suffix))) and not target.is_dir():
        if frame is None:
            raise ArgumentError("out", "several frames are written; give a folder, or a single frame", value=out)
        writer_of(target, kind=kind)
        check_no_file_of_a_run(target)
        paths = [target]
    else:
        # One folder may contain several frames that were exported singly.
        paths = frame_paths(target, frames, write.ending, alone=frame is None)
    splats = run.splats_of()
    place = Y_UP if kind == "glb" else run.capture_frame
    for index, path in zip(tqdm(frames, desc="export", unit="frame", disable=quiet), paths, strict=True):
        write(path, with_degree(to_body_frame(splats(index), place), degree))
        if len(paths) > 1 and path is paths[0]:
            announce(len(paths) * path.stat().st_size)
    return paths


def _resembles_ending(suffix: str) -> bool:
    """Return True if ``suffix`` is the name of a kind of splat file, such as ``.compressed-ply``, or a misspelt
    ending."""
    return (
        suffix[1:].lower() in WRITERS or nearest_name(suffix, [write.ending for write in WRITERS.values()]) is not None
    )
