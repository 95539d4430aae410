"""Several objects of a scene on the command line: names of objects, motions by name, and clear errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from egs_warp import cli
from egs_warp.assets import pawn
from egs_warp.commands.animate_scene import motions_of, named_objects
from egs_warp.errors import UserError
from egs_warp.io import write_ply


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
        ("c: jump", "it has no name of an object.*give NAME: MOTION"),
        ("a: jump; walk 1", "'walk 1': it has no name of an object"),
        ("box: jump", "box is a prop, which has no muscles; leave --prop box out"),
        ("a: jump; a: walk 1", "a has another motion, too"),
        ("a: fly", "fly"),
    ):
        with pytest.raises(UserError, match=message):
            motions_of(text, names, ["box"])


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--object", "a=0,0,0.5", "--prop", "b"], "--prop b: no object has this name; give one of a"),
        (["--object", "a=0,0,0.5", "--terrain", "t.json"], "--terrain: it has no effect on several objects"),
        (["--object", "0,0,0.5", "--prop", "b"], "--prop: it is for objects with names"),
        (["--object", "a=0,0,0.5", "--motion", "b: jump"], "--motion 'b: jump': it has no name of an object"),
        (["--object", "a=0,0,0.5", "--object", "b=nothing.png"], "b: --object nothing.png: neither a file nor numbers"),
        (["--object", "a=0,0,0.5", "--collision-mesh", "no.glb"], "no.glb: no such file"),
    ],
)
def test_mistakes_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=300, device="cpu").cloud)
    assert cli.main(["animate", str(tmp_path / "pawn.ply"), "-o", str(tmp_path / "out"), *flags]) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]
