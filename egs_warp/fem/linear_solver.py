"""Protocol of the linear solvers for a step's matrix: sparse factors on the host, dense factors on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from enum import IntEnum
from typing import Any, Protocol

import numpy as np
import warp as wp

from egs_warp.fem.momentum_projection import MomentumProjection


class FactorStatus(IntEnum):
    """State of the factors of the last matrix."""

    NONE = 0
    """No factors: the matrix is not finite or is singular. Cholesky solvers have no factors of an indefinite matrix
    either."""
    INDEFINITE = 1
    """Factors of an indefinite matrix."""
    DEFINITE = 2
    """Factors of a positive definite matrix."""


class LinearSolver(Protocol):
    """Direct solver for symmetric matrices S of one sparsity pattern, plus an optional low-rank term."""

    is_asynchronous: bool
    """True if ``factor`` only queues its work and returns before it is done."""

    @property
    def stream(self) -> AbstractContextManager[None]:
        """Context manager for a sequence of calls, which do not switch streams within it."""
        ...

    def entries_from(self, entries: wp.array) -> Any:
        """Return a copy of ``entries`` (nnz,) or (1, nnz) in the form that this solver reads: a NumPy array, or a
        PyTorch tensor on its device."""
        ...

    def factor(self, entries: Any, diagonal: np.ndarray | None = None) -> None:
        """Factor S.

        Args:
            entries: (nnz,) upper entries in the order of the pattern.
            diagonal: (n,) added to the diagonal, or None.
        """
        ...

    @property
    def status(self) -> FactorStatus:
        """Status of the factors; blocks until queued factors are computed."""
        ...

    def add_low_rank(self, across: np.ndarray, rates: np.ndarray) -> bool:
        """Replace S by S + U diag(r) U^T in the following solves. After each ``factor``, this can succeed only once.

        Args:
            across: (n, k) U.
            rates: (k,) r.

        Returns:
            True if the sum is positive definite; otherwise nothing is added.
        """
        ...

    def solve(self, right: np.ndarray, projection: MomentumProjection[np.ndarray] | None = None) -> np.ndarray:
        """Solve for ``right`` (n,) or for each column of (n, m); apply ``projection`` if given."""
        ...

    def quadratic_form(
        self,
        entries: Any,
        gradient: np.ndarray,
        weights: np.ndarray,
        vectors: np.ndarray,
        *,
        dt_now: float,
        dt_ahead: float,
        reference: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the quadratic model of the elastic energy in a subspace.

        Displacements are X = dt_now V + dt_ahead S^-1 diag(w) V, with ``reference`` subtracted from the last column.
        No low-rank term may have been added to S.

        Args:
            entries: (nnz,) upper entries of H, in the order of the pattern.
            gradient: (n,) g.
            weights: (n,) w.
            vectors: (n, m) V.
            dt_now: factor of V.
            dt_ahead: factor of the solution.
            reference: (n,) subtracted from the last column of X.

        Returns:
            X^T H X (m, m) and X^T g (m,); not finite if there are no factors.
        """
        ...


def energy_moves(
    solve: Callable[[Any], Any], weights: Any, vectors: Any, dt_now: float, dt_ahead: float, reference: Any
) -> Any:
    """Return the displacements X (..., n, m) of ``LinearSolver.quadratic_form``, with the same arguments; ``solve`` is
    a function that returns S^-1 times (..., n, m)."""
    moves = dt_now * vectors + dt_ahead * solve(weights[:, None] * vectors)
    moves[..., -1] -= reference
    return moves
