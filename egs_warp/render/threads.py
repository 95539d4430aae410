"""Launching one kernel over disjoint ranges: at once on a GPU, side by side in threads on a CPU."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp


def available_threads() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def launch_ranges(
    kernel: Any,
    count: int,
    *,
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    device: Any,
    threads: int,
    work: np.ndarray | None = None,
) -> None:
    """Run ``kernel``, whose first parameter is added to its thread index, for the indices 0 to ``count`` - 1.

    A Warp launch on a CPU runs on the calling thread and releases the interpreter lock, so launches over disjoint
    ranges run side by
    side. ``work`` (count,) is the expected effort of each index; without it all are alike. Results do not depend on
    ``threads``.
    """
    if device.is_cuda or threads <= 1 or count <= 1:
        wp.launch(kernel, dim=count, inputs=[0, *inputs], outputs=list(outputs), device=device)
        return
    # The module is loaded here because two threads must not compile it at the same time.
    wp.load_module(kernel.module, device=device)
    pieces = min(count, 4 * threads)
    if work is None:
        edges = np.linspace(0, count, pieces + 1).astype(int)
    else:
        done = np.concatenate([[0.0], np.cumsum(np.asarray(work, dtype=np.float64) + 1e-3)])
        edges = np.searchsorted(done, np.linspace(0.0, done[-1], pieces + 1))
        edges[0], edges[-1] = 0, count

    def launch_piece(piece: int) -> None:
        first, last = int(edges[piece]), int(edges[piece + 1])
        if last > first:
            wp.launch(kernel, dim=last - first, inputs=[first, *inputs], outputs=list(outputs), device=device)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(launch_piece, range(pieces)))
