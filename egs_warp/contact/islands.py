"""Islands: sets of bodies that are connected by contacts. The contact forces of different islands are independent."""

from __future__ import annotations

import numpy as np
import warp as wp

from egs_warp.kernels.contact.islands import islands_kernel
from egs_warp.launching import device_of, launch_cached


def enqueue_islands(counts: wp.array, pairs: wp.array, islands: wp.array) -> None:
    """Find the island of each body in many worlds, asynchronously.

    Args:
        counts: (B,) int, number of contacts.
        pairs: (B, K) vec2i, the two bodies of each contact; a negative index is an obstacle.
        islands: (B, nbody) int, overwritten with the lowest body index in each body's island.
    """
    launch_cached(islands_kernel, len(islands), inputs=[counts, pairs], outputs=[islands], device=device_of(islands))


def find_islands(body_count: int, pairs: np.ndarray) -> np.ndarray:
    """Return (body_count,), the lowest body index in each body's island, for one world.

    Args:
        body_count: number of bodies.
        pairs: (n, 2) int, the two bodies of each contact; a negative index is an obstacle.
    """
    if len(pairs) == 0:
        return np.arange(body_count)
    islands = wp.empty((1, body_count), dtype=int, device="cpu")
    contacts = wp.array(np.ascontiguousarray(pairs, np.int32)[None], dtype=wp.vec2i, device="cpu")
    enqueue_islands(wp.array([len(pairs)], dtype=int, device="cpu"), contacts, islands)
    return islands.numpy()[0].astype(int)
