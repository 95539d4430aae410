"""``egs-warp animate WORLD.yaml`` writes one film, and a trajectory and a report for each body. It refuses flags that
describe a single capture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from egs_warp import cli
from egs_warp.assets import pawn
from egs_warp.io import write_ply
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.pipelines.finished_run import FinishedRun

WORLD = """
friction: 0.5
bodies:
  - {name: jumper, capture: pawn.ply, up: z, nodes: 50, heading: 0, motion: "jump to target"}
  - {name: target, capture: pawn.ply, up: z, prop: true, density: 100, height: 0.5, at: [0.8, 0]}
obstacles:
  - box: {at: [0, 1.5], size: [0.3, 0.3, 0.2]}
"""


@pytest.mark.slow
def test_a_world_file_gives_one_film_and_the_files_of_each_body(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=3000, device="cpu").cloud)
    (tmp_path / "world.yaml").write_text(WORLD)
    out = tmp_path / "out"
    flags = ["-o", str(out), "--frames", "5", "--size", "64"]
    assert cli.main(["animate", str(tmp_path / "world.yaml"), *flags]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("jumper: cut off: jump to target") and printed[1].startswith("target: moved by 0.00 m")
    assert printed[2] == "audit: passed"
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == report["bodies"]["target"]["audit"] == "audit: passed"
    assert report["audit"]["momentum_residual"] < 1e-12 and report["audit"]["pairs"] == []
    assert report["film"] == "world.mp4" and (out / "world.mp4").stat().st_size > 0
    assert list(report["bodies"]) == ["jumper", "target"]
    for name in ("jumper", "target"):
        t = Trajectory.load(out / name / "trajectory.npz")
        assert t.time[-1] == pytest.approx(4 / 60) and np.isfinite(t.positions).all()
        assert json.loads((out / name / "report.json").read_text())["state"] in ("done", "cut off")
        assert FinishedRun.read(out / name).mesh.nodes.shape == t.rest_positions.shape
    files = json.loads((out / "manifest.json").read_text())["files"]
    assert {
        "world.mp4",
        "sheet.png",
        "report.json",
        "jumper/trajectory.npz",
        "target/contact_shape.npz",
    } <= files.keys()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--friction", "0.2"], "--friction: it is for a single capture"),
        (["--background", "pawn.ply"], "--background pawn.ply: no such file"),
        (["--frames", "1"], "--frames 1"),
    ],
)
def test_flags_of_a_single_capture_are_refused(
    tmp_path: Path, flags: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "world.yaml").write_text(WORLD)
    assert cli.main(["animate", str(tmp_path / "world.yaml"), "--out", str(tmp_path / "out"), *flags]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()
