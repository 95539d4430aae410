"""Worker threads, which execute each task once; Ctrl-C at any time ends the process."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time

import pytest

from egs_warp.worker_threads import Task, WorkerThreads, run_all, worker_threads

BUSY = """
import sys, time
from egs_warp.worker_threads import worker_threads
began = time.monotonic()
print("ready", flush=True)
while time.monotonic() < began + 60.0:
    worker_threads().begin(lambda: sum(range(300))).result()
"""


def test_each_task_is_done_once() -> None:
    """A worker or the caller executes each task once, even with more tasks than threads; the number of threads stays
    within its limit."""
    many, done = WorkerThreads(2), []
    before = threading.active_count()
    tasks = [many.begin(lambda number=number: done.append(number) or number) for number in range(300)]
    assert [task.result() for task in tasks] == list(range(300))
    assert sorted(done) == list(range(300))
    assert threading.active_count() <= before + 2
    many.end()
    assert threading.active_count() == before


def test_all_results_are_in_order_and_nothing_runs_after_an_error() -> None:
    """After one task has failed, the caller may reuse the memory of all tasks, because the others have ended or never
    start."""
    assert run_all([lambda number=number: number**2 for number in range(100)]) == [n**2 for n in range(100)]
    running, done = threading.Event(), []

    def slow() -> None:
        running.set()
        time.sleep(0.05)
        done.append(1)

    def failing() -> None:
        running.wait(10.0)
        raise ValueError("one task fails")

    with pytest.raises(ValueError, match="one task fails"):
        run_all([slow, failing, slow])
    ended = len(done)
    time.sleep(0.2)
    assert ended == len(done) >= 1


def test_tasks_run_concurrently() -> None:
    """Two tasks wait for each other, so they would time out if they were executed in sequence."""
    first, second = threading.Event(), threading.Event()

    def work() -> bool:
        first.set()
        return second.wait(10.0)

    some = WorkerThreads(1)
    task = some.begin(work)
    assert first.wait(10.0)
    second.set()
    assert task.result() and task.result()
    some.end()


def test_a_helper_that_is_busy_is_not_waited_for() -> None:
    go, begun = threading.Event(), threading.Event()

    def long() -> bool:
        begun.set()
        return go.wait(10.0)

    one = WorkerThreads(1)
    busy = one.begin(long)
    assert begun.wait(10.0)
    assert one.begin(threading.get_ident).result() == threading.get_ident()
    go.set()
    assert busy.result()
    one.end()


def test_a_cancelled_task_never_runs() -> None:
    done: list[int] = []
    task = Task(lambda: done.append(1))
    task.wait()
    task.run_once()
    assert task.result() is None and done == []


def test_an_error_is_raised_by_result() -> None:
    """Only the caller of ``result`` gets the error; the worker thread continues."""
    one = WorkerThreads(1)
    for _ in range(3):
        begun = threading.Event()

        def fails(begun: threading.Event = begun) -> None:
            begun.set()
            raise ValueError("over")

        task = one.begin(fails)
        assert begun.wait(10.0)
        with pytest.raises(ValueError, match="over"):
            task.result()
    one.end()


def test_each_of_the_first_tasks_has_a_thread() -> None:
    """A task starts even if previous ones, fewer than the maximum number of threads, are still running."""
    go, begun = threading.Event(), [threading.Event(), threading.Event()]

    def long(number: int) -> bool:
        begun[number].set()
        return go.wait(10.0)

    two = WorkerThreads(2)
    tasks = [two.begin(lambda number=number: long(number)) for number in range(2)]
    assert all(event.wait(10.0) for event in begun)
    go.set()
    assert all(task.result() for task in tasks)
    two.end()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_a_forked_process_has_helpers_of_its_own() -> None:
    assert worker_threads().begin(lambda: 3).result() == 3
    child = os.fork()
    if child == 0:
        helped = False
        try:
            seen = threading.Event()
            worker_threads().begin(seen.set)
            helped = seen.wait(10.0)
        finally:
            os._exit(0 if helped else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.slow
def test_ctrl_c_at_any_moment_ends_the_process() -> None:
    """Each of 200 processes ends after Ctrl-C at a random time; with ``ThreadPoolExecutor``, some of them would not."""
    moments = random.Random(7)
    for _ in range(200):
        run = subprocess.Popen([sys.executable, "-c", BUSY], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert run.stdout is not None and run.stdout.readline() == "ready\n"
        time.sleep(0.02 * moments.random())
        run.send_signal(signal.SIGINT)
        _, said = run.communicate(timeout=30.0)
        assert said.splitlines()[-1] == "KeyboardInterrupt"
