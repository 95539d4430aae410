"""Folder of a world: one export of all bodies, one film, and one-line errors for incomplete folders."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp import cli
from egs_warp.contact.terrain import Solid
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.plane import Plane
from egs_warp.io import read_capture
from egs_warp.io.bundle import read_bundle
from egs_warp.io.bundle_file import findings
from egs_warp.io.ply import write_ply
from egs_warp.pipelines.finished_world import SHAPE, FinishedWorld, is_world_folder, read_finished, scene_facts
from egs_warp.pipelines.render_run import render_run
from egs_warp.pipelines.shot import Shot
from egs_warp.pipelines.surroundings import Surroundings
from egs_warp.pipelines.world import World
from egs_warp.pipelines.world_film import world_cameras
from egs_warp.web.joint_header import joint_header
from egs_warp.web.world_recording import WorldRecording
from tests.support.finished_worlds import FRAMES, NAMES, box_cloud, write_world_run


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_world_run(tmp_path / "run")


def test_numbered_files_contain_all_bodies(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["export", str(folder), "--to", "ply", "--out", str(tmp_path / "ply"), "--every", "4"]) == 0
    world = FinishedWorld.read(folder)
    assert world.frame_count == FRAMES + 1 and [len(solid.faces) for solid in world.solids] == [2]
    cloud = read_capture(tmp_path / "ply" / "frame0004.ply", device="cpu").cloud
    parts = [run.deformer().deform(run.trajectory.positions[run.steps[4]]).cloud for run in world.bodies.values()]
    expected = np.concatenate([part.means.numpy() for part in parts])
    np.testing.assert_array_equal(cloud.means.numpy(), expected)
    # In the frame of the world, the box falls on the block.
    assert expected[-1, 2] - expected[len(expected) // 2 - 1, 2] > 0.2
    assert "wrote" in capsys.readouterr().out


def test_a_bundle_has_a_cage_for_each_body(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "world.egs"
    assert cli.main(["export", str(folder), "--to", "bundle", "--out", str(path), "--licence", "CC0"]) == 0
    assert findings(path) == [] and cli.main(["validate", str(path)]) == 0
    assert "block: 218 Gaussians" in capsys.readouterr().out
    bundle, world = read_bundle(path), FinishedWorld.read(folder)
    assert [body.name for body in bundle.bodies] == list(NAMES) and bundle.facts["licence"] == "CC0"
    assert bundle.frames == FRAMES + 1 and bundle.facts["flat_ground"] is False
    for body, run in zip(bundle.bodies, world.bodies.values(), strict=True):
        assert body.cage is not None
        nodes = run.trajectory.positions[run.steps]
        np.testing.assert_allclose(body.cage.nodes[:, : nodes.shape[1]], nodes, atol=2e-5)
    prop = bundle.bodies[1].cage
    assert prop is not None and len(prop.cage_tets) == 1 and prop.surface.min() == 4


def test_a_stage_has_a_prim_for_each_body(folder: Path, tmp_path: Path) -> None:
    Usd = pytest.importorskip("pxr.Usd")
    path = tmp_path / "world.usda"
    assert cli.main(["export", str(folder), "--to", "usd", "--out", str(path), "--every", "4"]) == 0
    stage = Usd.Stage.Open(str(path))
    assert stage.GetDefaultPrim().GetPath() == "/world"
    names = [prim.GetName() for prim in stage.GetDefaultPrim().GetChildren()]
    assert names == ["block", "box_1", "physics", "ground"]
    for name, has_volume in (("block", True), ("box_1", False)):
        assert stage.GetPrimAtPath(f"/world/{name}/splats").GetAttribute("positions").GetTimeSamples() == [
            0.0,
            4.0,
            8.0,
        ]
        assert bool(stage.GetPrimAtPath(f"/world/{name}/soft_body")) is has_volume


def test_a_world_is_filmed_again_with_another_camera(folder: Path, tmp_path: Path) -> None:
    world = read_finished(folder)
    count = render_run(world, tmp_path / "film", Shot(size=(48, 36), fps=15.0), quiet=True)
    assert count == 3 and len(list((tmp_path / "film").glob("*.png"))) == 3


def test_a_film_of_another_shape_shows_the_obstacles_near_the_bodies(folder: Path) -> None:
    world = read_finished(folder)
    assert isinstance(world, FinishedWorld)
    normals = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    faces = zip(normals, [-0.3, -0.3, 0.32, -0.4, -0.5], strict=True)
    filmed = replace(world.filmed, solids=(Solid(tuple(Plane(normal, offset) for normal, offset in faces)),))
    points, steps = filmed.framed_points(), np.arange(2)
    assert len(points) > filmed.motion().positions[..., 0].size
    (camera, _) = world_cameras(filmed, world.camera, Shot(camera="fixed", size=(120, 40)), steps)
    seen = points @ camera.rotation.T + camera.translation
    pixels = seen[:, :2] / seen[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    assert (seen[:, 2] > 0.0).all() and (pixels > 0.0).all() and (pixels < [120.0, 40.0]).all()


def test_a_world_of_a_scene_is_shown_in_it(folder: Path) -> None:
    """The scene is stored in the frame of its capture. Its obstacles are visible in the capture, so they are not
    drawn."""
    frame = BodyFrame(np.eye(3)[[1, 2, 0]], np.array([1.0, 2.0, 3.0]), 0.5)
    cloud = box_cloud((0.4, 0.4, 0.4))
    surroundings = Surroundings(frame, to_body_frame(cloud, frame))
    facts = scene_facts(World(surroundings=surroundings))
    report = json.loads((folder / "report.json").read_text())
    (folder / "report.json").write_text(json.dumps(report | {"scene": facts}))
    assert FinishedWorld.read(folder).scene is None
    write_ply(folder / "background.ply", cloud)
    world = FinishedWorld.read(folder)
    assert world.scene is not None and world.filmed.scene is world.scene and world.filmed.solids == ()
    np.testing.assert_allclose(world.scene.means.numpy(), surroundings.cloud.means.numpy(), atol=1e-5)
    recording = WorldRecording.read(folder)
    assert b'"scene": 0' in recording.header() or b'"scene":0' in recording.header()
    assert len(recording.header()) > len(joint_header({}, recording.page_bodies, world.first.trajectory.planes))
    (folder / "report.json").write_text(json.dumps(report | {"scene": {"axes": 1}}))
    with pytest.raises(UserError, match=r"report\.json: its scene is invalid; run egs-warp animate again"):
        _ = FinishedWorld.read(folder).filmed


def test_incomplete_folders_are_reported(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert is_world_folder(folder) and not is_world_folder(folder / "block") and not is_world_folder(tmp_path)
    assert cli.main(["export", str(folder), "--to", "skin", "--out", str(tmp_path / "a.glb")]) == 2
    assert f"--to skin: a skin has one body; export the folder of a body, such as {folder / 'block'}" in (
        capsys.readouterr().err
    )
    with pytest.raises(
        UserError, match=r"background .*: a scene behind the body is for the run of a single capture; leave it out"
    ):
        read_finished(folder, background=tmp_path / "a.ply")
    shape = (folder / "block" / SHAPE).read_bytes()
    (folder / "block" / SHAPE).write_bytes((folder / "box-1" / SHAPE).read_bytes())
    with pytest.raises(UserError, match=r"block.contact_shape\.npz: does not belong to the cage of trajectory\.npz"):
        FinishedWorld.read(folder)
    (folder / "block" / SHAPE).write_bytes(shape[:-200])
    with pytest.raises(UserError, match=r"contact_shape\.npz: cannot be read"):
        FinishedWorld.read(folder)
    (folder / "block" / SHAPE).unlink()
    with pytest.raises(UserError, match=r"contact_shape\.npz: is missing; run egs-warp animate again"):
        FinishedWorld.read(folder)
    (folder / "report.json").write_text(json.dumps({"bodies": {"../x": {}}}))
    with pytest.raises(UserError, match=r"report\.json: is not the report of a world"):
        FinishedWorld.read(folder)
