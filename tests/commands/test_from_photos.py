"""``egs-warp from-photos`` makes a film from photos of a ball on a floor, with a substitute for COLMAP."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from egs_warp.cli import main
from egs_warp.commands.train import TrainStep, run_train
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.io import read_capture
from egs_warp.io.picked import read_picked
from egs_warp.render import render_gaussians
from tests.support.coarse import coarse_cages
from tests.support.reconstruction import reconstruct_by
from tests.support.scenes import FLOOR, ball_on_floor

pytest.importorskip("torch")

STAGES = ("pose", "train", "pick", "film")


@dataclass(frozen=True)
class Photos:
    """Photos of a ball on a floor, and a folder for the results."""

    folder: Path
    cameras: list[Camera]
    out: Path

    def run(self, *flags: str, source: Path | None = None, out: Path | None = None) -> int:
        """Run the command on the photos, with a short training and a short film."""
        words = ["from-photos", str(source or self.folder), "--out", str(out or self.out), "--yes", "--preview"]
        return main([*words, "--iterations=400", "--gaussians=5000", "--motion=stand", "--up=z", *flags])

    def model(self, *_: object, **__: object) -> SimpleNamespace:
        """Return a substitute for COLMAP's reconstruction: the true cameras, and the Gaussians as points."""
        cloud = ball_on_floor()[0]
        means, shades = cloud.means.numpy(), np.clip(255 * (0.5 + 0.28 * cloud.sh.numpy()[:, 0]), 0, 255).astype(int)
        one = self.cameras[0]
        images = []
        for number, camera in enumerate(self.cameras, start=1):
            x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
            pose = " ".join(f"{value:.9g}" for value in (w, x, y, z, *camera.translation))
            images += [f"{number} {pose} 1 {number}.png", ""]
        texts = {
            "cameras.txt": [f"1 PINHOLE {one.width} {one.height} {one.fx} {one.fy} {one.cx} {one.cy}"],
            "images.txt": images,
            "points3D.txt": [
                f"{k} {x} {y} {z} {r} {g} {b} 0.1"
                for k, ((x, y, z), (r, g, b)) in enumerate(zip(means[::2], shades[::2], strict=True), start=1)
            ],
        }

        def write_binary(folder: str) -> None:
            for name, lines in texts.items():
                (Path(folder) / name).write_text("\n".join(lines) + "\n")

        posed = {k: SimpleNamespace(name=f"{k}.png", has_pose=True) for k in range(1, len(self.cameras) + 1)}
        return SimpleNamespace(
            images=posed,
            write_binary=write_binary,
            num_points3D=lambda: len(texts["points3D.txt"]),
            compute_mean_reprojection_error=lambda: 0.5,
        )


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Photos]:
    """Render six photos of 96 x 96 pixels."""
    folder = tmp_path_factory.mktemp("from-photos")
    cameras = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.4]), 1.1, count=6, size=96)
    (folder / "photos").mkdir()
    cloud, _ = ball_on_floor()
    for number, camera in enumerate(cameras, start=1):
        Image.fromarray(render_gaussians(cloud, camera).colour_srgb8()).save(folder / "photos" / f"{number}.png")
    with coarse_cages(120):
        yield Photos(folder / "photos", cameras, folder / "out")


def finished_stages(folder: Path) -> dict[str, bool]:
    return {name: one["finished"] for name, one in json.loads((folder / "stages.json").read_text()).items()}


@pytest.mark.slow
def test_an_interrupted_run_continues_and_finished_stages_are_used_again(
    photos: Photos, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = photos.out
    reconstruct_by(monkeypatch, photos.model)
    monkeypatch.setattr("egs_warp.training.checkpoint.SECONDS", 0.0)
    resumed: list[bool] = []

    def interrupted(args: Namespace, *, say: Callable[[str], None], show_step: object) -> list[str]:
        def stop(step: TrainStep) -> None:
            if step.done == 200:
                raise KeyboardInterrupt

        return run_train(args, say=say, show_step=stop)

    def watched(args: Namespace, *, say: Callable[[str], None], show_step: Callable[[TrainStep], None]) -> list[str]:
        resumed.append(args.resume)
        return run_train(args, say=say, show_step=show_step)

    monkeypatch.setattr("egs_warp.commands.train.run_train", interrupted)
    assert photos.run() == 130
    assert capsys.readouterr().err.splitlines()[-1].endswith("; repeat the command to continue")
    assert finished_stages(out) == {"pose": True, "train": False}
    monkeypatch.setattr("egs_warp.commands.train.run_train", watched)
    assert photos.run() == 0
    said = capsys.readouterr()
    assert "pose: already finished; its result is used" in said.err and resumed == [True]
    assert "photos to film: done, " in said.err.split("\r")[-1]
    assert finished_stages(out) == dict.fromkeys(STAGES, True)
    # The result of each stage is a file that other commands can read.
    capture = read_capture(out / "capture.ply").cloud
    (one,) = read_picked(out / "picked.json", capture).objects
    middle = np.median(capture.means.numpy()[one.gaussians], axis=0)
    assert np.linalg.norm(middle[:2]) < 0.15 and 0.3 < middle[2] < 0.8
    assert (out / "film" / "stand.mp4").is_file() and (out / "film" / "plane.json").is_file()
    # Repeating the command changes no file, because every stage is finished.
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    capsys.readouterr()
    assert photos.run() == 0
    assert capsys.readouterr().err.count("already finished; its result is used") == len(STAGES)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()} == before
    # Another motion repeats only the stage of the film.
    assert photos.run("--motion=stand 0.5") == 0
    said = capsys.readouterr().err
    assert said.count("already finished") == 3 and "film: its input, its flags or its files have changed" in said
    assert (out / "film" / "earlier-1" / "report.json").is_file()


@pytest.mark.slow
def test_poses_and_a_capture_skip_stages(photos: Photos, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    posed = tmp_path / "posed"
    (posed / "sparse").mkdir(parents=True)
    photos.model().write_binary(str(posed / "sparse"))
    (posed / "images").symlink_to(photos.folder, target_is_directory=True)
    monkeypatch.setattr("egs_warp.commands.animate.run_animate", lambda args: 3)
    assert photos.run(source=posed, out=tmp_path / "a") == 3
    assert list(finished_stages(tmp_path / "a")) == ["train", "pick", "film"]
    capture = tmp_path / "a" / "capture.ply"
    assert photos.run("--cameras", str(posed), source=capture, out=tmp_path / "b") == 3
    assert list(finished_stages(tmp_path / "b")) == ["pick", "film"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["absent", "--out", "out"], "absent: no such file or folder; give photos, a video, photos with poses"),
        (["photos", "--out", "photos/out"], "--out photos/out: it is in the folder of the photos; choose a folder"),
        (
            ["photos", "--out", "used"],
            "--out used: it contains capture.ply from another command; choose another folder",
        ),
        (["photos", "--out", "out", "--motion", "jmup"], "motion"),
        (["photos", "--out", "out", "--cameras", "x"], "--cameras: photos with poses already have cameras"),
    ],
)
def test_errors_of_later_stages_are_found_first(
    flags: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "capture.ply").touch()
    (tmp_path / "x").touch()
    assert main(["from-photos", *flags, "--yes"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert not (tmp_path / "out").exists()
