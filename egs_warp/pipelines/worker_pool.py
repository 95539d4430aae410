"""Pool of worker processes with retry: a task whose process is lost is run again."""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import runpy
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from types import ModuleType
from typing import IO, Any, Protocol

from egs_warp.errors import UserError
from egs_warp.launching import THREADS

MAX_ATTEMPTS = 3
"""Maximum number of attempts: a task that has lost its process this many times fails."""
ONE_THREAD: dict[str, str] = dict.fromkeys(
    ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS", THREADS], "1"
)
"""Environment variables of a worker, which make it use one core."""
ProgressCallback = Callable[..., object]
"""Function that a task calls to report its progress."""
TaskFunction = Callable[[Any, ProgressCallback], Any]
"""Function that runs a task; like tasks and results, it must be picklable. It is sent to each worker once."""
_WINDOWS, _NEW_GROUP = sys.platform == "win32", 0x200
_BEGIN = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); import {0}; {0}.serve()"


@dataclass(frozen=True)
class TaskResult:
    """Result of a task."""

    number: int
    """Index of the task, from 0."""
    value: Any
    """Return value of the task function; None if the task failed."""
    error: str | None
    """Reason for a failure in one line; None if there is a value."""
    attempts: int
    """Number of attempts: more than one if a worker was lost."""


@dataclass(frozen=True)
class Event:
    """Message from a worker."""

    worker: int
    """Number of the worker."""
    kind: str
    """Kind of the message: ``progress``, ``done``, ``failed`` or ``lost``."""
    value: Any = None
    """Values of a progress report, the result, or the reason for a failure in one line."""


class WorkerPool(Protocol):
    """Pool of numbered workers; each worker runs one task at a time."""

    size: int
    """Number of workers."""

    def begin(self, worker: int, task: Any) -> None:
        """Assign a task to an idle worker; a worker that does not exist or was lost is started."""
        ...

    def wait(self) -> Sequence[Event]:
        """Block until a worker has sent a message; return the messages."""
        ...

    def close(self) -> None:
        """Terminate all workers, even busy ones."""
        ...


def ended_tasks(pool: WorkerPool, tasks: Sequence[Any], progress: Callable[..., object]) -> Iterator[TaskResult]:
    """Run ``tasks`` on ``pool`` and yield each result as soon as it is available.

    ``progress`` is called with the index of a task and the values that it reports.
    """
    waiting, runs = deque(range(len(tasks))), [0] * len(tasks)
    busy: dict[int, int] = {}
    with closing(pool):
        while waiting or busy:
            for worker in range(pool.size):
                if waiting and worker not in busy:
                    number = busy[worker] = waiting.popleft()
                    runs[number] += 1
                    pool.begin(worker, tasks[number])
            for event in pool.wait():
                number = busy[event.worker]
                if event.kind == "progress":
                    progress(number, *event.value)
                    continue
                del busy[event.worker]
                if event.kind == "lost" and runs[number] < MAX_ATTEMPTS:
                    # Retry this task before those that have not been started yet.
                    waiting.appendleft(number)
                elif event.kind == "lost":
                    reason = f"its worker was lost {MAX_ATTEMPTS} times, finally: {event.value}"
                    yield TaskResult(number, None, reason, runs[number])
                else:
                    is_done = event.kind == "done"
                    yield TaskResult(number, *((event.value, None) if is_done else (None, event.value)), runs[number])


def attempt(work: TaskFunction, task: Any, progress: ProgressCallback) -> bytes:
    """Run a task and return a pickled pair: ``done`` and the result, or ``failed`` and the reason in one line."""
    kind, value = run_task(work, task, progress)
    try:
        return pickle.dumps((kind, value))
    except Exception as error:
        return pickle.dumps(("failed", f"its result cannot be sent: {error}"))


def run_task(work: TaskFunction, task: Any, progress: ProgressCallback) -> tuple[str, Any]:
    """Run a task and return ``done`` and the result, or ``failed`` and the reason in one line."""
    try:
        return "done", work(task, progress)
    except UserError as error:
        return "failed", error.format_message()
    except Exception as error:
        line = " ".join(str(error).split())
        return "failed", f"{type(error).__name__}: {line}" if line else type(error).__name__


@dataclass(frozen=True)
class _Running:
    """Process of a worker, and the queue of its tasks."""

    process: subprocess.Popen[bytes]
    messages: queue.SimpleQueue[bytes | None]
    """Pickled tasks to be sent to the process; None ends the queue."""


class ProcessPool:
    """Pool of Python processes on this machine, one thread each.

    The processes do not receive Ctrl-C, and they end when this process ends, even if it is killed.
    """

    def __init__(self, work: TaskFunction, size: int) -> None:
        self.size = size
        self._work = pickle.dumps(work)
        main = sys.modules["__main__"]
        # A worker can unpickle a function of the main script only after it has executed that script as a module.
        self._script = getattr(main, "__file__", None) if b"__main__" in self._work else None
        self._running: dict[int, _Running] = {}
        self._events: queue.SimpleQueue[tuple[int, Event]] = queue.SimpleQueue()

    def begin(self, worker: int, task: Any) -> None:
        """Assign a task to an idle worker; a worker that does not exist or was lost is started."""
        if worker not in self._running:
            self._start(worker)
        self._running[worker].messages.put(pickle.dumps(task))

    def wait(self) -> Sequence[Event]:
        """Block until a worker has sent a message; return the message."""
        while True:
            pid, event = self._events.get()
            running = self._running.get(event.worker)
            if running is not None and running.process.pid == pid:
                if event.kind == "lost":
                    self._end(self._running.pop(event.worker))
                return [event]

    def close(self) -> None:
        """Terminate all workers, even busy ones."""
        while self._running:
            self._end(self._running.popitem()[1])

    def _start(self, worker: int) -> None:
        process = subprocess.Popen(
            [sys.executable, "-c", _BEGIN.format(__name__)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **ONE_THREAD},
            # A separate process group does not receive Ctrl-C from the terminal.
            process_group=None if _WINDOWS else 0,
            creationflags=_NEW_GROUP if _WINDOWS else 0,
        )
        running = self._running[worker] = _Running(process, queue.SimpleQueue())
        for message in (pickle.dumps(sys.path), pickle.dumps(self._script), self._work):
            running.messages.put(message)
        for part in (self._listen, self._write):
            threading.Thread(target=part, args=(worker, running), daemon=True).start()

    def _write(self, _: int, running: _Running) -> None:
        """Send messages from a separate thread, because a worker that is still loading does not read yet."""
        stream = running.process.stdin
        assert stream is not None, "stdin is a pipe"
        # Ignore errors while writing: a dead worker is detected by the end of its output.
        with contextlib.suppress(OSError), stream:
            while (message := running.messages.get()) is not None:
                stream.write(message)
                stream.flush()

    def _listen(self, worker: int, running: _Running) -> None:
        process = running.process
        assert process.stdout is not None, "stdout is a pipe"
        # The output may end within a message; an unreadable message is treated like the end of the output.
        with contextlib.suppress(Exception), process.stdout:
            while True:
                kind, value = pickle.load(process.stdout)
                self._events.put((process.pid, Event(worker, kind, value)))
        process.kill()
        status = process.wait()
        cause = f"it ended by signal {-status}" if status < 0 else f"it ended with status {status}"
        self._events.put((process.pid, Event(worker, "lost", cause)))

    @staticmethod
    def _end(running: _Running) -> None:
        running.process.kill()
        running.process.wait()
        running.messages.put(None)


def serve() -> None:
    """Run a worker of ``ProcessPool``: it receives messages on stdin and sends them on the original stdout."""
    out = os.fdopen(os.dup(1), "wb")
    # Redirect other output to stderr. It is line-buffered, because a worker is terminated without a flush.
    os.dup2(2, 1)
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    script = pickle.load(sys.stdin.buffer)
    if script is not None:
        main_module = ModuleType("__mp_main__")
        main_module.__dict__.update(runpy.run_path(script, run_name="__mp_main__"))
        sys.modules["__main__"] = sys.modules["__mp_main__"] = main_module
    work = pickle.load(sys.stdin.buffer)
    tasks: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_receive_tasks, args=(sys.stdin.buffer, tasks), daemon=True).start()

    def progress(*values: Any) -> None:
        _send(out, pickle.dumps(("progress", values)))

    while True:
        _send(out, attempt(work, tasks.get(), progress))


def _receive_tasks(stream: IO[bytes], tasks: queue.SimpleQueue[Any]) -> None:
    """Put received tasks into the queue; exit from this process when the sender has exited."""
    with contextlib.suppress(EOFError, OSError, pickle.UnpicklingError):
        while True:
            tasks.put(pickle.load(stream))
    os._exit(0)


def _send(out: IO[bytes], message: bytes) -> None:
    out.write(message)
    out.flush()
