"""Selection of sharp frames of a video that are evenly spaced in time."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.io.frames import select_sharp_frames
from egs_warp.io.video import VideoWriter


def test_the_sharpest_frame_of_each_part_is_taken(tmp_path: Path) -> None:
    """Every fifth of forty frames is sharp; if eight frames are requested, these eight are selected."""
    random = np.random.default_rng(0)
    texture = random.integers(0, 255, (48, 64, 3)).astype(np.uint8)
    with VideoWriter(tmp_path / "v.mp4", 64, 48, frames_per_second=30) as video:
        for number in range(40):
            frame = np.roll(texture, number, axis=1)
            video.write(frame if number % 5 == 2 else cv2.GaussianBlur(frame, (0, 0), 3))
    taken = list(select_sharp_frames(tmp_path / "v.mp4", 8))
    assert [frame.number for frame in taken] == list(range(2, 40, 5))
    assert taken[0].pixels.shape == (48, 64, 3)
    assert len(list(select_sharp_frames(tmp_path / "v.mp4", 100))) == 40


def test_no_video_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_bytes(b"no video")
    with pytest.raises(UserError, match=r"v.mp4: not a readable video; give an .mp4 or .mov, or a folder of photos"):
        list(select_sharp_frames(tmp_path / "v.mp4", 5))


@pytest.mark.parametrize(
    "text",
    [
        "#EXTM3U\n#EXTINF:1,\nsecret.mp4\n",
        "ffconcat version 1.0\nfile secret.mp4\n",
        "v=0\nc=IN IP4 127.0.0.1\n",
        "<MPD/>",
        "",
    ],
)
def test_playlists_are_no_videos(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_text(text)
    with pytest.raises(UserError, match=r"a\.mp4: not a readable video; give an \.mp4 or \.mov"):
        next(select_sharp_frames(tmp_path / "a.mp4", 3))


def test_a_pipe_is_no_video(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mp4")
    with pytest.raises(UserError, match=r"a\.mp4: no such file; give a video or a folder of photos"):
        next(select_sharp_frames(tmp_path / "a.mp4", 3))
