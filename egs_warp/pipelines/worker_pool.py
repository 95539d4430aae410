"""Tasks over processes that may die: each is begun again if its process was lost, and none that has ended is."""

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
"""A task whose process was lost as often has failed."""
ONE_THREAD: dict[str, str] = dict.fromkeys(
    ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS", THREADS], "1"
)
"""Environment of a worker: those beside it have the other cores."""
ProgressCallback = Callable[..., object]
"""What a task tells of itself as it goes on."""
TaskFunction = Callable[[Any, ProgressCallback], Any]
"""What is done with each task; like tasks and results it can be pickled. It goes to each worker once."""
_WINDOWS, _NEW_GROUP = sys.platform == "win32", 0x200
_BEGIN = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); import {0}; {0}.serve()"


@dataclass(frozen=True)
class TaskResult:
    """A task that is over."""

    number: int
    """From 0, in the order in which tasks were given."""
    value: Any
    """What the work returned; None where there is an error."""
    error: str | None
    """Why there is no value, in a line."""
    attempts: int
    """How often it was begun: more than once where a worker was lost."""


@dataclass(frozen=True)
class Event:
    """What a worker says."""

    worker: int
    kind: str
    """``told``, ``done``, ``failed`` or ``lost``."""
    value: Any = None
    """What was told, the result, or a line."""


class WorkerPool(Protocol):
    """Workers, by number; each has one task at a time."""

    size: int

    def begin(self, worker: int, task: Any) -> None:
        """Give a free worker a task; a worker that is not there, or was lost, is started."""
        ...

    def wait(self) -> Sequence[Event]:
        """What workers have to say, as soon as one has."""
        ...

    def close(self) -> None:
        """End all workers, whatever they do."""
        ...


def ended_tasks(crew: WorkerPool, tasks: Sequence[Any], told: Callable[..., object]) -> Iterator[TaskResult]:
    """Each of the ``tasks`` as it ends, in whatever order. ``told`` gets the number of a task and what it tells."""
    waiting, runs = deque(range(len(tasks))), [0] * len(tasks)
    busy: dict[int, int] = {}
    with closing(crew):
        while waiting or busy:
            for worker in range(crew.size):
                if waiting and worker not in busy:
                    number = busy[worker] = waiting.popleft()
                    runs[number] += 1
                    crew.begin(worker, tasks[number])
            for event in crew.wait():
                number = busy[event.worker]
                if event.kind == "told":
                    told(number, *event.value)
                    continue
                del busy[event.worker]
                if event.kind == "lost" and runs[number] < MAX_ATTEMPTS:
                    # Before all that have not been begun.
                    waiting.appendleft(number)
                elif event.kind == "lost":
                    often = f"its worker was lost {MAX_ATTEMPTS} times, at last: {event.value}"
                    yield TaskResult(number, None, often, runs[number])
                else:
                    good = event.kind == "done"
                    yield TaskResult(number, *((event.value, None) if good else (None, event.value)), runs[number])


def attempt(work: TaskFunction, task: Any, tell: ProgressCallback) -> bytes:
    """Pickled: ``done`` and the result, or ``failed`` and a line."""
    kind, value = run_task(work, task, tell)
    try:
        return pickle.dumps((kind, value))
    except Exception as error:
        return pickle.dumps(("failed", f"what it returns cannot be sent: {error}"))


def run_task(work: TaskFunction, task: Any, tell: ProgressCallback) -> tuple[str, Any]:
    """``done`` and the result, or ``failed`` and a line."""
    try:
        return "done", work(task, tell)
    except UserError as error:
        return "failed", error.format_message()
    except Exception as error:
        line = " ".join(str(error).split())
        return "failed", f"{type(error).__name__}: {line}" if line else type(error).__name__


@dataclass(frozen=True)
class _Running:
    """A worker's process."""

    process: subprocess.Popen[bytes]
    messages: queue.SimpleQueue[bytes | None]
    """To be written to it; None is the last."""


class ProcessPool:
    """Workers on this machine, each a Python of its own on one thread.

    They hear of no Ctrl-C, and end with this process, however it ends.
    """

    def __init__(self, work: TaskFunction, size: int) -> None:
        self.size = size
        self._work = pickle.dumps(work)
        main = sys.modules["__main__"]
        # What a script itself defines is found in another process only by running the script as a module.
        self._script = getattr(main, "__file__", None) if b"__main__" in self._work else None
        self._running: dict[int, _Running] = {}
        self._events: queue.SimpleQueue[tuple[int, Event]] = queue.SimpleQueue()

    def begin(self, worker: int, task: Any) -> None:
        """See ``Crew``."""
        if worker not in self._running:
            self._start(worker)
        self._running[worker].messages.put(pickle.dumps(task))

    def wait(self) -> Sequence[Event]:
        """See ``Crew``."""
        while True:
            pid, event = self._events.get()
            running = self._running.get(event.worker)
            if running is not None and running.process.pid == pid:
                if event.kind == "lost":
                    self._end(self._running.pop(event.worker))
                return [event]

    def close(self) -> None:
        """See ``Crew``."""
        while self._running:
            self._end(self._running.popitem()[1])

    def _start(self, worker: int) -> None:
        process = subprocess.Popen(
            [sys.executable, "-c", _BEGIN.format(__name__)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **ONE_THREAD},
            # In a group of its own the terminal's Ctrl-C does not reach it.
            process_group=None if _WINDOWS else 0,
            creationflags=_NEW_GROUP if _WINDOWS else 0,
        )
        running = self._running[worker] = _Running(process, queue.SimpleQueue())
        for message in (pickle.dumps(sys.path), pickle.dumps(self._script), self._work):
            running.messages.put(message)
        for part in (self._listen, self._write):
            threading.Thread(target=part, args=(worker, running), daemon=True).start()

    def _write(self, _: int, running: _Running) -> None:
        """In a thread of its own: a worker that is still loading takes nothing yet."""
        stream = running.process.stdin
        assert stream is not None, "it was asked for"
        # One that has died is told by the end of its output.
        with contextlib.suppress(OSError), stream:
            while (message := running.messages.get()) is not None:
                stream.write(message)
                stream.flush()

    def _listen(self, worker: int, running: _Running) -> None:
        process = running.process
        assert process.stdout is not None, "it was asked for"
        # Its end, in the midst of a message or not; a message that cannot be read is no better.
        with contextlib.suppress(Exception), process.stdout:
            while True:
                kind, value = pickle.load(process.stdout)
                self._events.put((process.pid, Event(worker, kind, value)))
        process.kill()
        status = process.wait()
        how = f"it ended by signal {-status}" if status < 0 else f"it ended with status {status}"
        self._events.put((process.pid, Event(worker, "lost", how)))

    @staticmethod
    def _end(running: _Running) -> None:
        running.process.kill()
        running.process.wait()
        running.messages.put(None)


def serve() -> None:
    """The life of a worker of ``Processes``: messages come in by stdin and go out by what was stdout."""
    out = os.fdopen(os.dup(1), "wb")
    # Whatever else is printed goes where errors go, at once: a worker ends without a flush.
    os.dup2(2, 1)
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    script = pickle.load(sys.stdin.buffer)
    if script is not None:
        made = ModuleType("__mp_main__")
        made.__dict__.update(runpy.run_path(script, run_name="__mp_main__"))
        sys.modules["__main__"] = sys.modules["__mp_main__"] = made
    work = pickle.load(sys.stdin.buffer)
    tasks: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_take, args=(sys.stdin.buffer, tasks), daemon=True).start()

    def tell(*values: Any) -> None:
        _say(out, pickle.dumps(("told", values)))

    while True:
        _say(out, attempt(work, tasks.get(), tell))


def _take(stream: IO[bytes], tasks: queue.SimpleQueue[Any]) -> None:
    """Tasks as they come; the worker ends, whatever it does, when whoever gives them has ended."""
    with contextlib.suppress(EOFError, OSError, pickle.UnpicklingError):
        while True:
            tasks.put(pickle.load(stream))
    os._exit(0)


def _say(out: IO[bytes], message: bytes) -> None:
    out.write(message)
    out.flush()
