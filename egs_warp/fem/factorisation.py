"""Sparse factors of a step's matrix, and whether it is definite."""

from __future__ import annotations

import numpy as np
import qdldl

from egs_warp.fem.body import SoftBody


class Factorisation:
    """Sparse LDL^T of S = M + dt C + dt^2 K; the symbolic analysis is done once a body."""

    def __init__(self, body: SoftBody) -> None:
        self._body = body
        self._solver: qdldl.Solver | None = None
        self.negative_pivots = 0
        """Negative eigenvalues of the last matrix."""

    @property
    def ready(self) -> bool:
        """Whether there are factors, of a matrix that may be indefinite."""
        return self._solver is not None

    def update(self, entries: np.ndarray) -> bool:
        """Factor the matrix with these upper entries; False if it is not positive definite."""
        matrix = self._body.assembly.matrix(entries)
        if not np.isfinite(entries).all():
            self._solver = None
            return False
        try:
            if self._solver is None:
                self._solver = qdldl.Solver(matrix, upper=True)
            else:
                self._solver.update(matrix, upper=True)
        except RuntimeError:
            self._solver = None
            return False
        assert self._solver is not None
        pivots = self._solver.factors()[1]
        if not np.isfinite(pivots).all():
            self._solver = None
            return False
        self.negative_pivots = int((pivots <= 0.0).sum())
        return self.negative_pivots == 0

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solve for (N, 3), or for each column of (3N, m)."""
        assert self._solver is not None, "update() comes first"
        if right.ndim == 2 and right.shape == self._body.mesh.nodes.shape:
            return self._solver.solve(right.ravel()).reshape(right.shape)
        return np.stack([self._solver.solve(np.ascontiguousarray(column)) for column in right.T], axis=1)
