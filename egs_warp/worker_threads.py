"""Worker threads for short, frequent tasks.

A KeyboardInterrupt in the caller cannot block the workers, because it leaves no lock acquired that they need for their
next tasks.
"""

from __future__ import annotations

import atexit
import os
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

T = TypeVar("T")
_MAX_EXIT_TIME = 10.0
"""Maximum time for which the process waits for running tasks when it exits, s."""


class Task(Generic[T]):
    """Task that is executed once: by an idle worker or, if none has started it, by the caller of ``result``."""

    def __init__(self, work: Callable[[], T]) -> None:
        self._work = work
        # Use plain locks: a KeyboardInterrupt between any two lines can leave a lock of this task acquired, but no
        # thread blocks on such a lock afterwards, and workers do not need it for other tasks.
        self._started, self._done = threading.Lock(), threading.Lock()
        self._done.acquire()
        self._result: Any = None
        self._error: BaseException | None = None

    def run_once(self) -> None:
        """Execute the work, unless another thread has started it."""
        if not self._started.acquire(blocking=False):
            return
        try:
            self._result = self._work()
        except BaseException as error:
            self._error = error
        finally:
            self._done.release()

    def wait(self) -> None:
        """Block until the work is done. Work that has not started is cancelled."""
        if self._started.acquire(blocking=False):
            self._done.release()
        else:
            with self._done:
                pass

    def result(self) -> T:
        """Return the result of the work, executed in this thread if no worker has started it.

        Returns None if ``wait`` has cancelled the work. Raises the exception that the work has raised.
        """
        self.run_once()
        self.wait()
        if self._error is not None:
            raise self._error
        return self._result


class WorkerThreads:
    """Pool of at most ``max_threads`` threads, which are started on demand.

    ``ThreadPoolExecutor`` is not used, because a KeyboardInterrupt within its ``submit`` can leave a lock acquired, on
    which its threads, and therefore the exit of the process, would block.
    """

    def __init__(self, max_threads: int) -> None:
        self._max_threads = max_threads
        # ``SimpleQueue`` is implemented in C, so an interrupt cannot leave it in an inconsistent state.
        self._tasks: SimpleQueue[Task[Any] | None] = SimpleQueue()
        self._threads: list[threading.Thread] = []

    def begin(self, work: Callable[[], T]) -> Task[T]:
        """Queue ``work`` and return its task."""
        task = Task(work)
        if len(self._threads) < self._max_threads:
            thread = threading.Thread(target=self._run, name="helper", daemon=True)
            # If no thread can be started, the caller of ``result`` executes the work.
            with suppress(RuntimeError):
                thread.start()
                self._threads.append(thread)
        self._tasks.put(task)
        return task

    def end(self) -> None:
        """Stop the workers after their current tasks, and wait for them for at most ``_MAX_EXIT_TIME``."""
        for _ in self._threads:
            self._tasks.put(None)
        deadline = time.monotonic() + _MAX_EXIT_TIME
        for thread in self._threads:
            thread.join(max(deadline - time.monotonic(), 0.0))

    def _run(self) -> None:
        while task := self._tasks.get():
            task.run_once()
            # Release the memory of the last task before blocking on the next one.
            del task


@cache
def worker_threads() -> WorkerThreads:
    """Return the worker threads of this process: one fewer than the cores of the machine, but at least one."""
    workers = WorkerThreads(max(1, (os.cpu_count() or 1) - 1))
    # End the workers before the process exits, because compiled code must not be unloaded while a worker runs it.
    atexit.register(workers.end)
    return workers


def run_all(tasks: Iterable[Callable[[], T]]) -> list[T]:
    """Execute the ``tasks`` in the worker threads and in this thread, and return their results in order."""
    started = [worker_threads().begin(task) for task in tasks]
    try:
        return [task.result() for task in started]
    finally:
        # Wait for all tasks, because after an error the caller may reuse their memory.
        for task in started:
            task.wait()


if hasattr(os, "register_at_fork"):
    # A forked process has none of its parent's threads.
    os.register_at_fork(after_in_child=worker_threads.cache_clear)
