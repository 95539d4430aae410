"""Tasks for worker processes that may be killed."""

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


def square(task: int, progress: ProgressCallback) -> int:
    """Report progress and return the square. Tasks 3 and 5 raise an error, and task 4 returns an object that cannot be
    pickled."""
    progress(task, 2 * task)
    if task == 3:
        raise ArgumentError("task", "give another", value=3)
    if task == 4:
        return lambda: 4  # pyright: ignore[reportReturnType]
    if task == 5:
        raise ZeroDivisionError("five\nlines")
    return task * task


class Dying:
    """Task that kills its process in the first ``deaths[task]`` attempts and records each attempt in a file."""

    def __init__(self, folder: Path, deaths: dict[int, int]) -> None:
        self.folder, self.deaths = folder, deaths

    def __call__(self, task: int, progress: ProgressCallback) -> int:
        with (self.folder / f"{task}").open("a") as file:
            file.write("x")
        if len((self.folder / f"{task}").read_text()) <= self.deaths.get(task, 0):
            os.kill(os.getpid(), signal.SIGKILL)
        return task


def threads(task: Any, progress: ProgressCallback) -> dict[str, Any]:
    """Return the numbers of threads that a worker uses."""
    import numpy

    # NumPy is imported only in order to load BLAS.
    assert numpy is not None
    blas = [info["num_threads"] for info in threadpool_info() if info["user_api"] == "blas"]
    return {"blas": blas, "available": available_threads(), "process": os.getpid()}


def sleeping(folder: str, progress: ProgressCallback) -> None:
    """Record the process id, then sleep for minutes."""
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(300)


def half(whole: float, by: float) -> dict[str, float]:
    """Return a row of a benchmark, which contains the quotient of the arguments."""
    return {"share": whole / by}
