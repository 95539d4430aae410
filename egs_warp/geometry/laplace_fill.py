"""Harmonic continuation of a picture into a hole."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve


def laplace_fill(values: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Return ``values`` (rows, columns) or (rows, columns, channels), replaced by the solution of Laplace's equation
    inside ``hole`` (rows, columns) bool."""
    index = np.full(hole.shape, -1)
    index[hole] = np.arange(hole.sum())
    rows, columns, sums = [], [], np.zeros((int(hole.sum()), *values.shape[2:]))
    degree = np.zeros(int(hole.sum()))
    at = np.argwhere(hole)
    for step in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        there = at + step
        inside = ((there >= 0) & (there < hole.shape)).all(axis=1)
        there = np.clip(there, 0, np.array(hole.shape) - 1)
        other = np.where(inside, index[there[:, 0], there[:, 1]], -2)
        degree += inside
        rows.append(np.flatnonzero(other >= 0))
        columns.append(other[other >= 0])
        fixed = other == -1
        sums[fixed] += values[there[fixed, 0], there[fixed, 1]]
    row, column = np.concatenate(rows), np.concatenate(columns)
    matrix = sparse.diags(degree) - sparse.coo_array((np.ones(len(row)), (row, column)), shape=(len(at), len(at)))
    filled = values.astype(np.float64).copy()
    # The solver returns shape (n,) for a single channel.
    filled[hole] = np.asarray(spsolve(sparse.csc_array(matrix), sums)).reshape(sums.shape)
    return filled
