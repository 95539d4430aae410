"""Several objects of a scene on the command line: names of objects, motions by name, and clear errors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from egs_warp import cli
from egs_warp.assets import pawn
from egs_warp.commands.animate_scene import motions_of, named_objects
from egs_warp.contact.terrain import surface_above
from egs_warp.errors import UserError
from egs_warp.io import write_ply
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.pipelines.scene_collision import read_collision_mesh
from tests.support.scenes import two_pawns_on_a_board


def test_objects_have_names_or_none_has(tmp_path: Path) -> None:
    values = ["a=+1,2@x=1.jpg", "b=0,0,1", "a=-3,4@y.jpg"]
    assert named_objects(values) == {"a": ("+1,2@x=1.jpg", "-3,4@y.jpg"), "b": ("0,0,1",)}
    assert named_objects(["0,0,1"]) == named_objects(None) == {}
    mask = tmp_path / "a=mask.png"
    mask.write_bytes(b"")
    assert named_objects([str(mask)]) == {}
    with pytest.raises(UserError, match=r"--object 0,0,1: other objects have names; give this one a name, too"):
        named_objects(["a=1,1,1", "0,0,1"])


def test_motions_are_given_by_name_or_to_all_creatures() -> None:
    names = ["a", "b", "box"]
    assert motions_of("a: jump to b height=0.3; b: walk 1, nod", names, ["box"]) == {
        "a": "jump to b height=0.3",
        "b": "walk 1, nod",
    }
    assert motions_of("hop x3", names, ["box"]) == {"a": "hop x3", "b": "hop x3"}
    for text, message in (
        ("c: jump", "it does not begin with the name of an object.*give NAME: MOTION"),
        ("a: jump; walk 1", "'walk 1': it does not begin with the name of an object"),
        ("box: jump", "box is a prop, which has no muscles; leave --prop box out"),
        ("a: jump; a: walk 1", "a already has a motion"),
        ("a: fly", "fly"),
        ("a: nod, kick c", r"motion 2 \('kick c'\): no body 'c'.*; give one of b, box"),
        ("a: jump to a", "no body 'a'"),
        ("", "name a motion"),
    ):
        with pytest.raises(UserError, match=message):
            motions_of(text, names, ["box"])


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--object", "a=0,0,0.5", "--prop", "b"], "--prop b: no object has this name; give one of a"),
        (["--object", "a=0,0,0.5", "--terrain", __file__], "--terrain: it has no effect on several objects"),
        (["--object", "0,0,0.5", "--prop", "b"], "--prop: it is for objects with names"),
        (
            ["--object", "a=0,0,0.5", "--motion", "b: jump"],
            "--motion 'b: jump': it does not begin with the name",
        ),
        (
            ["--object", "a=0,0,0.5", "--object", "b=nothing.png"],
            "b: --object nothing.png: no such file or folder",
        ),
        (["--object", "a=0,0,0.5", "--collision-mesh", "no.glb"], "no.glb: no such file"),
    ],
)
def test_mistakes_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=300, device="cpu").cloud)
    assert cli.main(["animate", str(tmp_path / "pawn.ply"), "-o", str(tmp_path / "out"), *flags]) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_two_objects_of_a_scene_become_bodies_of_one_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two pawns 1.5 apart on a board: in the world they stand where the capture shows them, the ground ends at the edge
    of the board, and the collision mesh contains the block beside them at its captured position."""
    write_ply(tmp_path / "room.ply", two_pawns_on_a_board())
    out, mesh = tmp_path / "out", tmp_path / "mesh.glb"
    selected = [
        "--object",
        "near=0,0,0.5",
        "--object",
        "far=1.5,0,0.5",
        "--prop",
        "far",
        "--motion",
        "near: jump to far",
    ]
    quick = ["--up", "z", "--straddling", "split", "--no-inpaint", "--frames", "4", "--size", "64"]
    command = ["animate", str(tmp_path / "room.ply"), *selected, *quick]
    assert cli.main([*command, "--save-collision-mesh", str(mesh), "-o", str(out)]) == 0
    printed = capsys.readouterr()
    assert "the ground ends beside the objects" in printed.err and printed.out.startswith("near: cut off: jump to far")
    files = json.loads((out / "manifest.json").read_text())["files"]
    assert {"world.mp4", "obstacles.png", "background.ply", "near/object.ply", "far/segment.png"} <= files.keys()
    near, far = (Trajectory.load(out / name / "trajectory.npz").positions[0].mean(axis=0) for name in ("near", "far"))
    height = 1.0 / pawn(gaussian_count=3000, device="cpu").cloud.means.numpy()[:, 2].max()
    np.testing.assert_allclose(far[:2] - near[:2], [1.5 * height, 0.0], atol=0.05)
    assert Trajectory.load(out / "far" / "trajectory.npz").ground_coefficients.min() < -1.0
    solids = read_collision_mesh(mesh)
    assert len(solids) >= 1 and all(len(solid.faces) == 6 for solid in solids)
    top = surface_above(solids, np.array([0.8, 1.1, 0.0]), np.array([0.0, 0.0, 1.0]))
    assert top == pytest.approx(0.5, abs=0.06)
