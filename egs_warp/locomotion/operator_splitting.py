"""Operator splitting (ADMM) with the package OSQP, which only this module imports.

See docs/concepts/locomotion.md#solvers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
import osqp
import scipy.sparse as sparse

from egs_warp.launching import round_up, thread_local_cache

SCALING_PASSES = 4
"""Number of equilibration passes."""
RHO_UPDATE_INTERVAL = 50
"""Number of iterations after which rho may change. OSQP's default, an interval in time, would not be reproducible."""
WARM_START_ITERATIONS = 15
"""Number of iterations of a warm start, which estimates the active rows of an optimum."""
RHO = 1.0
"""Step size parameter rho of a warm start, for whitened rows of length 1."""
_WARM_START_ACCURACY = 1e-3
"""Accuracy at which a warm start may end before its last iteration."""
_ROW_MULTIPLE = 8
"""Multiple to which the row capacity of warm starts is rounded up."""
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


class OsqpWarmStart:
    """Warm starts with the package OSQP on whitened QPs of at most ``rows`` rows and ``unknowns`` unknowns. OSQP is set
    up once; each run only updates its numbers. A run starts from the given point, so it does not depend on previous
    runs."""

    def __init__(self, rows: int, unknowns: int) -> None:
        self._units, self._ones = np.zeros((unknowns, rows)), np.ones(rows)
        self._solver = osqp.OSQP(algebra="builtin")
        self._solver.setup(
            P=sparse.identity(unknowns, format="csc"),
            q=np.zeros(unknowns),
            # The values are ones, because OSQP drops zeros from the sparsity pattern.
            A=sparse.csc_matrix(np.ones((rows, unknowns))),
            l=-self._ones,
            u=self._ones,
            rho=RHO,
            eps_abs=_WARM_START_ACCURACY,
            eps_rel=_WARM_START_ACCURACY,
            scaling=0,
            max_iter=WARM_START_ITERATIONS,
            adaptive_rho=False,
            polishing=False,
            verbose=False,
        )

    def run(self, units: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> SplittingResult:
        """Run a few iterations on the whitened QP with rows ``units`` (m, n), see ``warm_start``."""
        m, n = units.shape
        self._units[:, :m], self._units[:, m:] = units.T, 0.0
        # Padding rows have bounds too, because OSQP factors again when finite bounds are added or removed.
        padded_lower, padded_upper = -self._ones, self._ones.copy()
        padded_lower[:m], padded_upper[:m] = lower, upper
        self._solver.update(Ax=self._units.ravel(), l=padded_lower, u=padded_upper)
        self._solver.warm_start(x=np.zeros(n) if start is None else start, y=np.zeros(len(padded_lower)))
        result = _convert_result(_run_osqp(self._solver))
        return replace(result, multipliers=result.multipliers[:m])


_osqp_warm_start = thread_local_cache(16)(OsqpWarmStart)


def warm_start(units: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> SplittingResult:
    """Run ``WARM_START_ITERATIONS`` iterations on a whitened QP: min 1/2 z^T z subject to lower <= R z <= upper.

    Args:
        units: (m, n) R, rows of length 1.
        lower: (m,) lower bounds.
        upper: (m,) upper bounds.
        start: (n,) initial z; None starts from 0.
    """
    return _osqp_warm_start(round_up(len(units), _ROW_MULTIPLE), units.shape[1]).run(units, lower, upper, start)


def _run_osqp(solver: osqp.OSQP) -> Any:
    """Solve, and raise ``KeyboardInterrupt`` if OSQP was interrupted."""
    result = solver.solve(raise_error=False)
    if result.info.status_val == _CODES.OSQP_SIGINT:
        # OSQP handles Ctrl-C itself while it runs and returns its current point.
        raise KeyboardInterrupt
    return result
