"""Tasks in worker processes, and on Ray if it is installed: lost tasks are repeated, finished ones are not."""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from egs_warp.errors import UserError
from egs_warp.installation import install_command
from egs_warp.pipelines.many import map_tasks
from egs_warp.pipelines.worker_pool import TaskResult
from tests.support import tasks

ROOT = Path(__file__).parents[2]
NO_RAY = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed (the extra ray)")
AT_LAST = "its worker was lost 3 times, finally: it ended by signal 9"


@pytest.fixture(scope="module")
def ray_here() -> Any:
    """Start a local Ray instance without a dashboard for all tests of this file."""
    ray = pytest.importorskip("ray")
    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield ray
    ray.shutdown()


@pytest.fixture(params=[2, pytest.param("ray", marks=NO_RAY)], ids=str)
def workers(request: pytest.FixtureRequest) -> int | str:
    """Return the argument ``workers`` for two processes and for Ray in turn."""
    if request.param == "ray":
        request.getfixturevalue("ray_here")
    return request.param


def in_order(ended: list[TaskResult]) -> list[TaskResult]:
    return sorted(ended, key=lambda one: one.number)


def test_each_task_ends_once_and_an_error_is_its_own(workers: int | str) -> None:
    told: list[tuple[int, ...]] = []
    given = [0, 1, 2, 3, 4, 5, 6, 7]
    ended = in_order(
        list(map_tasks(tasks.square, given, workers=workers, progress=lambda *values: told.append(values)))
    )
    assert [one.number for one in ended] == given and {one.attempts for one in ended} == {1}
    assert [one.value for one in ended] == [0, 1, 4, None, None, None, 36, 49]
    errors = [one.error for one in ended]
    assert errors[:3] == [None] * 3 and errors[6:] == [None] * 2
    assert errors[3] == "task 3: give another" and errors[5] == "ZeroDivisionError: five lines"
    assert errors[4] is not None and errors[4].startswith("its result cannot be sent: ")
    # The exact list is expected only from processes, because Ray is polled only from time to time.
    if workers == 2:
        assert sorted(told) == [(number, number, 2 * number) for number in given]


def test_lost_tasks_are_run_again_and_finished_ones_are_not(workers: int | str, tmp_path: Path) -> None:
    """Task 1 kills its worker once, task 3 twice, and task 4 in each attempt; no other task is repeated or lost."""
    work = tasks.Dying(tmp_path, {1: 1, 3: 2, 4: 99})
    ended = in_order(list(map_tasks(work, range(7), workers=workers)))
    assert [one.attempts for one in ended] == [1, 2, 1, 3, 3, 1, 1]
    assert [len((tmp_path / str(number)).read_text()) for number in range(7)] == [one.attempts for one in ended]
    assert [one.value for one in ended] == [0, 1, 2, 3, None, 5, 6]
    lost = ended[4].error
    assert lost is not None and lost.startswith("its worker was lost 3 times, finally: ") and "\n" not in lost
    assert workers == "ray" or lost == AT_LAST


def test_a_worker_has_one_thread_and_is_reused(workers: int | str) -> None:
    seen = [one.value for one in map_tasks(tasks.threads, range(6), workers=workers)]
    assert all(one["available"] == 1 and set(one["blas"]) == {1} for one in seen), seen
    used = {one["process"] for one in seen}
    assert 1 <= len(used) <= 2 and os.getpid() not in used


def test_nothing_to_do_starts_nothing() -> None:
    assert list(map_tasks(tasks.square, [], workers="nowhere")) == []


@pytest.mark.parametrize(
    ("workers", "line"),
    [
        (0, "workers 0: give a number of processes, at least 1"),
        ("nowhere", "workers nowhere: give a number of processes, ray, or a Ray cluster's address"),
    ],
)
def test_workers_that_cannot_be_had(workers: int | str, line: str) -> None:
    with pytest.raises(UserError, match=f"^{line}$"):
        list(map_tasks(tasks.square, [1], workers=workers))


def test_a_missing_ray_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=rf"^workers ray: Ray is not installed; {re.escape(install_command('ray'))}$"):
        list(map_tasks(tasks.square, [1], workers="ray"))


def started(body: str, *arguments: str) -> subprocess.Popen[str]:
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r})\n" + textwrap.dedent(body)
    command = [sys.executable, "-c", code, *arguments]
    # The program gets its own process group, so that the test can send Ctrl-C to the whole group, as a terminal does,
    # without ending itself.
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)


def until(true: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it has taken too long"
        time.sleep(0.05)


def lives(process: int) -> bool:
    try:
        # A zombie has ended; only its parent has not read its status yet.
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


SLEEPERS = """
    from egs_warp.commands.exit_handling import one_line_errors
    from egs_warp.pipelines.many import map_tasks
    from tests.support.tasks import sleeping
    with one_line_errors("prog"):
        list(map_tasks(sleeping, [sys.argv[1]] * 2, workers=2 if sys.argv[2] == "2" else "ray"))
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.slow)])
@pytest.mark.parametrize("crew", ["2", pytest.param("ray", marks=[NO_RAY, pytest.mark.slow])])
def test_no_worker_outlives_the_program(number: signal.Signals, crew: str, tmp_path: Path) -> None:
    """Ctrl-C, which a terminal sends to the whole process group, prints one line. No worker is left, even if the
    program is killed."""
    program = started(SLEEPERS, str(tmp_path), crew)
    try:
        until(lambda: len(list(tmp_path.iterdir())) == 2)
        workers = [int(path.name) for path in tmp_path.iterdir()]
        assert all(lives(worker) for worker in workers)
        os.killpg(program.pid, number) if number == signal.SIGINT else program.kill()
        _, said = program.communicate(timeout=60)
        until(lambda: not any(lives(worker) for worker in workers))
    finally:
        program.kill()
    if number == signal.SIGINT:
        assert said == "prog: stopped; finished files are complete, unfinished ones are removed\n"
        assert program.returncode == 130


@pytest.mark.slow
def test_functions_of_a_script_are_found_in_workers(tmp_path: Path) -> None:
    script = tmp_path / "cubes.py"
    script.write_text(
        textwrap.dedent(
            """
            from egs_warp.pipelines.many import map_tasks

            def cube(task, tell):
                print("heard")
                return task**3

            if __name__ == "__main__":
                print(sorted(one.value for one in map_tasks(cube, [1, 2, 3], workers=2)))
            """
        )
    )
    # The variable for unbuffered output, which some machines set, is removed, because without a buffer no output could
    # be lost.
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": ""}
    run = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, env=environment, timeout=120)
    assert run.stdout == "[1, 8, 27]\n" and run.stderr.count("heard") == 3, run.stderr


@NO_RAY
def test_a_ray_that_was_started_for_the_time_ends_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    import ray

    if ray.is_initialized():
        ray.shutdown()
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    assert [one.value for one in map_tasks(tasks.square, [6], workers="ray")] == [36]
    assert not ray.is_initialized()
