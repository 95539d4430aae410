"""Threads that help: small work, many times a second, that nobody is stuck with who is interrupted."""

from __future__ import annotations

import atexit
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

T = TypeVar("T")
_PATIENCE = 10.0
"""Seconds that the end of the process waits for what a helper is at."""


class Task(Generic[T]):
    """Work for whoever comes first: a helper that is free, or who wants its result."""

    def __init__(self, work: Callable[[], T]) -> None:
        self._work = work
        # Plain locks: Ctrl-C, which may come between any two lines of Python, can leave one of this task taken, for
        # which nobody waits any more, but none that a helper needs for the next.
        self._claim, self._over = threading.Lock(), threading.Lock()
        self._over.acquire()
        self._result: Any = None
        self._error: BaseException | None = None

    def run_once(self) -> None:
        """The work, unless somebody is or was at it."""
        if not self._claim.acquire(blocking=False):
            return
        try:
            self._result = self._work()
        except BaseException as error:
            self._error = error
        finally:
            self._over.release()

    def wait(self) -> None:
        """Nobody is at the work when this returns, nor will be."""
        if self._claim.acquire(blocking=False):
            self._over.release()
        else:
            with self._over:
                pass

    def result(self) -> T:
        """Of the work, done here if no helper has begun it; raises what it raised; None if it was settled before."""
        self.run_once()
        self.wait()
        if self._error is not None:
            raise self._error
        return self._result


class WorkerThreads:
    """At most ``most`` threads, one more begun with each of the first tasks.

    Not ``ThreadPoolExecutor``: a KeyboardInterrupt within its ``submit`` can leave a lock taken for which its threads
    wait, and the end of the process for them.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        # Made of no Python that could be interrupted half-way.
        self._tasks: SimpleQueue[Task[Any] | None] = SimpleQueue()
        self._threads: list[threading.Thread] = []

    def begin(self, work: Callable[[], T]) -> Task[T]:
        """``work`` for a helper to do."""
        task = Task(work)
        if len(self._threads) < self._most:
            thread = threading.Thread(target=self._help, name="helper", daemon=True)
            # Where there can be no more of them, who wants the result does the work.
            with suppress(RuntimeError):
                thread.start()
                self._threads.append(thread)
        self._tasks.put(task)
        return task

    def end(self) -> None:
        """Helpers stop after what they are at."""
        for _ in self._threads:
            self._tasks.put(None)
        latest = time.monotonic() + _PATIENCE
        for thread in self._threads:
            thread.join(max(latest - time.monotonic(), 0.0))

    def _help(self) -> None:
        while task := self._tasks.get():
            task.run_once()
            # Held while it waits for the next, the memory of the last would be.
            del task


@cache
def worker_threads() -> WorkerThreads:
    """Of this process: one for each core but one, and one at least."""
    made = WorkerThreads(max(1, (os.cpu_count() or 1) - 1))
    # Compiled code must not be taken away from under a helper.
    atexit.register(made.end)
    return made


if hasattr(os, "register_at_fork"):
    # Threads are not forked.
    os.register_at_fork(after_in_child=worker_threads.cache_clear)
