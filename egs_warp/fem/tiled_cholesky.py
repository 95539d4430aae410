"""Dense Cholesky factors of a step's matrix, in PyTorch; on a GPU they are faster than sparse factors.

The kernel that inverts triangular blocks is in ``egs_warp.kernels.fem.triangles``.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
import torch
import warp as wp

from egs_warp.fem.batched import as_warp
from egs_warp.fem.cuda_graphs import GraphStream
from egs_warp.fem.dissection import Dissection
from egs_warp.fem.linear_solver import FactorStatus, energy_moves
from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.fem.tile_tasks import TileTaskGraph
from egs_warp.kernels.fem import triangles as kernels
from egs_warp.kernels.fem.tiled_inverse import BLOCK, TILE_SIDE, tiled_inverse_kernel
from egs_warp.precision import Mat33, real

_PROCESSOR_FRACTION = 10 / 11
"""Fraction of a GPU's multiprocessors that the kernel occupies; the rest stays available for concurrent work."""


class TiledCholesky:
    """Dense Cholesky solver for symmetric matrices of one pattern; implements ``LinearSolver``.

    The inverse factor L^-1 is computed once per matrix, because a product with L^-1 takes a fiftieth of the time of a
    triangular solve. A triangular solve takes as long for one right-hand side as for a thousand.
    """

    is_asynchronous = True

    def __init__(self, upper_pattern: sparse.csc_matrix | sparse.csc_array, *, device: str) -> None:
        """Allocate the solver.

        Args:
            upper_pattern: (n, n) upper triangle with the diagonal, entries in the order of ``factor``.
            device: PyTorch device.
        """
        count = len(upper_pattern.indptr) - 1
        rows = np.asarray(upper_pattern.indices, dtype=np.int64)
        columns = np.repeat(np.arange(count), np.diff(upper_pattern.indptr))
        self.device = torch.device(device)
        self.stream = GraphStream(self.device)
        self._upper = torch.from_numpy(rows * count + columns).to(self.device)
        self._lower = torch.from_numpy(columns * count + rows).to(self.device)
        self._root = _InverseFactor(Dissection.of(upper_pattern), self.stream)
        self.places = self._root.entry_slots(rows, columns)
        """(nnz,) positions of the entries in the flat matrix that is factored."""
        self._energy_hessian = torch.zeros((count, count), dtype=torch.float64, device=self.device)
        self._entries, self._diagonal = self._energy_hessian.new_zeros(len(rows)), self._energy_hessian.new_zeros(count)
        self._uploaded_diagonal = np.zeros(count)
        self._flags_readback, self.status_flags = self.stream.pinned(2), self._energy_hessian.new_zeros(2)
        """(2,) flags on the host and on the device: nonzero if the entries are finite, and nonzero if the matrix is
        positive definite."""
        self._factored = self.stream.run_captured(self._factor)
        self.rotation_response, self.rotation_operator = (
            self._energy_hessian.new_zeros(shape) for shape in ((count, 3), (3, count))
        )
        """(n, 3) and (3, n), factors of the momentum projection: the solution for a right-hand side b is corrected by
        adding ``rotation_response`` ``rotation_operator`` b."""
        self._momentum_matrices = self._energy_hessian.new_zeros(2, 3, 3)
        self._half_solved, self._solved = self._energy_hessian.new_zeros(2, count)
        self._rotation = self._energy_hessian.new_zeros(3)
        self._finite = self._pending = False
        self._status = FactorStatus.NONE

    def entries_from(self, entries: wp.array) -> torch.Tensor:
        """Return a copy of ``entries`` on the device; PyTorch must use Warp's stream."""
        return wp.to_torch(entries).flatten().clone()

    def factor(self, entries: np.ndarray | torch.Tensor, diagonal: np.ndarray | None = None) -> None:
        """Factor S asynchronously; see ``LinearSolver.factor``. An indefinite matrix has no factors."""
        with self.stream:
            self._entries.copy_(self._to_device(entries))
            self.upload_diagonal(np.zeros(len(self._diagonal)) if diagonal is None else diagonal)
            self._factored()
        self._pending = True

    def upload_diagonal(self, diagonal: np.ndarray) -> None:
        """Set the ``diagonal`` (n,) that is added to the entries."""
        # The diagonal is usually the same in every step.
        if not np.array_equal(diagonal, self._uploaded_diagonal):
            self._uploaded_diagonal = diagonal.copy()
            self._diagonal.copy_(self._to_device(diagonal))

    def enqueue_factor(self, entries: torch.Tensor) -> None:
        """Queue the factorisation with the uploaded diagonal, as part of a graph.

        After launching the graph, the caller must call ``mark_started``.
        """
        self._entries.copy_(entries)
        self._factor()

    def enqueue_low_rank(self, directions: torch.Tensor, sign: float) -> None:
        """Queue the update of the factors from S to S + ``sign`` U^T U. ``status_flags`` and ``status`` tell whether it
        succeeds.

        S must be positive definite. Updates with a negative sign must come last, since their sum may be indefinite.

        Args:
            directions: (k, n) U.
            sign: 1 or -1.
        """
        self.status_flags[1].mul_(self._root.add_low_rank(directions, sign))
        self._flags_readback.copy_(self.status_flags, non_blocking=True)

    def mark_started(self) -> None:
        """Record that factors are queued; ``status`` then blocks until they are computed."""
        self._pending = True

    def _factor(self) -> None:
        """Queue the factorisation with the current entries and diagonal, and the download of its ``status_flags``."""
        self._root.matrix.view(-1)[self.places] = self._entries
        self._root.matrix.diagonal().add_(self._diagonal[self._root.order])
        definite = self._root.factor()
        self.status_flags.copy_(torch.stack([self._entries.isfinite().all(), definite]))
        self._flags_readback.copy_(self.status_flags, non_blocking=True)

    def add_low_rank(self, across: np.ndarray, rates: np.ndarray) -> bool:
        """Add a low-rank term; see ``LinearSolver.add_low_rank``. If the sum is not positive definite, S keeps its
        factors."""
        self._finish()
        if not self._finite or not (np.isfinite(across).all() and np.isfinite(rates).all()):
            return False
        with self.stream:
            if not self._root.factor_with(self._to_device(across), self._to_device(rates)):
                return False
        self._status = FactorStatus.DEFINITE
        return True

    @property
    def status(self) -> FactorStatus:
        """Status of the factors; blocks until queued factors are computed."""
        self._finish()
        return self._status

    def _finish(self) -> None:
        """Block until queued factors are computed, and set their status."""
        if self._pending:
            self.stream.wait()
            self._pending = False
            finite, definite = self._flags_readback.tolist()
            self._finite = finite > 0.0
            self._status = FactorStatus.DEFINITE if self._finite and definite > 0.0 else FactorStatus.NONE

    def solve(self, right: np.ndarray, projection: MomentumProjection[np.ndarray] | None = None) -> np.ndarray:
        """Solve for ``right``; see ``LinearSolver.solve``."""
        assert self.status is FactorStatus.DEFINITE, "call factor() first"
        with self.stream:
            plain = self._to_host(self.enqueue_solve(self._to_device(right)))
        return plain if projection is None else projection.corrected(right, plain)

    @property
    def inverse(self) -> torch.Tensor:
        """(n, n) matrix R on the device with S^-1 = R^T R: L^-1 with permuted unknowns. The address of R never
        changes."""
        return self._root.inverse

    def enqueue_solve(self, right: torch.Tensor) -> torch.Tensor:
        """Queue S^-1 ``right`` (n, m) and return the result."""
        return self.inverse.T @ (self.inverse @ right)

    def enqueue_momentum_projection(
        self, rotation_modes: torch.Tensor, mode_momenta: torch.Tensor, rotation_response: torch.Tensor, ratio: float
    ) -> None:
        """Queue the momentum projection of the current factors; arguments as the fields of ``MomentumProjection``.

        Since S is symmetric, the correction of a solution is a linear function of its right-hand side b: U P b with
        P = inverse (T - ratio U)^T. One product with P replaces two.
        """
        self.rotation_response.copy_(rotation_response)
        torch.mm(mode_momenta.T, self.rotation_response, out=self._momentum_matrices[0])
        wp.launch(
            kernels.invert_momentum_matrix_kernel,
            1,
            inputs=[ratio, as_warp(self._momentum_matrices[:1], Mat33)],
            outputs=[as_warp(self._momentum_matrices[1:], Mat33)],
            device=wp.device_from_torch(self.device),
        )
        torch.mm(
            self._momentum_matrices[1], rotation_modes.T - ratio * self.rotation_response.T, out=self.rotation_operator
        )

    def enqueue_projected_solve(self, right: torch.Tensor) -> torch.Tensor:
        """Queue S^-1 ``right`` (n, m) with the last queued momentum projection, and return the result."""
        return self.enqueue_solve(right).addmm_(self.rotation_response, self.rotation_operator @ right)

    def enqueue_vector_solve(self, right: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Queue the solution for one right-hand side without allocations.

        Args:
            right: (n,).

        Returns:
            S^-1 ``right`` (n,), and (3,) coefficients r. For the projected solution, ``rotation_response`` r must be
            added. The next call overwrites both.
        """
        torch.mv(self.inverse, right, out=self._half_solved)
        torch.mv(self.inverse.T, self._half_solved, out=self._solved)
        torch.mv(self.rotation_operator, right, out=self._rotation)
        return self._solved, self._rotation

    def quadratic_form(
        self,
        entries: np.ndarray | torch.Tensor,
        gradient: np.ndarray | torch.Tensor,
        weights: np.ndarray | torch.Tensor,
        vectors: np.ndarray | torch.Tensor,
        *,
        dt_now: float,
        dt_ahead: float,
        reference: np.ndarray | torch.Tensor,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the quadratic model of the elastic energy; see ``LinearSolver.quadratic_form``."""
        with self.stream:
            matrix, slope, masses, columns, offset = map(
                self._to_device, (entries, gradient, weights, vectors, reference)
            )
            terms = self.enqueue_quadratic_form(matrix, slope, masses, columns, dt_now, dt_ahead, offset)
            quadratic, linear = map(self._to_host, terms)
            return quadratic, linear

    def enqueue_quadratic_form(
        self,
        entries: torch.Tensor,
        gradient: torch.Tensor,
        weights: torch.Tensor,
        vectors: torch.Tensor,
        dt_now: float,
        dt_ahead: float,
        reference: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Queue ``quadratic_form`` of device tensors, without synchronisation."""
        flat = self._energy_hessian.view(-1)
        flat[self._upper] = entries
        flat[self._lower] = entries
        moves = energy_moves(self.enqueue_solve, weights, vectors, dt_now, dt_ahead, reference)
        return moves.T @ (self._energy_hessian @ moves), gradient @ moves

    def _to_device(self, values: np.ndarray | torch.Tensor) -> torch.Tensor:
        if isinstance(values, torch.Tensor):
            return values
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)

    @staticmethod
    def _to_host(values: torch.Tensor) -> np.ndarray:
        return values.cpu().numpy()


class _InverseFactor:
    """Inverse factor R with S^-1 = R^T R for symmetric matrices S (n, n) of one pattern.

    R is L^-1 for S permuted to the order of the dissection; the columns of R are in the original order of S. On a GPU
    the slabs are eliminated in parallel, tile by tile; on a CPU PyTorch factors the whole matrix.
    """

    def __init__(self, dissection: Dissection, stream: GraphStream) -> None:
        order, device = dissection.order, stream.device
        count = len(order)
        permutation = np.empty(count, dtype=np.int64)
        permutation[order] = np.arange(count)
        self._host_permutation, self._stream = permutation, stream
        self._permutation, self.order = (
            torch.from_numpy(each).to(device) for each in (permutation, order.astype(np.int64))
        )
        self.matrix, self.inverse = torch.zeros((2, count, count), dtype=torch.float64, device=device)
        """(n, n) each: the matrix S in the order of the dissection, of which only the lower triangle is read, and R."""
        # The keys are the numbers k of directions.
        self._small: dict[int, tuple[_TriangularInverse, _TriangularInverse]] = {}
        self._tiled = (
            TiledInverseFactor(dissection, self.matrix, self.inverse, stream) if device.type == "cuda" else None
        )

    @cached_property
    def _whole(self) -> _TriangularInverse:
        return _TriangularInverse(len(self.order), self._stream)

    def entry_slots(self, rows: np.ndarray, columns: np.ndarray) -> torch.Tensor:
        """Return the positions in the flat ``matrix`` of the entries of one triangle at ``rows`` and ``columns``."""
        one, other = self._host_permutation[rows], self._host_permutation[columns]
        slots = np.maximum(one, other) * len(self.order) + np.minimum(one, other)
        return torch.from_numpy(slots).to(self._stream.device)

    def factor(self) -> torch.Tensor:
        """Compute R of ``matrix``; return a () bool tensor, True if the matrix is positive definite."""
        if self._tiled is not None:
            return self._tiled.factor()
        definite = self._whole.factor(self.matrix)
        self._set_inverse(self._whole.inverse)
        return definite

    def add_low_rank(self, directions: torch.Tensor, sign: float) -> torch.Tensor:
        """Update R from S to S + ``sign`` U^T U, with ``directions`` U (k, n).

        With W = R U^T and K K^T = 1 + sign W^T W, the new factor is (1 - sign W K^-T (K + 1)^-1 W^T)^T R (Andrews, AIAA
        Journal 6(6), 1968). Only k x k matrices are factored.

        Returns:
            () bool tensor, True if the sum is positive definite.
        """
        count = len(directions)
        if count not in self._small:
            self._small[count] = _TriangularInverse(count, self._stream), _TriangularInverse(count, self._stream)
        plain, raised = self._small[count]
        through = torch.mm(self.inverse, directions.T)
        one = torch.eye(count, dtype=torch.float64, device=through.device)
        factor, info = torch.linalg.cholesky_ex(torch.addmm(one, through.T, through, alpha=sign))
        plain.invert(factor)
        raised.invert(factor + one)
        gain = torch.mm(raised.inverse.T, plain.inverse)
        self.inverse.addmm_(through, gain @ (through.T @ self.inverse), alpha=-sign)
        return info == 0

    def factor_with(self, across: torch.Tensor, rates: torch.Tensor) -> bool:
        """Compute R of ``matrix`` + U diag(r) U^T, with ``across`` U (n, m) and ``rates`` r (m,).

        Returns:
            True if the sum is positive definite; otherwise R is unchanged.
        """
        directions = across[self.order]
        if not bool(self._whole.factor(torch.addmm(self.matrix, directions * rates, directions.T))):
            return False
        self._set_inverse(self._whole.inverse)
        return True

    def _set_inverse(self, inverse: torch.Tensor) -> None:
        torch.index_select(inverse, 1, self._permutation, out=self.inverse)


class TiledInverseFactor:
    """Inverse factor R with S^-1 = R^T R for symmetric matrices S (n, n), computed by one kernel.

    R is L^-1 for S permuted to the order of the dissection; the columns of R are in the original order of S.
    """

    def __init__(
        self, dissection: Dissection, matrix: torch.Tensor, inverse: torch.Tensor, stream: GraphStream
    ) -> None:
        """Allocate the scratch memory.

        Args:
            dissection: partition of the unknowns.
            matrix: (n, n) float64, input: the lower triangle of S in the order of the dissection.
            inverse: (n, n) float64, output: R.
            stream: stream of the launches.
        """
        tasks = TileTaskGraph([len(part) for part in dissection.parts], len(dissection.separator))
        device, self._stream = matrix.device, stream
        order = dissection.order.astype(np.int32)
        permutation = np.empty_like(order)
        permutation[order] = np.arange(len(order))
        index_arrays = (
            torch.from_numpy(values).to(device) for values in (tasks.tasks, tasks.pairs, order, permutation)
        )
        self._inputs = [as_warp(matrix, real), *(as_warp(values, wp.int32) for values in index_arrays), tasks.columns]
        numbers = (
            torch.zeros(count * TILE_SIDE**2, dtype=torch.float64, device=device)
            for count in (tasks.tiles, tasks.columns)
        )
        flags = (torch.zeros(count, dtype=torch.int32, device=device) for count in (tasks.tiles + tasks.columns, 4))
        self._inputs += [
            *(as_warp(values, real) for values in numbers),
            *(as_warp(values, wp.int32) for values in flags),
        ]
        self._definite = torch.zeros(1, dtype=torch.bool, device=device)
        self._outputs = [as_warp(inverse, real), as_warp(self._definite, wp.bool)]
        self._device = wp.device_from_torch(device)
        self._blocks = min(len(tasks.tasks), max(1, int(_PROCESSOR_FRACTION * self._device.sm_count)))

    def factor(self) -> torch.Tensor:
        """Queue the computation of R of ``matrix``; return a () bool tensor, True if the matrix is positive
        definite."""
        wp.launch(
            tiled_inverse_kernel,
            (self._blocks, BLOCK),
            inputs=self._inputs,
            outputs=self._outputs,
            device=self._device,
            stream=self._stream.current(),
            block_dim=BLOCK,
        )
        return self._definite[0]


class _TriangularInverse:
    """Inverse of a lower triangular matrix: small diagonal blocks are inverted in parallel, then pairs of blocks
    recursively."""

    def __init__(self, count: int, stream: GraphStream) -> None:
        pairs = max(0, math.ceil(math.log2(count / kernels.MAX_ROWS)))
        # The size is even, because kernels load two numbers at once.
        side = 2 * math.ceil(count / 2 ** (pairs + 1))
        size = side * 2**pairs
        self._count, self._side, self._size, self._stream = count, side, size, stream
        self._lower = torch.eye(size, dtype=torch.float64, device=stream.device)
        self._out = torch.zeros_like(self._lower)
        self.inverse = self._out[:count, :count]

    def factor(self, matrix: torch.Tensor) -> torch.Tensor:
        """Set ``inverse`` to the inverse of the Cholesky factor of ``matrix`` (n, n); return a () bool tensor, True if
        the matrix is positive definite."""
        factor, info = torch.linalg.cholesky_ex(matrix)
        self.invert(factor)
        return info == 0

    def invert(self, lower: torch.Tensor) -> None:
        """Set ``inverse`` to the inverse of the ``lower`` triangular matrix (n, n)."""
        self._lower[: self._count, : self._count] = lower
        side = self._side
        # PyTorch would invert the blocks one after the other.
        lanes = kernels.BLOCK if lower.is_cuda else 1
        wp.launch(
            kernels.invert_triangles_kernel,
            (self._size // side, lanes),
            inputs=[as_warp(self._lower, real), side],
            outputs=[as_warp(self._out, real)],
            device=wp.device_from_torch(lower.device),
            stream=self._stream.current(),
            block_dim=lanes,
        )
        while side < self._size:
            first, second = (_blocks(self._out, side, 2 * side, place) for place in (0, side * (self._size + 1)))
            below = side * self._size
            between = torch.bmm(_blocks(self._lower, side, 2 * side, below), first)
            _blocks(self._out, side, 2 * side, below).copy_(torch.bmm(second, between).neg_())
            side *= 2


def _blocks(matrix: torch.Tensor, side: int, apart: int, first: int) -> torch.Tensor:
    """Return a view (b, side, side) of blocks of a square ``matrix``.

    Args:
        matrix: contiguous square matrix.
        side: rows of a block.
        apart: rows between the first rows of two blocks, along the diagonal.
        first: flat index of the first block's first entry.
    """
    size = len(matrix)
    return matrix.as_strided((size // apart, side, side), (apart * (size + 1), size, 1), first)
