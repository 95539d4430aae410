"""Work for processes that may die."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_info

from egs_warp.errors import ArgumentError
from egs_warp.launching import available_threads
from egs_warp.pipelines.worker_pool import ProgressCallback


def square(task: int, tell: ProgressCallback) -> int:
    """Told on the way; refuses 3, cannot send what it makes of 4."""
    tell(task, 2 * task)
    if task == 3:
        raise ArgumentError("task", "give another", value=3)
    if task == 4:
        return lambda: 4  # pyright: ignore[reportReturnType]
    if task == 5:
        raise ZeroDivisionError("five\nlines")
    return task * task


class Dying:
    """Kills its process when it is given a task, each as often as that says; writes down each time that it begins."""

    def __init__(self, folder: Path, deaths: dict[int, int]) -> None:
        self.folder, self.deaths = folder, deaths

    def __call__(self, task: int, tell: ProgressCallback) -> int:
        with (self.folder / f"{task}").open("a") as file:
            file.write("x")
        if len((self.folder / f"{task}").read_text()) <= self.deaths.get(task, 0):
            os.kill(os.getpid(), signal.SIGKILL)
        return task


def threads(task: Any, tell: ProgressCallback) -> dict[str, Any]:
    """How many threads a worker has."""
    import numpy

    # That it is loaded is what counts.
    assert numpy is not None
    blas = [info["num_threads"] for info in threadpool_info() if info["user_api"] == "blas"]
    return {"blas": blas, "available": available_threads(), "process": os.getpid()}


def sleeping(folder: str, tell: ProgressCallback) -> None:
    """Writes its process's number down, then sleeps for minutes."""
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(300)


def half(whole: float, by: float) -> dict[str, float]:
    """A benchmark's row."""
    return {"share": whole / by}
