"""Order along a space-filling curve: neighbours in space become neighbours in the file."""

from __future__ import annotations

import numpy as np

_BITS = 16


def morton_order(points: np.ndarray) -> np.ndarray:
    """(n,) permutation that sorts ``points`` (n, 3) along a Morton curve of 2^16 cells per side; stable."""
    points = points.astype(np.float64)
    low = points.min(axis=0)
    extent = np.maximum(points.max(axis=0) - low, 1e-300)
    cells = np.minimum((points - low) / extent * 2**_BITS, 2**_BITS - 1).astype(np.uint64)
    keys = np.zeros(len(points), np.uint64)
    for bit in range(_BITS):
        for axis in range(3):
            keys |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(keys, kind="stable")
