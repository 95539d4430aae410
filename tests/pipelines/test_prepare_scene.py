"""Runs of ``animate SCENE --object``: invalid arguments are reported before the scene is prepared, no file is lost, and
a film is written."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egs_warp.cli import main
from egs_warp.errors import UserError
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.inpainting.inpainters import OpenCvInpainter, OpenCvMethod
from egs_warp.io import read_capture, write_ply
from egs_warp.io.planes import read_planes
from egs_warp.pipelines.creature import CreatureOptions, make_creature
from egs_warp.pipelines.prepare_scene import PreparedScene, SceneOptions, prepare_scene, viewing_directions
from egs_warp.segmentation.clearance import StraddlingPolicy
from egs_warp.segmentation.object_spec import ObjectSpec
from tests.support.grounds import on_folds
from tests.support.scenes import FLOOR, ball_on_floor


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a ball on a floor."""
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    write_ply(path, ball_on_floor()[0])
    return path


@pytest.fixture(scope="module")
def prepared() -> PreparedScene:
    """Separate the ball from its floor, in which the hole stays open."""
    options = SceneOptions(clearing=StraddlingPolicy.SPLIT, inpaint=False)
    return prepare_scene(ball_on_floor()[0], ObjectSpec(point=np.array([0.0, -0.5, 0.5])), options=options)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--motion", "nothing"], "unknown motion 'nothing'"),
        (["--motion", "twist 180", "--distance", "nan"], "--distance nan"),
        (["--motion", "trajectory {tmp}/no.json"], "no.json: no such file or folder"),
        (["--muscles", "{tmp}/no.json"], "no.json: no such file or folder"),
        (["--terrain", "{tmp}/no.json"], "no.json: no such file or folder"),
        (["--inpainter", "lama"], "--inpainter lama: give patch, telea, ns or an ONNX file"),
        (["--inpainter", "ns", "--no-inpaint"], "--inpainter: --no-inpaint leaves the floor as captured"),
        (["--object", ""], "--object: the value is empty; give a mask.png"),
        (["--object", "0,0,0.5", "--up", ""], "--up : give one of x, y, z"),
        (["--background", "{tmp}/no.ply"], "--background: with --object the rest of the scene is the background"),
    ],
)
def test_invalid_flags_are_reported_before_the_scene_is_prepared(
    scene_file: Path,
    tmp_path: Path,
    flags: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def too_late(*_: object, **__: object) -> None:
        pytest.fail("the scene is being taken apart")

    monkeypatch.setattr("egs_warp.pipelines.prepare_scene.prepare_scene", too_late)
    given = [flag.format(tmp=tmp_path) for flag in flags]
    scene = ["animate", str(scene_file), "--object", "0,0,0.5", "--out", str(tmp_path / "out")]
    assert main([*scene, *given]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


@pytest.mark.parametrize(
    "flags",
    [
        ["--cameras", "."],
        ["--view", "0"],
        ["--no-inpaint"],
        ["--inpainter", "ns"],
        ["--straddling", "split"],
    ],
)
def test_scene_flags_need_an_object(
    scene_file: Path, tmp_path: Path, flags: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["animate", str(scene_file), *flags, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"egs-warp: {flags[0]}: needs --object") and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def _noting(told: dict[str, Any]) -> Callable[..., None]:
    """Return a substitute for a function, which stores its keyword arguments and ends the command."""

    def note(*_: object, **named: Any) -> None:
        told.update(named)
        raise UserError("far enough")

    return note


def test_animate_passes_on_the_scene_options(scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: dict[str, Any] = {}
    monkeypatch.setattr("egs_warp.pipelines.prepare_scene.prepare_scene", _noting(told))
    flags = ["--object", "0,0,0.5", "--inpainter", "ns", "--straddling", "remove", "--out", str(tmp_path / "out")]
    assert main(["animate", str(scene_file), *flags]) == 2
    assert told["options"].inpainter == OpenCvInpainter(OpenCvMethod.NAVIER_STOKES)
    assert told["options"].clearing is StraddlingPolicy.REMOVE


def test_the_parts_of_earlier_steps_are_animated(
    tmp_path: Path, prepared: PreparedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared.write(tmp_path)
    told: dict[str, Any] = {}
    monkeypatch.setattr("egs_warp.pipelines.animate.animate", _noting(told))
    flags = ["--plane", str(tmp_path / "plane.json"), "--background", str(tmp_path / "background.ply")]
    assert main(["animate", str(tmp_path / "object.ply"), *flags, "--out", str(tmp_path / "out")]) == 2
    assert told["background"].count == prepared.background.count
    np.testing.assert_allclose(told["plane"].normal, prepared.plane.normal, atol=1e-9)


@pytest.mark.slow
def test_uneven_ground_is_passed_on_with_the_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ground is measured, reported, written next to the plane, read again and passed to the animation; with
    ``--flat`` the plane is used instead. The object comes to rest on the ground where it stood.
    """
    cloud, truth = on_folds(0.04, length=0.9)
    click = ObjectSpec(point=np.array([0.0, 0.0, 0.5]))
    options = SceneOptions(clearing=StraddlingPolicy.SPLIT, inpaint=False)
    prepared = prepare_scene(cloud, click, up=FLOOR.normal, options=options)
    ground = prepared.ground
    assert ground is not None and any(note.startswith("the ground is not flat") for note in prepared.notes)
    heights = ground.heights(prepared.object.means.numpy())
    # The object is not cut at the plane.
    assert heights.min() > -0.01 and prepared.object.count > 0.95 * truth.sum()
    prepared.write(tmp_path)
    for flag in ((), ("--flat",)):
        told: dict[str, Any] = {}
        monkeypatch.setattr("egs_warp.pipelines.animate.animate", _noting(told))
        line = ["animate", str(tmp_path / "object.ply"), "--plane", str(tmp_path / "plane.json"), *flag]
        assert main([*line, "--out", str(tmp_path / "out")]) == 2
        if flag:
            assert told["options"].creature.ground is None
        else:
            nodes = ground.nodes().reshape(-1, 3)
            assert np.abs(told["options"].creature.ground.heights(nodes)).max() < 1e-3
    # The body is stiff, because its own sag (0.033 of its height on the coarse cage, where 0.05 is requested) would
    # hide a drop of 0.017.
    creature = make_creature(prepared.object, options=CreatureOptions(ground=ground, sag=0.01, nodes=120))
    body, start = creature.body, creature.start.positions
    assert creature.geometry.field is not None
    # The body touches the ground where it was captured and sinks by 0.015. If the ground were not raised to the body,
    # the body would hang 0.017 above it and sink by 0.027. On the slope of a fold, the ball would roll, and its centre
    # would move by 0.075 to the side.
    assert abs(creature.stepper.detector.gaps(body.mesh.nodes)[0].min()) < 0.005 * body.height
    assert abs((body.centre_of_mass(start) - body.centre_of_mass(body.mesh.nodes))[2]) < 0.02 * body.height
    assert creature.stepper.detector.gaps(start)[0].min() > -0.01 * body.height


@pytest.mark.slow
def test_one_command_from_a_scene_to_a_video(
    scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The film, the parts and the inpainted floor are written. PyTorch is treated as missing, because training would
    take a minute."""
    monkeypatch.setattr("egs_warp.pipelines.prepare_scene.has_torch", lambda: False)
    scene, out = str(scene_file), tmp_path / "out"
    flags = ["--object", "0,-0.5,0.5", "--frames", "2", "--size", "64", "--out", str(out)]
    assert main(["animate", scene, *flags]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"film: {out / 'jump.mp4'}")
    assert (out / "jump.mp4").stat().st_size > 0
    parts, pictures = ("object.ply", "background.ply", "plane.json"), ("plane.png", "segment.png", "filled.png")
    for name in ("sheet.png", "report.json", "trajectory.npz", *parts, *pictures):
        assert (out / name).stat().st_size > 0
    rest = read_capture(out / "background.ply").cloud.means.numpy()
    ball = read_capture(out / "object.ply").cloud.means.numpy()
    assert not ((rest[:, 2] > 0.05) & (np.linalg.norm(rest - [0.0, 0.0, 0.5], axis=1) < 0.55)).any()
    assert (np.linalg.norm(ball - [0.0, 0.0, 0.5], axis=1) < 0.55).sum() > 1400
    # The inpainted floor continues where the ball stood.
    assert ((np.abs(rest[:, 2]) < 0.05) & (np.linalg.norm(rest[:, :2], axis=1) < 0.1)).sum() > 20


def test_an_animation_that_fails_loses_none_of_the_parts(
    scene_file: Path, tmp_path: Path, prepared: PreparedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object, **__: object) -> None:
        raise UserError("animate: cannot")

    monkeypatch.setattr("egs_warp.pipelines.prepare_scene.prepare_scene", lambda *_, **__: prepared)
    monkeypatch.setattr("egs_warp.pipelines.animate.animate", failing)
    out = tmp_path / "out"
    assert main(["animate", str(scene_file), "--object", "0,0,0.5", "--out", str(out)]) == 2
    assert read_capture(out / "object.ply").cloud.count == prepared.object.count
    assert read_capture(out / "background.ply").cloud.count == prepared.background.count
    for name in ("plane.json", "plane.png", "segment.png"):
        assert (out / name).is_file()
    assert not (out / "filled.png").exists(), "no floor was filled"


@pytest.mark.slow
def test_a_scene_is_prepared_and_viewed_from_its_cameras() -> None:
    cloud, _ = ball_on_floor()
    told: list[tuple[str, float]] = []
    costs: list[Mapping[str, float]] = []
    options = SceneOptions(clearing=StraddlingPolicy.SPLIT, inpaint=False)
    prepared = prepare_scene(
        cloud,
        ObjectSpec(point=np.array([0.0, -0.5, 0.5])),
        options=options,
        progress=lambda stage, done: told.append((stage, done)),
        expect_costs=costs.append,
    )
    assert told == [("plane", 0.0), ("ground", 0.0), ("segment", 0.0)]
    assert [list(one) for one in costs] == [["plane", "ground", "segment"]]
    assert prepared.background is prepared.background_with_hole
    assert any("straddled the plane: split at it" in note for note in prepared.notes)
    cameras = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.5]), 0.9, count=12, elevations=(20.0, 40.0, 60.0))
    found = viewing_directions(prepared, cameras)
    assert found is not None and len(found) == 6
    elevations = np.degrees(np.arcsin(found[:, 2] / np.linalg.norm(found, axis=1)))
    assert np.sort(elevations) == pytest.approx([20.0, 40.0, 40.0, 40.0, 40.0, 60.0], abs=0.2)
    assert all(any(np.allclose(way, camera.centre - prepared.located.centre) for camera in cameras) for way in found)
    assert viewing_directions(prepared, []) is None


@pytest.mark.slow
def test_a_hovering_object_leaves_no_hole(tmp_path: Path) -> None:
    """A ball that hovers over the floor by a fifth of its size is set down; no floor is inpainted, and ``plane.json``
    has no hole."""
    cloud, truth = ball_on_floor(lift=0.33)
    spec = ObjectSpec(point=np.array([0.0, -0.5, 0.83]))
    scene = prepare_scene(cloud, spec, options=SceneOptions(clearing=StraddlingPolicy.SPLIT))
    assert scene.hole is None and scene.filled is None and scene.background is scene.background_with_hole
    assert "the ground under it is complete" in scene.notes
    assert scene.object.count >= 0.99 * truth.sum()
    heights = scene.plane.heights(scene.object.means.numpy())
    assert abs(float(heights.min())) < 0.02 and float(heights.max()) == pytest.approx(1.0, abs=0.02)
    assert any("and was lowered onto it" in note for note in scene.notes)
    scene.write(tmp_path)
    (known,) = read_planes(tmp_path / "plane.json")
    assert known.hole is None and known.plane.normal[2] > 0.999


def test_a_scene_sets_the_waiting_policy_before_torch_is_imported() -> None:
    """OpenMP reads its wait policy when PyTorch is imported. A value that the user has set is kept."""
    program = (
        "import os, sys; import egs_warp.pipelines.prepare_scene;"
        " print('torch' in sys.modules, os.environ['OMP_WAIT_POLICY'])"
    )
    for given, expected in ({}, "False PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "False ACTIVE"):
        environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"} | given
        done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
        assert done.stdout.strip().splitlines()[-1] == expected, done.stderr
