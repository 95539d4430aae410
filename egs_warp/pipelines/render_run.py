"""Rendering of a finished run: through any camera, at any size, in colour, depth or alpha."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from enum import Enum
from pathlib import Path

import numpy as np

from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.frames import box_corners
from egs_warp.io.run_folder import check_no_file_of_a_run
from egs_warp.io.sequence import frame_paths
from egs_warp.io.video import VideoWriter, write_png
from egs_warp.pipelines.film import drawn_frames
from egs_warp.pipelines.film_file import Frame
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.finished_world import FinishedWorld
from egs_warp.pipelines.progress import render_bar
from egs_warp.pipelines.shot import FilmedMotion, Shot, around, nearest_steps, resized, turntable
from egs_warp.pipelines.world_film import film_steps, world_cameras, world_frames

_MILLIMETRES = 1000.0


class Show(Enum):
    """Quantity that a picture shows."""

    COLOUR = "colour"
    DEPTH = "depth"
    """Depth of the creature. In a video, it is shown as grey values, with white for the minimum of the film; in a PNG,
    as 16-bit millimetres, with 0 outside the creature."""
    ALPHA = "alpha"
    """Opacity of the creature as grey values."""


def render_run(
    run: FinishedRun | FinishedWorld,
    out: Path,
    shot: Shot,
    *,
    show: Show = Show.COLOUR,
    hold: int | None = None,
    shadow: bool = True,
    light: bool = True,
    quiet: bool = False,
) -> int:
    """Write a video, or a folder of PNGs, of a finished run. Equal arguments give equal pictures.

    Args:
        run: The run, of a single capture or of a world.
        out: Video (.mp4, .mov, .webm); a name without an ending is a folder of PNGs.
        shot: Camera, size, frame rate and background.
        show: Quantity to show.
        hold: Frame, counted at 60 Hz, at which the motion is frozen while the camera moves around it once; None shows
            the motion.
        shadow: True to draw a shadow on the ground.
        light: True to use the main light of the run, if it has one.
        quiet: True to show no progress bar.

    Returns:
        The number of frames.

    Raises:
        UserError: The run does not have the frame ``hold``; or ``out`` does not support the options of ``shot``, is a
            folder with other frames, or is a file of a run.
    """
    folder = out.suffix == ""
    if not folder:
        check_no_file_of_a_run(out)
    if shot.transparent and (show is not Show.COLOUR or (not folder and out.suffix.lower() == ".mp4")):
        advice = "give a .mov, a .webm or a folder" if show is Show.COLOUR else "show colour instead of depth or alpha"
        raise ArgumentError(
            "background", f"H.264 and films of depth or alpha have no transparency; {advice}", value="transparent"
        )
    if isinstance(run, FinishedWorld):
        motion: FilmedMotion = run.filmed.motion()
        last = np.arange(run.frame_count)
        camera = run.camera
        steps = film_steps(run.filmed, shot)
    else:
        motion, last = run.trajectory, run.steps
        camera = run.creature.camera
        steps = nearest_steps(motion.time, shot.fps)
    if hold is None:
        if isinstance(run, FinishedWorld):
            cameras = world_cameras(run.filmed, camera, shot, steps)
        else:
            cameras = shot.cameras(camera, motion, steps, in_scene=run.scene is not None)
    else:
        steps = np.full(turntable(shot.fps), last[run.frame_number(hold, argument="turntable")])
        base = resized(camera, *(shot.size or (camera.width, camera.height)))
        cameras = around(base, motion.positions[steps[:1]], count=len(steps))
    if isinstance(run, FinishedWorld):
        frames = world_frames(run.filmed, steps, cameras, shot, shadow=shadow)
    else:
        main_light = run.creature.light if light else None
        scene = run.scene_without_shadow() if light and shadow else run.scene
        deformer, t = run.deformer(), run.trajectory
        frames = drawn_frames(deformer, t, steps, cameras, shot, scene=scene, shadow=shadow, light=main_light)
    corners = motion.positions[steps] if hold is None else motion.positions[steps[:1]]
    near, far = _depths(corners.reshape(-1, 3), cameras) if show is Show.DEPTH else (0.0, 1.0)
    pictures = frame_paths(out, range(len(steps)), ".png") if folder else []
    with contextlib.ExitStack() as stack:
        video = None
        if not folder:
            width, height = cameras[0].width, cameras[0].height
            writer = VideoWriter(out, width, height, frames_per_second=shot.fps, alpha=shot.transparent)
            video = stack.enter_context(writer)
        show_image = stack.enter_context(render_bar(len(steps), quiet=quiet))
        for index, frame in enumerate(frames):
            if video is not None:
                video.write(_picture(frame, show, near, far))
            elif show is Show.DEPTH:
                write_png(pictures[index], _millimetres(frame))
            else:
                write_png(pictures[index], _picture(frame, show, near, far))
            show_image()
    return len(steps)


def _picture(frame: Frame, show: Show, near: float, far: float) -> np.ndarray:
    if show is Show.COLOUR:
        return frame.picture()
    alpha = frame.image.alpha.numpy()
    grey = alpha if show is Show.ALPHA else alpha * np.clip((far - frame.image.depth.numpy()) / (far - near), 0.0, 1.0)
    return np.repeat(np.rint(255.0 * np.clip(grey, 0.0, 1.0)).astype(np.uint8)[..., None], 3, axis=2)


def _millimetres(frame: Frame) -> np.ndarray:
    """Return the depth (H, W) uint16, mm; 0 where the opacity is at most 0.5."""
    is_opaque = frame.image.alpha.numpy() > 0.5
    return np.where(is_opaque, np.clip(np.rint(_MILLIMETRES * frame.image.depth.numpy()), 1, 65535), 0).astype(
        np.uint16
    )


def _depths(points: np.ndarray, cameras: Sequence[Camera]) -> tuple[float, float]:
    """Return the minimum and maximum z-depth of the box around ``points`` (n, 3) over all ``cameras``."""
    corners = box_corners(points.min(axis=0), points.max(axis=0))
    depths = np.concatenate([(corners - camera.centre) @ camera.rotation[2] for camera in cameras])
    if depths.max() <= 0.0:
        raise UserError("camera: the creature is behind it in every frame; turn the camera around")
    near = max(float(depths.min()), 0.0)
    return near, max(float(depths.max()), near + 1e-6)
