"""Batched Cholesky factorisation of dense symmetric matrices of one size, panel by panel, in PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import scipy.sparse as sparse
import torch

from egs_warp.fem.linear_solver import FactorStatus
from egs_warp.fem.momentum_projection import MomentumProjection

PANEL = 96
"""Number of columns that are factored at once."""
CHUNK_BYTES = 2**31
"""Total size of the matrices that are processed at once, bytes; temporary memory is a small multiple of it."""


class PanelCholesky:
    """Dense Cholesky solver for the matrices of several worlds, which all have the same pattern. Its methods resemble
    those of ``LinearSolver``, with a world axis.

    The factorisation is left-looking and proceeds by panels: each panel is updated with all columns before it, its
    diagonal block is factored, and the rows below are multiplied by the inverse of that factor. The inverses are
    stored, so that a solve consists of matrix products only. CUDA's own batched factorisation is designed for small
    matrices. Arguments named ``select`` must be ascending. Worlds whose status is not ``DEFINITE`` must not be solved.
    """

    def __init__(
        self,
        upper_pattern: sparse.csc_matrix | sparse.csc_array,
        worlds: int,
        device: torch.device,
        *,
        panel: int = PANEL,
        chunk_bytes: int = CHUNK_BYTES,
    ) -> None:
        """Allocate the factors, which take 8 n^2 bytes per world.

        Args:
            upper_pattern: (n, n) upper triangle with the diagonal.
            worlds: number of worlds.
            device: device of the factors.
            panel: number of columns factored at once.
            chunk_bytes: total size of the matrices processed at once.
        """
        size = len(upper_pattern.indptr) - 1
        columns = np.repeat(np.arange(size), np.diff(upper_pattern.indptr))
        self._lower = torch.as_tensor(columns * size + upper_pattern.indices.astype(np.int64), device=device)
        self._upper = torch.as_tensor(upper_pattern.indices.astype(np.int64) * size + columns, device=device)
        self.size, self.panel = size, panel
        self.chunk = max(1, chunk_bytes // (8 * size * size))
        """Number of worlds whose matrices are processed at once."""
        self._starts = range(0, size, panel)
        kind = {"dtype": torch.float64, "device": device}
        self.status = torch.zeros(worlds, dtype=torch.int8, device=device)
        """(worlds,) ``FactorStatus`` of each world."""
        self._factors = torch.zeros((worlds, size, size), **kind)
        self._inverses = torch.zeros((worlds, len(self._starts), panel, panel), **kind)

    def factor(
        self,
        entries: torch.Tensor,
        diagonal: torch.Tensor,
        select: torch.Tensor,
        add_term: Callable[[torch.Tensor], None] | None = None,
    ) -> None:
        """Factor the matrices of the worlds ``select``.

        Args:
            entries: (k, nnz) upper entries in the order of the pattern.
            diagonal: (n,) added to each diagonal.
            select: (k,) worlds.
            add_term: function that adds a term to the lower triangles (k, n, n) before they are factored.
        """
        count = len(select)
        matrices = entries.new_zeros(count, self.size * self.size)
        matrices.index_copy_(1, self._lower, entries)
        matrices = matrices.view(count, self.size, self.size)
        matrices.diagonal(dim1=1, dim2=2).add_(diagonal)
        if add_term is not None:
            add_term(matrices)
        is_definite = torch.ones(count, dtype=torch.bool, device=matrices.device)
        inverses = self._inverses.new_zeros((count, *self._inverses.shape[1:]))
        for number, start in enumerate(self._starts):
            stop = min(start + self.panel, self.size)
            columns, before = matrices[:, start:, start:stop], matrices[:, start:, :start]
            if start > 0:
                columns.baddbmm_(before, before[:, : stop - start].mT, alpha=-1.0)
            own, wrong = torch.linalg.cholesky_ex(columns[:, : stop - start])
            is_definite &= (wrong == 0) & own.diagonal(dim1=1, dim2=2).isfinite().all(dim=1)
            identity = torch.eye(stop - start, dtype=own.dtype, device=own.device).expand_as(own)
            inverse = torch.linalg.solve_triangular(own, identity, upper=False)
            inverses[:, number, : stop - start, : stop - start] = inverse
            columns[:, : stop - start] = own
            if stop < self.size:
                columns[:, stop - start :] = columns[:, stop - start :] @ inverse.mT
        self._factors[select], self._inverses[select] = matrices, inverses
        self.status[select] = torch.where(is_definite, FactorStatus.DEFINITE, FactorStatus.NONE).to(torch.int8)

    def dense(self, entries: torch.Tensor) -> torch.Tensor:
        """Return the symmetric matrices (k, n, n) with upper ``entries`` (k, nnz) in the order of the pattern."""
        matrices = entries.new_zeros(len(entries), self.size * self.size)
        matrices.index_copy_(1, self._lower, entries)
        matrices.index_copy_(1, self._upper, entries)
        return matrices.view(-1, self.size, self.size)

    def solve(
        self, right: torch.Tensor, select: torch.Tensor, projection: MomentumProjection[torch.Tensor] | None = None
    ) -> torch.Tensor:
        """Return S^-1 ``right`` for right-hand sides (k, n, m) of the worlds ``select`` (k,); apply ``projection`` if
        given."""
        is_complete = len(select) == len(self._factors)
        # A slice of all worlds avoids a copy of the factors.
        parts = [
            self._solve_chunk(part if is_complete else select[part], right[part]) for part in self.chunks(len(select))
        ]
        plain = parts[0] if len(parts) == 1 else torch.cat(parts)
        return plain if projection is None else projection.corrected(right, plain)

    def chunks(self, count: int) -> Iterator[slice]:
        """Return slices of the ``count`` worlds that are processed at once; a single empty slice if there are none."""
        return (slice(start, min(start + self.chunk, count)) for start in range(0, max(count, 1), self.chunk))

    def _solve_chunk(self, select: torch.Tensor | slice, right: torch.Tensor) -> torch.Tensor:
        factors, inverses, solution = self._factors[select], self._inverses[select], right.clone()
        bounds = [(start, min(start + self.panel, self.size)) for start in self._starts]
        for number, (start, stop) in enumerate(bounds):
            rows = solution[:, start:stop]
            if start > 0:
                rows = torch.baddbmm(rows, factors[:, start:stop, :start], solution[:, :start], alpha=-1.0)
            solution[:, start:stop] = inverses[:, number, : stop - start, : stop - start] @ rows
        for number, (start, stop) in reversed(list(enumerate(bounds))):
            rows = solution[:, start:stop]
            if stop < self.size:
                rows = torch.baddbmm(rows, factors[:, stop:, start:stop].mT, solution[:, stop:], alpha=-1.0)
            solution[:, start:stop] = inverses[:, number, : stop - start, : stop - start].mT @ rows
        return solution
