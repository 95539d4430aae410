"""``egs-warp train --resume``, and protection of the files of an earlier training."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from egs_warp.cli import main
from egs_warp.commands.train import TrainStep
from tests.support.posed import posed_folder

pytest.importorskip("torch")

MOMENTS = int(os.environ.get("EGS_WARP_MOMENTS", "2"))
OFTEN = (
    "import sys; from egs_warp.training import checkpoint; checkpoint.SECONDS = 0.0;"
    " from egs_warp.cli import main; sys.exit(main(sys.argv[1:]))"
)
"""Python code that runs the command and writes checkpoints as often as possible."""


def line(folder: Path, out: Path, device: str = "cpu") -> list[str]:
    return ["train", str(folder), "--out", str(out), "--iterations", "200", "--gaussians", "300", "--device", device]


def bits(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files, without the times in the report."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".json"}


@pytest.mark.slow
def test_ctrl_c_prints_how_to_continue(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("egs_warp.training.checkpoint.SECONDS", 0.0)
    posed, whole, out = posed_folder(tmp_path / "posed"), tmp_path / "whole" / "a.ply", tmp_path / "out" / "a.ply"
    assert main(line(posed, whole)) == 0
    with monkeypatch.context() as patch:

        def stop(self: object, step: TrainStep) -> None:
            if step.done == 151:
                raise KeyboardInterrupt

        patch.setattr("egs_warp.commands.train._Progress.step", stop)
        assert main(line(posed, out)) == 130
    assert capsys.readouterr().err.splitlines()[-1].endswith("; continue with --resume and the same flags")
    assert sorted(os.listdir(out.parent)) == ["a.training.npz"]
    assert main(line(posed, out)) == 2
    assert capsys.readouterr().err == (
        f"egs-warp: --out {out}: its training was interrupted; give --resume to continue it, or --overwrite to start"
        " again\n"
    )
    assert main([*line(posed, out), "--resume"]) == 0
    assert bits(out.parent) == bits(whole.parent)
    capsys.readouterr()
    assert main([*line(posed, out), "--resume"]) == 0
    assert capsys.readouterr().out == f"{out}: this training has finished\n"


def test_an_earlier_training_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The report and the contact sheet of an earlier training are protected too, although no flag names them."""
    posed, out = posed_folder(tmp_path / "posed"), tmp_path / "a.ply"
    (tmp_path / "a.sheet.png").write_bytes(b"sheet")
    assert main(line(posed, out)) == 2
    assert capsys.readouterr().err == (
        f"egs-warp: --out {out}: a.sheet.png exists already; choose another name, or move it aside with --overwrite\n"
    )
    out.write_bytes(b"cloud")
    assert main([*line(posed, out), "--overwrite"]) == 0
    assert (tmp_path / "earlier-1" / "a.ply").read_bytes() == b"cloud"
    assert (tmp_path / "earlier-1" / "a.sheet.png").read_bytes() == b"sheet"
    assert sorted(os.listdir(tmp_path)) == ["a.ply", "a.report.json", "a.sheet.png", "earlier-1", "posed"]


@pytest.mark.slow
def test_random_moments(tmp_path: Path, device: str) -> None:
    """The training is killed by SIGKILL immediately after its first checkpoint, and at random times, half of them after
    the first checkpoint. Without a checkpoint, the training starts again.

    The capture is bitwise equal to that of an uninterrupted training, also on a GPU, because floating-point sums do not
    use atomic operations.
    """
    posed, whole = posed_folder(tmp_path / "posed"), tmp_path / "whole" / "a.ply"
    command = [sys.executable, "-c", OFTEN]
    # The kernels are already compiled, so every start takes equally long.
    subprocess.run([*command, *line(posed, tmp_path / "first" / "a.ply", device)], check=True, capture_output=True)
    began = time.monotonic()
    subprocess.run([*command, *line(posed, whole, device)], check=True, capture_output=True)
    length = time.monotonic() - began
    assert bits(whole.parent) == bits(tmp_path / "first"), "two trainings alike that nothing cuts off"
    moments = random.Random(18)
    went_on = 0
    for number in range(MOMENTS):
        out = tmp_path / str(number) / "a.ply"
        checkpoint = out.with_name("a.training.npz")
        run = subprocess.Popen(
            [*command, *line(posed, out, device)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        if number % 2:
            time.sleep(length * moments.random())
        else:
            while run.poll() is None and not checkpoint.exists():
                time.sleep(0.01)
            if number:
                time.sleep(0.3 * length * moments.random())
        run.send_signal(signal.SIGKILL)
        run.wait()
        kept = checkpoint.exists()
        went_on += kept
        if kept or not out.exists():
            again = [*line(posed, out, device), *(["--resume"] if kept else [])]
            subprocess.run([*command, *again], check=True, capture_output=True)
        assert bits(out.parent) == bits(whole.parent), number
    assert went_on
