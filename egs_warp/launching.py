"""Launch a kernel over many independent rows with every core of a CPU.

On a CPU, Warp runs one launch on one thread but releases the interpreter lock while it runs, so launches over disjoint
rows from a thread pool run side by side.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

import warp as wp

_MIN_ROWS_PER_CHUNK = 2048
"""Below this a launch's own cost (about 20 us) is no longer small against its work."""

_CHUNKS_PER_THREAD = 4
"""Rows differ in cost (outside points search longer), so give the pool more chunks than threads."""


def launch_rows(
    kernel: wp.Kernel, row_count: int, *, inputs: Sequence[Any], outputs: Sequence[Any], device: wp.Device
) -> None:
    """Run ``kernel`` over rows 0 .. ``row_count`` - 1.

    The kernel's first parameter must be ``first_row: wp.int32`` and its row ``first_row + wp.tid()``; each row may
    write only what belongs to it, so that the result does not depend on how rows are shared out. ``inputs`` and
    ``outputs`` are the remaining parameters.
    """
    thread_count = os.cpu_count() or 1
    chunk_count = min(thread_count * _CHUNKS_PER_THREAD, row_count // _MIN_ROWS_PER_CHUNK)
    if not device.is_cpu or thread_count == 1 or chunk_count < 2:
        wp.launch(kernel, dim=row_count, inputs=[0, *inputs], outputs=list(outputs), device=device)
        return
    # Compiling is not safe from several threads at once.
    kernel.module.load(device, block_dim=1)
    bounds = [row_count * chunk // chunk_count for chunk in range(chunk_count + 1)]

    def launch_chunk(first: int, last: int) -> None:
        wp.launch(kernel, dim=last - first, inputs=[first, *inputs], outputs=list(outputs), device=device)

    for finished in [_pool().submit(launch_chunk, a, b) for a, b in pairwise(bounds)]:
        finished.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=os.cpu_count())
