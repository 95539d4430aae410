"""Estimation of camera poses of photos by pycolmap."""

from __future__ import annotations

import json
import shutil
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egs_warp.cli import main
from egs_warp.errors import UserError
from egs_warp.installation import install_command
from egs_warp.io import read_cameras
from egs_warp.io.cameras import read_points
from egs_warp.io.run_folder import MANIFEST
from egs_warp.pipelines import pose_photos as module
from tests.support.reconstruction import COLMAP_BIN, model, photos_of_noise, reconstruct_by


def fails(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["pose", *arguments]) == 2
    error = capsys.readouterr().err.splitlines()
    assert error[-1].startswith("egs-warp: ")
    return error[-1].removeprefix("egs-warp: ")


def test_without_pycolmap_one_line_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    error = fails(capsys, str(tmp_path), "--out", str(tmp_path / "out"))
    assert error == f"pose: pycolmap is not installed; {install_command('pose')}"
    assert not (tmp_path / "out").exists()


def test_bad_input_is_one_line_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pycolmap")
    out = tmp_path / "out"
    assert "neither a folder of photos nor a video" in fails(capsys, str(tmp_path / "no"), "--out", str(out))
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"no photo")
    assert "only 0 readable photos were found; give at least 3" in fails(
        capsys, str(tmp_path / "photos"), "--out", str(out)
    )
    assert not list(out.iterdir())
    for number in range(3):
        Image.new("RGB", (64, 48), (0, 0, 90 * number)).save(tmp_path / "photos" / f"{number}.png")
    assert "no photo could be posed; take more photos" in fails(capsys, str(tmp_path / "photos"), "--out", str(out))
    assert not list(out.iterdir())
    (out / "images").mkdir()
    assert "it has images, which would be mixed with this one; choose another folder" in fails(
        capsys, str(tmp_path / "photos"), "--out", str(out)
    )


def test_skipped_masks_are_reported(tmp_path: Path) -> None:
    source = tmp_path / "photos"
    for name in ("0.png", "thumbelina/1.png", "masks/0.png", "depth/0.png", "depth/1.png"):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 8)).save(source / name)
    assert sorted(module._copied(source, tmp_path / "images")) == [
        f"{source}/depth: 2 files skipped: their names look like masks or depth images",
        f"{source}/masks: 1 file skipped: its name looks like a mask or depth image",
    ]
    copied = {path.relative_to(tmp_path / "images").as_posix() for path in (tmp_path / "images").rglob("*.png")}
    assert copied == {"0.png", "thumbelina/1.png"}


def test_a_folder_belongs_to_one_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Remnants of a killed run are removed, an earlier run is refused or moved aside, and a failed run leaves no
    files."""
    photos, out = photos_of_noise(tmp_path / "photos"), tmp_path / "out"
    left = out / ".egs-pose-left"
    left.mkdir(parents=True)
    (left / "0.png").write_bytes(b"half")

    def fails_late(*_: object, **__: object) -> None:
        assert not left.exists()
        raise UserError("pose: no photo could be posed")

    reconstruct_by(monkeypatch, fails_late)
    assert "no photo could be posed" in fails(capsys, str(photos), "--out", str(out))
    assert not list(out.iterdir())
    reconstruct_by(monkeypatch, model)
    (photos / "phone.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    assert main(["pose", str(photos), "--out", str(out)]) == 0
    assert "phone.HEIC: HEIC is not read; convert the photos to JPEG" in capsys.readouterr().err
    manifest = json.loads((out / MANIFEST).read_text())
    assert manifest["finished"] and manifest["command"] == "pose"
    assert set(manifest["files"]) == {
        *(f"images/{number}.png" for number in range(3)),
        *(f"sparse/0/{name}" for name in COLMAP_BIN),
    }
    assert "it has an earlier run" in fails(capsys, str(photos), "--out", str(out))
    assert main(["pose", str(photos), "--out", str(out), "--overwrite"]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["earlier-1", "images", MANIFEST, "sparse"]
    assert (out / "earlier-1" / "sparse" / "0" / "cameras.bin").is_file()


@pytest.mark.parametrize("room", [0, 50, 100])
def test_a_truncated_model_is_reported(
    room: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a full disk, COLMAP does not report that its model is incomplete; the command does."""
    reconstruct_by(monkeypatch, partial(model, capacity=room))
    out = tmp_path / "out"
    assert main(["pose", str(photos_of_noise(tmp_path / "photos")), "--out", str(out)]) == 1
    assert "out: COLMAP's model is incomplete, most likely because the disk is full" in capsys.readouterr().err
    assert not out.exists()


def test_failures_of_colmap_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """COLMAP's error for a database that cannot be opened is reported in one line."""

    def fails(*_: object, **__: object) -> None:
        raise RuntimeError("No registered database factory succeeded.\nmore")

    reconstruct_by(monkeypatch, fails)
    out = tmp_path / "out"
    assert main(["pose", str(photos_of_noise(tmp_path / "photos")), "--out", str(out)]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("egs-warp: pose: COLMAP cannot continue (No registered database factory succeeded.); check")
    assert not out.exists()


@pytest.mark.data
@pytest.mark.slow
def test_photos_of_a_room_get_their_known_poses(
    data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All of twelve adjacent photos of the bonsai, one of which is rotated by an EXIF tag, get poses. The relative
    distances of the cameras are correct."""
    pytest.importorskip("pycolmap")
    photos = tmp_path / "photos"
    photos.mkdir()
    known = {
        view.name: view.camera for view in sorted(read_cameras(data_dir / "posed/bonsai"), key=lambda v: v.name)[:12]
    }
    for number, name in enumerate(known):
        original = data_dir / "posed/bonsai/images" / name
        if number == 4:
            exif = Image.Exif()
            exif[0x0112] = 6
            with Image.open(original) as opened:
                opened.transpose(Image.Transpose.ROTATE_90).save(photos / name, exif=exif, quality=97)
        else:
            shutil.copy(original, photos / name)
    out = tmp_path / "posed"
    assert main(["pose", str(photos), "--out", str(out), "--max-side", "800"]) == 0
    printed = capsys.readouterr()
    assert "estimated the poses of 12 of 12 photos (100 %)" in printed.out
    assert "features 12/12" in printed.err and "matches 66/66" in printed.err
    found = {view.name: view for view in read_cameras(out)}
    assert all(view.image is not None and view.camera.width == 800 for view in found.values())
    points = read_points(out)
    assert points is not None and len(points.positions) > 500
    # Poses are determined only up to a similarity transform, so ratios of the distances between camera centres are
    # compared.
    distances = []
    for cameras in ({name: found[name].camera for name in known}, known):
        centres = np.array([camera.centre for camera in cameras.values()])
        between = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
        distances.append(between / between.mean())
    assert np.abs(distances[0] - distances[1]).max() < 0.1
