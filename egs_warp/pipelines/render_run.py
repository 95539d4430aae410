"""The film of a finished run again: through any camera, at any size, in colour, depth or alpha."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from enum import Enum
from pathlib import Path

import numpy as np
from tqdm import tqdm

from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.frames import box_corners
from egs_warp.io.run_folder import check_no_file_of_a_run
from egs_warp.io.sequence import frame_paths
from egs_warp.io.video import VideoWriter, write_png
from egs_warp.pipelines.film import Frame, drawn_frames
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.shot import Shot, around, nearest_steps, resized, turntable

_MILLIMETRES = 1000.0


class Show(Enum):
    """What a picture shows of the creature."""

    COLOUR = "colour"
    DEPTH = "depth"
    """Grey, white at the nearest of the whole film; as PNG 16 bits of millimetres, 0 where there is nothing."""
    ALPHA = "alpha"
    """Grey: how much light the creature keeps from what is behind it."""


def render_run(
    run: FinishedRun,
    out: Path,
    shot: Shot,
    *,
    show: Show = Show.COLOUR,
    hold: int | None = None,
    shadow: bool = True,
    quiet: bool = False,
) -> int:
    """Write a video (.mp4, .mov, .webm), or a folder of PNGs where ``out`` has no ending; returns how many frames.

    ``hold``: this frame at 60 Hz alone, and the camera goes around it once. The same arguments give the same pictures.
    Raises ``UserError`` for a frame that the run does not have, a name or shot that does not fit the other, and a
    folder that holds other frames, or for a file of a run.
    """
    folder = out.suffix == ""
    if not folder:
        check_no_file_of_a_run(out)
    if shot.transparent and (show is not Show.COLOUR or (not folder and out.suffix.lower() == ".mp4")):
        advice = "give a .mov, a .webm or a folder" if show is Show.COLOUR else "leave out what to show besides colour"
        raise ArgumentError("background", f"H.264, depth and alpha have no transparency; {advice}", value="transparent")
    t = run.trajectory
    if hold is None:
        steps = nearest_steps(t.time, shot.fps)
        cameras = shot.cameras(run.creature.camera, t, steps)
    else:
        steps = np.full(turntable(shot.fps), run.steps[run.frame_number(hold, asked_by="turntable")])
        base = resized(run.creature.camera, *(shot.size or (run.creature.camera.width, run.creature.camera.height)))
        cameras = around(base, t.positions[steps[:1]], count=len(steps))
    frames = drawn_frames(run.deformer(), t, steps, cameras, shot, scene=run.scene, shadow=shadow)
    corners = t.positions[steps] if hold is None else t.positions[steps[:1]]
    near, far = _depths(corners.reshape(-1, 3), cameras) if show is Show.DEPTH else (0.0, 1.0)
    pictures = frame_paths(out, range(len(steps)), ".png") if folder else []
    with contextlib.ExitStack() as stack:
        video = None
        if not folder:
            width, height = cameras[0].width, cameras[0].height
            writer = VideoWriter(out, width, height, frames_per_second=shot.fps, alpha=shot.transparent)
            video = stack.enter_context(writer)
        bar = stack.enter_context(tqdm(total=len(steps), desc="render", unit="frame", disable=quiet))
        for index, frame in enumerate(frames):
            if video is not None:
                video.write(_picture(frame, show, near, far))
            elif show is Show.DEPTH:
                write_png(pictures[index], _millimetres(frame))
            else:
                write_png(pictures[index], _picture(frame, show, near, far))
            bar.update()
    return len(steps)


def _picture(frame: Frame, show: Show, near: float, far: float) -> np.ndarray:
    if show is Show.COLOUR:
        return frame.picture()
    alpha = frame.image.alpha.numpy()
    grey = alpha if show is Show.ALPHA else alpha * np.clip((far - frame.image.depth.numpy()) / (far - near), 0.0, 1.0)
    return np.repeat(np.rint(255.0 * np.clip(grey, 0.0, 1.0)).astype(np.uint8)[..., None], 3, axis=2)


def _millimetres(frame: Frame) -> np.ndarray:
    """(H, W) uint16, 0 where less than half of the light is kept."""
    there = frame.image.alpha.numpy() > 0.5
    return np.where(there, np.clip(np.rint(_MILLIMETRES * frame.image.depth.numpy()), 1, 65535), 0).astype(np.uint16)


def _depths(points: np.ndarray, cameras: Sequence[Camera]) -> tuple[float, float]:
    """Least and greatest z-depth of the nodes ``points`` (n, 3) in any of the cameras."""
    corners = box_corners(points.min(axis=0), points.max(axis=0))
    depths = np.concatenate([(corners - camera.centre) @ camera.rotation[2] for camera in cameras])
    if depths.max() <= 0.0:
        raise UserError("camera: the creature is behind it all the time; turn it round")
    near = max(float(depths.min()), 0.0)
    return near, max(float(depths.max()), near + 1e-6)
