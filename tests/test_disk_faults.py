"""Disk faults: every write of a file by a command fails once, because the disk is full or access is denied."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest

from egs_warp.assets.pawn import pawn
from egs_warp.cli import main
from egs_warp.io import write_ply
from egs_warp.io.planes import read_planes
from egs_warp.io.run_folder import MANIFEST
from tests.support.disk_faults import assert_one_line, fail_once, largest_file
from tests.support.posed import posed_folder
from tests.support.reconstruction import model, photos_of_noise, reconstruct_by
from tests.support.scenes import write_scene

COMMANDS = {
    "convert to ply": "convert {capture} {out}/a.ply",
    "convert to compressed ply": "convert {capture} {out}/a.compressed.ply",
    "convert to spz": "convert {capture} {out}/a.spz",
    "convert to sog": "convert {capture} {out}/a.sog",
    "convert to splat": "convert {capture} {out}/a.splat",
    "convert to glb": "convert {capture} {out}/a.glb",
    "samples": "samples --out {out}",
    "info": "info {capture} --up z --plot {out}/info.png",
    "muscles": "muscles {capture} --up z --plot {out}/muscles.png",
    "view": "view {run} --export {out}/page.html",
    "video": "render {run} --out {out}/close.mp4 --size 64",
    "video with alpha": "render {run} --out {out}/close.mov --size 64 --background transparent",
    "pictures": "render {run} --out {out} --show depth --size 64",
    "frames": "export {run} --to spz --out {out} --every 6",
    "glTF": "export {run} --to glb --frame 4 --out {out}",
    "usd": "export {run} --to usd --out {out}/a.usdc",
    "usd as text": "export {run} --to usd --out {out}/a.usda",
    "bundle": "export {run} --to bundle --out {out}/a.egs",
    "animate": "animate {capture} --up z --frames 3 --size 64 --out {out}",
    "plane": "plane {scene}/scene.ply --object {scene}/photo1.png --cameras {scene}/cameras.json --out {out}",
    "segment": "segment {scene}/scene.ply --object {scene}/photo1.png --cameras {scene}/cameras.json"
    " --straddling split --out {out}",
    "pose": "pose {photos} --out {out}",
    "inpaint": "inpaint {scene}/parts/background.ply --plane {scene}/parts/plane.json --out {out}/filled.ply",
    "train": "train {scene}/posed --out {out}/a.ply --iterations 40 --gaussians 300 --device cpu",
}
SCENES = {"plane", "segment", "inpaint", "train"}
SLOW = {"samples", "info", "muscles", "pictures", *SCENES}
"""Commands that compute for a long time before each file, or write many files."""
Command = Callable[[str, Path], int]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("capture") / "pawn.ply"
    write_ply(path, pawn(gaussian_count=1500).cloud)
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a ball on a floor, its parts, and photos with poses."""
    folder = tmp_path_factory.mktemp("scene")
    write_scene(folder, views=4, size=64)
    posed_folder(folder / "posed")
    assert main(COMMANDS["segment"].format(scene=folder, out=folder / "parts").split()) == 0
    return folder


@pytest.fixture
def photos(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder of photos whose poses are estimated by a substitute for pycolmap."""
    reconstruct_by(monkeypatch, model)
    return photos_of_noise(tmp_path_factory.mktemp("photos") / "photos")


@pytest.fixture
def command(capture: Path, run_folder: Path, request: pytest.FixtureRequest) -> Command:
    """Return a function that runs a line of ``COMMANDS`` with output to a folder, and returns its exit status."""

    def run(line: str, out: Path) -> int:
        places = {"capture": capture, "run": run_folder, "out": out}
        if "{scene}" in line:
            if "train " in line:
                pytest.importorskip("torch")
            places["scene"] = request.getfixturevalue("scene")
        if "{photos}" in line:
            places["photos"] = request.getfixturevalue("photos")
        words = [word.format(**places) for word in line.split()]
        try:
            return main(words)
        except SystemExit as end:
            assert isinstance(end.code, int)
            return end.code

    return run


def files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("size", [pytest.param(0, marks=pytest.mark.slow), 700])
@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, id=name, marks=[pytest.mark.slow] if name in SCENES else [])
        for name, line in COMMANDS.items()
    ],
)
def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(
    line: str,
    size: int,
    command: Command,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
) -> None:
    """If a write fails at its first byte or later, the exit status is 1, and only complete files are left."""
    for made in {"scene", "photos"} & set(re.findall(r"{(\w+)}", line)):
        request.getfixturevalue(made)
    with largest_file(size):
        status = command(line, tmp_path / "out") if line.endswith("{out}") else command(line, tmp_path)
    assert status == 1
    assert_one_line(capsys.readouterr().err, "File too large")
    # An interrupted run leaves its initial files, which are small enough to be complete.
    assert {path.name for path in files(tmp_path)} <= {"manifest.json", "run.yaml", "plane.json"}
    assert all(read_planes(path) for path in files(tmp_path) if path.name == "plane.json")


@pytest.mark.parametrize(
    ("reason", "status"),
    [
        pytest.param(errno.ENOSPC, 1, id="full"),
        pytest.param(errno.EACCES, 2, id="refused", marks=pytest.mark.slow),
        pytest.param(errno.EPIPE, 2, id="pipe", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, id=name, marks=[pytest.mark.slow] if name in SLOW else [])
        for name, line in COMMANDS.items()
        if name != "animate"
    ],
)
def test_each_file_operation_fails_once(
    line: str,
    reason: int,
    status: int,
    command: Command,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each opening and renaming of a file fails in turn, with a one-line error and no temporary file left. A last run
    without a fault writes all files. (``tests/pipelines/test_animate.py`` tests ``animate``.)
    """
    out = tmp_path / "out"
    for number in range(200):
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        with monkeypatch.context() as patch:
            failed = fail_once(patch, number, reason)
            ended = command(line, out)
        said = capsys.readouterr().err
        assert not [path for path in files(out) if path.name.startswith(".egs-")]
        if not failed:
            break
        assert ended == status
        assert_one_line(said, os.strerror(reason))
    assert ended == 0 and number >= 2 and files(out)


def test_a_clock_that_jumps_changes_nothing(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock jumps forward or back by a day each time it is read, and a killed process has left a file with a date
    in the future. The run finishes and removes that file, but none of its own files.
    """
    left = tmp_path / ".egs-0123456789abcdef.ply"
    left.write_text("half")
    tomorrow = time.time() + 86_400.0
    os.utime(left, (tomorrow, tomorrow))
    looks, clock = count(), time.time
    monkeypatch.setattr(time, "time", lambda: clock() + 86_400.0 * (next(looks) % 3 - 1) + 7.0)
    assert command(COMMANDS["animate"], tmp_path) == 0
    assert "Traceback" not in capsys.readouterr().err
    assert next(looks) >= 1 and not left.exists()
    assert json.loads((tmp_path / MANIFEST).read_text())["finished"] and (tmp_path / "jump.mp4").stat().st_size > 500
