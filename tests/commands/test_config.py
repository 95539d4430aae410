"""Configuration files: a run from the file that another run wrote repeats that run, and each bad file gives a one-line
error."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from imageio_ffmpeg import count_frames_and_secs

from egs_warp import cli
from egs_warp.assets import pawn
from egs_warp.commands import COMMANDS
from egs_warp.commands.config import with_config, write_config
from egs_warp.errors import UserError
from egs_warp.io import write_ply
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.finished_run import FinishedRun


@pytest.mark.slow
@pytest.mark.usefixtures("coarse")
def test_a_run_from_its_file_has_the_same_bits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=4000).cloud)
    flags = ["--up", "z", "--frames", "4", "--size", "48x32", "--camera", "follow", "--background", "#204060"]
    assert cli.main(["animate", str(tmp_path / "pawn.ply"), *flags, "--out", str(tmp_path / "a")]) == 0
    again = ["animate", "--config", str(tmp_path / "a" / "run.yaml"), "--out", str(tmp_path / "b")]
    assert cli.main(again) == 0
    for name in ("jump.mp4", "sheet.png", "trajectory.npz", "creature.npz", "run.yaml"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    # The film has the requested number of frames, of which the first shows the body at rest.
    assert count_frames_and_secs(str(tmp_path / "a" / "jump.mp4"))[0] == 4
    run = FinishedRun.read(tmp_path / "a")
    assert len(run.steps) == run.report["asked"]["frames"] == 4
    assert run.trajectory.time[-1] == pytest.approx(3 / 60)
    assert '"run.yaml"' in (tmp_path / "a" / "manifest.json").read_text()
    assert "differs from the capture" not in capsys.readouterr().err
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=4100).cloud)
    assert cli.main([*again[:-1], str(tmp_path / "c"), "--frames", "2"]) == 0
    assert "differs from the capture of the run in" in capsys.readouterr().err
    assert yaml.safe_load((tmp_path / "c" / "run.yaml").read_text())["frames"] == 2


def test_an_interrupted_run_has_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The configuration file exists as soon as a simulation step is made; bad input found before that leaves no
    file."""
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=4000).cloud)
    flags = ["animate", str(tmp_path / "pawn.ply"), "--up", "z", "--friction", "0.7", "--qp", "daqp"]
    flags += ["--nodes", "120", "--out", str(tmp_path / "a")]

    def interrupted(creature: Creature, *_: object, parts: Callable[[], Path], **__: object) -> None:
        assert creature.stepper.settings.qp_solver == "daqp" and creature.geometry.friction == 0.7
        assert len(creature.cage.mesh.nodes) < 250
        parts().mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr("egs_warp.pipelines.takes.simulate", interrupted)
    assert cli.main(flags) == 130
    kept = yaml.safe_load((tmp_path / "a" / "run.yaml").read_text())
    assert (kept["friction"], kept["qp"], kept["nodes"]) == (0.7, "daqp", 120)

    def refused(*_: object, **__: object) -> None:
        raise UserError("jump: this body cannot")

    monkeypatch.setattr("egs_warp.pipelines.takes.simulate", refused)
    assert cli.main([*flags[:-1], str(tmp_path / "b")]) == 2
    assert not (tmp_path / "b").exists()


def _given(arguments: list[str]) -> dict:
    parser, commands = cli._parsers()
    return vars(parser.parse_args(["animate", *with_config(arguments, commands["animate"]), "--out", "x"]))


def test_files_are_relative_to_the_file_and_flags_take_precedence(tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    for name in ("a.ply", "steps.json", "bow.csv", "fixed"):
        (tmp_path / "here" / name).write_text("")
    config = tmp_path / "here" / "run.yaml"
    config.write_text(
        "capture: a.ply\nterrain: steps.json\nmotion: trajectory bow.csv\nfriction: 0.3\nno-shadow: true\n"
        "up: -y\nobject: 0,0,1\ncamera: fixed\nno_inpaint: false\ndistance: null\n"
    )
    given = _given(["--config", str(config)])
    here = tmp_path / "here"
    assert given["capture"] == str(here / "a.ply") and given["terrain"] == here / "steps.json"
    assert given["motion"] == f"trajectory {here / 'bow.csv'}"
    assert (given["friction"], given["no_shadow"], given["no_inpaint"], given["distance"]) == (0.3, True, False, None)
    assert (given["up"], given["object"], given["camera"]) == ("-y", ["0,0,1"], "fixed")
    other = _given(["other.ply", "--config", str(config), "--friction", "0.7"])
    assert (other["capture"], other["friction"]) == ("other.ply", 0.7)


def test_written_values_are_the_given_ones(tmp_path: Path) -> None:
    parser, commands = cli._parsers()
    flags = [
        "a.ply",
        "--up=-y",
        "--view",
        "1e5",
        "--motion",
        "hop x3, twist 180",
        "--view-from=-1,0,.5",
        "--frames",
        "9",
        "--no-shadow",
    ]
    chosen = parser.parse_args(["animate", *flags, "--out", "x"])
    write_config(tmp_path / "run.yaml", chosen, commands["animate"])
    again = parser.parse_args(
        ["animate", *with_config(["--config", str(tmp_path / "run.yaml")], commands["animate"]), "--out", "x"]
    )
    assert vars(again) | {"config": None} == vars(chosen)


def test_clicks_are_a_list_and_clicks_of_the_command_line_replace_those_of_the_file(tmp_path: Path) -> None:
    parser, commands = cli._parsers()
    clicks = ["--object", "+1,2@a.jpg", "--object=-3,4@b.jpg"]
    chosen = parser.parse_args(["animate", "a.ply", *clicks, "--out", "x"])
    write_config(tmp_path / "run.yaml", chosen, commands["animate"])
    given = _given(["--config", str(tmp_path / "run.yaml")])
    assert given["object"] == ["+1,2@a.jpg", "-3,4@b.jpg"]
    other = _given(["--config", str(tmp_path / "run.yaml"), "--object", "0,0,1"])
    assert other["object"] == ["0,0,1"]
    (tmp_path / "run.yaml").write_text("object: [[1, 2]]")
    with pytest.raises(UserError, match=r"object is \[\[1, 2\]\]; give a string or a list of strings"):
        _given(["--config", str(tmp_path / "run.yaml")])


def test_files_of_named_objects_are_relative_to_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the file in a value becomes relative; the name of the object and the name in a file of picked objects stay
    unchanged. A file that the run writes need not exist."""
    parser, commands = cli._parsers()
    for name in ("a=odd.png", "mask.png", "picked.json", "m.glb"):
        (tmp_path / name).write_text("")
    monkeypatch.chdir(tmp_path)
    values = ["b=mask.png", "c=picked.json:fox", "d=0,0,1", "e=+1,2@x=1.jpg"]
    flags = [f"--object={value}" for value in values]
    flags += ["--collision-mesh", "m.glb", "--save-collision-mesh", "new.glb"]
    chosen = parser.parse_args(["animate", "a.ply", *flags, "--out", "x"])
    (tmp_path / "x").mkdir()
    write_config(tmp_path / "x" / "run.yaml", chosen, commands["animate"])
    monkeypatch.chdir(tmp_path / "x")
    given = _given(["--config", "run.yaml"])
    assert given["object"] == ["b=../mask.png", "c=../picked.json:fox", "d=0,0,1", "e=+1,2@x=1.jpg"]
    assert (given["collision_mesh"], given["save_collision_mesh"]) == (Path("../m.glb"), Path("../new.glb"))
    monkeypatch.chdir(tmp_path)
    odd = parser.parse_args(["animate", "a.ply", "--object", "a=odd.png", "--out", "x"])
    write_config(tmp_path / "x" / "run.yaml", odd, commands["animate"])
    assert _given(["--config", "x/run.yaml"])["object"] == ["x/../a=odd.png"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("speed: 3", "unknown key 'speed' (did you mean"),
        ("trust: true", "unknown key 'trust'"),
        ("motion: [jump]", "motion is ['jump']; give a string or a number"),
        ("motion: true", "motion is True; give a string or a number"),
        ("no-shadow: 3", "no-shadow is 3; give true"),
        ("frames: many", "--frames many: give a whole number"),
        ("seed: 2026-01-01", "--seed 2026-01-01: give a whole number"),
        ("- jump", "no keys and values"),
        ("", "no keys and values"),
        ("a: [", "not YAML"),
        ("motion: !!python/object/apply:os.system [id]", "not YAML"),
        ("a: " + "[" * 5000, "not YAML"),
        ("frames: &a 4\nfps: *a", "run.yaml, line 2: not YAML (an alias, *name; write out what it stands for)"),
        (
            "motion: [" + "jump, " * 5000 + "jump]",
            "motion is ['jump', 'jump', 'jump', 'jump', 'jump', 'jump', ...]; give",
        ),
    ],
)
def test_bad_files_are_one_line(text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run.yaml").write_text(text)
    flags = ["animate", "a.ply", "--config", str(tmp_path / "run.yaml"), "--out", str(tmp_path / "out")]
    try:
        status = cli.main(flags)
    except SystemExit as stop:
        status = stop.code
    error = capsys.readouterr().err
    assert status == 2 and said in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("way", ["lists", "merged"])
def test_short_files_that_expand_to_billions_of_values(way: str, tmp_path: Path) -> None:
    """Eleven levels of nested YAML aliases or merged keys would not fit into memory if they were expanded; the error
    message does not expand them."""
    inner = {"lists": "[z, z]", "merged": "{up: z}"}[way]
    lines = [f"a0: &a0 {inner}"]
    for level in range(1, 12):
        many = ", ".join([f"*a{level - 1}"] * 9)
        lines.append(f"a{level}: &a{level} " + {"lists": f"[{many}]", "merged": f"{{<<: [{many}]}}"}[way])
    lines.append("object: [*a11]")
    (tmp_path / "run.yaml").write_text("\n".join(lines))
    with pytest.raises(
        UserError, match=r"run.yaml, line \d+: not YAML \(an alias, \*name; write out what it stands for"
    ):
        _given(["--config", str(tmp_path / "run.yaml")])


def test_a_missing_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["animate", "--config", str(tmp_path / "none.yaml"), "--out", "x"]) == 2
    assert "none.yaml: no such file" in capsys.readouterr().err


def test_help_names_every_command_and_its_examples_are_valid(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["--help"])
    said = capsys.readouterr().out
    assert stop.value.code == 0 and "exit status:" in said and max(map(len, said.splitlines())) <= 100
    for name in COMMANDS:
        assert re.search(rf"^  {name} +\S", said, re.MULTILINE)
    parser, commands = cli._parsers()
    for line in re.findall(r"^  egs-warp (?!COMMAND)(.+)$", said, re.MULTILINE):
        parser.parse_args(shlex.split(line))
    for name in COMMANDS:
        text = commands[name].format_help()
        examples = re.findall(rf"^  egs-warp {name}(.*)$", text, re.MULTILINE)
        assert examples and "exit status:" in text
        for example in examples:
            if "--config" not in example:
                parser.parse_args([name, *cli._attach_negative_values(shlex.split(example))])
