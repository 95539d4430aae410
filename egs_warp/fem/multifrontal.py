"""Multifrontal L D L^T factorisation of a step's sparse matrix, with solves for many right-hand sides.

The kernels are in ``egs_warp.kernels.fem.supernodal``, ``quadratic_form`` and ``products``.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as dense
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.front_layout import FrontLayout, as_index_array
from egs_warp.fem.linear_solver import FactorStatus
from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.fem.supernodes import Supernodes, first_of_equal_rows
from egs_warp.kernels.fem import supernodal as kernels
from egs_warp.kernels.fem.products import PANEL, Rows
from egs_warp.kernels.fem.quadratic_form import quadratic_form_kernel
from egs_warp.launching import launch_cached, run_concurrently, shared_zeros, zeros
from egs_warp.precision import real

_MIN_RELATIVE_PIVOT = 1e-14
"""Pivot threshold, as a fraction of the largest diagonal entry. A matrix with a pivot at or below it is singular."""


@dataclass(frozen=True)
class SymbolicFactorization:
    """Symbolic factorisation of a sparsity pattern, shared by all matrices with that pattern."""

    full_from_upper: np.ndarray
    """(nnz of the full matrix,) index of the upper entry that equals each entry of the full symmetric matrix, in column
    order."""
    offsets: wp.array
    """(n + 1,) column offsets of the full matrix."""
    indices: wp.array
    """Row indices of the full matrix."""
    first_of_equal_rows: wp.array
    """(n,) 0 for each row with the same pattern as the previous row, otherwise 1."""
    permutation: np.ndarray
    """(n,) position of each row in the order of elimination."""
    layout: FrontLayout
    """Memory layout of the fronts."""

    @classmethod
    def of(cls, upper_pattern: sparse.csc_matrix | sparse.csc_array) -> SymbolicFactorization:
        """Analyse the pattern of an upper triangle that includes the diagonal."""
        upper = sparse.csc_matrix(
            (np.arange(1.0, upper_pattern.nnz + 1.0), upper_pattern.indices, upper_pattern.indptr), upper_pattern.shape
        )
        full = (upper + sparse.triu(upper, 1).T).tocsc()
        full.sort_indices()
        blocks = Supernodes.of(upper)
        return cls(
            full.data.astype(np.int64) - 1,
            as_index_array(full.indptr),
            as_index_array(full.indices),
            as_index_array(first_of_equal_rows(full)),
            blocks.permutation,
            FrontLayout.of(blocks, upper),
        )


class MultifrontalLdl:
    """Multifrontal L D L^T solver for symmetric matrices of one pattern; implements ``LinearSolver``.

    The symbolic analysis is done once. Results are bitwise equal on any number of cores. There is no pivoting, because
    positive definite matrices need none. The factors of an indefinite matrix serve only to compute its inertia and to
    add the muscles' stiffness. A nearly singular matrix is reported as having no factors.
    """

    is_asynchronous = False
    stream: AbstractContextManager[None] = nullcontext()

    def __init__(
        self, upper_pattern: sparse.csc_matrix | sparse.csc_array, analysis: SymbolicFactorization | None = None
    ) -> None:
        """Allocate the solver.

        Args:
            upper_pattern: (n, n) upper triangle with the diagonal, entries in the order of ``factor``.
            analysis: symbolic factorisation of the pattern; computed if None.
        """
        self._device = wp.get_device("cpu")
        # Loading a module from two threads at once is not safe.
        kernels.solve_kernel.module.load(self._device, block_dim=1)
        symbolic = analysis or SymbolicFactorization.of(upper_pattern)
        self._full_from_upper = symbolic.full_from_upper
        self._full = Rows()
        self._full_values, self._full.values = shared_zeros(len(symbolic.full_from_upper))
        self._full.offsets, self._full.indices, self._full.first_of_equal_rows = (
            symbolic.offsets,
            symbolic.indices,
            symbolic.first_of_equal_rows,
        )
        self._diagonal = upper_pattern.indptr[1:] - 1
        self._unknowns = len(upper_pattern.indptr) - 1
        self.permutation = symbolic.permutation
        """(n,) position of each row in the order of elimination."""
        self._layout = layout = symbolic.layout
        self._entries, self._matrix = shared_zeros(upper_pattern.nnz)
        sizes = layout.front + layout.scratch, layout.stack, layout.factor, layout.inverses, self._unknowns
        self._front, self._stack, self._factor, self._inverses, self._reciprocals = (
            shared_zeros(size + kernels.PADDING)[1] for size in sizes
        )
        self._negative = np.zeros(1, np.int32)
        self._negative_array = wp.array(self._negative, dtype=int, device="cpu", copy=False)
        self._workspace = shared_zeros(0)[1]
        self._counters = np.zeros(3, np.int32)
        self._counters_array = wp.array(self._counters, dtype=int, device="cpu", copy=False)
        self._no_projection, self._projection = _ProjectionArrays(0).struct, _ProjectionArrays(self._unknowns)
        self._projection.struct.enabled = 1
        self._effort: _EffortWorkspace | None = None
        self._loaded: set[Any] = set()
        """Kernels whose modules are loaded."""
        self._added: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        """U (n, k), S^-1 U (n, k) and the inverse (k, k) of the capacitance matrix diag(1/r) + U^T S^-1 U."""
        self.negative_pivots = -1
        """Number of negative eigenvalues of the last matrix; -1 if it has no factors."""

    def entries_from(self, entries: wp.array) -> np.ndarray:
        """Return a copy of ``entries`` on the host."""
        return entries.numpy().flatten()

    def factor(self, entries: np.ndarray, diagonal: np.ndarray | None = None) -> None:
        """Factor S; see ``LinearSolver.factor``. The factors of an indefinite matrix can be used for solves too."""
        self.negative_pivots, self._added = -1, None
        if not np.isfinite(entries).all():
            return
        self._entries[:] = entries
        if diagonal is not None:
            self._entries[self._diagonal] += diagonal
        launch_cached(
            kernels.factor_kernel,
            1,
            inputs=[
                *(self._layout.fronts, len(self._layout.fronts.first), self._matrix),
                _MIN_RELATIVE_PIVOT * float(np.abs(self._entries[self._diagonal]).max()),
                *(self._front, self._layout.front, self._stack, self._factor, self._inverses, self._reciprocals),
            ],
            outputs=[self._negative_array],
            device=self._device,
        )
        self.negative_pivots = int(self._negative[0])

    @property
    def status(self) -> FactorStatus:
        """Status of the factors."""
        if self._added is not None or self.negative_pivots == 0:
            return FactorStatus.DEFINITE
        return FactorStatus.INDEFINITE if self.negative_pivots > 0 else FactorStatus.NONE

    def add_low_rank(self, across: np.ndarray, rates: np.ndarray) -> bool:
        """Add a low-rank term by the Woodbury formula, also to an indefinite S; see ``LinearSolver.add_low_rank``."""
        self._added = None
        if self.status is FactorStatus.NONE or len(rates) == 0:
            return self.status is FactorStatus.DEFINITE
        through = self.solve(across)
        small = across.T @ through
        small[np.diag_indices_from(small)] += 1.0 / rates
        # Haynsworth's inertia additivity: the number of negative eigenvalues of the sum is that of S, plus the number
        # of positive eigenvalues of the small matrix, minus the number of positive rates.
        positive, inverse = inverse_and_positives(small)
        if self.negative_pivots + positive != int((rates > 0.0).sum()):
            return False
        self._added = np.ascontiguousarray(across), np.ascontiguousarray(through), np.ascontiguousarray(inverse)
        return True

    def solve(self, right: np.ndarray, projection: MomentumProjection[np.ndarray] | None = None) -> np.ndarray:
        """Solve for ``right``; see ``LinearSolver.solve``."""
        if self._added is None:
            return self._solve_unprojected(right, projection)
        plain = self._solve_unprojected(right)
        across, through, small = self._added
        plain -= through @ (small @ (across.T @ plain))
        return plain if projection is None else projection.corrected(right, plain)

    def quadratic_form(
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
        """Compute the quadratic model of the elastic energy with two threads; see ``LinearSolver.quadratic_form``."""
        assert self._added is None
        count = vectors.shape[1]
        if self.status is FactorStatus.NONE:
            return np.full((count, count), np.nan), np.full(count, np.nan)
        panels = -(-count // PANEL)
        if self._effort is None or len(self._effort.linear) != panels:
            self._effort = _EffortWorkspace(panels, self._unknowns)
        workspace, vectors = self._effort, np.asarray(vectors, dtype=np.float64)
        weights = np.ascontiguousarray(weights, dtype=np.float64)
        self._full_values[:] = entries[self._full_from_upper]
        workspace.reference[:], workspace.gradient[:] = reference, gradient
        self._launch_two_threads(
            quadratic_form_kernel,
            panels,
            [
                *(*self._factor_arguments, *self._address_of(vectors), weights.ctypes.data, dt_now, dt_ahead),
                *(workspace.reference_array, workspace.gradient_array, self._full, self._workspace_for(panels)),
            ],
            [workspace.moves, workspace.products, workspace.linear_array, workspace.quadratic_array],
        )
        return workspace.quadratic[:count, :count].copy(), workspace.linear.ravel()[:count].copy()

    def _solve_unprojected(
        self, right: np.ndarray, projection: MomentumProjection[np.ndarray] | None = None
    ) -> np.ndarray:
        assert self.status is not FactorStatus.NONE, "call factor() first"
        right = np.asarray(right, dtype=np.float64)
        solution = np.empty(right.shape)
        panels = -(-(1 if right.ndim == 1 else right.shape[1]) // PANEL)
        struct = self._no_projection if projection is None else self._projection.load(projection)
        inputs = [*self._factor_arguments, *self._address_of(right), struct]
        inputs += [self._workspace_for(panels), solution.ctypes.data]
        self._launch_two_threads(kernels.solve_kernel, panels, inputs, [])
        return solution

    def _launch_two_threads(self, kernel: Any, panels: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch ``kernel``; if there are several ``panels``, on two threads that share the work."""
        self._counters[:] = 0

        def launch() -> None:
            launch_cached(kernel, 1, inputs=[self._counters_array, *inputs], outputs=outputs, device=self._device)

        if panels > 1:
            if kernel not in self._loaded:
                # Two threads must not load a module at the same time.
                kernel.module.load(self._device, block_dim=1)
                self._loaded.add(kernel)
            run_concurrently(launch, launch)
        else:
            launch()

    @property
    def _factor_arguments(self) -> list[Any]:
        fronts = self._layout.fronts
        return [fronts, len(fronts.first), self._unknowns, self._factor, self._inverses, self._reciprocals]

    @staticmethod
    def _address_of(right: np.ndarray) -> list[int]:
        """Return the address of ``right``, its row and column strides in float64 values, and its number of columns."""
        strides = [stride // 8 for stride in right.strides]
        return [right.ctypes.data, *(strides if right.ndim > 1 else [*strides, 0]), right[0].size]

    def _workspace_for(self, panels: int) -> wp.array:
        size = panels * (self._unknowns + 4) * PANEL
        if self._workspace.size < size:
            self._workspace = shared_zeros(size)[1]
        return self._workspace


class _ProjectionArrays:
    """Arrays of a momentum projection and the struct through which the kernels access them."""

    def __init__(self, unknowns: int) -> None:
        self.struct = kernels.MomentumProjection()
        self._arrays: dict[str, np.ndarray] = {}
        for name, size in (
            ("rotation_modes", 3 * unknowns),
            ("mode_momenta", 3 * unknowns),
            ("rotation_response", 3 * unknowns),
            ("inverse", 9),
        ):
            self._arrays[name], array = shared_zeros(size)
            setattr(self.struct, name, array)
        self._ratio, self.struct.inertia_ratio = shared_zeros(1)
        self._loaded: MomentumProjection[np.ndarray] | None = None

    def load(self, projection: MomentumProjection[np.ndarray]) -> Any:
        """Copy ``projection`` to the arrays, unless it was the last one, and return the kernels' struct."""
        if self._loaded is not projection:
            self._loaded, self._ratio[0] = projection, projection.inertia_ratio
            for name, array in self._arrays.items():
                array[:] = getattr(projection, name).ravel()
        return self.struct


class _EffortWorkspace:
    """Workspace of ``quadratic_form`` for a given number of panels."""

    def __init__(self, panels: int, unknowns: int) -> None:
        self.moves, self.products = (zeros((panels, unknowns, PANEL), real, "cpu") for _ in range(2))
        self.reference, self.reference_array = shared_zeros(unknowns)
        self.gradient, self.gradient_array = shared_zeros(unknowns)
        self.linear, self.linear_array = shared_zeros((panels, PANEL))
        self.quadratic, self.quadratic_array = shared_zeros((panels * PANEL, panels * PANEL))


def inverse_and_positives(symmetric: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of positive eigenvalues and the inverse of a symmetric matrix.

    Both come from one Bunch-Kaufman factorisation. Of ``symmetric`` (n, n) only the lower triangle is read. For a
    singular matrix the number is -1 and the inverse is not finite.
    """
    factor, invert = dense.get_lapack_funcs(("sytrf", "sytri"), (symmetric,))
    factors, pivots, info = factor(symmetric, lower=1)
    if info > 0:
        return -1, np.full_like(symmetric, np.nan)
    # A 2 x 2 block, marked by negative pivots, has one eigenvalue of each sign.
    positive = int((factors.diagonal()[pivots > 0] > 0.0).sum()) + int((pivots < 0).sum()) // 2
    inverse, _ = invert(factors, pivots, lower=1)
    lower = np.tril(inverse, -1)
    return positive, lower + lower.T + np.diag(inverse.diagonal())
