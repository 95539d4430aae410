"""Optimum of a strictly convex QP to rounding, from a guess of its active constraints.

The dual active-set method of Goldfarb and Idnani (1983), started at the guess. Its kernels are in
``egs_warp.kernels.locomotion.active_set`` and ``egs_warp.kernels.locomotion.whitened_constraints``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from egs_warp.kernels.locomotion import active_set as kernels
from egs_warp.kernels.locomotion.whitened_constraints import STEP, WhitenedConstraints, reduce_kernel, scratch_size
from egs_warp.launching import thread_local_cache
from egs_warp.precision import Vec4, real

_MAX_PIVOTS = 600
"""Maximum number of changes of the active set."""
_BOUND_TOLERANCE = 1e-8
"""Tolerance of the bounds of a row, multiplied by the row's norm in z if that exceeds 1."""
_INFEASIBLE_COST = 1e6
"""Factor of ``WhitenedQp.objective_drop``. Bounds that raise the objective by more count as infeasible."""


@dataclass(frozen=True)
class WhitenedQp:
    """The QP min 1/2 x^T P x + q^T x with rows A, in whitened coordinates z = D^1/2 L^T (x - x0), P = L D L^T, with the
    unconstrained minimum x0: the Hessian is the identity, and the cost is half the squared distance from x0."""

    P: np.ndarray
    """(n, n)."""
    q: np.ndarray
    """(n,)."""
    rows: np.ndarray
    """(m, n) A."""
    minimum: np.ndarray
    """(n,) x0, the unconstrained minimum."""
    values_at_minimum: np.ndarray
    """(m,) A x0."""
    row_norms: np.ndarray
    """(m,) norms of the rows in z; 1 for zero rows."""
    objective_drop: float
    """Decrease of the objective from x = 0 to x0, at least 1."""

    @classmethod
    def of(cls, P: np.ndarray, q: np.ndarray, A: np.ndarray) -> WhitenedQp:
        """Whiten the QP.

        Args:
            P: (n, n).
            q: (n,).
            A: (m, n).

        Raises:
            numpy.linalg.LinAlgError: P is finite but not positive definite. If P is not finite, the minimum is NaN.
        """
        P, q, A = (np.asarray(each, dtype=np.float64) for each in (P, q, A))
        minimum, values_at_minimum, row_norms = _workspace_for(A).reduce(P, q, A)
        return cls(P, q, A, minimum, values_at_minimum, row_norms, max(1.0, -0.5 * float(q @ minimum)))

    @property
    def unit_rows(self) -> np.ndarray:
        """(m, n) rows in z, each of length 1 or 0. A view that is valid until another QP of this size is whitened in
        this thread."""
        return _workspace_for(self.rows).unit_rows(self)

    def whiten(self, x: np.ndarray) -> np.ndarray:
        """Return z (n,) of ``x`` (n,)."""
        return _workspace_for(self.rows).whiten(self, x)

    @cached_property
    def slack(self) -> np.ndarray:
        """(m,) tolerance of the bounds of each row."""
        return _BOUND_TOLERANCE * np.maximum(1.0, self.row_norms)


@dataclass(frozen=True)
class Optimum:
    """Result of the active-set method."""

    x: np.ndarray
    """(n,)."""
    multipliers: np.ndarray
    """(m,) positive at an active upper bound."""
    feasible: bool
    """True if a point satisfies the bounds; otherwise ``x`` has no meaning."""


class _Workspace:
    """Reused memory and recorded launches for QPs of at most ``rows`` rows and ``unknowns`` unknowns; allocating them
    takes longer than a solve. It holds the whitened rows of one QP, the one that was loaded last."""

    def __init__(self, rows: int, unknowns: int) -> None:
        padded_unknowns = -(-unknowns // 8) * 8
        self._minimum, self._values_at_minimum, self._row_norms = np.zeros(unknowns), np.zeros(rows), np.zeros(rows)
        self._units, self._unknowns = np.zeros((rows, padded_unknowns)), unknowns
        constraints = WhitenedConstraints()
        self._transpose, self._roots = np.zeros((unknowns, padded_unknowns)), np.zeros(unknowns)
        constraints.lower, constraints.columns = _zeros((unknowns, padded_unknowns)), _zeros((unknowns, rows))
        constraints.upper, constraints.roots = _shared(self._transpose), _shared(self._roots)
        constraints.scratch = _zeros((scratch_size(unknowns, padded_unknowns),))
        constraints.minimum, constraints.free, constraints.lengths = map(
            _shared, (self._minimum, self._values_at_minimum, self._row_norms)
        )
        constraints.rows, constraints.products = map(_by_fours, (self._units, np.zeros((rows, rows))))
        constraints.has_products = wp.zeros(rows, dtype=int, device="cpu")
        self._definite, self._at_zero = np.zeros(1, np.int32), np.zeros(rows)
        self._lower, self._upper, self._slack = np.zeros((3, rows))
        self._cost_limit, self._multipliers = np.zeros(1), np.zeros(unknowns)
        self._side, self._active, self._end = (np.zeros(count, np.int32) for count in (rows, unknowns, 2))
        program, search = kernels.Program(), kernels.ActiveSetState()
        program.constraints, program.values_at_origin = constraints, _by_fours(self._at_zero)
        program.lower, program.upper, program.slack = map(_shared, (self._lower, self._upper, self._slack))
        program.cost_limit, search.multipliers = _shared(self._cost_limit), _shared(self._multipliers)
        search.side, search.active = _shared(self._side), _shared(self._active)
        search.values, search.orthogonal_part = _by_fours(np.zeros(rows)), _by_fours(np.zeros(padded_unknowns))
        search.factor = _zeros((unknowns, unknowns))
        search.rates, search.solved_products = _zeros((unknowns,)), _zeros((unknowns,))
        self._whitening_launch: Any = wp.launch(
            reduce_kernel,
            1,
            inputs=[0, 0, 0, 0, 0, 0],
            outputs=[constraints, _shared(self._definite)],
            device="cpu",
            record_cmd=True,
        )
        self._search_launch: Any = wp.launch(
            kernels.optimum_kernel,
            1,
            inputs=[program, _MAX_PIVOTS, search],
            outputs=[_shared(self._end), 0],
            device="cpu",
            record_cmd=True,
        )
        # The launches hold the addresses of these structs' arrays.
        self._structs = constraints, program, search
        self._loaded: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def reduce(self, P: np.ndarray, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Whiten the QP; return x0 (n,), A x0 (m,) and the norms of the rows (m,)."""
        P, q, A = (each if each.strides[-1] == 8 else np.ascontiguousarray(each) for each in (P, q, A))
        arguments = P.ctypes.data, P.strides[0] // 8, q.ctypes.data, A.ctypes.data, A.strides[0] // 8, len(A)
        for index, value in enumerate(arguments):
            self._whitening_launch.set_param_at_index_from_ctype(index, value)
        self._whitening_launch.launch()
        self._loaded = P, q, A
        if not self._definite[0]:
            if np.isfinite(P).all():
                raise np.linalg.LinAlgError("the Hessian is not positive definite")
            self._minimum[:], self._values_at_minimum[:], self._row_norms[:] = np.nan, np.nan, 1.0
        return self._minimum.copy(), self._values_at_minimum[: len(A)].copy(), self._row_norms[: len(A)].copy()

    def unit_rows(self, qp: WhitenedQp) -> np.ndarray:
        """Return the unit rows (m, n) of the QP in z."""
        self._load(qp)
        return self._units[: len(qp.rows), : self._unknowns]

    def whiten(self, qp: WhitenedQp, x: np.ndarray) -> np.ndarray:
        """Return z (n,) of ``x`` (n,)."""
        self._load(qp)
        offset = x - qp.minimum
        return (offset + self._transpose[:, : self._unknowns] @ offset) / self._roots

    def _load(self, qp: WhitenedQp) -> None:
        """Whiten the QP unless it is the one that is loaded."""
        arrays = qp.P, qp.q, qp.rows
        if self._loaded is None or any(one is not other for one, other in zip(self._loaded, arrays, strict=True)):
            self.reduce(*arrays)
            self._loaded = arrays

    def search(
        self, qp: WhitenedQp, lower: np.ndarray, upper: np.ndarray, side: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Run the active-set method.

        Args:
            qp: the whitened QP.
            lower: (m,) lower bounds of the rows.
            upper: (m,) upper bounds.
            side: (m,) guess of the active bounds: 1 lower, -1 upper, 0 none.

        Returns:
            Status; active rows, their sides and their multipliers for unit rows, each (active count,); and the point
            (n,).
        """
        self._load(qp)
        m, point = len(qp.rows), np.empty(self._unknowns)
        self._at_zero[:m], self._at_zero[m:] = qp.values_at_minimum / qp.row_norms, 0.0
        self._lower[:m], self._lower[m:] = lower / qp.row_norms, -np.inf
        self._upper[:m], self._upper[m:] = upper / qp.row_norms, np.inf
        self._slack[:m], self._slack[m:] = qp.slack / qp.row_norms, 0.0
        self._side[:m], self._side[m:] = side, 0
        self._cost_limit[0] = _INFEASIBLE_COST * qp.objective_drop
        self._search_launch.set_param_at_index_from_ctype(4, point.ctypes.data)
        self._search_launch.launch()
        status, count = self._end.tolist()
        active = self._active[:count].copy()
        return status, active, self._side[active], self._multipliers[:count].copy(), point


_thread_workspace = thread_local_cache(16)(_Workspace)


def _workspace_for(A: np.ndarray) -> _Workspace:
    """Return the workspace of this thread for the size of ``A``."""
    return _thread_workspace(-(-len(A) // STEP) * STEP, A.shape[1])


def _zeros(shape: tuple[int, ...]) -> wp.array:
    return wp.zeros(shape, dtype=real, device="cpu")


def _shared(values: np.ndarray) -> wp.array:
    return wp.array(values, dtype=real if values.dtype == np.float64 else int, device="cpu", copy=False)


def _by_fours(values: np.ndarray) -> wp.array:
    return wp.array(values.reshape(*values.shape[:-1], -1, 4), dtype=Vec4, device="cpu", copy=False)


def solve_from_guess(
    qp: WhitenedQp, lower: np.ndarray, upper: np.ndarray, at_lower: np.ndarray, at_upper: np.ndarray
) -> Optimum | None:
    """Solve the QP subject to lower <= A x <= upper, lower < upper.

    Args:
        qp: the whitened QP.
        lower: (m,).
        upper: (m,).
        at_lower: (m,) bool, guess of the rows at their lower bound.
        at_upper: (m,) bool, guess of the rows at their upper bound.

    Returns:
        The optimum, or None on numerical failure.
    """
    m, n = qp.rows.shape
    side = np.where(at_lower & np.isfinite(lower), 1, np.where(at_upper & np.isfinite(upper), -1, 0))
    status, active, sides, active_multipliers, x = _workspace_for(qp.rows).search(qp, lower, upper, side)
    multipliers = np.zeros(m)
    if status == kernels.NUMERICAL_FAILURE:
        return None
    if status == kernels.INFEASIBLE:
        return Optimum(np.zeros(n), multipliers, False)
    multipliers[active] = -sides * active_multipliers / qp.row_norms[active]
    values, slack = qp.rows @ x, 10.0 * qp.slack
    # Contradictory rows have multipliers too, so the bounds must be checked.
    is_feasible = bool((values > lower - slack).all() and (values < upper + slack).all())
    return Optimum(x, multipliers, True) if is_feasible else None
