"""Matrices of bodies that are partitioned into slabs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def slab_matrix(parts: Sequence[int], between: int, *, seed: int) -> np.ndarray:
    """Return a random positive definite matrix (n, n) with independent diagonal blocks of ``parts`` unknowns.

    The blocks are coupled only by the last ``between`` unknowns.
    """
    count = sum(parts) + between
    half = np.random.default_rng(seed).normal(size=(count, count))
    matrix = (half + half.T) / 2.0
    group = np.repeat(np.arange(len(parts) + 1), [*parts, between])
    apart = (group[:, None] != group) & (np.maximum(group[:, None], group) < len(parts))
    matrix[apart] = 0.0
    return matrix + 2.2 * np.sqrt(count) * np.eye(count)
