"""Factors of a step's matrix as a dense one, by torch: for a GPU, where that takes less time than any sparse way."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
import torch

from egs_warp.fem.kept import Kept


class DenseFactors:
    """Cholesky factors L of symmetric matrices of one pattern; see ``Factors``.

    L^-1 is made once a matrix: a triangular solve takes as long for one right-hand side as for a thousand, a product
    with L^-1 a fiftieth of that.
    """

    def __init__(self, upper_pattern: sparse.csc_matrix | sparse.csc_array, *, device: str) -> None:
        """``upper_pattern``: upper triangle with the diagonal, entries in the order of ``update``."""
        count = len(upper_pattern.indptr) - 1
        rows = np.asarray(upper_pattern.indices, dtype=np.int64)
        columns = np.repeat(np.arange(count), np.diff(upper_pattern.indptr))
        self._device = torch.device(device)
        self._upper = torch.from_numpy(rows * count + columns).to(self._device)
        self._lower = torch.from_numpy(columns * count + rows).to(self._device)
        self._matrix, self._other = torch.zeros((2, count, count), dtype=torch.float64, device=self._device)
        self._identity = torch.eye(count, dtype=torch.float64, device=self._device)
        self._finite = False
        self._factor: torch.Tensor | None = None
        self._inverse: torch.Tensor | None = None

    def update(self, entries: np.ndarray) -> bool:
        """See ``Factors``; what is not positive definite has no factors."""
        self._factor = self._inverse = None
        self._finite = bool(np.isfinite(entries).all())
        if not self._finite:
            return False
        self._fill(self._matrix, entries)
        factor, info = torch.linalg.cholesky_ex(self._matrix)
        self._factor = factor if int(info) == 0 else None
        return self.ready

    def add(self, across: np.ndarray, rates: np.ndarray) -> bool:
        """See ``Factors``; S keeps its own factor where the sum has none."""
        if not self._finite or not (np.isfinite(across).all() and np.isfinite(rates).all()):
            return False
        directions = self._take(across)
        factor, info = torch.linalg.cholesky_ex(torch.addmm(self._matrix, directions * self._take(rates), directions.T))
        if int(info) != 0:
            return False
        self._factor, self._inverse = factor, None
        return True

    @property
    def ready(self) -> bool:
        """See ``Factors``."""
        return self._factor is not None

    def solve(self, right: np.ndarray, kept: Kept | None = None) -> np.ndarray:
        """See ``Factors``."""
        plain = self._give(self._solve(self._take(right)))
        return plain if kept is None else kept.corrected(right, plain)

    def _solve(self, right: torch.Tensor) -> torch.Tensor:
        inverse = self._inverse
        if inverse is None:
            assert self._factor is not None, "update() comes first"
            inverse = self._inverse = torch.linalg.solve_triangular(self._factor, self._identity, upper=False)
        return inverse.T @ (inverse @ right)

    def strain_ahead(
        self,
        entries: np.ndarray,
        slope: np.ndarray,
        weights: np.ndarray,
        vectors: np.ndarray,
        *,
        near: float,
        far: float,
        away: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """See ``Factors``."""
        given = self._take(vectors)
        moves = near * given + far * self._solve(self._take(weights)[:, None] * given)
        moves[:, -1] -= self._take(away)
        self._fill(self._other, entries)
        return self._give(moves.T @ (self._other @ moves)), self._give(self._take(slope) @ moves)

    def _take(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self._device)

    @staticmethod
    def _give(values: torch.Tensor) -> np.ndarray:
        return values.cpu().numpy()

    def _fill(self, matrix: torch.Tensor, entries: np.ndarray) -> None:
        values, flat = self._take(entries), matrix.view(-1)
        flat[self._upper] = values
        flat[self._lower] = values
