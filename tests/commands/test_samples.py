"""``egs-warp samples``: its files can be read, and its suggested commands are valid."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from egs_warp import cli
from egs_warp.io import read_capture


def test_the_two_commands_fit_the_two_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["samples", "--out", str(tmp_path / "new" / "my samples")]) == 0
    said = capsys.readouterr().out
    commands = [shlex.split(line) for line in re.findall(r"^  egs-warp (.+)$", said, re.MULTILINE)]
    assert len(commands) == 2
    alone, scene = (cli._parsers()[0].parse_args(command) for command in commands)
    thing, whole = read_capture(alone.capture).cloud, read_capture(scene.capture).cloud
    assert whole.count > thing.count > 3000
    assert np.ptp(thing.means.numpy()[:, 2]) == pytest.approx(1.0, abs=0.05)
    point = np.array([float(part) for part in scene.object[0].split(",")])
    assert np.linalg.norm(whole.means.numpy() - point, axis=1).min() < 0.3
    assert not Path(alone.out).exists() and alone.out != scene.out


def test_a_place_that_cannot_be_written_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert cli.main(["samples", "--out", str(tmp_path / "file" / "samples")]) == 2
    error = capsys.readouterr().err
    assert "is a file); choose another one" in error and error.count("\n") == 1


def test_another_file_of_the_same_name_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Files of an earlier call are replaced."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["samples"]) == cli.main(["samples"]) == 0
    pawn, whole = Path("samples/pawn.ply"), Path("samples/pawn_on_its_board.ply")
    pawn.unlink()
    whole.write_text("own")
    capsys.readouterr()
    assert cli.main(["samples"]) == 2
    error = capsys.readouterr().err
    expected = (
        "--out samples: it has another pawn_on_its_board.ply already; choose another folder, or move the file aside"
    )
    assert expected in error and error.count("\n") == 1
    assert not pawn.exists() and whole.read_text() == "own"
