"""Peak memory of this process on Linux.

``ru_maxrss`` is not used, because a child process starts with its parent's value, which exceeds the child's own peak if
the parent is large.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

_IMPORTS = ("numpy", "warp", "cv2", "PIL.Image", "PIL.WebPImagePlugin", "PIL.PngImagePlugin", "egs_warp.io")
"""Modules that are imported before the measurement, so that their memory is not counted."""
_MAX_SECONDS = 60.0


def reset_peak() -> None:
    """Reset the peak to the memory that is in use."""
    Path("/proc/self/clear_refs").write_text("5")


def peak_bytes() -> int:
    """Return the peak of the resident memory in bytes."""
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:")]
    return 1024 * int(line.split()[1])


def megabytes_of(read: Callable[..., Any], *arguments: Any) -> float:
    """Return the peak memory in MiB of ``read(*arguments)`` beyond that of its imports, measured in a process of its
    own.

    ``read`` is a function of a module; it may raise ``UserError``.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*_IMPORTS, __name__])
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_measured, args=(sender, read, arguments))
    process.start()
    sender.close()
    assert receiver.poll(_MAX_SECONDS), f"{read} has not ended after {_MAX_SECONDS:g} s"
    megabytes = receiver.recv()
    process.join()
    return megabytes


def _measured(answer: Connection, read: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    import warp as wp

    from egs_warp.errors import UserError

    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    reset_peak()
    before = peak_bytes()
    try:
        result = read(*arguments)
    except UserError as error:
        result = error
    answer.send((peak_bytes() - before) / 2**20)
    del result
