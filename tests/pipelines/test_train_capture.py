"""Captures from photos with poses: ``egs_warp.pipelines.train_capture`` and ``egs-warp train``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from egs_warp.cli import main
from egs_warp.errors import UserError
from egs_warp.io import read_capture
from egs_warp.io.orientation import apply_orientation
from tests.support.posed import posed_folder
from tests.support.training_views import ring

pytest.importorskip("torch")
from egs_warp.pipelines.train_capture import train
from egs_warp.training.initial_cloud import initial_cloud, middle_of
from egs_warp.training.metrics import psnr
from egs_warp.training.posed_photos import backdrop_colour, laid_over, read_views
from egs_warp.training.training_view import TrainingView


def run(folder: Path, out: Path, *flags: str) -> int:
    return main(["train", str(folder), "--out", str(out), "--iterations", "60", "--gaussians", "300", *flags])


def test_command_writes_capture_report_and_sheet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    posed = posed_folder(tmp_path / "posed")
    out = tmp_path / "made" / "ball.ply"
    assert run(posed, out, "--sh-degree", "1") == 0
    printed = capsys.readouterr()
    assert "held out: " in printed.out and f"wrote {out}" in printed.out
    assert f"photos: 9 of 9 used (9 in {posed}; poses of transforms.json), none with a mask" in printed.out
    assert "training 60/60" in printed.err and "frames/s" in printed.err
    assert sorted(path.name for path in out.parent.iterdir()) == ["ball.ply", "ball.report.json", "ball.sheet.png"]
    capture = read_capture(out, device="cpu").cloud
    assert capture.sh.shape[1] == 4
    report = json.loads((out.parent / "ball.report.json").read_text())
    assert report["gaussians"] == capture.count <= 300
    assert report["iterations"] == 60 and report["photos"] == 9 and report["photo_size"] == [32, 32]
    # Every eighth photo, here numbers 0 and 8, is held out.
    assert [score["name"] for score in report["scores"] if score["held_out"]] == ["r_0.png", "r_8.png"]
    held_out = [score["psnr"] for score in report["scores"] if score["held_out"]]
    assert report["mean"]["held_out"]["psnr"] == pytest.approx(np.mean(held_out))
    photo = read_views(posed).views[0].image
    flat = psnr(np.broadcast_to(photo.mean(axis=(0, 1)), photo.shape), photo)
    assert report["mean"]["held_out"]["psnr"] > flat + 1.0
    sheet = cv2.imread(str(out.parent / "ball.sheet.png"))
    assert sheet is not None and sheet.shape[:2] == (64, 64)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--iterations", "0"], "--iterations 0: give a whole number of at least 1"),
        (["--gaussians", "5"], "--gaussians 5: give a whole number of at least 100"),
        (["--max-side", "1"], "--max-side 1: give a whole number of at least 16"),
        (["--sh-degree", "4"], "--sh-degree 4: give 0, 1, 2 or 3"),
        (["--background", "redd"], "--background redd: give a colour: r,g,b from 0 to 1, #rrggbb, or a name"),
        (["--background", "0,0,2"], "--background 0,0,2: give a colour: r,g,b from 0 to 1, #rrggbb, or a name"),
        (["--device", "tpu"], "--device tpu: this machine has cpu"),
        (["--out", "made/x.obj"], "made/x.obj: give a name that ends in"),
        ([], "photos: no such file or folder"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    flags: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    if flags:
        (tmp_path / "photos").mkdir()
    assert main(["train", "photos", "--out", "made/x.ply", *flags]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith("egs-warp: ") and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == (["photos"] if flags else [])


def test_unusable_photos_are_named_and_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One photo is missing, one is truncated, and one has another shape; the other photos are used."""
    posed = posed_folder(tmp_path / "posed")
    (posed / "r_5.png").unlink()
    (posed / "r_3.png").write_bytes((posed / "r_3.png").read_bytes()[:60])
    cv2.imwrite(str(posed / "r_6.png"), np.zeros((32, 20, 3), np.uint8))
    assert run(posed, tmp_path / "ball.ply") == 0
    error = capsys.readouterr().err
    assert "left out r_5.png: r_5.png: the photo is not beside the poses; put it there" in error
    assert "r_3.png: the picture is cut short; copy it again" in error
    assert "r_6.png: the photo has 20 x 32 pixels, but its camera has 32 x 32" in error
    report = json.loads((tmp_path / "ball.report.json").read_text())
    assert [one["name"] for one in report["left_out"]] == ["r_3.png", "r_5.png", "r_6.png"]
    assert report["photos"] == 6
    assert report["sources"]["total"] == 9 and report["sources"]["used"] == 6


def test_without_any_photo_an_earlier_result_stays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    posed = posed_folder(tmp_path / "posed")
    for photo in posed.glob("*.png"):
        photo.unlink()
    out = tmp_path / "ball.ply"
    out.write_bytes(b"precious")
    assert run(posed, out, "--overwrite") == 2
    assert "none of its 9 photos can be used; the first: r_0.png: the photo is not beside" in capsys.readouterr().err
    assert out.read_bytes() == b"precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.ply", "posed"]


def test_portrait_and_landscape_through_a_lens(tmp_path: Path) -> None:
    """Photos of two cameras with lens distortion, one of which stores images rotated by an EXIF tag, are used for
    training, scored, and shown in one contact sheet."""
    posed = posed_folder(tmp_path / "posed", size=48)
    tree = json.loads((posed / "transforms.json").read_text())
    for number, frame in enumerate(tree["frames"]):
        pixels = cv2.imread(str(posed / frame["file_path"]))
        assert pixels is not None
        frame.update(k1=-0.02)
        if number % 2:
            # The left and right margins are cropped, which gives a portrait image that is stored rotated.
            upright = np.ascontiguousarray(pixels[:, 8:-8, ::-1])
            exif = Image.Exif()
            exif[0x0112] = 6
            Image.fromarray(apply_orientation(upright, 8)).save(posed / f"t_{number}.png", exif=exif)
            frame.update(file_path=f"t_{number}.png", w=32, h=48, cx=16.0, cy=24.0)
    (posed / "transforms.json").write_text(json.dumps(tree))
    assert run(posed, tmp_path / "ball.ply", "--iterations", "200") == 0
    report = json.loads((tmp_path / "ball.report.json").read_text())
    assert report["left_out"] == []
    assert report["mean"]["held_out"]["psnr"] > 20.0
    sheet = cv2.imread(str(tmp_path / "ball.sheet.png"))
    assert sheet is not None and sheet.shape == (96, 96, 3)


def test_a_photo_with_a_wrong_pose_is_detected_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One of sixteen photos has a wrong pose; it is excluded and reported."""
    posed = posed_folder(tmp_path / "posed", count=16)
    tree = json.loads((posed / "transforms.json").read_text())
    wrong = tree["frames"][5]
    wrong["transform_matrix"] = tree["frames"][12]["transform_matrix"]
    (posed / "transforms.json").write_text(json.dumps(tree))
    assert run(posed, tmp_path / "ball.ply", "--iterations", "400") == 0
    report = json.loads((tmp_path / "ball.report.json").read_text())
    assert [one["name"] for one in report["left_out"]] == ["r_5.png"]
    assert "left out r_5.png: it does not fit the other photos" in capsys.readouterr().err
    assert [score["name"] for score in report["scores"] if score["misfit"]] == ["r_5.png"]


def test_reduced_photos_keep_their_colours_and_field_of_view(tmp_path: Path) -> None:
    """A photo of half the size has the same mean colour, and its camera has the same field of view. Transparent pixels
    do not change the colours of their neighbours."""
    posed = posed_folder(tmp_path / "posed", alpha=True)
    full, half = read_views(posed).views[3], read_views(posed, max_side=16).views[3]
    assert full.alpha is not None and half.alpha is not None
    assert half.image.shape == (16, 16, 3)
    assert half.camera.width / half.camera.fx == pytest.approx(full.camera.width / full.camera.fx)
    one, other = (laid_over(view, (1.0, 0.0, 0.5)).image for view in (full, half))
    np.testing.assert_allclose(one.reshape(16, 2, 16, 2, 3).mean(axis=(1, 3)), other, atol=1e-5)


def test_masks_beside_the_photos_remove_the_background(tmp_path: Path) -> None:
    """With masks named by COLMAP's convention, ``masks/PHOTO.png``, pixels outside the mask are replaced by the
    background."""
    posed = posed_folder(tmp_path / "set" / "images")
    masks = tmp_path / "set" / "masks"
    masks.mkdir()
    plain = read_views(posed).views
    assert all(view.alpha is None for view in plain)
    rim = np.concatenate([plain[0].image[0], plain[0].image[-1], plain[0].image[:, 0], plain[0].image[:, -1]])
    np.testing.assert_allclose(backdrop_colour(plain[:1]), rim.mean(axis=0), atol=1e-6)
    half = np.zeros((32, 32), np.uint8)
    half[:, 16:] = 255
    for number in range(9):
        cv2.imwrite(str(masks / f"r_{number}.png.png"), half)
    views = read_views(posed).views
    assert backdrop_colour(views) == (1.0, 1.0, 1.0)
    laid = laid_over(views[2], (0.0, 1.0, 0.0)).image
    np.testing.assert_array_equal(laid[:, :16], np.broadcast_to([0.0, 1.0, 0.0], (32, 16, 3)).astype(np.float32))
    np.testing.assert_array_equal(laid[:, 16:], plain[2].image[:, 16:])
    result = train(posed, iterations=3, max_gaussians=100, sh_degree=0, device="cpu")
    assert np.array_equal(result.views[2].image[:, :16], np.ones((32, 16, 3), np.float32))
    cv2.imwrite(str(masks / "r_4.png.png"), half[:8])
    (left,) = read_views(posed).left_out
    assert left.name == "r_4.png"
    assert "r_4.png.png: the mask has 32 x 8 pixels, but its photo has 32 x 32; make the mask" in left.reason


def test_the_centre_is_where_the_cameras_point() -> None:
    shift = np.array([3.0, -2.0, 5.0])
    cameras = [replace(camera, translation=camera.translation - camera.rotation @ shift) for camera in ring(7)]
    np.testing.assert_allclose(middle_of(cameras), shift, atol=1e-9)


def test_the_first_cloud_fills_the_silhouettes_and_nothing_else() -> None:
    """For masks of a small sphere, the points of the initial cloud are distributed over the whole sphere, and in each
    view at least 85 % of them are inside the mask."""
    centre, radius = np.array([0.1, -0.05, 0.0]), 0.2
    views = []
    for camera in ring(12, 64):
        rows, columns = np.mgrid[:64, :64] + 0.5
        rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones((64, 64))], -1)
        rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)) @ camera.rotation
        to_centre = centre - camera.centre
        off = np.linalg.norm(to_centre - (rays @ to_centre)[..., None] * rays, axis=-1)
        image = np.broadcast_to([0.8, 0.3, 0.1], (64, 64, 3)).astype(np.float32)
        views.append(TrainingView(camera, image, alpha=(off < radius).astype(np.float32)))
    cloud = initial_cloud(views, count=500, sh_degree=1, device="cpu")
    means = cloud.means.numpy()
    assert len(means) == 500
    for view in views[::3]:
        p = means @ view.camera.rotation.T + view.camera.translation
        column = view.camera.fx * p[:, 0] / p[:, 2] + view.camera.cx
        row = view.camera.fy * p[:, 1] / p[:, 2] + view.camera.cy
        assert view.alpha is not None
        assert view.alpha[row.astype(int), column.astype(int)].mean() > 0.85
    distance = np.linalg.norm(means - centre, axis=1)
    assert 0.6 * radius < np.median(distance) < radius
    assert np.abs(means.mean(axis=0) - centre).max() < 0.2 * radius
    # The size of each Gaussian is about the spacing of 500 points in the sphere.
    spacing = (4 / 3 * np.pi * radius**3 / 500) ** (1 / 3)
    assert 0.3 * spacing < np.exp(cloud.log_scales.numpy()).mean() < 1.2 * spacing
    np.testing.assert_allclose(cloud.sh.numpy()[:, 0] * 0.28209479 + 0.5, np.tile([0.8, 0.3, 0.1], (500, 1)), atol=1e-5)


def test_cameras_without_a_common_view_are_refused() -> None:
    camera = ring(1)[0]
    away = replace(camera, rotation=camera.rotation, near=1e9, far=2e9)
    view = TrainingView(away, np.zeros((camera.height, camera.width, 3), np.float32))
    with pytest.raises(UserError, match="train: the cameras have no common view; check the poses"):
        initial_cloud([view], count=100, sh_degree=0, device="cpu")


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("name", "least"), [("bonsai", 17.0), ("mouse", 22.0)])
def test_photos_of_a_room_become_a_capture(name: str, least: float, data_dir: Path) -> None:
    """The photos show a room with slight lens distortion, or a desk in portrait and landscape, at reduced size."""
    result = train(data_dir / "posed" / name, iterations=300, max_gaussians=5000, max_side=90, device="cpu")
    held_out = result.mean_score(held_out=True)
    assert held_out is not None and held_out.psnr > least
    if name == "mouse":
        assert {view.image.shape[:2] for view in result.views} == {(90, 68), (68, 90)}
