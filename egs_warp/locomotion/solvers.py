"""Quadratic programs whose bounds change; the one place that imports DAQP."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

import numpy as np

from egs_warp.errors import UserError
from egs_warp.launching import Device
from egs_warp.locomotion.active_set import WhitenedQp, solve_from_guess
from egs_warp.locomotion.admm import AdmmStatus
from egs_warp.locomotion.operator_splitting import AdmmSplitting, OperatorSplitting, OsqpSplitting, SplittingRun

MAX_VIOLATION = 3e-3
"""By which a point of OSQP's iteration limit may leave its bounds and still be used."""
_MOST_ITERATIONS = 4000
_BOUND_PADDING = 0.3
"""Of the accuracy, by which bounds are moved apart."""
_HELD = 1e-12
"""Between the bounds of a row that is held."""


class QpStatus(Enum):
    """How a QP ended; the value says cause and cure."""

    SOLVED = "solved"
    INEXACT = "solved to a lower accuracy; the best point found is used"
    ITERATION_LIMIT = "the iteration limit was reached near the bounds; the last point is used"
    INFEASIBLE = "no point satisfies the bounds; choose other contact states"
    FAILED = "the solver gave up; scale the problem"


_STATUS = {
    AdmmStatus.SOLVED: QpStatus.SOLVED,
    AdmmStatus.INEXACT: QpStatus.INEXACT,
    AdmmStatus.LIMIT: QpStatus.ITERATION_LIMIT,
    AdmmStatus.INFEASIBLE: QpStatus.INFEASIBLE,
    AdmmStatus.DOUBTFUL: QpStatus.INFEASIBLE,
    AdmmStatus.FAILED: QpStatus.FAILED,
}
"""Of a splitting that had all of its iterations."""


class QpSolver(Enum):
    """Who solves; chosen by name."""

    OSQP = "osqp"
    """Operator splitting: to an accuracy, warm-started, never stuck."""
    ADMM = "admm"
    """OSQP's operator splitting as kernels."""
    DAQP = "daqp"
    """Dual active set: to rounding."""

    @classmethod
    def _missing_(cls, value: object) -> QpSolver:
        raise UserError(f"QP solver {value!r} is not known; give one of {', '.join(one.value for one in cls)}")


@dataclass(frozen=True)
class QpSolution:
    """``x`` and ``multipliers`` are only meaningful where ``usable``."""

    status: QpStatus
    x: np.ndarray
    """(n,)."""
    multipliers: np.ndarray
    """(m,) positive where the upper bound pushes (OSQP's sign)."""
    objective: float

    @property
    def usable(self) -> bool:
        """Whether ``x`` may be read."""
        return self.status in (QpStatus.SOLVED, QpStatus.INEXACT, QpStatus.ITERATION_LIMIT)


class QuadraticProgram(Protocol):
    """min 1/2 x^T P x + q^T x subject to l <= A x <= u, set up once; a re-solve changes only l and u."""

    def solve(
        self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None = None, *, beside: bool = False
    ) -> QpSolution:
        """Solve with these bounds (m,), warm-started from ``start`` (n,), or from the last solution; ``beside`` where
        that is the optimum of a program beside this one."""
        ...


def quadratic_program(
    P: np.ndarray,
    q: np.ndarray,
    A: np.ndarray,
    *,
    solver: QpSolver | str = QpSolver.OSQP,
    accuracy: float = 3e-5,
    device: Device = None,
) -> QuadraticProgram:
    """The program with P (n, n), q (n,) and A (m, n) for ``solver`` (or its name); ``accuracy`` is that of operator
    splitting, ``device`` where it runs as kernels."""
    solver = QpSolver(solver)
    if solver is QpSolver.DAQP:
        return DaqpProgram(P, q, A)
    if solver is QpSolver.ADMM:
        splitting = AdmmSplitting(P, q, accuracy=accuracy, device=device)
    else:
        splitting = OsqpSplitting(P, q, accuracy=accuracy)
    return SplittingProgram(P, q, A, splitting, accuracy=accuracy)


class SplittingProgram:
    """A ``QuadraticProgram`` by OSQP's operator splitting: a few iterations on the rows that matter tell which of them
    hold the optimum, from where ``active_set`` finds it to rounding. Where rounding leads that astray, they go on with
    all rows, to the splitting's own accuracy. A program beside one that is solved needs no iterations: the rows that
    its minimum without bounds breaks are a guess that costs as little.
    """

    def __init__(
        self, P: np.ndarray, q: np.ndarray, A: np.ndarray, splitting: OperatorSplitting, *, accuracy: float = 3e-5
    ) -> None:
        self._P, self._q, self._A = P, q, A
        self._splitting = splitting
        # What has next to no room between its bounds is as good as without any: room to the accuracy that is asked.
        self._room = _BOUND_PADDING * accuracy
        self._rows = WhitenedQp.of(P, q, A)
        self._whole: SplittingRun | None = None
        self._start: np.ndarray | None = None

    def solve(
        self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None = None, *, beside: bool = False
    ) -> QpSolution:
        """See ``QuadraticProgram``."""
        start = self._start if start is None else start
        if (upper - lower < _HELD).any():
            # Rows that are held, as those of contact states are, repeat each other: met to an accuracy, not exactly.
            return self._by_iterations(lower, upper, start)
        rows = self._rows
        lower, upper = lower - self._room, upper + self._room
        chosen = (rows.values_at_minimum < lower) | (rows.values_at_minimum > upper)
        if not chosen.any():
            # As in flight: there is nothing to iterate on.
            return self._exact(rows.minimum, np.zeros(len(lower)))
        if beside:
            return self._from_the_minimum(lower, upper, start)
        index = np.flatnonzero(chosen)
        # In coordinates in which costs are squares of distances, where a few iterations go far.
        below, above = (
            (lower - rows.values_at_minimum) / rows.row_norms,
            (upper - rows.values_at_minimum) / rows.row_norms,
        )
        z = None if start is None else rows.whiten(start)
        made = self._splitting.warm_start(rows.unit_rows[index], below[index], above[index], z)
        if (
            made.ending not in (AdmmStatus.SOLVED, AdmmStatus.INEXACT, AdmmStatus.LIMIT)
            or not np.isfinite(made.x).all()
        ):
            # Whether there is no point the search finds out: OSQP leaves 2e9 where it doubts that there is any.
            return self._from_the_minimum(lower, upper, start)
        multipliers = np.zeros(len(lower))
        multipliers[index] = made.multipliers
        at = rows.unit_rows @ made.x
        low, high = at - below < -multipliers, above - at < multipliers
        found = self._finished(lower, upper, low, high & ~low)
        return found or self._by_iterations(lower, upper, start)

    def _from_the_minimum(self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> QpSolution:
        """From the rows that the minimum without bounds breaks."""
        free = self._rows.values_at_minimum
        return self._finished(lower, upper, free < lower, free > upper) or self._by_iterations(lower, upper, start)

    def _finished(self, lower: np.ndarray, upper: np.ndarray, low: np.ndarray, high: np.ndarray) -> QpSolution | None:
        """The optimum, from a guess of the rows that hold it at which bound; None where rounding leads astray."""
        found = solve_from_guess(self._rows, lower, upper, low, high)
        if found is None:
            return None
        if not found.feasible:
            return _solution(QpStatus.INFEASIBLE, self._P, self._q, None, None, len(lower))
        return self._exact(found.x, found.multipliers)

    def _exact(self, x: np.ndarray, multipliers: np.ndarray) -> QpSolution:
        self._start = x
        return _solution(QpStatus.SOLVED, self._P, self._q, x, multipliers, len(multipliers))

    def _by_iterations(self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> QpSolution:
        """With all rows, set up once: the splitting's own accuracy."""
        if self._whole is None:
            self._whole = self._splitting.full_run(self._A, _MOST_ITERATIONS)
        made = self._whole.run(lower, upper, start)
        status = _STATUS[made.ending]
        if status is QpStatus.ITERATION_LIMIT:
            rows = self._A @ made.x
            broken = max(float((lower - rows).max()), float((rows - upper).max()))
            status = status if broken <= MAX_VIOLATION else QpStatus.FAILED
        found = _solution(status, self._P, self._q, made.x, made.multipliers, len(lower))
        self._start = found.x if found.usable else None
        return found


class DaqpProgram:
    """A ``QuadraticProgram`` for DAQP (MIT); P must be positive definite."""

    def __init__(self, P: np.ndarray, q: np.ndarray, A: np.ndarray) -> None:
        self._P, self._q = np.ascontiguousarray(P), q
        try:
            import daqp
        except ImportError as error:
            raise UserError("QP solver daqp: the package is not installed; pip install daqp, or use osqp") from error
        count = len(q)
        # DAQP takes leading rows of the identity as plain bounds.
        plain = A.shape[0] >= count and np.array_equal(A[:count], np.eye(count))
        self._rows = np.ascontiguousarray(A[count:] if plain else A)
        self._model = daqp.Model()
        # A static contact's rows repeat each other: without reduction DAQP takes some sets of them for contradictory.
        self._model.settings = {"eq_reduction": 1}
        self._ready = False

    def solve(
        self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None = None, *, beside: bool = False
    ) -> QpSolution:
        """See ``QuadraticProgram``; it starts from its own last active set."""
        low, high = np.maximum(lower, -1e30), np.minimum(upper, 1e30)
        held = np.where(high - low < 1e-13, 5, 0).astype(np.int32)
        # Setting up already finds held rows that contradict each other.
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
            -6: QpStatus.INFEASIBLE,  # held rows contradict each other
        }.get(flag, QpStatus.FAILED)
        return _solution(status, self._P, self._q, x, multipliers, len(lower))


def _solution(status: QpStatus, P: np.ndarray, q: np.ndarray, x: Any, multipliers: Any, rows: int) -> QpSolution:
    solution = QpSolution(status, x, multipliers, float("inf"))
    if not solution.usable or x is None or not np.isfinite(x).all():
        failed = QpStatus.INFEASIBLE if status is QpStatus.INFEASIBLE else QpStatus.FAILED
        return QpSolution(failed, np.zeros(len(q)), np.zeros(rows), float("inf"))
    return QpSolution(status, x, multipliers, float(0.5 * x @ P @ x + q @ x))
