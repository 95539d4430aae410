"""Programs that are stopped in any way: they print one line, have a defined exit status and leave no half-written
file."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from egs_warp.commands.exit_handling import HandledExit, one_line_errors
from egs_warp.errors import UserError
from egs_warp.io import atomic_write


def program(body: str) -> list[str]:
    code = "import os, signal, sys, threading, time\nfrom egs_warp.commands.exit_handling import one_line_errors\n"
    code += "with one_line_errors('prog'):\n" + textwrap.indent(textwrap.dedent(body), "    ")
    return [sys.executable, "-c", code]


def ended(body: str) -> tuple[int, str]:
    done = subprocess.run(program(body), capture_output=True, text=True, timeout=60)
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (UserError("bad"), 2, "prog: bad\n"),
        (KeyboardInterrupt(), 130, "prog: stopped; finished files are complete, unfinished ones are removed\n"),
        (MemoryError(), 1, "prog: not enough memory; give a smaller capture, picture or number of Gaussians\n"),
        (
            OSError(errno.ENOSPC, "No space left on device", "out/a.ply"),
            1,
            "prog: out/a.ply: No space left on device; free some space, or choose another folder\n",
        ),
        (
            PermissionError(errno.EACCES, "Permission denied", "out/a.ply"),
            2,
            "prog: out/a.ply: Permission denied; free some space, or choose another folder\n",
        ),
    ],
)
def test_each_end_is_one_line(error: BaseException, status: int, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(HandledExit) as end, one_line_errors("prog"):
        raise error
    assert end.value.code == status and capsys.readouterr().err == line


@pytest.mark.parametrize(
    ("number", "status"),
    [(errno.ENOSPC, 1), (errno.EDQUOT, 1), (errno.EIO, 1), (errno.EACCES, 2), (errno.EROFS, 2), (errno.ENOTDIR, 2)],
)
def test_a_file_that_cannot_be_written(
    number: int, status: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A full or broken disk does not count as invalid input (status 1); a folder without write access does (status
    2)."""
    reason = os.strerror(number)
    with pytest.raises(HandledExit) as end, one_line_errors("prog"), atomic_write(tmp_path / "a.json"):
        raise OSError(number, reason)
    said = f"prog: {tmp_path / 'a.json'}: cannot be written ({reason}); choose another path\n"
    assert end.value.code == status and capsys.readouterr().err == said


def test_errors_of_our_own_keep_their_traceback() -> None:
    for error in (ZeroDivisionError(), FileNotFoundError(errno.ENOENT, "gone", "x")):
        with pytest.raises(type(error)), one_line_errors("prog"):
            raise error


@pytest.mark.parametrize(
    ("number", "status", "line"), [(signal.SIGINT, 130, "stopped"), (signal.SIGTERM, 143, "terminated by")]
)
def test_signals_unwind(number: signal.Signals, status: int, line: str, tmp_path: Path) -> None:
    body = f"""
        from egs_warp.io.atomic import atomic_write
        with atomic_write({str(tmp_path / "a.json")!r}) as temporary:
            temporary.write_text("half")
            os.kill(os.getpid(), {int(number)})
            time.sleep(10)
    """
    code, said = ended(body)
    assert code == status and said.startswith(f"prog: {line}") and said.count("\n") == 1
    assert os.listdir(tmp_path) == []


def test_an_interrupt_swallowed_by_a_destructor_still_ends_the_program() -> None:
    body = """
        class Thing:
            def __del__(self):
                raise KeyboardInterrupt
        thing = Thing()
        del thing
        time.sleep(10)
    """
    code, said = ended(body)
    assert code == 130 and said == "prog: stopped; finished files are complete, unfinished ones are removed\n"


def test_a_second_interrupt_ends_at_once() -> None:
    body = """
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        finally:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
    """
    assert ended(body) == (130, "")


def test_a_closed_pipe_only_silences() -> None:
    body = """
        for _ in range(20000):
            print("x" * 50)
            print("y" * 50, file=sys.stderr)
        open(sys.argv[1], "w").write("done") if len(sys.argv) > 1 else None
    """
    run = subprocess.Popen(program(body), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert run.stdout is not None and run.stderr is not None
    run.stdout.read(10)
    run.stdout.close()
    run.stderr.close()
    assert run.wait(60) == 0


def told_by(command: str, *, encoding: str = "utf-8") -> tuple[int, str, str]:
    """Run a shell command in which ``egs-warp`` stands for the program; return the exit status, the output and the
    errors."""
    line = command.replace("egs-warp", f"{sys.executable} -m egs_warp.cli")
    # Output is buffered, because without a buffer, as some machines set it, each write would report its error at once.
    environment = os.environ | {"PYTHONIOENCODING": encoding, "PYTHONUNBUFFERED": ""}
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, env=environment, timeout=120)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(
    ("command", "status"),
    [
        pytest.param("egs-warp doctor >&-", 0, marks=pytest.mark.slow),
        ("egs-warp doctor <&- >&- 2>&-", 0),
        pytest.param("egs-warp animate none.ply --out never 2>&-", 2, marks=pytest.mark.slow),
        ("egs-warp animate none.ply --out never 2>/dev/full", 2),
        ("egs-warp doctor >/dev/full", 1),
    ],
)
def test_closed_outputs_do_not_change_the_status(command: str, status: int) -> None:
    """If the output is closed or full, the exit status is 1, but only for commands whose result is their output."""
    ended, _, said = told_by(command)
    assert ended == status and "Traceback" not in said and said.count("\n") <= 1


def test_files_do_not_get_the_numbers_of_closed_streams() -> None:
    """If a file had the descriptor of a closed standard stream, output of libraries would be written into the file."""
    code = "from egs_warp.commands.exit_handling import one_line_errors\nwith one_line_errors('prog'):\n"
    code += " import os, tempfile\n with tempfile.TemporaryFile() as file: os._exit(file.fileno())"
    assert told_by(f'{sys.executable} -c "$(cat <<"END"\n{code}\nEND\n)" <&- >&- 2>&-')[0] > 2


def test_characters_outside_the_terminal_encoding(tmp_path: Path) -> None:
    """Characters of a folder name that the terminal cannot encode are printed escaped, after all files are written."""
    status, said, error = told_by(f"egs-warp samples --out '{tmp_path}/é'", encoding="ascii")
    assert status == 0 and "\\xe9" in said and error == ""


def test_wrong_flags_are_reported_quickly() -> None:
    """No heavy package is imported for a wrong flag or the version."""
    code = "import sys\nfrom egs_warp.cli import main\ntry:\n main(sys.argv[1:])\nexcept SystemExit as end:\n"
    code += " print(end.code, *sorted({'warp', 'numpy', 'scipy', 'torch', 'cv2'} & set(sys.modules)))"
    for flags, said in (
        (["--version"], "egs-warp 0.1.0\n0\n"),
        (["animate", "--wrong"], "2\n"),
        (["train", "--help"], "0\n"),
    ):
        done = subprocess.run([sys.executable, "-c", code, *flags], capture_output=True, text=True, check=True)
        assert done.stdout.endswith(said)


def test_an_unwritable_kernel_cache_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    run = [sys.executable, "-m", "egs_warp.cli", "animate", str(tmp_path / "file"), "--out", str(tmp_path / "out")]
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "file" / "cache")}
    done = subprocess.run(run, capture_output=True, text=True, env=environment)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "cache: cannot be created (Not a directory); set WARP_CACHE_PATH to a writable folder" in done.stderr


def test_a_machine_without_a_gpu_is_not_warned(tmp_path: Path) -> None:
    """The file is empty, which is found after Warp has started."""
    (tmp_path / "none.ply").write_text("")
    run = [sys.executable, "-m", "egs_warp.cli", "animate", "none.ply", "--up", "z", "--out", "never"]
    done = subprocess.run(run, capture_output=True, text=True, cwd=tmp_path)
    assert done.stderr.startswith("egs-warp: none.ply: ") and done.stderr.count("\n") == 1


def test_ctrl_c_converted_by_a_library_is_recognised() -> None:
    """SciPy's HiGHS raises "ImportError: initialization failed" if it is interrupted while it is imported."""
    body = """
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        except KeyboardInterrupt as error:
            raise ImportError("initialization failed") from error
    """
    assert ended(body) == (130, "prog: stopped; finished files are complete, unfinished ones are removed\n")


def test_an_error_after_a_handled_ctrl_c_is_reported() -> None:
    """An example of such an error is a take that cannot be saved after Ctrl-C has ended the live page."""
    body = """
        from egs_warp.errors import UserError
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        except KeyboardInterrupt:
            pass
        raise UserError("take.npz: cannot be written")
    """
    assert ended(body) == (2, "prog: take.npz: cannot be written\n")


@pytest.mark.parametrize(
    "after", [0.05, 0.8, *(pytest.param(after, marks=pytest.mark.slow) for after in (0.3, 1.5, 2.5, 4.0))]
)
def test_ctrl_c_in_any_phase_is_one_line(after: float, tmp_path: Path) -> None:
    """Ctrl-C during imports, preparation, simulation or video of a short run leaves neither a traceback nor a
    half-written file."""
    code = """
        import numpy as np
        import egs_warp as egs
        pawn = egs.scene("pawn", device="cpu")
        options = egs.AnimateOptions(frames=61, size=64)
        egs.animate(pawn.object, sys.argv[1], plane=pawn.plane, options=options, quiet=True)
    """
    out = tmp_path / "out"
    run = subprocess.Popen([*program(code), str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    # Python needs some time before it executes the program.
    time.sleep(0.5 + after)
    run.send_signal(signal.SIGINT)
    said = run.communicate(timeout=60)[1]
    if run.returncode != 0:
        assert run.returncode == 130
        lines = [line for line in said.splitlines() if not line.startswith("Warp")]
        assert lines == ["prog: stopped; finished files are complete, unfinished ones are removed"]
    if out.exists():
        assert not [name for name in os.listdir(out) if name.startswith(".egs-")]
