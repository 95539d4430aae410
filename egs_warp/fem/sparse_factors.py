"""Factors of a step's sparse matrix, many right-hand sides at once."""

from __future__ import annotations

import numpy as np
import rslab
import scipy.sparse as sparse

from egs_warp.launching import beside

_SPLIT = 32
"""Right-hand sides from which on half of them are solved in a second thread."""


class SparseFactors:
    """Supernodal L D L^T of symmetric matrices of one pattern; the symbolic analysis is done once. The same bits on any
    number of cores.
    """

    def __init__(self, upper_pattern: sparse.csc_matrix | sparse.csc_array) -> None:
        """``upper_pattern``: upper triangle with the diagonal, entries in the order of ``update``."""
        order = sparse.csc_matrix(
            (np.arange(1.0, upper_pattern.nnz + 1.0), upper_pattern.indices, upper_pattern.indptr), upper_pattern.shape
        )
        lower = order.T.tocsc()
        lower.sort_indices()
        self._lower_from_upper = lower.data.astype(np.int64) - 1
        full = (order + sparse.triu(order, 1).T).tocsc()
        full.sort_indices()
        self._symbolic = rslab.analyze(full, path="ldlt", threads=1)
        self._factors: rslab.Ldlt | None = None
        self.negative_pivots = 0
        """Negative eigenvalues of the last matrix."""

    def update(self, entries: np.ndarray) -> bool:
        """Factor the matrix with these upper ``entries`` (nnz,); False if it is not positive definite.

        The factors of an indefinite matrix can be solved with all the same; without any, ``solve`` must not be called.
        """
        self._factors = None
        if not np.isfinite(entries).all():
            return False
        try:
            factors = self._symbolic.factor(entries[self._lower_from_upper])
        except RuntimeError:  # numerically singular
            return False
        assert isinstance(factors, rslab.Ldlt), "the path is ldlt"
        self._factors, self.negative_pivots = factors, int(factors.inertia[1])
        return self.negative_pivots == 0

    @property
    def ready(self) -> bool:
        """Whether there are factors."""
        return self._factors is not None

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solve for ``right`` (n,) or for each column of (n, m)."""
        factors = self._factors
        assert factors is not None, "update() comes first"
        if right.ndim == 1:
            return np.asarray(factors.solve(right))
        if right.shape[1] == 0:
            return right
        # Column by column in memory: as the factors take them.
        right = np.asfortranarray(right)
        if right.shape[1] < _SPLIT:
            return np.asarray(factors.solve_many(right))
        half = right.shape[1] // 2
        first, second = beside(lambda: factors.solve_many(right[:, :half]), lambda: factors.solve_many(right[:, half:]))
        return np.hstack([first, second])
