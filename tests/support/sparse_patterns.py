"""Symmetric, diagonally dominant sparse matrices of many kinds."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse


def upper_of(matrix: sparse.csc_matrix) -> sparse.csc_matrix:
    """Return the upper triangle of a matrix, with sorted indices."""
    upper = sparse.csc_matrix(sparse.triu(matrix))
    upper.sort_indices()
    return upper


def dominant(pattern: np.ndarray, seed: int = 0) -> sparse.csc_matrix:
    """Return a symmetric matrix with random entries where ``pattern`` (n, n), or its transpose, is set, and a dominant
    diagonal."""
    either = np.triu(pattern | pattern.T, 1)
    values = np.where(either, np.random.default_rng(seed).standard_normal(either.shape), 0.0)
    values += values.T
    return sparse.csc_matrix(values + np.diag(1.0 + np.abs(values).sum(axis=1)))


def _grid(nx: int, ny: int, nz: int) -> np.ndarray:
    places = np.stack(np.meshgrid(*map(np.arange, (nx, ny, nz)), indexing="ij"), axis=-1).reshape(-1, 3)
    # The order is random, because meshers number nodes in no particular order.
    places = np.random.default_rng(8).permutation(places)
    near = np.abs(places[:, None] - places).max(axis=-1) <= 1
    return np.kron(near, np.ones((3, 3), dtype=bool))


def _random(count: int, share: float) -> np.ndarray:
    return np.random.default_rng(count).random((count, count)) < share


def _arrow(count: int) -> np.ndarray:
    pattern = np.eye(count, dtype=bool)
    pattern[0] = True
    return pattern


def _apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.block(
        [[first, np.zeros((len(first), len(second)), bool)], [np.zeros((len(second), len(first)), bool), second]]
    )


PATTERNS = {
    "one number": dominant(np.ones((1, 1), dtype=bool)),
    "a diagonal": dominant(np.eye(9, dtype=bool)),
    "a chain": dominant(np.eye(40, k=1, dtype=bool)),
    "an arrow": dominant(_arrow(23)),
    "full, of sixteen": dominant(np.ones((16, 16), dtype=bool)),
    "full, of fifty": dominant(np.ones((50, 50), dtype=bool)),
    "random": dominant(_random(70, 0.05)),
    "dense random": dominant(_random(61, 0.3)),
    "two apart": dominant(_apart(_random(20, 0.2), np.ones((17, 17), dtype=bool))),
    "grid of nodes": dominant(_grid(6, 5, 4)),
}
"""Matrices by name."""
