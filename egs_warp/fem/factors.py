"""Factors of a step's matrix, wherever they are made: sparse on the host, dense on a GPU."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.sparse_factors import SparseFactors


class Factors(Protocol):
    """Of symmetric matrices S of one pattern, and of sums with them.

    Arrays are NumPy's, or their own: those are made by ``take``, stay where the factors are, can be calculated with
    like NumPy's, and come back by ``give``.
    """

    def update(self, entries: np.ndarray) -> bool:
        """Factor S with these upper ``entries`` (nnz,); False if it is not positive definite."""
        ...

    def add(self, across: np.ndarray, rates: np.ndarray) -> bool:
        """From now on solve with S + U diag(r) U^T, ``across`` U (n, k) and ``rates`` r (k,); False, and nothing is
        added, if that is not positive definite. Once after ``update`` with success."""
        ...

    @property
    def ready(self) -> bool:
        """Whether there is something to solve with."""
        ...

    def solve(self, right: Any) -> Any:
        """(n,) or each column of (n, m), NumPy's or their own; alike comes back."""
        ...

    def quadratic(self, entries: np.ndarray, moves: Any) -> Any:
        """(m, m) X^T H X of the matrix H with upper ``entries`` (nnz,) and ``moves`` X (n, m), one of their own; alike
        comes back."""
        ...

    def ahead(self, weights: np.ndarray, vectors: Any, near: float, far: float) -> Any:
        """``near`` X + ``far`` S^-1 (diag(w) X) of ``vectors`` X (n, m), one of their own, ``weights`` w (n,); alike
        comes back."""
        ...

    def take(self, values: np.ndarray) -> Any:
        """As one of their own."""
        ...

    def give(self, values: Any) -> np.ndarray:
        """One of their own, as NumPy's."""
        ...


def factors_on(device: wp.Device, upper_pattern: sparse.csc_matrix | sparse.csc_array) -> Factors:
    """Dense ones on a GPU, where torch sees it too; else sparse ones.

    A dense Cholesky factor and its inverse take 2 ms for 541 nodes on an H100, and 10 for 2,000; with the host's
    factors steps there take from as long (253 nodes) to 1.7 times as long (1,833).
    """
    if device.is_cuda:
        try:
            import torch
        except ImportError:
            return SparseFactors(upper_pattern)
        if torch.cuda.is_available():
            from egs_warp.fem.dense_factors import DenseFactors

            return DenseFactors(upper_pattern, device=str(device))
    return SparseFactors(upper_pattern)
