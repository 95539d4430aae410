"""Factors of a step's sparse matrix, many right-hand sides at once."""

from __future__ import annotations

import numpy as np
import rslab
import scipy.linalg as dense
import scipy.sparse as sparse

from egs_warp.launching import beside

_SPLIT = 32
"""Right-hand sides from which on half of them are solved in a second thread."""


class SparseFactors:
    """Supernodal L D L^T of symmetric matrices of one pattern; see ``Factors``. The symbolic analysis is done once. The
    same bits on any number of cores.
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
        self._full_from_upper, self._full = full.data.astype(np.int64) - 1, (full.indices, full.indptr)
        self._symbolic = rslab.analyze(full, path="ldlt", threads=1)
        self._factors: rslab.Ldlt | None = None
        self._added: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        """U, S^-1 U and the inverse of the capacitance matrix."""
        self.negative_pivots = 0
        """Negative eigenvalues of the last matrix."""

    def update(self, entries: np.ndarray) -> bool:
        """See ``Factors``. The factors of an indefinite matrix can be solved with all the same; without any, ``solve``
        must not be called.
        """
        self._factors = self._added = None
        if not np.isfinite(entries).all():
            return False
        try:
            factors = self._symbolic.factor(entries[self._lower_from_upper])
        except RuntimeError:  # numerically singular
            return False
        assert isinstance(factors, rslab.Ldlt), "the path is ldlt"
        self._factors, self.negative_pivots = factors, int(factors.inertia[1])
        return self.negative_pivots == 0

    def add(self, across: np.ndarray, rates: np.ndarray) -> bool:
        """See ``Factors``: by Woodbury's formula, also where S alone is not definite."""
        if not self.ready:
            return False
        if len(rates) == 0:
            return self.negative_pivots == 0
        self._added = None
        through = self.solve(across)
        small = across.T @ through
        small[np.diag_indices_from(small)] += 1.0 / rates
        # Haynsworth: negative eigenvalues of the sum = those of S + positive ones of the small matrix - pulling
        # directions.
        positive, inverse = inverse_and_positives(small)
        if self.negative_pivots + positive != int((rates > 0.0).sum()):
            return False
        self._added = across, through, inverse
        return True

    @property
    def ready(self) -> bool:
        """See ``Factors``."""
        return self._factors is not None

    def solve(self, right: np.ndarray) -> np.ndarray:
        """See ``Factors``."""
        plain = self._plain(right)
        if self._added is None:
            return plain
        across, through, small = self._added
        return plain - through @ (small @ (across.T @ plain))

    def quadratic(self, entries: np.ndarray, moves: np.ndarray) -> np.ndarray:
        """See ``Factors``."""
        matrix = sparse.csr_matrix((entries[self._full_from_upper], *self._full), shape=(len(moves), len(moves)))
        moves = np.ascontiguousarray(moves)
        half = moves.shape[1] // 2
        parts = beside(lambda: moves.T @ (matrix @ moves[:, :half]), lambda: moves.T @ (matrix @ moves[:, half:]))
        return np.hstack(parts)

    def take(self, values: np.ndarray) -> np.ndarray:
        """See ``Factors``."""
        return values

    def give(self, values: np.ndarray) -> np.ndarray:
        """See ``Factors``."""
        return values

    def _plain(self, right: np.ndarray) -> np.ndarray:
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


def inverse_and_positives(symmetric: np.ndarray) -> tuple[int, np.ndarray]:
    """How many eigenvalues of the lower triangle's matrix (n, n) are positive, and its inverse, from one
    Bunch-Kaufman factorisation; not finite where the matrix is singular.
    """
    factor, invert = dense.get_lapack_funcs(("sytrf", "sytri"), (symmetric,))
    factors, pivots, info = factor(symmetric, lower=1)
    if info > 0:
        return -1, np.full_like(symmetric, np.nan)
    # A block of two, marked by negative pivots, has an eigenvalue of each sign.
    positive = int((factors.diagonal()[pivots > 0] > 0.0).sum()) + int((pivots < 0).sum()) // 2
    inverse, _ = invert(factors, pivots, lower=1)
    lower = np.tril(inverse, -1)
    return positive, lower + lower.T + np.diag(inverse.diagonal())
