"""The most memory that this process has held (Linux).

Not ``ru_maxrss``, which a child begins with that of the process that started it: beside a large one it never grows.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

_IMPORTS = ("numpy", "warp", "cv2", "PIL.Image", "PIL.WebPImagePlugin", "PIL.PngImagePlugin", "egs_warp.io")
"""What no reader is charged for."""
_PATIENCE = 60.0


def reset_peak() -> None:
    """From now on the peak is that of what is held now and later."""
    Path("/proc/self/clear_refs").write_text("5")


def peak_bytes() -> int:
    """Of resident memory."""
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:")]
    return 1024 * int(line.split()[1])


def megabytes_of(read: Callable[..., Any], *arguments: Any) -> float:
    """Memory that ``read(*arguments)`` takes at most beyond its imports, in a process of its own.

    ``read`` is a function of a module; one that raises ``UserError`` counts as well.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*_IMPORTS, __name__])
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_measured, args=(there, read, arguments))
    process.start()
    there.close()
    assert here.poll(_PATIENCE), f"{read} has not ended after {_PATIENCE:g} s"
    taken = here.recv()
    process.join()
    return taken


def _measured(answer: Connection, read: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    import warp as wp

    from egs_warp.errors import UserError

    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    reset_peak()
    before = peak_bytes()
    try:
        kept = read(*arguments)
    except UserError as error:
        kept = error
    answer.send((peak_bytes() - before) / 2**20)
    del kept
