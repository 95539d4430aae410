"""Examples: runs of a few frames write the files of docs/guide/report.md, and wrong flags are reported in one line."""

from __future__ import annotations

import importlib.util
import json
import runpy
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from egs_warp.locomotion.trajectory import Trajectory

EXAMPLES = Path(__file__).parent.parent / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.example
@pytest.mark.parametrize(
    ("name", "motion", "asked"),
    [
        ("twist", "twist", {"heading_degrees": 180.0, "distance": 0.0, "height": 0.2}),
        ("hop", "hop", {"distance": 0.7, "height": 0.3, "square": 1.0}),
        ("walk", "walk", {"distance": 0.4, "step_length": 0.1, "speed": 1.0}),
        ("waddle", "walk", {"distance": 0.6, "step_length": 0.1, "speed": 1.0}),
        ("crawl", "walk", {"distance": 3.0, "step_length": 0.1, "speed": 1.0}),
        ("turn", "turn", {"heading_degrees": -90.0, "distance": 0.0, "speed": 1.0}),
        ("dance", "dance", {"tempo": 120.0, "first": 0.6, "beats": 10.0}),
        ("get_up", "stand", {"seconds": 1.0}),
        ("acting", "look around", {"degrees": 35.0, "branch": 0.0}),
    ],
)
def test_example_writes_its_files(tmp_path: Path, name: str, motion: str, asked: dict[str, float]) -> None:
    report = example(name).main(["--out", str(tmp_path), "--frames", "4", "--size", "64"]).to_json()
    assert json.loads((tmp_path / "report.json").read_text()) == json.loads(json.dumps(report))
    (entry,) = report["motion"]
    assert entry["name"] == motion and entry["asked"] == asked
    assert {"distance", "height", "heading_degrees", "tilt_degrees", "airborne_frames"} <= set(entry["reached"])
    assert report["audit"]["momentum_residual"] < 1e-5 and report["audit"]["angular_momentum_residual"] < 1e-4
    trajectory = Trajectory.load(tmp_path / "trajectory.npz")
    assert len(trajectory.time) == 4 and np.isfinite(trajectory.positions).all()
    (film,) = tmp_path.glob("*.mp4")
    assert film.stat().st_size > 0 and (tmp_path / "sheet.png").stat().st_size > 0


@pytest.mark.example
@pytest.mark.parametrize(
    ("name", "flags", "bodies"),
    [
        ("chess", ["--seed", "1"], ["attacker", "target"]),
        ("push", ["--seed", "1"], ["pusher", "box"]),
        ("door", [], ["pawn", "door"]),
        ("stairs", [], ["climber"]),
        ("board", [], ["pawn", "box"]),
        ("crowd", ["--count", "2"], ["pawn-1", "pawn-2"]),
    ],
)
def test_example_of_a_world_writes_its_files(tmp_path: Path, name: str, flags: list[str], bodies: list[str]) -> None:
    small = ["--nodes", "60"]
    report = example(name).main(["--out", str(tmp_path), "--frames", "4", "--size", "64", *small, *flags])
    assert list(report.bodies) == bodies and not report.stopped
    assert "audit: passed" in report.summary()
    times = [Trajectory.load(tmp_path / body / "trajectory.npz").time for body in bodies]
    # A frame consists of several steps, because the bodies are small.
    assert all(time[-1] == pytest.approx(3.0 / 60.0) for time in times)
    assert (tmp_path / "world.mp4").stat().st_size > 0 and (tmp_path / "sheet.png").stat().st_size > 0


@pytest.mark.example
def test_the_optimised_jump_gets_higher() -> None:
    pytest.importorskip("gymnasium")
    heights = example("optimise_jump").main(["--worlds", "4", "--generations", "2", "--frames", "20"])
    assert len(heights) == 2 and 0.0 < heights[0] <= heights[1] < 2.0


@pytest.mark.parametrize(
    ("name", "flags", "message"),
    [
        ("crawl", ["--distance", "-99"], "crawl.py: motion 1 ('walk -99.0'): distance -99.0: give a number of"),
        ("get_up", ["--push", "hard"], "get_up.py: push 1 ('hard'): give a time, an impulse and a direction"),
        ("dance", ["--beats", "none.csv"], "dance.py: none.csv: no such file or folder"),
        ("walk", ["--distance", "99"], "walk.py: motion 1 ('walk 99.0 0.1'): distance 99.0: give a number of"),
        ("jump", ["--size", "0"], "jump.py: --size 0: give a number of pixels from 16 to 4096"),
        ("twist", ["--device", "tpu"], "twist.py: --device tpu: this machine has cpu"),
        ("hop", ["--hops", "0"], "hop.py: motion 1 ('hop x0'): repeat 0; give a whole number"),
        ("acting", ["--motion", "bow + hop"], "acting.py: motion 1 ('bow + hop'): hop is not a gesture; gestures are"),
        ("finetune", ["--steps", "0"], "finetune.py: --steps 0, --size 256: give at least 1 step"),
    ],
)
def test_bad_flags_are_one_line(
    tmp_path: Path,
    name: str,
    flags: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = EXAMPLES / f"{name}.py"
    monkeypatch.setattr(sys, "argv", [str(path), *flags, "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(path), run_name="__main__")
    error = capsys.readouterr().err
    assert end.value.code == 2 and error.startswith(message) and error.count("\n") == 1
