"""Frames of a film, and the files of a film: its video and its contact sheet."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from time import perf_counter

import numpy as np
import warp as wp

from egs_warp.geometry.camera import Camera
from egs_warp.io.run_folder import RunFolder
from egs_warp.io.video import VideoWriter, contact_sheet, write_png
from egs_warp.pipelines.progress import render_bar
from egs_warp.pipelines.shot import Shot
from egs_warp.render.compositing import RenderedImage

SHEET_FRAMES = 12
"""Number of frames on the contact sheet."""
_TIME_SHARE = 0.5
"""Fraction of the contact sheet that is distributed evenly over time; the rest is distributed over the motion."""


@dataclass(frozen=True)
class Frame:
    """One picture of a film."""

    image: RenderedImage
    """Image of the creature over its background, or over black if the shot is transparent."""
    shade: wp.array | None
    """(H, W) float32 opacity of the shadow; None unless the shot is transparent."""
    milliseconds: tuple[float, float]
    """Times for deforming and for rendering, ms."""

    def picture(self) -> np.ndarray:
        """Return the image (H, W, 3) uint8, or, for a transparent shot, (H, W, 4) with straight alpha."""
        if self.shade is None:
            return self.image.colour_srgb8()
        alpha = self.image.alpha.numpy()
        whole = alpha + (1.0 - alpha) * self.shade.numpy()
        straight = self.image.colour.numpy() / np.maximum(whole, 1e-6)[..., None]
        return np.rint(255.0 * np.clip(np.dstack([straight, whole]), 0.0, 1.0)).astype(np.uint8)


def encode_film(
    frames: Iterable[Frame],
    run: RunFolder,
    name: str,
    camera: Camera,
    shot: Shot,
    time: np.ndarray,
    sheet: np.ndarray,
    *,
    quiet: bool = False,
) -> tuple[Path, dict[str, list[float]]]:
    """Write the video ``name`` and ``sheet.png`` into the folder of ``run``.

    Args:
        frames: The frames, rendered one by one as they are written.
        run: Folder for the files.
        name: Name of the video, without the file ending.
        camera: Camera of the first frame.
        shot: Frame rate and transparency.
        time: (n,) s, time of each frame.
        sheet: (m,) indices of the frames on the contact sheet (``sheet_frames``).
        quiet: True to show no progress bar.

    Returns:
        The path of the video, and the computing time of each frame by stage, ms.
    """
    milliseconds: dict[str, list[float]] = {"deform": [], "render": [], "encode": []}
    sheet_images: list[np.ndarray] = []
    path = run.file(f"{name}.{'mov' if shot.transparent else 'mp4'}")
    with (
        _writer(path, camera, shot) as video,
        render_bar(len(time), quiet=quiet) as show_image,
    ):
        for index, frame in enumerate(frames):
            started = perf_counter()
            image = frame.picture()
            video.write(image)
            if index in sheet:
                sheet_images.append(_over_white(image))
            encoding = 1e3 * (perf_counter() - started)
            for stage, spent in zip(milliseconds, (*frame.milliseconds, encoding), strict=True):
                milliseconds[stage].append(spent)
            show_image()
    labels = [f"{time[i]:.2f} s" for i in sheet]
    write_png(run.file("sheet.png"), contact_sheet(sheet_images, 4, labels))
    return path, milliseconds


def sheet_frames(positions: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the indices (m,) of the frames for a contact sheet, increasing: the first, the last, and frames between
    them.

    The intervals between the frames have equal sums of their share of the time and their share of the path of the
    points. A body that rests for a long time thus takes few cells.

    Args:
        positions: (F, N, 3) m, points that move.
        steps: (n,) index of the state of each frame.
    """
    moves = [float(np.linalg.norm(positions[b] - positions[a], axis=1).mean()) for a, b in pairwise(steps)]
    path, last = np.concatenate([[0.0], np.cumsum(moves)]), max(len(steps) - 1, 1)
    progress = np.arange(len(steps)) / last
    if path[-1] > 0.0:
        progress = _TIME_SHARE * progress + (1.0 - _TIME_SHARE) * path / path[-1]
    count = min(SHEET_FRAMES, len(steps))
    frames = np.interp(np.linspace(0.0, 1.0, count), progress, np.arange(len(steps))).round().astype(int)
    # No frame is shown twice: each is at least one after the frame before it, and one before the frame after it.
    frames = np.maximum.accumulate(frames - np.arange(count)) + np.arange(count)
    return np.minimum(frames, len(steps) - count + np.arange(count))


def _writer(path: Path, camera: Camera, shot: Shot) -> VideoWriter:
    return VideoWriter(path, camera.width, camera.height, frames_per_second=shot.fps, alpha=shot.transparent)


def _over_white(image: np.ndarray) -> np.ndarray:
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:] / 255.0
    return np.rint(alpha * image[..., :3] + 255.0 * (1.0 - alpha)).astype(np.uint8)
