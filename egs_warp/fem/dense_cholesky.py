"""Factors of a step's matrix as a dense one, by torch: for a GPU, where that takes less time than any sparse way."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
import torch
import warp as wp

from egs_warp.fem.batched import as_warp
from egs_warp.fem.cuda_graphs import GraphCache, GraphStream, PinnedUpload
from egs_warp.fem.dissection import Dissection
from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.fem.tiled_inverse import TiledInverseFactor
from egs_warp.kernels.fem import triangles as kernels
from egs_warp.precision import real


class DenseCholesky:
    """Cholesky factors L of symmetric matrices of one pattern; see ``Factors``.

    L^-1 is made once a matrix: a triangular solve takes as long for one right-hand side as for a thousand, a product
    with L^-1 a fiftieth of that.
    """

    is_host = False

    def __init__(self, upper_pattern: sparse.csc_matrix | sparse.csc_array, *, device: str) -> None:
        """``upper_pattern``: upper triangle with the diagonal, entries in the order of ``update``."""
        count = len(upper_pattern.indptr) - 1
        rows = np.asarray(upper_pattern.indices, dtype=np.int64)
        columns = np.repeat(np.arange(count), np.diff(upper_pattern.indptr))
        self.device = torch.device(device)
        self.stream = GraphStream(self.device)
        self._upper = torch.from_numpy(rows * count + columns).to(self.device)
        self._lower = torch.from_numpy(columns * count + rows).to(self.device)
        self._root = _InverseFactor(Dissection.of(upper_pattern), self.stream)
        self.places = self._root.places_of(rows, columns)
        """Of the entries in the matrix that is factored."""
        self._other = torch.zeros((count, count), dtype=torch.float64, device=self.device)
        self._entries, self._diagonal = self._other.new_zeros(len(rows)), self._other.new_zeros(count)
        self._diagonal_here = np.zeros(count)
        self._told, self.verdict = self.stream.pinned(2), self._other.new_zeros(2)
        """Whether the entries were finite, and the matrix definite."""
        self._factored = self.stream.run_captured(self._factor)
        self._strain_told, self._strain_entries = PinnedUpload(self.stream, 3 * count), torch.zeros_like(self._entries)
        self._strain_here, self._strains = self.stream.pinned(0), GraphCache(self.stream)
        self._finite = self._ready = self._begun = False

    def update(self, entries: np.ndarray | torch.Tensor, diagonal: np.ndarray | None = None) -> bool:
        """See ``Factors``; what is not positive definite has no factors."""
        self.start_update(entries, diagonal)
        return self.is_ready

    def start_update(self, entries: np.ndarray | torch.Tensor, diagonal: np.ndarray | None = None) -> None:
        """See ``Factors``."""
        with self.stream:
            self._entries.copy_(self._take(entries))
            self.upload_diagonal(np.zeros(len(self._diagonal)) if diagonal is None else diagonal)
            self._factored()
        self._begun = True

    def upload_diagonal(self, diagonal: np.ndarray) -> None:
        """The ``diagonal`` (n,) that is added to the entries."""
        # From step to step it is the same.
        if not np.array_equal(diagonal, self._diagonal_here):
            self._diagonal_here = diagonal.copy()
            self._diagonal.copy_(self._take(diagonal))

    def enqueue(self, entries: torch.Tensor) -> None:
        """``begin`` with the diagonal that was told, as part of a graph; who launches that says so by ``begun``."""
        self._entries.copy_(entries)
        self._factor()

    def enqueue_low_rank(self, directions: torch.Tensor, sign: float) -> None:
        """From now on solve with S + ``sign`` U^T U, ``directions`` U (k, n), where that is definite; ``verdict`` and
        ``ready`` say so. S must be, and a sign of less than 0 comes last."""
        self.verdict[1].mul_(self._root.add(directions, sign))
        self._told.copy_(self.verdict, non_blocking=True)

    def mark_started(self) -> None:
        """Factors are on their way."""
        self._begun = True

    def _factor(self) -> None:
        """Of what lies in the entries and the diagonal, and whether these are finite and make it definite."""
        self._root.matrix.view(-1)[self.places] = self._entries
        self._root.matrix.diagonal().add_(self._diagonal[self._root.order])
        definite = self._root.make()
        self.verdict.copy_(torch.stack([self._entries.isfinite().all(), definite]))
        self._told.copy_(self.verdict, non_blocking=True)

    def add_low_rank(self, across: np.ndarray, rates: np.ndarray) -> bool:
        """See ``Factors``; S keeps its own factor where the sum has none."""
        self._settle()
        if not self._finite or not (np.isfinite(across).all() and np.isfinite(rates).all()):
            return False
        with self.stream:
            if not self._root.make_with(self._take(across), self._take(rates)):
                return False
        self._ready = True
        return True

    @property
    def is_ready(self) -> bool:
        """See ``Factors``."""
        self._settle()
        return self._ready

    def _settle(self) -> None:
        """Wait for what is begun, and see what it has come to."""
        if self._begun:
            self.stream.wait()
            self._begun = False
            finite, definite = self._told.tolist()
            self._finite, self._ready = finite > 0.0, finite > 0.0 and definite > 0.0

    def solve(self, right: np.ndarray, kept: MomentumProjection | None = None) -> np.ndarray:
        """See ``Factors``."""
        assert self.is_ready, "update() comes first"
        with self.stream:
            plain = self._give(self._solve(self._take(right)))
        return plain if kept is None else kept.corrected(right, plain)

    @property
    def inverse(self) -> torch.Tensor:
        """(n, n) R of S^-1 = R^T R, L^-1 in another order of unknowns, on the device, always in the same place."""
        return self._root.inverse

    def _solve(self, right: torch.Tensor) -> torch.Tensor:
        return self.inverse.T @ (self.inverse @ right)

    def effort_quadratic(
        self,
        entries: np.ndarray,
        gradient: np.ndarray,
        weights: np.ndarray,
        vectors: np.ndarray,
        *,
        dt_now: float,
        dt_ahead: float,
        reference: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """See ``Factors``."""
        count = vectors.shape[1]
        with self.stream:
            self._strain_told.set(gradient, weights, reference)
            self._strain_entries.copy_(self._take(entries))
            given = self._take(vectors)
            if self._strain_here.numel() < count * count + count:
                self._strain_here = self.stream.pinned(count * count + count)
                self._strains.forget()

            def work() -> None:
                found = self._strain(given, dt_now, dt_ahead)
                self._strain_here[: len(found)].copy_(found, non_blocking=True)

            if isinstance(vectors, torch.Tensor):
                self._strains.run((given.data_ptr(), count, dt_now, dt_ahead), work)
            else:
                # What comes from the host lies elsewhere the next time.
                work()
            self.stream.wait()
        form, along = np.split(self._strain_here.numpy()[: count * count + count], [count * count])
        return form.reshape(count, count).copy(), along.copy()

    def _strain(self, given: torch.Tensor, near: float, far: float) -> torch.Tensor:
        """Form and slope, one behind the other, with what was told; no numbers where there are no factors."""
        slope, weights, away = self._strain_told.device.split([len(given)] * 3)
        form, along = self.enqueue_effort_quadratic(self._strain_entries, slope, weights, given, near, far, away)
        return torch.cat([form.flatten(), along])

    def enqueue_effort_quadratic(
        self,
        entries: torch.Tensor,
        slope: torch.Tensor,
        weights: torch.Tensor,
        vectors: torch.Tensor,
        near: float,
        far: float,
        away: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """``strain_ahead`` of what lies on the device, with nothing that waits."""
        moves = near * vectors + far * self._solve(weights[:, None] * vectors)
        moves[:, -1] -= away
        flat = self._other.view(-1)
        flat[self._upper] = entries
        flat[self._lower] = entries
        return moves.T @ (self._other @ moves), slope @ moves

    def _take(self, values: np.ndarray | torch.Tensor) -> torch.Tensor:
        if isinstance(values, torch.Tensor):
            return values
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)

    @staticmethod
    def _give(values: torch.Tensor) -> np.ndarray:
        return values.cpu().numpy()


class _InverseFactor:
    """R of S^-1 = R^T R for symmetric matrices S (n, n) of one pattern: L^-1 of S in the order of its slabs, columns in
    that of S.

    On a GPU slabs are eliminated at once, by tiles; on a CPU the whole goes by torch.
    """

    def __init__(self, slabs: Dissection, stream: GraphStream) -> None:
        order, device = slabs.order, stream.device
        count = len(order)
        place = np.empty(count, dtype=np.int64)
        place[order] = np.arange(count)
        self._place_here, self._stream = place, stream
        self._place, self.order = (torch.from_numpy(each).to(device) for each in (place, order.astype(np.int64)))
        self.matrix, self.inverse = torch.zeros((2, count, count), dtype=torch.float64, device=device)
        """Of these the lower triangle of S in the order of the slabs, and R."""
        # Of each number of directions that were added at once.
        self._small: dict[int, tuple[_Triangle, _Triangle]] = {}
        self._tiled = TiledInverseFactor(slabs, self.matrix, self.inverse, stream) if device.type == "cuda" else None

    @cached_property
    def _whole(self) -> _Triangle:
        return _Triangle(len(self.order), self._stream)

    def places_of(self, rows: np.ndarray, columns: np.ndarray) -> torch.Tensor:
        """Where the entries at ``rows`` and ``columns`` of one triangle lie in the flat ``matrix``."""
        one, other = self._place_here[rows], self._place_here[columns]
        places = np.maximum(one, other) * len(self.order) + np.minimum(one, other)
        return torch.from_numpy(places).to(self._stream.device)

    def make(self) -> torch.Tensor:
        """R of what lies in the ``matrix``; () bool, whether that is definite."""
        if self._tiled is not None:
            return self._tiled.make()
        definite = self._whole.factor(self.matrix)
        self._give(self._whole.inverse)
        return definite

    def add(self, directions: torch.Tensor, sign: float) -> torch.Tensor:
        """R of S + ``sign`` U^T U, ``directions`` U (k, n); () bool, whether that is definite.

        With W = R U^T and K K^T = 1 + sign W^T W that is (1 - sign W K^-T (K + 1)^-1 W^T)^T R: the square root of a
        sum by the one of a matrix (Andrews, AIAA Journal 6(6), 1968), so that n is not factored anew.
        """
        count = len(directions)
        if count not in self._small:
            self._small[count] = _Triangle(count, self._stream), _Triangle(count, self._stream)
        plain, raised = self._small[count]
        through = torch.mm(self.inverse, directions.T)
        one = torch.eye(count, dtype=torch.float64, device=through.device)
        factor, info = torch.linalg.cholesky_ex(torch.addmm(one, through.T, through, alpha=sign))
        plain.invert(factor)
        raised.invert(factor + one)
        gain = torch.mm(raised.inverse.T, plain.inverse)
        self.inverse.addmm_(through, gain @ (through.T @ self.inverse), alpha=-sign)
        return info == 0

    def make_with(self, across: torch.Tensor, rates: torch.Tensor) -> bool:
        """R of the ``matrix`` and ``across`` (n, m) diag(``rates``) across^T, if that is definite; else it stays."""
        directions = across[self.order]
        if not bool(self._whole.factor(torch.addmm(self.matrix, directions * rates, directions.T))):
            return False
        self._give(self._whole.inverse)
        return True

    def _give(self, made: torch.Tensor) -> None:
        torch.index_select(made, 1, self._place, out=self.inverse)


class _Triangle:
    """Inverses of Cholesky factors of one size: of small blocks on the diagonal at once, then of pairs of them."""

    def __init__(self, count: int, stream: GraphStream) -> None:
        pairs = max(0, math.ceil(math.log2(count / kernels.LARGEST)))
        # Even, for what loads two numbers at once.
        side = 2 * math.ceil(count / 2 ** (pairs + 1))
        size = side * 2**pairs
        self._count, self._side, self._size, self._stream = count, side, size, stream
        self._given = torch.eye(size, dtype=torch.float64, device=stream.device)
        self._made = torch.zeros_like(self._given)
        self.inverse = self._made[:count, :count]

    def factor(self, matrix: torch.Tensor) -> torch.Tensor:
        """``inverse`` of the factor of the lower triangle of a ``matrix`` (n, n); () bool, whether it has one."""
        factor, info = torch.linalg.cholesky_ex(matrix)
        self.invert(factor)
        return info == 0

    def invert(self, lower: torch.Tensor) -> None:
        """``inverse`` of a ``lower`` triangle (n, n)."""
        self._given[: self._count, : self._count] = lower
        side = self._side
        # Torch would take one block after the other.
        lanes = kernels.BLOCK if lower.is_cuda else 1
        wp.launch(
            kernels.invert_triangles_kernel,
            (self._size // side, lanes),
            inputs=[as_warp(self._given, real), side],
            outputs=[as_warp(self._made, real)],
            device=wp.device_from_torch(lower.device),
            stream=self._stream.current(),
            block_dim=lanes,
        )
        while side < self._size:
            first, second = (_blocks(self._made, side, 2 * side, place) for place in (0, side * (self._size + 1)))
            below = side * self._size
            between = torch.bmm(_blocks(self._given, side, 2 * side, below), first)
            _blocks(self._made, side, 2 * side, below).copy_(torch.bmm(second, between).neg_())
            side *= 2


def _blocks(matrix: torch.Tensor, side: int, apart: int, first: int) -> torch.Tensor:
    """(b, side, side) blocks of a square ``matrix``, each so far ``apart`` along the diagonal, from entry ``first``."""
    size = len(matrix)
    return matrix.as_strided((size // apart, side, side), (apart * (size + 1), size, 1), first)
