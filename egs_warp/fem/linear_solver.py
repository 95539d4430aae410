"""Protocol of the linear solvers for a step's matrix: sparse factors on the host, dense factors on a GPU."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.fem.multifrontal import MultifrontalLdl


class LinearSolver(Protocol):
    """Direct solver for symmetric matrices S of one sparsity pattern, plus an optional low-rank term."""

    is_host: bool
    """True if entries are NumPy arrays; False if they are PyTorch tensors on the device."""

    @property
    def stream(self) -> AbstractContextManager[None]:
        """Context within which calls need no stream switches."""
        ...

    def update(self, entries: Any, diagonal: np.ndarray | None = None) -> bool:
        """Factor S.

        Args:
            entries: (nnz,) upper entries in the order of the pattern.
            diagonal: (n,) added to the diagonal, or None.

        Returns:
            True if S is positive definite.
        """
        ...

    def start_update(self, entries: Any, diagonal: np.ndarray | None = None) -> None:
        """Start ``update`` asynchronously where the solver supports it; ``is_ready`` waits for the result."""
        ...

    def add_low_rank(self, across: np.ndarray, rates: np.ndarray) -> bool:
        """Replace S by S + U diag(r) U^T in the following solves. This succeeds at most once per ``update``.

        Args:
            across: (n, k) U.
            rates: (k,) r.

        Returns:
            True if the sum is positive definite; otherwise nothing is added.
        """
        ...

    @property
    def is_ready(self) -> bool:
        """True if factors exist; blocks until queued ones are computed."""
        ...

    def solve(self, right: np.ndarray, projection: MomentumProjection | None = None) -> np.ndarray:
        """Solve for ``right`` (n,) or for each column of (n, m); apply ``projection`` if given."""
        ...

    def effort_quadratic(
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
            X^T H X (m, m) and X^T g (m,).
        """
        ...


def linear_solver_on(device: wp.Device, upper_pattern: sparse.csc_matrix | sparse.csc_array) -> LinearSolver:
    """Return a dense solver on a GPU that PyTorch can use, and otherwise a sparse solver on the host.

    On an H100 the inverse of a dense factor takes 0.15 ms for 568 nodes and 0.44 ms for 1,064.
    """
    if device.is_cuda:
        try:
            import torch
        except ImportError:
            return MultifrontalLdl(upper_pattern)
        if torch.cuda.is_available():
            from egs_warp.fem.dense_cholesky import DenseCholesky

            return DenseCholesky(upper_pattern, device=str(device))
    return MultifrontalLdl(upper_pattern)
