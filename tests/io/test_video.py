"""Images and videos: reading returns what was written, and no half-written file is left."""

from __future__ import annotations

import errno
import os
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.io.video import VideoWriter, contact_sheet, ffmpeg_program, write_png


def smooth_frames(count: int, height: int, width: int) -> list[np.ndarray]:
    y, x = np.mgrid[:height, :width]
    return [
        np.stack([x * 255 // width, y * 255 // height, np.full_like(x, 20 + 20 * k)], -1).astype(np.uint8)
        for k in range(count)
    ]


@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 63)])
def test_video_reads_back(tmp_path: Path, height: int, width: int) -> None:
    frames = smooth_frames(9, height, width)
    with VideoWriter(tmp_path / "v.mp4", width, height, frames_per_second=30) as video:
        for frame in frames:
            video.write(frame)
    assert os.listdir(tmp_path) == ["v.mp4"]
    reader = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(30)
    fourcc = int(reader.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little")
    assert fourcc in (b"avc1", b"h264")
    for frame in frames:
        ok, back = reader.read()
        assert ok
        assert back.shape[:2] == (height + height % 2, width + width % 2)
        assert np.abs(back[:height, :width, ::-1].astype(float) - frame).mean() < 4.0
    assert not reader.read()[0]


def test_a_failed_video_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(b"good")
    with pytest.raises(RuntimeError, match="solver"), VideoWriter(path, 16, 16) as video:
        video.write(np.zeros((16, 16, 3), np.uint8))
        raise RuntimeError("solver")
    with pytest.raises(UserError, match=r"a frame has shape \(8, 16, 3\)"), VideoWriter(path, 16, 16) as video:
        video.write(np.zeros((8, 16, 3), np.uint8))
    assert path.read_bytes() == b"good"
    assert os.listdir(tmp_path) == ["v.mp4"]


def test_an_ffmpeg_that_does_not_start_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: object, **__: object) -> None:
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    ffmpeg = ffmpeg_program()
    monkeypatch.setattr("egs_warp.io.video.ffmpeg_program", lambda: ffmpeg)
    monkeypatch.setattr(subprocess, "Popen", failing)
    with pytest.raises(UserError, match=r"v\.mp4: cannot be written \(Resource temporarily unavailable\)"):
        VideoWriter(tmp_path / "v.mp4", 16, 16).__enter__()
    assert os.listdir(tmp_path) == []


def test_a_full_disk_reported_by_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If ffmpeg reports a full disk, the message says so, and the exit status follows from the cause of the error;
    other messages of ffmpeg are quoted unchanged."""
    for said, number in (("[out#0] Error: No space left on device", errno.ENOSPC), ("Unknown encoder", None)):
        program = tmp_path / "ffmpeg"
        program.write_text(f"#!/bin/sh\ncat > /dev/null\necho '{said}' >&2\nexit 1\n")
        program.chmod(0o755)
        monkeypatch.setattr("egs_warp.io.video.ffmpeg_program", lambda program=program: str(program))
        with pytest.raises(UserError) as caught, VideoWriter(tmp_path / "v.mp4", 16, 16) as video:
            video.write(np.zeros((16, 16, 3), np.uint8))
        reason = said if number is None else os.strerror(number)
        assert str(caught.value) == f"{tmp_path / 'v.mp4'}: ffmpeg could not write the video ({reason})"
        assert getattr(caught.value.__cause__, "errno", None) == number
    assert os.listdir(tmp_path) == ["ffmpeg"]


def test_unwritable_places_are_named(tmp_path: Path) -> None:
    missing = tmp_path / "missing" / "v.mp4"
    with pytest.raises(UserError, match=r"v\.mp4: its folder does not exist; create .*missing first"):
        VideoWriter(missing, 16, 16).__enter__()
    with pytest.raises(UserError, match=r"v\.mp4: its folder does not exist"):
        write_png(missing, np.zeros((4, 4, 3), np.uint8))


def test_png_is_lossless_and_in_rgb_order(tmp_path: Path) -> None:
    image = smooth_frames(1, 13, 17)[0]
    write_png(tmp_path / "p.png", image)
    read = cv2.imread(str(tmp_path / "p.png"))
    assert read is not None and np.array_equal(read[..., ::-1], image)


def test_contact_sheet_places_frames_and_writes_labels() -> None:
    frames = [np.full((64, 80, 3), 10 * k, np.uint8) for k in range(12)]
    sheet = contact_sheet(frames, 4, [f"{k / 6:.2f} s" for k in range(12)])
    assert sheet.shape == (3 * 64, 4 * 80, 3)
    for k in range(12):
        cell = sheet[k // 4 * 64 : k // 4 * 64 + 64, k % 4 * 80 : k % 4 * 80 + 80]
        assert (cell[32:] == 10 * k).all()
        assert (cell[:24] != 10 * k).any(), "a label"
    with pytest.raises(UserError, match="12 frames and 1 labels"):
        contact_sheet(frames, 4, ["x"])


def test_a_sheet_holds_frames_of_different_sizes() -> None:
    """In a contact sheet with portrait and landscape images, each image is centred on white in its cell."""
    wide, tall = np.full((20, 40, 3), 7, np.uint8), np.full((60, 30, 3), 9, np.uint8)
    sheet = contact_sheet([wide, tall], 2, ["", ""])
    assert sheet.shape == (60, 80, 3)
    assert (sheet[20:40, :40] == 7).all() and (sheet[:20, :40] == 255).all() and (sheet[40:, :40] == 255).all()
    assert (sheet[:, 45:75] == 9).all() and (sheet[:, 40:45] == 255).all()


@pytest.mark.parametrize("name", ["2026-11-21T12:30", "-dash", "pipe:1", "concat:a|b", "%03d"])
def test_a_folder_may_have_any_name(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """ffmpeg could interpret such names as a URL, an option or a pattern."""
    monkeypatch.chdir(tmp_path)
    Path(name).mkdir()
    with VideoWriter(Path(name) / "v.mp4", 16, 16) as video:
        video.write(np.zeros((16, 16, 3), np.uint8))
    assert os.listdir(name) == ["v.mp4"] and (Path(name) / "v.mp4").stat().st_size > 0


def test_a_missing_ffmpeg_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for program in (tmp_path / "none", Path("/bin/false")):
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
        with pytest.raises(UserError, match=r"no ffmpeg, so no video could be written .*set IMAGEIO_FFMPEG_EXE"):
            ffmpeg_program()
