"""Factors of a step's matrix, wherever they are made: sparse on the host, dense on a GPU."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.fem.multifrontal import MultifrontalLdl


class LinearSolver(Protocol):
    """Of symmetric matrices S of one pattern, and of sums with them."""

    is_host: bool
    """Where they work: entries come from the host's arrays, or as tensors of the device."""

    @property
    def stream(self) -> AbstractContextManager[None]:
        """Within it what they do there takes least time."""
        ...

    def update(self, entries: Any, diagonal: np.ndarray | None = None) -> bool:
        """Factor S with these upper ``entries`` (nnz,), and ``diagonal`` (n,) added; False if it is not positive
        definite."""
        ...

    def start_update(self, entries: Any, diagonal: np.ndarray | None = None) -> None:
        """``update``, for which nobody waits: ``ready`` does. A GPU goes on with it meanwhile."""
        ...

    def add_low_rank(self, across: np.ndarray, rates: np.ndarray) -> bool:
        """From now on solve with S + U diag(r) U^T, ``across`` U (n, k) and ``rates`` r (k,); False, and nothing is
        added, if that is not positive definite. Once after ``update`` with success."""
        ...

    @property
    def is_ready(self) -> bool:
        """Whether there is something to solve with. Of factors that are begun, once they are there."""
        ...

    def solve(self, right: np.ndarray, kept: MomentumProjection | None = None) -> np.ndarray:
        """(n,) or each column of (n, m); with what is ``kept``."""
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
        """(m, m) X^T H X and (m,) X^T g of the moves X = ``near`` V + ``far`` S^-1 diag(w) V of ``vectors`` V (n, m),
        ``weights`` w (n,), from the last of which ``away`` (n,) is taken; H has upper ``entries``, g (n,) is the
        ``slope``. Of an S without a sum."""
        ...


def linear_solver_on(device: wp.Device, upper_pattern: sparse.csc_matrix | sparse.csc_array) -> LinearSolver:
    """Dense ones on a GPU, where torch sees it too; else sparse ones.

    The inverse of a dense factor takes 0.15 ms for 568 nodes on an H100, and 0.44 for 1,064.
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
