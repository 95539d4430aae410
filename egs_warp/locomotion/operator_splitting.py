"""Operator splitting (ADMM) with the package OSQP, which only this module imports.

See docs/concepts/locomotion.md#solvers.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import osqp
import scipy.sparse as sparse

SCALING_PASSES = 4
"""Number of equilibration passes."""
RHO_UPDATE_INTERVAL = 50
"""Number of iterations after which rho may change. OSQP's default, an interval in time, would not be reproducible."""
_CODES: Any = osqp.SolverStatus


class QpStatus(Enum):
    """Status of a solved QP; the value names the cause and what to do."""

    SOLVED = "solved"
    INEXACT = "solved to a lower accuracy; the best point found is used"
    ITERATION_LIMIT = "the iteration limit was reached near the bounds; the last point is used"
    INFEASIBLE = "no point satisfies the bounds; choose other contact states"
    FAILED = "the solver gave up; scale the problem"

    @property
    def usable(self) -> bool:
        """True if the point of the solve may be used."""
        return self in (QpStatus.SOLVED, QpStatus.INEXACT, QpStatus.ITERATION_LIMIT)


@dataclass(frozen=True)
class SplittingResult:
    """Result of the iterations on one QP."""

    status: QpStatus
    x: np.ndarray
    """(n,) last point."""
    multipliers: np.ndarray
    """(m,) multipliers, positive at an active upper bound."""


class OsqpIterations:
    """OSQP iterations on one QP with variable bounds. The first run sets up OSQP."""

    def __init__(self, P: np.ndarray, q: np.ndarray, A: np.ndarray, *, accuracy: float, iterations: int) -> None:
        """Prepare the QP with constraint rows ``A`` (m, n), and at most ``iterations`` iterations in each run."""
        limits = {"max_iter": iterations, "eps_abs": accuracy, "eps_rel": accuracy}
        self._options: Any = {"P": sparse.csc_matrix(np.triu(P)), "q": q, "A": sparse.csc_matrix(A), **limits}
        self._solver: osqp.OSQP | None = None

    def run(self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> SplittingResult:
        """Iterate with bounds ``lower``, ``upper`` (m,) from ``start`` (n,); None starts from the previous result."""
        if self._solver is None:
            self._solver = osqp.OSQP(algebra="builtin")
            self._solver.setup(
                **self._options,
                l=lower,
                u=upper,
                verbose=False,
                scaling=SCALING_PASSES,
                polishing=False,  # Polishing fails on redundant rows and takes half of the time.
                warm_starting=True,
                adaptive_rho=True,
                adaptive_rho_interval=RHO_UPDATE_INTERVAL,
                check_termination=25,
            )
        else:
            self._solver.update(l=lower, u=upper)
        if start is not None:
            self._solver.warm_start(x=start)
        return _convert_result(_run_osqp(self._solver))


def _convert_result(result: Any) -> SplittingResult:
    """Convert a result of OSQP to a ``SplittingResult``."""
    status = {
        _CODES.OSQP_SOLVED: QpStatus.SOLVED,
        _CODES.OSQP_SOLVED_INACCURATE: QpStatus.INEXACT,
        _CODES.OSQP_MAX_ITER_REACHED: QpStatus.ITERATION_LIMIT,
        _CODES.OSQP_PRIMAL_INFEASIBLE: QpStatus.INFEASIBLE,
        _CODES.OSQP_PRIMAL_INFEASIBLE_INACCURATE: QpStatus.INFEASIBLE,
    }.get(result.info.status_val, QpStatus.FAILED)
    return SplittingResult(status, result.x, result.y)


def _run_osqp(solver: osqp.OSQP) -> Any:
    """Solve, and raise ``KeyboardInterrupt`` if OSQP was interrupted."""
    result = solver.solve(raise_error=False)
    if result.info.status_val == _CODES.OSQP_SIGINT:
        # OSQP handles Ctrl-C itself while it runs and returns its current point.
        raise KeyboardInterrupt
    return result
