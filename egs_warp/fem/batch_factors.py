"""Cholesky factors of many dense symmetric matrices of one size, by panels, in torch."""

from __future__ import annotations

from collections.abc import Iterator

import torch

PANEL = 96
"""Columns that are factored at a time."""
CHUNK_BYTES = 2**31
"""Of the matrices that are worked on at a time: what is needed beside the factors stays a few times as large."""


class BatchCholesky:
    """A factor L of S = L L^T for each of B worlds, in slots.

    A left-looking factorisation by panels: a product with all columns before, the panel's own small factor, and a
    product with its inverse, which is kept: so solving takes nothing but products either. CUDA's own batched
    factorisation is made for small matrices. ``slots`` in what follows are ascending.
    """

    def __init__(
        self, slots: int, size: int, device: torch.device, *, panel: int = PANEL, chunk_bytes: int = CHUNK_BYTES
    ) -> None:
        """For ``slots`` worlds with matrices (size, size): 8 ``slots size``^2 bytes."""
        self.size, self.panel = size, panel
        self.chunk = max(1, chunk_bytes // (8 * size * size))
        """Worlds whose matrices are worked on at a time."""
        self._starts = range(0, size, panel)
        kind = {"dtype": torch.float64, "device": device}
        self._factors = torch.zeros((slots, size, size), **kind)
        self._inverses = torch.zeros((slots, len(self._starts), panel, panel), **kind)

    def factor(self, slots: torch.Tensor, matrices: torch.Tensor) -> torch.Tensor:
        """Factor ``matrices`` (k, n, n), lower triangles, which are used up, into ``slots`` (k,); (k,) bool says which
        are positive definite, the others' slots must not be solved with."""
        count = len(slots)
        fine = torch.ones(count, dtype=torch.bool, device=matrices.device)
        inverses = self._inverses.new_zeros((count, *self._inverses.shape[1:]))
        for number, start in enumerate(self._starts):
            stop = min(start + self.panel, self.size)
            columns, before = matrices[:, start:, start:stop], matrices[:, start:, :start]
            if start > 0:
                columns.baddbmm_(before, before[:, : stop - start].mT, alpha=-1.0)
            own, wrong = torch.linalg.cholesky_ex(columns[:, : stop - start])
            fine &= (wrong == 0) & own.diagonal(dim1=1, dim2=2).isfinite().all(dim=1)
            identity = torch.eye(stop - start, dtype=own.dtype, device=own.device).expand_as(own)
            inverse = torch.linalg.solve_triangular(own, identity, upper=False)
            inverses[:, number, : stop - start, : stop - start] = inverse
            columns[:, : stop - start] = own
            if stop < self.size:
                columns[:, stop - start :] = columns[:, stop - start :] @ inverse.mT
        self._factors[slots], self._inverses[slots] = matrices, inverses
        return fine

    def solve(self, slots: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        """(k, n, m) S^-1 times ``right`` of that shape, with the factors in ``slots`` (k,)."""
        whole = len(slots) == len(self._factors)
        # Where all are asked for, they need not be copied.
        parts = [self._solved(part if whole else slots[part], right[part]) for part in self.chunks(len(slots))]
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    def chunks(self, count: int) -> Iterator[slice]:
        """Of ``count`` worlds those that are worked on at a time; one empty chunk of none."""
        return (slice(start, min(start + self.chunk, count)) for start in range(0, max(count, 1), self.chunk))

    def _solved(self, slots: torch.Tensor | slice, right: torch.Tensor) -> torch.Tensor:
        factors, inverses, answer = self._factors[slots], self._inverses[slots], right.clone()
        bounds = [(start, min(start + self.panel, self.size)) for start in self._starts]
        for number, (start, stop) in enumerate(bounds):
            rows = answer[:, start:stop]
            if start > 0:
                rows = torch.baddbmm(rows, factors[:, start:stop, :start], answer[:, :start], alpha=-1.0)
            answer[:, start:stop] = inverses[:, number, : stop - start, : stop - start] @ rows
        for number, (start, stop) in reversed(list(enumerate(bounds))):
            rows = answer[:, start:stop]
            if stop < self.size:
                rows = torch.baddbmm(rows, factors[:, stop:, start:stop].mT, answer[:, stop:], alpha=-1.0)
            answer[:, start:stop] = inverses[:, number, : stop - start, : stop - start].mT @ rows
        return answer
