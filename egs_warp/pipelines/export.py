"""A finished run as files of other tools: numbered splat files, or one USD stage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tqdm import tqdm

from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import ArgumentError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.gaussians import with_degree
from egs_warp.io.sequence import frame_paths
from egs_warp.io.writing import WRITERS
from egs_warp.pipelines.finished_run import FinishedRun

_Y_UP = BodyFrame(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.zeros(3), 1.0)


def chosen_frames(run: FinishedRun, *, frame: int | None, every: int) -> np.ndarray:
    """Indices of frames at 60 Hz: one, or ``every`` so many. Raises ``UserError`` for one that is not there."""
    if every < 1:
        raise ArgumentError("every", "give a whole number of at least 1", value=every)
    if frame is None:
        return np.arange(0, len(run.steps), every)
    return np.array([run.frame_number(frame, asked_by="frame")])


def export_splats(
    run: FinishedRun,
    folder: Path | str,
    kind: str,
    *,
    frame: int | None = None,
    every: int = 1,
    degree: int | None = None,
    quiet: bool = False,
) -> list[Path]:
    """Write ``frame0000.ply`` and so on into ``folder``, numbered at 60 Hz; returns the paths.

    ``kind`` is one of ``WRITERS``. All but ``glb`` lie in the frame and units of the capture, so they fit what is left
    of it; ``glb`` is in metres, y up, as glTF asks. Raises ``UserError`` for a frame that the run does not have, and
    for a folder with other frames.
    """
    ending, write = WRITERS[kind]
    frames = chosen_frames(run, frame=frame, every=every)
    # Stills may lie together.
    paths = frame_paths(folder, frames, ending, alone=frame is None)
    deformer = run.deformer()
    place = _Y_UP if kind == "glb" else run.capture_frame
    for index, path in zip(tqdm(frames, desc="export", unit="frame", disable=quiet), paths, strict=True):
        cloud = to_body_frame(deformer.deform(run.trajectory.positions[run.steps[index]]).cloud, place)
        write(path, with_degree(cloud, degree))
    return paths
