"""Quadratic programs whose bounds change; the one place that imports OSQP."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import osqp
import scipy.sparse as sparse


class QpStatus(Enum):
    """How a QP ended; the value says cause and cure."""

    SOLVED = "solved"
    INEXACT = "solved to a lower accuracy; the best point found is used"
    INFEASIBLE = "no point satisfies the bounds; soften them"
    FAILED = "the solver gave up; scale the problem"


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
        return self.status in (QpStatus.SOLVED, QpStatus.INEXACT)


class QuadraticProgram:
    """min 1/2 x^T P x + q^T x subject to l <= A x <= u, set up once; a re-solve changes only l and u."""

    def __init__(self, P: np.ndarray, q: np.ndarray, A: np.ndarray, *, accuracy: float = 3e-5) -> None:
        self._P, self._q, self._A = P, q, A
        self._accuracy = accuracy
        self._solver: osqp.OSQP | None = None

    def solve(self, lower: np.ndarray, upper: np.ndarray) -> QpSolution:
        """Solve with these bounds (m,), warm-started from the last solution."""
        if self._solver is None:
            self._solver = osqp.OSQP(algebra="builtin")
            self._solver.setup(
                P=sparse.csc_matrix(np.triu(self._P)),
                q=self._q,
                A=sparse.csc_matrix(self._A),
                l=lower,
                u=upper,
                verbose=False,
                eps_abs=self._accuracy,
                eps_rel=self._accuracy,
                max_iter=4000,
                scaling=0,
                polishing=True,
                warm_starting=True,
                adaptive_rho=True,
                adaptive_rho_interval=50,
                check_termination=25,
            )
        else:
            self._solver.update(l=lower, u=upper)
        result = self._solver.solve(raise_error=False)
        codes: Any = osqp.SolverStatus
        status = {
            codes.OSQP_SOLVED: QpStatus.SOLVED,
            codes.OSQP_SOLVED_INACCURATE: QpStatus.INEXACT,
            codes.OSQP_MAX_ITER_REACHED: QpStatus.INEXACT,
            codes.OSQP_PRIMAL_INFEASIBLE: QpStatus.INFEASIBLE,
            codes.OSQP_PRIMAL_INFEASIBLE_INACCURATE: QpStatus.INFEASIBLE,
        }.get(result.info.status_val, QpStatus.FAILED)
        solution = QpSolution(status, result.x, result.y, float("inf"))
        if not solution.usable or result.x is None or not np.isfinite(result.x).all():
            failed = QpStatus.INFEASIBLE if status is QpStatus.INFEASIBLE else QpStatus.FAILED
            return QpSolution(failed, np.zeros(len(self._q)), np.zeros(len(lower)), float("inf"))
        value = float(0.5 * result.x @ self._P @ result.x + self._q @ result.x)
        return QpSolution(status, result.x, result.y, value)
