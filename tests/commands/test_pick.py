"""``--object picked.json`` on the command line, and the flags of ``egs-warp pick``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.assets import pawn
from egs_warp.cli import main
from egs_warp.commands.pick import _up_of
from egs_warp.commands.scene_input import SceneInput
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.io import read_capture
from egs_warp.io.picked import PickedFile, PickedObject, read_picked, write_picked
from egs_warp.io.planes import PlaneRecord
from egs_warp.io.posed_images import PosedImage
from egs_warp.pipelines.info import CaptureExtent
from egs_warp.segmentation.object_spec import ObjectSpec
from tests.support.scenes import round_ones, shell, write_scene

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a ball on a floor, scene.ply, and picked.json of the ball and of its upper half."""
    folder = tmp_path_factory.mktemp("scene")
    write_scene(folder, views=2, size=32)
    cloud = read_capture(folder / "scene.ply").cloud
    means = cloud.means.numpy()
    ball = (np.linalg.norm(means - [0.0, 0.0, 0.5], axis=1) < 0.55) & (means[:, 2] > 0.02)
    ground, half = PlaneRecord(FLOOR), PlaneRecord(Plane(FLOOR.normal, -0.5))
    objects = (
        PickedObject("ball", ball, ground, np.array([0.0, 1.0, 0.0])),
        PickedObject("upper half", ball & (means[:, 2] > 0.5), half),
    )
    write_picked(folder / "picked.json", PickedFile("scene.ply", objects), cloud)
    return folder


@pytest.mark.slow
def test_segment_takes_a_picked_object_and_its_plane(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for value, lowest in ((f"{scene / 'picked.json'}", 0.0), (f"{scene / 'picked.json'}:upper half", 0.5)):
        out = tmp_path / f"out-{lowest}"
        flags = ["--out", str(out), "--flat", "--straddling", "none"]
        assert main(["segment", str(scene / "scene.ply"), "--object", value, *flags]) == 0
        means = read_capture(out / "object.ply").means.numpy()
        assert lowest - 1e-6 < means[:, 2].min() < lowest + 0.05 and means[:, 2].max() > 0.95
        assert np.linalg.norm(means[:, :2], axis=1).max() < 0.6
        assert "object: " in capsys.readouterr().out


def test_the_haze_around_a_picked_object_is_left_out_and_a_scene_is_not(scene: Path):
    cloud = read_capture(scene / "scene.ply").cloud
    (ball, _) = read_picked(scene / "picked.json", cloud).objects
    haze = round_ones(5.0 * shell(40), 0.5)
    haze = replace(haze, opacity_logits=wp.full(haze.count, -2.0, dtype=wp.float32))
    both = concatenate(cloud.subset(ball.gaussians), haze)
    mask = np.arange(both.count) < both.count - haze.count

    def given(cloud: GaussianCloud, mask: np.ndarray) -> SceneInput:
        return SceneInput(cloud, (), ObjectSpec(picked=mask), None, FLOOR, ())

    alone = given(both, mask).object_alone
    assert alone is not None
    np.testing.assert_array_equal(alone.means.numpy(), both.means.numpy()[mask])
    assert given(cloud, ball.gaussians).object_alone is None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (["picked.json:bell"], "it has no object 'bell' (did you mean 'ball'?); it has ball, upper half"),
        (["picked.json", "0,0,1"], "is a whole object; give no other value"),
        (["absent.json"], "make it with egs-warp pick"),
        (["cameras.json"], "not a file of egs-warp pick"),
    ],
)
def test_a_wrong_value_is_one_line(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], values: list[str], message: str
):
    given = [f"--object={scene / value if 'json' in value else value}" for value in values]
    assert main(["segment", str(scene / "scene.ply"), *given, "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line


def test_the_file_of_pick_must_end_in_json(scene: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["pick", str(scene / "scene.ply"), "--out", "picked.txt"]) == 2
    assert "--out picked.txt: give a file name that ends in .json" in capsys.readouterr().err


def test_the_page_starts_with_the_up_direction_that_is_given_or_seen_or_estimated(capsys: pytest.CaptureFixture[str]):
    """The cameras are held upright. Without cameras that define up, that of a tilted capture of one object is the
    normal of its base, and not an axis."""
    turn = Rotation.from_euler("x", 30.0, degrees=True).as_matrix()
    cloud = to_body_frame(pawn(gaussian_count=2000).cloud, BodyFrame(turn, np.zeros(3), 1.0))
    up = turn[:, 2]
    cameras = [PosedImage("", camera, None) for camera in ring_cameras(Plane(up, 0.0), np.zeros(3), 3.0, count=9)]

    def start(given: np.ndarray | None, seen: int) -> tuple[float, str]:
        found = _up_of(SceneInput(cloud, cameras[:seen], None, given, None, ()))
        return float(np.degrees(np.arccos(min(1.0, found @ up)))), capsys.readouterr().err

    assert start(up, 9) == (pytest.approx(0.0, abs=0.01), "")
    angle, note = start(None, 9)
    assert angle < 1.0 and "(the cameras are held upright); if that is wrong, give --up" in note
    for seen in (0, 2):
        angle, note = start(None, seen)
        assert angle < 3.0, seen
        assert "up is estimated as " in note and note.endswith("; if that is wrong, give --up\n")


@pytest.mark.slow
def test_info_takes_a_picked_object(scene: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["info", str(scene / "scene.ply"), "--object", str(scene / "picked.json")]) == 0
    lines = capsys.readouterr().out
    assert "front    0.00,1.00,0.00 as given" in lines and "a round base" in lines
    capture = CaptureExtent.of(read_capture(scene / "scene.ply").cloud, str(scene / "scene.ply"))
    first, second, third, *_ = lines.splitlines()
    assert [first, second] == capture.lines() and third.startswith("object   ")


@pytest.mark.slow
def test_animate_takes_a_picked_object(scene: Path, tmp_path: Path, coarse: None):
    out = tmp_path / "run"
    flags = ["--frames", "3", "--size", "64", "--straddling", "none", "--no-inpaint", "--flat", "--motion", "stand"]
    value = f"{scene / 'picked.json'}:ball"
    assert main(["animate", str(scene / "scene.ply"), "--object", value, "--out", str(out), *flags]) in (0, 3)
    assert (out / "sheet.png").is_file() and (out / "plane.json").is_file()
    # Here the object is the whole capture, without a scene around it.
    cloud = read_capture(out / "object.ply").cloud
    whole = PickedObject("ball", np.ones(cloud.count, bool), PlaneRecord(FLOOR))
    write_picked(tmp_path / "whole.json", PickedFile("object.ply", (whole,)), cloud)
    again = [
        "--object",
        str(tmp_path / "whole.json"),
        "--out",
        str(tmp_path / "again"),
        "--frames",
        "3",
        "--size",
        "64",
    ]
    assert main(["animate", str(out / "object.ply"), *again, "--motion", "stand"]) in (0, 3)
    assert not (tmp_path / "again" / "plane.json").exists()
