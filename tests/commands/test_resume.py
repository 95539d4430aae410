"""``egs-warp resume``: a run that is killed at any moment and resumed is bitwise equal to an uninterrupted run."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from egs_warp import cli
from egs_warp.assets import pawn, scene, stool
from egs_warp.errors import UserError
from egs_warp.io import write_ply
from egs_warp.io.run_folder import MANIFEST, has_finished
from tests.support.coarse import NODES, coarse_main, coarse_maker
from tests.support.disk_faults import assert_one_line, fail_once
from tests.support.scenes import two_pawns_on_a_board

PATIENCE = 900.0
"""Maximum duration of a run on a busy machine, s."""
MOMENTS = int(os.environ.get("EGS_WARP_MOMENTS", "1"))
"""Number of random times at which each command is killed. The default is for a short test; docs/reliability.md
describes the long one."""
SEED = os.environ.get("EGS_WARP_SEED", "")
"""Seed of the random times, so that several processes can test different ones."""
SMALL = ("--up", "z", "--size", "32")
COMMANDS = {
    "jump": ("pawn.ply", "--frames", "28"),
    "hops": ("pawn.ply", "--motion", "hop 0.3 0.2 x2, jump", "--frames", "110"),
    "walk": ("stool.ply", "--motion", "walk 0.2", "--frames", "20"),
    "keys": ("pawn.ply", "--motion", "trajectory keys.json", "--camera", "follow", "--background", "transparent"),
    "scene": ("room.ply", "--object", "0,0,0.5", "--frames", "20"),
}
WORLD = """
bodies:
  - {name: jumper, capture: pawn.ply, up: z, nodes: 50, heading: 0, motion: jump 0.3}
  - {name: target, capture: pawn.ply, up: z, prop: true, density: 100, height: 0.5, at: [0.55, 0]}
  - {name: lift, capture: pawn.ply, up: z, prop: true, height: 0.2, at: [0, 1.5], path: [{time: 0.5, above: 0.2}]}
"""
KEYS = [{"time": 0.4, "part": "head", "quantity": "position", "value": [0, 0, -0.05]}]


def write_inputs(folder: Path) -> Path:
    """Write the input files of the commands into ``folder``."""
    write_ply(folder / "pawn.ply", pawn(gaussian_count=2000, device="cpu").cloud)
    (folder / "keys.json").write_text(json.dumps(KEYS))
    return folder


def animate(name: str, folder: Path, out: Path) -> list[str]:
    capture, *flags = COMMANDS[name]
    given = [str(folder / flag) if flag.endswith(".ply") else flag for flag in flags]
    given = [flag.replace("keys.json", str(folder / "keys.json")) for flag in given]
    return ["animate", str(folder / capture), *SMALL, *given, "--out", str(out)]


def bits(folder: Path) -> dict[str, bytes | str]:
    """Return the contents of all files, without the timings of the report and without its checksum."""
    found: dict[str, bytes | str] = {path.name: path.read_bytes() for path in folder.iterdir()}
    report = json.loads(found["report.json"])
    found["report.json"] = json.dumps(report | {"timing": None})
    manifest = json.loads(found[MANIFEST])
    found[MANIFEST] = json.dumps(manifest | {"files": manifest["files"] | {"report.json": None}})
    return found


def process(arguments: Sequence[str]) -> list[str]:
    """Return a command line that runs the command with coarse cages in its own process."""
    return [sys.executable, "-m", "tests.support.coarse", *arguments]


def finishes(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status, which may be that of a fall, because the body is coarse."""
    done = subprocess.run(process(arguments), capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode in (0, 3), done.stderr
    return done.returncode


def has_begun(out: Path) -> bool:
    """Return True if ``out`` contains a run that can be resumed, which has files besides its manifest."""
    try:
        has_finished(out)
    except UserError as error:
        assert "no run has written here" in str(error)
        return False
    return True


def ended_by(arguments: Sequence[str], number: int, ready: Path, after: float) -> tuple[int, str]:
    """Return the exit status and the message of a run that receives a signal ``after`` seconds after the file ``ready``
    appears."""
    run = subprocess.Popen(process(arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    give_up = time.monotonic() + PATIENCE
    while not ready.exists() and run.poll() is None and time.monotonic() < give_up:
        time.sleep(0.01)
    time.sleep(after)
    run.send_signal(number)
    _, said = run.communicate(timeout=PATIENCE)
    return run.returncode, said


@pytest.mark.slow
def test_a_run_that_is_killed_repeatedly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The run is killed by SIGKILL before its first part, by Ctrl-C between parts, and by SIGKILL after the simulation.
    Runs that are not killed execute in this process."""
    folder, whole, out = write_inputs(tmp_path), tmp_path / "whole", tmp_path / "out"
    assert coarse_main(animate("jump", folder, whole)) == 0
    parts = out / "trajectory.parts"
    moments = random.Random(18)
    first, again = animate("jump", folder, out), ["resume", str(out)]
    assert ended_by(first, signal.SIGKILL, parts / "start.npz", 0.2 * moments.random())[0] == -signal.SIGKILL
    status, said = ended_by(again, signal.SIGINT, parts / "steps-000001.npz", 0.2 * moments.random())
    told = "egs-warp: stopped; finished files are complete, unfinished ones are removed"
    assert status == 130 and said.splitlines()[-1] == f"{told}; egs-warp resume {out} continues it"
    assert not [name for name in os.listdir(out) if name.startswith(".egs-")]
    assert ended_by(again, signal.SIGKILL, out / "plots.png", 0.0)[0] == -signal.SIGKILL
    assert not json.loads((out / MANIFEST).read_text())["finished"]
    assert coarse_main(again) == 0
    assert bits(out) == bits(whole)
    capsys.readouterr()
    # The folder is now in the state in which a kill at the very end of the run leaves it.
    parts.mkdir()
    (out / ".egs-run.lock").touch()
    assert coarse_main(again) == 0 and bits(out) == bits(whole)
    capsys.readouterr()
    assert coarse_main(again) == 0 and capsys.readouterr().out == f"{out}: this run has finished\n"


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_random_moments(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run is killed by SIGKILL or Ctrl-C at any time, including its preparation and video. A run that has not
    written a file yet is started again."""
    folder, whole = write_inputs(tmp_path), tmp_path / "whole"
    if name == "walk":
        # On a coarser cage, the stool does not have four feet.
        monkeypatch.setenv("EGS_WARP_TEST_NODES", "500")
    write_ply(folder / "stool.ply", stool(device="cpu").cloud)
    write_ply(folder / "room.ply", scene("pawn", device="cpu").whole()[0])
    began = time.monotonic()
    status = finishes(animate(name, folder, whole))
    # Whichever process is killed below, the folder contains only files of the run.
    assert not [path for path in whole.iterdir() if path.is_dir() or path.name.startswith(".")]
    length = time.monotonic() - began
    moments = random.Random(name + SEED)
    for number, ending in enumerate([signal.SIGKILL] * MOMENTS + [signal.SIGINT] * -(-MOMENTS // 4)):
        out = tmp_path / str(number)
        ended_by(animate(name, folder, out), ending, folder, length * moments.random())
        assert finishes(["resume", str(out)] if has_begun(out) else animate(name, folder, out)) == status
        assert bits(out) == bits(whole), number


@pytest.mark.slow
def test_each_file_operation_of_a_resumed_run_fails_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Resume a run that was interrupted during the video: an error is one line and leaves nothing half-written.

    The folder does not count as finished. A second ``resume`` completes the run.
    """
    folder, whole, cut, out = write_inputs(tmp_path), tmp_path / "whole", tmp_path / "cut", tmp_path / "out"
    assert coarse_main(animate("jump", folder, whole)) == 0
    with monkeypatch.context() as patch:
        patch.setattr("egs_warp.pipelines.animate.draw_film", interrupted)
        assert coarse_main(animate("jump", folder, cut)) == 130
    for number in range(100):
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(cut, out)
        capsys.readouterr()
        with monkeypatch.context() as patch:
            failed = fail_once(patch, number, errno.ENOSPC)
            status = coarse_main(["resume", str(out)])
        if not failed:
            break
        assert status == 1
        assert_one_line(capsys.readouterr().err, os.strerror(errno.ENOSPC))
        assert not [name for name in os.listdir(out) if name.startswith(".egs-")]
        assert not json.loads((out / MANIFEST).read_text())["finished"]
    assert number > 8 and status == 0 and bits(out).keys() == bits(whole).keys()
    assert all(its == bits(whole)[name] for name, its in bits(out).items() if name != "run.yaml")


@pytest.mark.slow
def test_a_world_continues_to_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run is interrupted before its film, and the last steps of one body are missing, as after a kill between two
    parts."""
    write_inputs(tmp_path)
    (tmp_path / "world.yaml").write_text(WORLD)
    whole, out = tmp_path / "whole", tmp_path / "out"
    first = ["animate", str(tmp_path / "world.yaml"), "--frames", "40", "--size", "32", "--out"]
    status = cli.main([*first, str(whole)])
    with monkeypatch.context() as patch:
        patch.setattr("egs_warp.pipelines.animate_world.draw_world_film", interrupted)
        assert cli.main([*first, str(out)]) == 130
    parts = sorted((out / "jumper" / "trajectory.parts").glob("steps-*.npz"))
    assert len(parts) > 2 and not (out / "report.json").exists()
    parts[-1].unlink()
    assert cli.main(["resume", str(out)]) == status
    for name in ("jumper", "target", "lift"):
        assert (out / name / "trajectory.npz").read_bytes() == (whole / name / "trajectory.npz").read_bytes()
        assert not (out / name / "trajectory.parts").exists()
    assert (out / "world.mp4").read_bytes() == (whole / "world.mp4").read_bytes()
    assert json.loads((out / MANIFEST).read_text())["finished"]


@pytest.mark.slow
def test_objects_of_a_scene_given_by_flags_continue_to_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run is interrupted before its film and loses its last steps. It is resumed from another working directory,
    without the cache of scenes."""
    monkeypatch.setenv("EGS_WARP_CACHE", "")
    monkeypatch.setattr("egs_warp.pipelines.creature.make_checked_creature", coarse_maker(NODES))
    write_ply(tmp_path / "room.ply", two_pawns_on_a_board())
    monkeypatch.chdir(tmp_path)
    flags = ["--object", "near=0,0,0.5", "--object", "far=1.5,0,0.5", "--prop", "far", "--motion", "near: jump to far"]
    flags += ["--up", "z", "--straddling", "split", "--no-inpaint", "--frames", "20", "--size", "32"]
    first = ["animate", "room.ply", *flags, "--save-collision-mesh", "mesh.glb", "--out"]
    status = cli.main([*first, "whole"])
    mesh = (tmp_path / "mesh.glb").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr("egs_warp.pipelines.animate_world.draw_world_film", interrupted)
        assert cli.main([*first, "out"]) == 130
    sorted((tmp_path / "out" / "near" / "trajectory.parts").glob("steps-*.npz"))[-1].unlink()
    (tmp_path / "mesh.glb").unlink()
    monkeypatch.chdir(tmp_path / "out")
    assert cli.main(["resume", str(tmp_path / "out")]) == status
    assert (tmp_path / "mesh.glb").read_bytes() == mesh
    for name in ("near/trajectory.npz", "far/trajectory.npz", "world.mp4", "background.ply"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name


def interrupted(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_runs_that_cannot_be_resumed_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def told(folder: Path) -> str:
        assert cli.main(["resume", str(folder)]) == 2
        return capsys.readouterr().err

    out, manifest = tmp_path / "out", tmp_path / "out" / MANIFEST
    assert told(out) == f"egs-warp: {out}: no run has written here; start one without resuming\n"
    out.mkdir()
    content: dict = {"schema": 1, "version": "0.0.1", "finished": False, "files": {"run.yaml": None}}
    manifest.write_text(json.dumps(content))
    assert told(out) == f"egs-warp: {out}: no run has written here; start one without resuming\n"
    (out / "trajectory.parts").mkdir()
    content["files"] |= {"trajectory.parts": None}
    manifest.write_text(json.dumps(content))
    assert "the run was started by egs-warp 0.0.1, but this is version 0.1.0, whose steps may differ; start" in told(
        out
    )
    for broken in ("[]", "{}", json.dumps({"files": {"../a": None}})):
        manifest.write_text(broken)
        assert told(out) == f"egs-warp: {manifest}: not a manifest of a run; start the run again\n"
    manifest.write_text(json.dumps(content | {"version": "0.1.0"}))
    assert "run.yaml: is missing; the run was interrupted before its first step" in told(out)
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=50, device="cpu").cloud)
    (out / "run.yaml").write_text("capture: ../pawn.ply\nup: z\ncapture_sha256: 0\n")
    assert "pawn.ply: differs from the capture of the run; restore that file, or start the run again" in told(out)
