"""``egs-warp demo`` films the hops of the README and does not change an earlier run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from egs_warp.cli import main


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--size", "8"], "--size 8: give a number of pixels from 16 to 4096"),
        (["--frames", "0"], "--frames 0: give"),
        (["--device", "tpu"], "--device tpu: this machine has"),
    ],
)
def test_bad_flags_are_one_line(
    flags: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", "--out", str(tmp_path / "demo"), *flags]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_earlier_run_is_not_touched(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "manifest.json").write_text('{"finished": true, "files": {"hop.mp4": {}}}')
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "it has an earlier run" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["manifest.json"]


@pytest.mark.slow
@pytest.mark.usefixtures("coarse")
def test_the_demo_films_the_hops_over_the_board(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--out", str(tmp_path / "demo"), "--frames", "3", "--size", "64"]) == 0
    assert f"egs-warp view {tmp_path / 'demo'}" in capsys.readouterr().out
    report = json.loads((tmp_path / "demo" / "report.json").read_text())
    assert report["film"] == "hop.mp4" and (tmp_path / "demo" / "hop.mp4").stat().st_size > 0
    assert report["motion"][0]["name"] == "hop" and report["source"] == "pawn"
    # The board is stored with the run, so another film of the run with default settings is the same.
    assert main(["render", str(tmp_path / "demo"), "--out", str(tmp_path / "again.mp4")]) == 0
    assert (tmp_path / "again.mp4").read_bytes() == (tmp_path / "demo" / "hop.mp4").read_bytes()
