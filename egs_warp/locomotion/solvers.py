"""Solvers of QPs whose bounds change while P, q and A stay the same.

This is the only module that imports DAQP. See docs/concepts/locomotion.md#solvers.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from egs_warp.errors import UserError, did_you_mean
from egs_warp.locomotion.active_set import WhitenedQp, solve_from_guess
from egs_warp.locomotion.operator_splitting import OsqpIterations, QpStatus, warm_start

MAX_VIOLATION = 3e-3
"""Maximum violation of the bounds with which a point at the iteration limit is still used."""
_MAX_ITERATIONS = 4000
ACCURACY = 3e-5
"""Accuracy of operator splitting, absolute and relative."""
_BOUND_PADDING = 0.3
"""Distance by which bounds are widened, in units of the accuracy."""
_EQUALITY_WIDTH = 1e-12
"""Distance between the bounds of a row below which the row is treated as an equality."""


class QpSolver(Enum):
    """QP solver, selected by name."""

    OSQP = "osqp"
    """A few OSQP iterations on the host, then the active-set method."""
    ADMM = "admm"
    """The whole mode search in one kernel on the device, with the same splitting iterations and active-set method."""
    DAQP = "daqp"
    """DAQP, a dual active-set method on the host; an optional package."""

    @property
    def on_host(self) -> QpSolver:
        """Solver of single QPs on the host: OSQP in place of ``admm``."""
        return QpSolver.OSQP if self is QpSolver.ADMM else self

    @classmethod
    def _missing_(cls, value: object) -> QpSolver:
        names = [one.value for one in cls]
        raise UserError(f"QP solver {value!r} is not known{did_you_mean(value, names)}; give one of {', '.join(names)}")


@dataclass(frozen=True)
class QpSolution:
    """Solution of a QP. ``x`` and ``multipliers`` are meaningful only if ``usable``."""

    status: QpStatus
    x: np.ndarray
    """(n,) the minimiser, or the last iterate of a solve that stopped early."""
    multipliers: np.ndarray
    """(m,) multipliers, positive at an active upper bound (OSQP's sign)."""
    objective: float
    """Objective at ``x``; infinite if not ``usable``."""

    @property
    def usable(self) -> bool:
        """True if ``x`` may be used."""
        return self.status.usable


def quadratic_program(
    P: np.ndarray, q: np.ndarray, A: np.ndarray, *, solver: QpSolver | str = QpSolver.OSQP
) -> QuadraticProgram:
    """Set up the QP min 1/2 x^T P x + q^T x subject to lower <= A x <= upper; a solve changes only the bounds.

    Args:
        P: (n, n) Hessian.
        q: (n,) linear term.
        A: (m, n) constraint rows.
        solver: solver, or its name ``osqp`` or ``daqp``.
    """
    return DaqpProgram(P, q, A) if QpSolver(solver) is QpSolver.DAQP else SplittingProgram(P, q, A)


class SplittingProgram:
    """QP that is solved by operator splitting and the active-set method.

    A few iterations of operator splitting, on the rows that the unconstrained minimum violates, guess the active rows.
    From this guess ``active_set`` finds the optimum to rounding. After a numerical failure, operator splitting
    continues with all rows to its own accuracy. With ``skip_splitting`` the iterations are skipped; the active-set
    method is then equally fast from the rows that the unconstrained minimum violates.
    """

    def __init__(self, P: np.ndarray, q: np.ndarray, A: np.ndarray) -> None:
        self._P, self._q, self._A = P, q, A
        # If the feasible set is a single point, multipliers are unbounded. So the bounds are widened by a distance
        # below the accuracy.
        self._padding = _BOUND_PADDING * ACCURACY
        self._rows = WhitenedQp.of(P, q, A)
        self._start: np.ndarray | None = None

    @cached_property
    def _full_run(self) -> OsqpIterations:
        """Operator splitting with all rows."""
        return OsqpIterations(self._P, self._q, self._A, accuracy=ACCURACY, iterations=_MAX_ITERATIONS)

    def solve(
        self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None = None, *, skip_splitting: bool = False
    ) -> QpSolution:
        """Solve the QP with the given bounds.

        Args:
            lower: (m,) lower bounds.
            upper: (m,) upper bounds.
            start: (n,) warm start; None uses the last solution.
            skip_splitting: True if another QP of the same step has been solved; operator splitting is then skipped.
        """
        start = self._start if start is None else start
        if (upper - lower < _EQUALITY_WIDTH).any():
            # The equality rows of contact states may be redundant, so they are satisfied approximately instead of
            # exactly.
            return self._solve_by_splitting(lower, upper, start)
        rows = self._rows
        lower, upper = lower - self._padding, upper + self._padding
        violated = (rows.values_at_minimum < lower) | (rows.values_at_minimum > upper)
        if not violated.any():
            # No bound is active, for example in flight.
            return self._solved(rows.minimum, np.zeros(len(lower)))
        if skip_splitting:
            return self._solve_from_minimum(lower, upper, start)
        index = np.flatnonzero(violated)
        # In whitened coordinates a few iterations are enough.
        below, above = (
            (lower - rows.values_at_minimum) / rows.row_norms,
            (upper - rows.values_at_minimum) / rows.row_norms,
        )
        z = None if start is None else rows.whiten(start)
        result = warm_start(rows.unit_rows[index], below[index], above[index], z)
        if not result.status.usable or not np.isfinite(result.x).all():
            # The active-set method decides whether the QP is feasible: where OSQP cannot decide, it returns x = 2e9.
            return self._solve_from_minimum(lower, upper, start)
        multipliers = np.zeros(len(lower))
        multipliers[index] = result.multipliers
        at = rows.unit_rows @ result.x
        low, high = at - below < -multipliers, above - at < multipliers
        solution = self._solve_from_guess(lower, upper, low, high & ~low)
        return solution or self._solve_by_splitting(lower, upper, start)

    def _solve_from_minimum(self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> QpSolution:
        """Solve with the guess that the rows which the unconstrained minimum violates are active."""
        values = self._rows.values_at_minimum
        return self._solve_from_guess(lower, upper, values < lower, values > upper) or self._solve_by_splitting(
            lower, upper, start
        )

    def _solve_from_guess(
        self, lower: np.ndarray, upper: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> QpSolution | None:
        """Solve from a guess of the active bounds, (m,) bool each; return None on numerical failure."""
        solution = solve_from_guess(self._rows, lower, upper, low, high)
        if solution is None:
            return None
        if not solution.feasible:
            return _solution(QpStatus.INFEASIBLE, self._P, self._q, None, None, len(lower))
        return self._solved(solution.x, solution.multipliers)

    def _solved(self, x: np.ndarray, multipliers: np.ndarray) -> QpSolution:
        """Return ``x`` as the solution, with the status ``SOLVED``, and store it for the next warm start."""
        self._start = x
        return _solution(QpStatus.SOLVED, self._P, self._q, x, multipliers, len(multipliers))

    def _solve_by_splitting(self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> QpSolution:
        """Solve by operator splitting with all rows, to its own accuracy."""
        result = self._full_run.run(lower, upper, start)
        status = result.status
        if status is QpStatus.ITERATION_LIMIT:
            rows = self._A @ result.x
            violation = max(float((lower - rows).max()), float((rows - upper).max()))
            status = status if violation <= MAX_VIOLATION else QpStatus.FAILED
        solution = _solution(status, self._P, self._q, result.x, result.multipliers, len(lower))
        self._start = solution.x if solution.usable else None
        return solution


class DaqpProgram:
    """``QuadraticProgram`` that is solved by DAQP (MIT licence); P must be positive definite."""

    def __init__(self, P: np.ndarray, q: np.ndarray, A: np.ndarray) -> None:
        self._P, self._q = np.ascontiguousarray(P), q
        try:
            import daqp
        except ImportError as error:
            raise UserError("QP solver daqp: the package is not installed; pip install daqp, or use osqp") from error
        count = len(q)
        # DAQP treats leading rows of the identity as simple bounds.
        plain = A.shape[0] >= count and np.array_equal(A[:count], np.eye(count))
        self._rows = np.ascontiguousarray(A[count:] if plain else A)
        self._model = daqp.Model()
        # The rows of a static contact are redundant: without reduction DAQP reports some of them as infeasible.
        self._model.settings = {"eq_reduction": 1}
        self._ready = False

    def solve(
        self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None = None, *, skip_splitting: bool = False
    ) -> QpSolution:
        """Solve with bounds ``lower``, ``upper`` (m,). DAQP starts from its last active set; ``start`` and
        ``skip_splitting`` are ignored."""
        low, high = np.maximum(lower, -1e30), np.minimum(upper, 1e30)
        held = np.where(high - low < 1e-13, 5, 0).astype(np.int32)
        # The setup already detects equality rows that contradict each other.
        if self._ready:
            flag = self._model.update(bupper=high, blower=low, sense=held)
        else:
            flag, _ = self._model.setup(self._P, self._q, self._rows, high, low, held)
            self._ready = flag >= 0
        x, multipliers = None, None
        if flag >= 0:
            x, _, flag, info = self._model.solve()
            multipliers = np.asarray(info["lam"])
        status = {
            1: QpStatus.SOLVED,
            2: QpStatus.INEXACT,
            -1: QpStatus.INFEASIBLE,
            -4: QpStatus.ITERATION_LIMIT,
            -6: QpStatus.INFEASIBLE,  # Equality rows contradict each other.
        }.get(flag, QpStatus.FAILED)
        return _solution(status, self._P, self._q, x, multipliers, len(lower))


QuadraticProgram: TypeAlias = SplittingProgram | DaqpProgram
"""QP that is set up once for one of the solvers."""


def _solution(status: QpStatus, P: np.ndarray, q: np.ndarray, x: Any, multipliers: Any, rows: int) -> QpSolution:
    """Return a solution with this ``status``; if it is not usable, with x = 0 and an infinite objective."""
    solution = QpSolution(status, x, multipliers, float("inf"))
    if not solution.usable or x is None or not np.isfinite(x).all():
        failed = QpStatus.INFEASIBLE if status is QpStatus.INFEASIBLE else QpStatus.FAILED
        return QpSolution(failed, np.zeros(len(q)), np.zeros(rows), float("inf"))
    return QpSolution(status, x, multipliers, float(0.5 * x @ P @ x + q @ x))
