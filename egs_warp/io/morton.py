"""Order along a space-filling curve, so that Gaussians that are neighbours in the file are neighbours in space."""

from __future__ import annotations

import numpy as np

_BITS = 16


def morton_order(points: np.ndarray) -> np.ndarray:
    """Return the permutation (n,) that sorts ``points`` (n, 3), stably, along a Morton curve of 2^16 cells per side."""
    points = points.astype(np.float64)
    low = points.min(axis=0)
    extent = np.maximum(points.max(axis=0) - low, 1e-300)
    cells = np.minimum((points - low) / extent * 2**_BITS, 2**_BITS - 1).astype(np.uint64)
    keys = np.zeros(len(points), np.uint64)
    for bit in range(_BITS):
        for axis in range(3):
            keys |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(keys, kind="stable")
