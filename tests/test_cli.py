"""Command line: invalid input ends in a one-line error and exit status 2, and no file is lost."""

from __future__ import annotations

import importlib
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from egs_warp import __version__
from egs_warp.assets import pawn
from egs_warp.cli import _FIRST_EXAMPLES, _attach_negative_values, _parsers, main
from egs_warp.commands import COMMANDS
from egs_warp.commands.camera_flags import TRANSPARENT
from egs_warp.commands.config import _WORDS, NAME, with_config
from egs_warp.commands.flags import named_path, parse_plane, parse_up
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.inpainting.inpainters import OpenCvMethod
from egs_warp.io import write_ply
from egs_warp.io.run_folder import CONFIG
from egs_warp.io.writing import WRITERS
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import Strategy
from egs_warp.motions.repertoire import MOTIONS
from egs_warp.motions.style import PRESETS
from egs_warp.pipelines.render_run import Show
from egs_warp.pipelines.shot import CameraMove
from egs_warp.segmentation.clearance import StraddlingPolicy


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--distance", "nan"], "--distance nan: give a number of body heights from 0 to 10"),
        (["--distance", "-1"], "--distance -1: give a number of body heights from 0 to 10"),
        (["--height", "11"], "--height 11: give a number of body heights from 0 to 10"),
        (["--height", "0"], "--height 0: a jump needs a height above 0 body heights"),
        (["--frames", "0"], "--frames 0: give a whole number of at least 2; the first picture is at rest"),
        (["--frames", "9" * 20], f"--frames {'9' * 20}: give at most 216000 frames, which are an hour"),
        (["--front", "1e308,1e308,0"], "--front 1e308,1e308,0: give three numbers x,y,z or an axis such as -y"),
        (
            ["--plane", "0,0,1,1e300"],
            "--plane 0,0,1,1e300: the plane lies 1e+300 units from the origin; give one at most 1e+12 units away",
        ),
        (["--plane", "1" * 300], f"{'1' * 60}...: no such file or folder, the name is too long; check the path"),
        (["--size", "99999"], "--size 99999x99999: give sides from 16 to 4096 pixels, such as 512 or 640x360"),
        (["--camera", "none.json"], "none.json: no such file"),
        (["--fps", "-1"], "--fps -1: give a number of frames per second from 1 to 1000"),
        (["--nodes", "7"], "--nodes 7: give a whole number from 50 to 20000"),
        (["--friction", "nan"], "--friction nan: give a Coulomb coefficient from 0 to 10"),
        (["--friction", "-1"], "--friction -1: give a Coulomb coefficient from 0 to 10"),
        (["--metres-per-unit", "-2"], "--metres-per-unit -2: give a number of metres from 1e-9 to 1e9"),
        (["--up", "w"], "--up w: give one of x, y, z, -x, -y, -z"),
        (["--metres-per-unit", "1e-300"], "--metres-per-unit 1e-300: give a number of metres from 1e-9 to 1e9"),
        (["--metres-per-unit", "1e300"], "--metres-per-unit 1e+300: give a number of metres from 1e-9 to 1e9"),
        (["--plane", "0,0,0,1"], "give four finite numbers nx,ny,nz,d with a normal that is not zero"),
        (["--plane", "1,2"], "--plane 1,2: give four numbers nx,ny,nz,d"),
        (
            ["--push", "0.5 0.1 north"],
            "push 1 ('0.5 0.1 north'): unknown direction 'north'; give one of ahead, back, left",
        ),
        (["--push", "0.5 99 left"], "push 1 ('0.5 99 left'): impulse 99: give m sqrt(g H) from 0 to 10"),
        (["--device", "tpu"], "--device tpu: this machine has cpu"),
        (
            ["--gravity-up", "1,2"],
            "--gravity-up 1,2: give three numbers x,y,z or an axis such as -y",
        ),
        (["--style", "floppy"], "--style: unknown word 'floppy'; give one of light, heavy, rubbery"),
        (["--style", "squash=3"], "style: squash 3: give a number of times the usual from 0.5 to 2"),
        (["--motion", "walk", "--style", "heavy"], "--style: no motion of 'walk' jumps"),
        (["--beats", "90"], "--beats: no motion of 'jump' takes beats; add a dance"),
        (["--motion", "dance", "--beats", "soon.csv"], "soon.csv: no such file"),
        (["--motion", "dance", "--beats", "90 soon"], "first soon: give a number of seconds from 0 to 600"),
        ([], "nothing.ply"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_bad_input_is_one_line(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if "nothing.ply" not in message:
        (tmp_path / "nothing.ply").touch()
    status = main(["animate", str(tmp_path / "nothing.ply"), "--out", str(tmp_path / "out"), *flags])
    error = capsys.readouterr().err
    assert status == 2
    assert message in error
    assert error.startswith("egs-warp: ") and error.count("\n") == 1


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--object", "-1,-2.5,.5"], "nothing.ply: no such file"),
        (["--object", "-.1,0,0,-.05,1,2"], "nothing.ply: no such file"),
        (["--up", "-y", "--view-from", "-1,0,.5", "--plane", "-8e-05,0,1,-0.2"], "nothing.ply: no such file"),
        (["--up", "-w"], "--up: its value is missing; give one; see egs-warp animate --help"),
        (["--frames", "many"], "egs-warp: --frames many: give a whole number\n"),
        (["--friction", "high"], "egs-warp: --friction high: give a number\n"),
        (["--no-shadow=yes"], "--no-shadow: it takes no value; leave the value out; see egs-warp animate --help"),
        (["--nonsense"], "unrecognized arguments: --nonsense"),
        (["--out", ""], "egs-warp: --out '': the name is empty; give a name"),
        (["--out", "{tmp}/file/out"], "file is a file); choose another one"),
    ],
)
def test_values_may_begin_with_a_minus_and_wrong_flags_take_one_line(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    if "nothing.ply" not in message:
        (tmp_path / "nothing.ply").touch()
    flags = [flag.format(tmp=tmp_path) for flag in flags]
    try:
        status = main(["animate", str(tmp_path / "nothing.ply"), "--out", str(tmp_path / "out"), *flags])
    except SystemExit as stop:
        status = stop.code
    error = capsys.readouterr().err
    assert status == 2
    assert message in error
    assert error.startswith("egs-warp") and error.count("\n") == 1


@pytest.mark.parametrize(
    "line",
    [
        "animate {long} --out {out}",
        "animate {capture} --out {out} --object {long} --up z",
        "animate {capture} --out {out} --object 0,0,0.5 --cameras {long} --up z",
        "animate {capture} --out {out} --background {long} --up z",
        "convert {long} {out}.ply",
        "view {long}",
    ],
)
def test_names_that_are_too_long_are_one_line(line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "a.ply", pawn(gaussian_count=50, device="cpu").cloud)
    given = {"long": "a" * 300, "capture": tmp_path / "a.ply", "out": tmp_path / "out"}
    assert main([word.format(**given) for word in line.split()]) == 2
    error = capsys.readouterr().err
    assert ("no such file" in error or "neither a file nor numbers" in error) and error.count("\n") == 1


def test_a_flat_object_does_not_overwrite_an_earlier_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-1, 1, (500, 2)), np.zeros(500)])
    cloud = GaussianCloud.from_numpy(
        flat, np.tile([1.0, 0, 0, 0], (500, 1)), np.full((500, 3), -6.0), np.full(500, 3.0), np.zeros((500, 1, 3))
    )
    write_ply(tmp_path / "flat.ply", cloud)
    out = tmp_path / "out"
    out.mkdir()
    (out / "jump.mp4").write_bytes(b"precious")
    status = main(["animate", str(tmp_path / "flat.ply"), "--up", "z", "--out", str(out)])
    assert status == 2
    assert "Traceback" not in capsys.readouterr().err
    assert (out / "jump.mp4").read_bytes() == b"precious"
    assert [path.name for path in out.iterdir()] == ["jump.mp4"]


@pytest.mark.parametrize(
    "line",
    [
        "animate flat.ply --up z --out new/out",
        "animate flat.ply --up z --object 5,5,5 --out new/out",
        "segment flat.ply --up z --object 5,5,5 --out new/out",
        "plane flat.ply --up z --object 5,5,5 --out new/out",
        "convert frames new/out --to spz",
        "animate flat.ply --up z --out new.mp4",
        "plane flat.ply --object 0,0,0 --out plane.json",
    ],
)
def test_what_is_refused_leaves_no_folder(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-1, 1, (100, 2)), np.zeros(100)])
    cloud = GaussianCloud.from_numpy(
        flat, np.tile([1.0, 0, 0, 0], (100, 1)), np.full((100, 3), -6.0), np.full(100, 3.0), np.zeros((100, 1, 3))
    )
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "flat.ply", cloud)
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "frame0001.ply").write_text("not a capture")
    before = sorted(path.name for path in tmp_path.rglob("*"))
    assert main(line.split()) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("egs-warp: ")
    assert sorted(path.name for path in tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_own_muscles_are_plotted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The plot shows the fibres of the file; the error for a fibre outside the body names the fibre."""
    thing = pawn()
    write_ply(tmp_path / "pawn.ply", thing.cloud)
    flags = ["muscles", str(tmp_path / "pawn.ply"), "--plot", str(tmp_path / "muscles.png")]
    flags += ["--plane", ",".join(str(x) for x in (*thing.plane.normal, thing.plane.offset))]
    foot = -thing.plane.offset * thing.plane.normal
    for far, status in ((0.3, 0), (9.0, 2)):
        ends = {"from": (foot + 0.1 * thing.plane.normal).tolist(), "to": (foot + far * thing.plane.normal).tolist()}
        (tmp_path / "own.json").write_text(json.dumps({"fibres": [{"name": "spine", "kind": "longitudinal", **ends}]}))
        assert main([*flags, "--muscles", str(tmp_path / "own.json")]) == status
    said = capsys.readouterr()
    assert "1 fibres, 4 segments" in said.out and 'fibre "spine"' in said.err
    assert cv2.imread(str(tmp_path / "muscles.png")) is not None


@pytest.mark.parametrize("name", ["a.xyz", "a", ".png"])
def test_a_plot_needs_the_name_of_a_picture(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "nothing.ply").touch()
    assert main(["muscles", str(tmp_path / "nothing.ply"), "--plot", str(tmp_path / name)]) == 2
    error = capsys.readouterr().err
    message = f"{name}: not the name of an image; give a name that ends in one of .png, .jpg"
    assert message in error and error.count("\n") == 1


def test_a_plot_needs_an_existing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The error is reported before the capture is read."""
    (tmp_path / "nothing.ply").touch()
    assert main(["muscles", str(tmp_path / "nothing.ply"), "--plot", str(tmp_path / "gone" / "a.png")]) == 2
    assert f"a.png: its folder does not exist; create {tmp_path / 'gone'} first" in capsys.readouterr().err


def test_what_a_command_writes_has_one_name() -> None:
    """A command names its output ``--out``, or ``-o``, unless it writes only on request; only ``convert`` takes it by
    position, after its inputs."""
    for name, command in _parsers()[1].items():
        flags = command._option_string_actions
        assert ("--out" in flags) == ("-o" in flags), name
        assert not {"--out", "--plot", "--export"} < set(flags), name
        if name in ("demo", "samples"):
            assert all(action.option_strings for action in command._actions), name


def test_no_flag_takes_an_empty_path() -> None:
    """All flags for paths refuse an empty value, for example from an unset variable, because it would mean the working
    folder."""
    taken = [action.type for command in _parsers()[1].values() for action in command._actions]
    assert named_path in taken and Path not in taken


@pytest.mark.parametrize("number", ["-1", "4294967296", "many"])
@pytest.mark.parametrize("line", ["inpaint a.ply --plane 0,0,1,0 --out b.ply", "pose a --out b", "train a --out b.ply"])
def test_seeds_are_checked(line: str, number: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*line.split(), "--seed", number]) == 2
    assert capsys.readouterr().err == f"egs-warp: --seed {number}: give a whole number from 0 to 4294967295\n"


def test_choices_of_flags_are_those_of_the_library() -> None:
    """The choices are duplicated so that a wrong flag is reported before heavy packages are imported."""

    def choices(command: str, flag: str) -> set[str]:
        (action,) = [action for action in _parsers()[1][command]._actions if flag in action.option_strings]
        return set(action.choices or ())

    assert choices("convert", "--to") == set(WRITERS) == choices("export", "--to") - {"usd", "bundle", "skin"}
    assert choices("animate", "--qp") == choices("live", "--qp") == {solver.value for solver in QpSolver}
    assert choices("animate", "--strategy") == choices("live", "--strategy") == {each.value for each in Strategy}
    assert choices("render", "--show") == {show.value for show in Show}
    assert choices("segment", "--straddling") == {method.value for method in StraddlingPolicy}
    assert NAME == CONFIG
    assert {"patch", TRANSPARENT, *CameraMove, *(method.value for method in OpenCvMethod)} == set(_WORDS)


@pytest.mark.parametrize(
    ("line", "suggestion"),
    [
        ("twist a.ply", "'twist' is unknown (did you mean animate CAPTURE --motion twist --out FOLDER?); give one of "),
        (f"{__file__}", f"is unknown (did you mean animate {__file__} --out FOLDER?); give one of doctor, demo"),
        ("animte a.ply", "'animte' is unknown (did you mean 'animate'?); give one of doctor, "),
        ("animate a.ply --out b --resume", "--resume (did you mean the command egs-warp resume?)"),
        ("animate a.ply --otu b", "unrecognized arguments: --otu (did you mean '--out'?)"),
        ("animate a.ply --out b --motion wlak", "unknown motion 'wlak' (did you mean 'walk'?)"),
        ("animate a.ply --out b --motion jump,HPO", "unknown motion 'hpo' (did you mean 'hop'?)"),
        ("animate a.ply --out b --motion jump.hieght=1", "unknown motion 'jump.hieght=1'"),
        ("animate a.ply --out b --style hevy", "unknown word 'hevy' (did you mean 'heavy'?)"),
        ("animate a.ply --out b --style squish=1.2", "unknown word 'squish=1.2' (did you mean 'squash'?)"),
        ("animate a.ply --out b --camera folow", "--camera folow (did you mean 'follow'?)"),
        ("animate a.ply --out b --background transparnt", "no such file (did you mean 'transparent'?)"),
        ("animate a.ply --out b --background blu", "no such file (did you mean 'blue'?)"),
        ("animate a.ply --out b --background blue", "a.ply: no such file or folder"),
        ("animate a.ply --out b --qp osq", "--qp osq: unknown (did you mean 'osqp'?)"),
        ("export a --to plly --out b", "--to plly: unknown (did you mean 'ply'?)"),
        (
            "convert a.ply b.splt",
            "give a name that ends in .compressed.ply, .ply, .spz, .sog, .splat, .glb (did you mean ",
        ),
        ("info pwan.ply", "pwan.ply: no such file or folder (did you mean 'pawn.ply'?)"),
        ("--versoin", "--versoin (did you mean '--version'?)"),
        ("demo folder", "egs-warp demo: unrecognized arguments: folder (did you mean --out folder?)"),
        ("demo --motion walk", "--motion (a flag of from-photos, animate; egs-warp demo takes --out, --size, "),
        ("demo --fruit", "--fruit (egs-warp demo takes --out, --size, --frames, --device, --overwrite)"),
        ("animate a.ply --out b --colour red", "unrecognized arguments: --colour; see egs-warp animate --help"),
        ("animate a.ply --out b --speed 2", "unrecognized arguments: --speed; see egs-warp animate --help"),
        ("animate a.ply --out b --mass 2", "unrecognized arguments: --mass; see egs-warp animate --help"),
        ("animate a.ply --out b --duration 3", "--duration (did you mean '--frames': number of frames at 60 Hz?)"),
        ("animate a.ply --out b --fritcion 1", "--fritcion (did you mean '--friction'?)"),
        ("animate a.ply --out b --light", "--light (it is on by default; --no-light turns it off)"),
        ("animate a.ply --out b --no-preview", "unrecognized arguments: --no-preview; see egs-warp animate --help"),
        ("demo --seconds 3", "--seconds (did you mean '--frames': frames at 60 per second?)"),
        ("segment a.ply --out b --point 1,2,3", "--point (did you mean '--object'?)"),
        ("train a --out b.ply --steps 9", "--steps (did you mean '--iterations'?)"),
        ("demo --zzz", "--zzz (egs-warp demo takes --out, --size, --frames, --device, --overwrite)"),
        ("demo --dir folder", "--dir (egs-warp demo writes to --out)"),
        ("view a --output b.html", "--output (egs-warp view writes to --export)"),
        ("muscles a.ply -o b.png", "-o (egs-warp muscles writes to --plot)"),
        ("validate a --out b", "--out (a flag of other commands)"),
        ("convert a.ply --out b.ply", "--out (egs-warp convert takes the output as its last argument, OUT)"),
        ("convert a.ply -o b.ply", "-o (egs-warp convert takes the output as its last argument, OUT)"),
        ("animate --halp", "--halp (did you mean '--help'?)"),
        ("train a --out b.ply --gpu", "--gpu (did you mean '--device'?)"),
        (
            "--out b animate a.ply",
            "egs-warp: unrecognized arguments: --out (a flag of other commands; egs-warp takes --",
        ),
        ("inpaint a.ply --plane 0,0,1,0 --hole 0,0,0,1 --out b.ply --inpainter tela", "tela (did you mean 'telea'?)"),
    ],
)
def test_a_misspelt_name_is_answered_by_the_nearest_one(
    line: str, suggestion: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pawn.ply").touch()
    if "a.ply: no such file" not in suggestion:
        (tmp_path / "a.ply").touch()
    try:
        status = main(line.split())
    except SystemExit as stop:
        status = stop.code
    error = capsys.readouterr().err
    assert status == 2 and error.count("\n") == 1
    assert suggestion in error


def test_names_of_a_run_file_and_of_python_are_answered_too(tmp_path: Path) -> None:
    import egs_warp as egs

    (tmp_path / "run.yaml").write_text("capture: a.ply\nmotoin: jump\n")
    with pytest.raises(UserError, match=r"unknown key 'motoin' \(did you mean 'motion'\?\)"):
        with_config([f"--config={tmp_path / 'run.yaml'}"], _parsers()[1]["animate"])
    with pytest.raises(UserError, match=r"'distanse' is unknown \(did you mean 'distance'\?\); jump takes"):
        egs.motion("jump distanse=1")
    with pytest.raises(UserError, match=r"scene 'pwan' is unknown \(did you mean 'pawn'\?\)"):
        egs.scene("pwan")
    with pytest.raises(AttributeError, match=r"no attribute 'anmiate' \(did you mean 'animate'\?\)"):
        egs.anmiate  # noqa: B018


def _examples() -> list[str]:
    commands = [
        f"{name} {example}"
        for name in COMMANDS
        for example in importlib.import_module(f"egs_warp.commands.{name.replace('-', '_')}").EXAMPLES
    ]
    return [*commands, *_FIRST_EXAMPLES]


@pytest.mark.parametrize("example", _examples())
def test_the_examples_of_the_help_are_accepted(
    example: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In an empty folder, each example is rejected only because files are missing."""
    monkeypatch.chdir(tmp_path)
    words = shlex.split(example)
    if words[0] in ("doctor", "demo", "samples"):
        assert _parsers()[0].parse_args(words).command == words[0]
        return
    assert main(words) == 2
    error = capsys.readouterr().err
    assert re.search(
        "no such (file|folder)|no folder|not a folder|no run has written|no camera poses|make web|not installed|"
        "this machine has",
        error,
    ), error
    assert not list(tmp_path.iterdir())


def test_the_commands_of_the_pages_are_accepted() -> None:
    """Each line of a code block that begins with ``egs-warp`` can be parsed, with placeholders in capitals as names."""
    parser, root, count = _parsers()[0], Path(__file__).parents[1], 0
    for page in (root / "README.md", *sorted((root / "docs").rglob("*.md"))):
        if "notebook" in page.parts:
            continue
        for block in re.findall(r"^```\w*\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
            for line in re.sub(r"\\\n\s*", " ", block).splitlines():
                if line.startswith("egs-warp ") and "..." not in line:
                    words = shlex.split(line, comments=True)[1:]
                    command = _parsers()[1].get(words[0])
                    if command is not None and "--config" in words:
                        continue
                    try:
                        parser.parse_args(_attach_negative_values(words))
                    except SystemExit as stop:
                        assert stop.code == 0, f"{page.name}: {line}"
                    count += 1
    assert count > 40


def test_without_a_command_the_help_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("usage: egs-warp ") and "animate" in printed.out and printed.err == ""


def test_the_help_of_animate_lists_the_registry(capsys: pytest.CaptureFixture[str]) -> None:
    """The help lists all motions with their own default values, and the most important flags first."""
    with pytest.raises(SystemExit):
        main(["animate", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    for name, kind in MOTIONS.items():
        assert re.search(rf"(one of|,) '?{name}'?( FILE)?(,| --object)", text), name
        for value in kind.parameters:
            if value.name in ("distance", "height", "heading_degrees"):
                flag = value.name.replace("_", "-")
                (described,) = re.findall(rf"--{flag} [A-Z_]+ (.*?) --", text)
                assert f"{name} ({value.default:g})" in described
    assert all(preset in text for preset in PRESETS)
    first = text[text.index("most used:") : text.index("motion: --distance")]
    assert re.findall(r"--(\w+) [A-Z]", first) == ["out", "up", "motion", "object", "camera", "size", "device"]
    table = (Path(__file__).parents[1] / "docs" / "guide" / "capture.md").read_text()
    (row,) = re.findall(r"^\| `--motion` \|(.*)$", table, re.MULTILINE)
    assert all(re.search(rf"`{name}[ `]", row) for name in MOTIONS)


def test_tables_of_the_pages_have_as_many_cells_in_each_row() -> None:
    for page in sorted((Path(__file__).parents[1] / "docs").rglob("*.md")):
        width = 0
        for number, line in enumerate(page.read_text().splitlines(), start=1):
            cells = len(re.findall(r"(?<!\\)\|", re.sub(r"`[^`]*`", "", line))) if line.startswith("|") else 0
            assert width in (0, cells) or cells == 0, f"{page.name}:{number}: {cells - 1} cells, not {width - 1}"
            width = cells


def test_axes_and_planes_are_read() -> None:
    assert np.array_equal(parse_up("-y"), [0.0, -1.0, 0.0])
    assert np.array_equal(parse_up("+Z"), [0.0, 0.0, 1.0])
    plane = parse_plane("0,2,0,-4")
    assert np.array_equal(plane.normal, [0.0, 1.0, 0.0]) and plane.offset == -2.0
    with pytest.raises(UserError, match="give one of x, y, z"):
        parse_up("up")


def test_the_package_runs_as_a_module() -> None:
    """``python -m egs_warp`` runs the command."""
    done = subprocess.run([sys.executable, "-m", "egs_warp", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith(__version__)


@pytest.mark.parametrize(("given", "taken"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "4"}, "4")])
def test_blas_uses_one_thread_by_default(given: dict[str, str], taken: str) -> None:
    """The environment variable is set before NumPy, which reads it, is loaded; a value that the user has set is
    kept."""
    script = """
import atexit, os, sys
import egs_warp.cli
atexit.register(lambda: print(os.environ["OPENBLAS_NUM_THREADS"], "numpy" in sys.modules))
egs_warp.cli.main(["--version"])
"""
    rest = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-c", script], env=rest | given, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-2:] == [taken, "False"]


def test_a_mistake_is_reported_before_warp_and_scipy_are_imported(tmp_path: Path) -> None:
    """Their import takes seconds, in which a misspelt word looks like a program that works."""
    (tmp_path / "a.ply").touch()
    mistakes = [
        "animate none.ply --out b",
        "animate a.ply --motion jmup --out b",
        "animate a.ply --motion hop,walk+nodd --out b",
        "animate a.ply --up w --out b",
        "animate a.ply --size 12x --out b",
        "animate a.ply --plane 0,0,1 --out b",
        "animate a.ply --view-from 0,0,0 --out b",
        "animate a.ply --muscles none.json --out b",
        "info none.ply",
        "view none",
        "export none --to ply --out b",
        "resume none",
        "segment none.ply --object 0,0,0 --out b",
        "train none --out b.ply",
    ]
    program = (
        "import sys; from egs_warp.cli import main\n"
        f"for line in {mistakes}:\n"
        "    assert main(line.split()) == 2, line\n"
        "    assert not {'warp', 'scipy', 'torch'} & sys.modules.keys(), line"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("\n") == len(mistakes)
    assert "--view-from 0,0,0: this direction has no length; give one" in done.stderr
