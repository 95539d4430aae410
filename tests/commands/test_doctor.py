"""``egs-warp doctor`` prints a correct report, and with ``--warm`` it compiles all kernels that a run needs."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest
import warp as wp

from egs_warp.cli import main
from egs_warp.errors import UserError
from egs_warp.io.video import ffmpeg_program
from egs_warp.pipelines import machine


def test_it_names_device_versions_memory_and_cache(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    said = capsys.readouterr().out
    assert f"warp-lang {wp.__version__}" in said and "device   cpu: " in said and "GiB free" in said
    assert str(wp.config.kernel_cache_dir) in said and ffmpeg_program() in said and "mp4" in said


def test_a_missing_ffmpeg_is_reported_with_status_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def none() -> str:
        raise UserError("no ffmpeg, so no video could be written (gone); pip install imageio-ffmpeg")

    monkeypatch.setattr(machine, "ffmpeg_program", none)
    assert main(["doctor"]) == 1
    assert "problem  no ffmpeg, so no video could be written (gone); pip install" in capsys.readouterr().out


def test_an_unknown_device_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--device", "tpu"]) == 2
    error = capsys.readouterr().err
    assert "--device tpu: this machine has cpu" in error and error.count("\n") == 1


@pytest.mark.slow
def test_kernels_are_compiled_by_a_process_that_ends_with_its_context(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "cache"))
    deadline = time.monotonic() + 120.0
    with machine.compiling_in_background("cpu") as process:
        while not list((tmp_path / "cache").rglob("*.o")):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.1)
    assert process.returncode is not None


def test_a_background_process_that_ignores_signals_ends_with_its_context() -> None:
    program = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60.0)"
    with machine.background_process(program) as process:
        time.sleep(0.5)
        assert process.poll() is None
        began = time.monotonic()
    assert process.returncode is not None and time.monotonic() - began < 10.0
    with machine.background_process("pass") as finished:
        assert finished.wait(60.0) == 0


@pytest.mark.slow
def test_a_background_process_ends_if_its_parent_is_killed() -> None:
    """Parent and child hold the same pipe, which reaches its end when both have ended."""
    child = "import os, sys; os.write(int(sys.argv[1]), b'started'); import time; time.sleep(60.0)"
    reading, writing = os.pipe()
    os.set_inheritable(writing, True)
    code = (
        "import subprocess, sys, time; from egs_warp.pipelines import machine; popen = subprocess.Popen;"
        f"subprocess.Popen = lambda command, **rest: popen([*command, '{writing}'], close_fds=False, **rest);"
        f"context = machine.background_process({child!r}); context.__enter__(); time.sleep(60.0)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], close_fds=False)
    os.close(writing)
    assert os.read(reading, 7) == b"started"
    parent.kill()
    parent.wait()
    assert select.select([reading], [], [], 30.0)[0] and os.read(reading, 1) == b"", "the child has ended"
    os.close(reading)


@pytest.mark.slow
def test_after_warm_a_run_compiles_nothing(tmp_path: Path) -> None:
    """The run uses a kernel cache of its own. After ``doctor --warm``, the run adds no file to this cache. The compiler
    prints nothing, neither a warning nor an error."""
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache")}

    def run(*flags: str) -> str:
        command = [sys.executable, "-m", "egs_warp.cli", *flags]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=400)
        printed = [line for line in done.stderr.splitlines() if line.strip() and not line.startswith("compile: ")]
        assert not printed
        return done.stdout

    before = run("doctor")
    assert "kernels 0/" in before and "kernel files are not compiled for cpu" in before
    warm = run("doctor", "--warm")
    assert "are not compiled" not in warm
    there = {path for path in (tmp_path / "cache").rglob("*.o")}
    code = (
        "import sys; from egs_warp.assets.pawn import pawn; from egs_warp.pipelines.animate import *;"
        "made = pawn(gaussian_count=4000);"
        "animate(made.cloud, sys.argv[1], plane=made.plane, options=AnimateOptions(frames=3, size=32), quiet=True)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "out")], env=environment, check=True, timeout=400)
    assert {path for path in (tmp_path / "cache").rglob("*.o")} == there
