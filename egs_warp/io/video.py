"""Writing of images and videos. Files are written atomically: to a temporary file in the same folder, which is then
renamed."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Annotated

import numpy as np

from egs_warp.checked_calls import Positive, PositiveCount, Range, checked_constructor
from egs_warp.errors import ArgumentError, UserError
from egs_warp.io.atomic import atomic_write, system_error


def write_png(path: Path | str, image: np.ndarray) -> None:
    """Write a PNG from ``image``: (H, W, 3) RGB, (H, W, 4) RGBA or (H, W) grey. Raises ``UserError`` if the file cannot
    be written."""
    import cv2

    shape = image.shape
    if not (image.ndim == 2 or (image.ndim == 3 and shape[2] in (3, 4))) or image.size == 0:
        raise ArgumentError("image", "give an array of shape (H, W), (H, W, 3) or (H, W, 4)", value=f"of shape {shape}")
    if image.dtype not in (np.uint8, np.uint16):
        advice = "give uint8 from 0 to 255; for colours from 0 to 1, np.uint8(255.0 * image + 0.5)"
        raise ArgumentError("image", advice, value=f"of type {image.dtype}")
    swap = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    coded = image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), swap[image.shape[2]])
    ok, data = cv2.imencode(".png", coded)
    if not ok:
        raise UserError(f"{path}: the picture of shape {image.shape} could not be encoded as PNG; write a smaller one")
    with atomic_write(path) as temporary:
        temporary.write_bytes(data.tobytes())


def contact_sheet(frames: Sequence[np.ndarray], columns: PositiveCount, labels: Sequence[str]) -> np.ndarray:
    """Return a contact sheet (rows * H, columns * W, 3) uint8: the frames with labels in their upper left corners.

    H and W are the maximum height and width; smaller frames are centred in a white cell.
    """
    import cv2

    if len(frames) != len(labels) or not frames:
        raise UserError(f"contact sheet: {len(frames)} frames and {len(labels)} labels; give one label for each frame")
    height, width = (max(frame.shape[axis] for frame in frames) for axis in (0, 1))
    rows = -(-len(frames) // columns)
    sheet = np.full((rows * height, columns * width, 3), 255, dtype=np.uint8)
    size = max(0.35, height / 512 * 0.8)
    rim = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * max(1, round(1.5 * size)) + 1,) * 2)
    for index, (frame, label) in enumerate(zip(frames, labels, strict=True)):
        letters = cv2.putText(
            np.zeros((height, width), np.uint8),
            label,
            (int(12 * size), int(30 * size)),
            cv2.FONT_HERSHEY_SIMPLEX,
            size,
            255,
            max(1, round(1.4 * size)),
            cv2.LINE_AA,
        )
        # Dark letters with a light outline are legible on any background.
        cell = _in_the_middle(frame, height, width)
        for colour, mask in ((255.0, cv2.dilate(letters, rim)), (20.0, letters)):
            cell = cell + mask[..., None] / 255.0 * (colour - cell)
        row, column = divmod(index, columns)
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = np.rint(cell)
    return sheet


def _in_the_middle(frame: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return ``frame`` in the middle of a white cell (height, width, 3) float32."""
    cell = np.full((height, width, 3), 255.0, dtype=np.float32)
    top, left = (height - frame.shape[0]) // 2, (width - frame.shape[1]) // 2
    cell[top : top + frame.shape[0], left : left + frame.shape[1]] = frame
    return cell


def ffmpeg_program() -> str:
    """Return the path of the ffmpeg program. Raises ``UserError`` if there is none that runs."""
    import imageio_ffmpeg

    cure = "pip install imageio-ffmpeg, or set IMAGEIO_FFMPEG_EXE to an ffmpeg program"
    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
        subprocess.run([program, "-version"], stdin=subprocess.DEVNULL, capture_output=True, check=True, timeout=60)
    except (RuntimeError, OSError, subprocess.SubprocessError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"no ffmpeg, so no video could be written ({reason}); {cure}") from error
    return program


class _AbandonedError(Exception):
    """Internal exception that discards an incomplete video."""


_TOO_LARGE = getattr(signal, "SIGXFSZ", 0)
"""Signal that ends a program whose output exceeds the user's limit of the file size; 0 on Windows, which has no such
signal."""
_BT709 = ("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709")
_CODECS = {
    ".mp4": ("mp4", "libx264", "yuv420p", ("-preset", "medium", "-movflags", "+faststart")),
    ".mov": ("mov", "prores_ks", "yuva444p10le", ("-profile:v", "4444", "-alpha_bits", "16", "-vendor", "apl0")),
    ".webm": ("webm", "libvpx-vp9", "yuva420p", ("-b:v", "0", "-auto-alt-ref", "0", "-cpu-used", "4", "-row-mt", "1")),
}
"""Format, codec, pixel format and other options of ffmpeg, by the ending of the video."""


@checked_constructor
class VideoWriter:
    """Video writer that uses the ffmpeg program of imageio-ffmpeg: H.264 (.mp4), ProRes 4444 (.mov) or VP9 (.webm). The
    last two support straight alpha.

    Use it as a context manager. If the context ends without an exception, the video is moved to ``path``; otherwise
    nothing is written.
    """

    def __init__(
        self,
        path: Path | str,
        width: PositiveCount,
        height: PositiveCount,
        *,
        frames_per_second: Positive = 60.0,
        quality: Annotated[int, Range(0, 51)] = 16,
        alpha: bool = False,
    ) -> None:
        """Prepare the FFmpeg command. ``quality`` is the constant rate factor of H.264 and VP9: 0 is lossless, 16 has
        hardly visible losses, 51 is the worst.

        Raises ``UserError`` if the name of the file does not end in .mp4, .mov or .webm, and for ``alpha`` in an .mp4.
        """
        self._path = Path(path)
        self._shape = (height, width, 4 if alpha else 3)
        ending = self._path.suffix.lower()
        if ending not in _CODECS:
            raise UserError(f"{path}: give a name that ends in {', '.join(_CODECS)}")
        if alpha and ending == ".mp4":
            raise UserError(f"{path}: H.264 has no alpha; give a name that ends in .mov or .webm")
        self._format, codec, pixels, more = _CODECS[ending]
        rate = () if codec == "prores_ks" else ("-crf", str(quality))
        self._command_tail = [
            # Allow only the protocols of pipes and files, because names may look like addresses or playlists.
            *("-protocol_whitelist", "file,pipe", "-f", "rawvideo", "-pix_fmt", "rgba" if alpha else "rgb24"),
            *("-s", f"{width + width % 2}x{height + height % 2}"),
            *("-r", f"{frames_per_second:g}", "-i", "pipe:0", "-an"),
            *("-vf", "scale=out_color_matrix=bt709:out_range=tv", "-c:v", codec, "-pix_fmt", pixels),
            *(*rate, *more, "-color_range", "tv", *_BT709),
        ]

    def __repr__(self) -> str:
        height, width, _ = self._shape
        return f"VideoWriter({str(self._path)!r}, {width} x {height} pixels)"

    def __enter__(self) -> VideoWriter:
        program = ffmpeg_program()
        with contextlib.ExitStack() as files:
            temporary = files.enter_context(atomic_write(self._path))
            self._log = files.enter_context(tempfile.TemporaryFile())
            self._process = subprocess.Popen(
                [
                    *(program, "-y", "-loglevel", "error"),
                    *self._command_tail,
                    *("-f", self._format, str(temporary)),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=self._log,
                # Ctrl-C must reach only this process, which then ends ffmpeg.
                start_new_session=True,
            )
            self._files = files.pop_all()
        return self

    def write(self, frame: np.ndarray) -> None:
        """Append a frame (H, W, 3) uint8 RGB, or (H, W, 4) RGBA with ``alpha``. Odd sides are padded by repeating the
        last line, because yuv420p requires even sides."""
        if frame.shape != self._shape or frame.dtype != np.uint8:
            raise UserError(
                f"{self._path}: a frame has shape {frame.shape} and type {frame.dtype},"
                f" expected {self._shape} and uint8; give frames of one shape"
            )
        height, width, _ = self._shape
        if height % 2 or width % 2:
            frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(frame).data)
        except BrokenPipeError as error:
            raise self._failure() from (self._system_error() or error)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process.stdin is not None
        try:
            if kind is not None:
                self._process.kill()
            # A failure of ffmpeg is reported below, with its exit status and message.
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.close()
            if self._process.wait() != 0 and kind is None:
                raise self._failure() from self._system_error()
        except BaseException:
            self._abandon()
            raise
        if kind is None:
            self._files.close()
        else:
            self._abandon()

    def _abandon(self) -> None:
        """Discard the video and leave an existing file at the path unchanged. The cause of the failure is not chained,
        because it does not concern the path."""
        self._files.__exit__(_AbandonedError, _AbandonedError(), None)

    def _failure(self) -> UserError:
        lines = self._log_text().splitlines()
        reason = self._system_error()
        message = reason.strerror if reason is not None else lines[-1] if lines else "no message"
        return UserError(f"{self._path}: ffmpeg could not write the video ({message})")

    def _system_error(self) -> OSError | None:
        """Return the error of the operating system that ended ffmpeg, such as a full disk; None if there was none."""
        if self._process.wait() == -_TOO_LARGE:
            return OSError(errno.EFBIG, os.strerror(errno.EFBIG))
        return system_error(self._log_text())

    def _log_text(self) -> str:
        self._process.wait()
        self._log.seek(0)
        return self._log.read().decode(errors="replace").strip()
