"""Who iterates by OSQP's operator splitting: OSQP on the host, or kernels; the one place that imports OSQP."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Protocol

import numpy as np
import osqp
import scipy.sparse as sparse
import warp as wp

from egs_warp.launching import Device, thread_local_cache
from egs_warp.locomotion.admm import AdmmPrograms, AdmmResult, AdmmStatus, AdmmWarmStart, DenseQp

SCALING_PASSES = 4
"""Passes of the equilibration."""
RHO_UPDATE_INTERVAL = 50
"""Iterations after which rho may change: by the clock, two runs would differ."""
WARM_START_ITERATIONS = 15
"""Iterations that tell which rows hold an optimum."""
RHO = 1.0
"""Of these: what multipliers are to distances where costs are squares of distances and rows have length 1."""
_ENOUGH = 1e-3
"""Accuracy at which they may end before."""
_ROWS = 8
"""Rows by which programs differ that OSQP has memory for."""
_CODES: Any = osqp.SolverStatus


class SplittingRun(Protocol):
    """On one program, set up once."""

    def run(self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> AdmmResult:
        """With these bounds (m,), from ``start`` (n,), else from where they last ended."""
        ...


class OperatorSplitting(Protocol):
    """Who iterates on programs with the same P and q."""

    def warm_start(
        self, units: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None
    ) -> AdmmResult:
        """A few iterations on min 1/2 z^T z subject to l <= R z <= u (m,), rows R (m, n) ``units`` long, from
        ``start`` (n,), else from 0."""
        ...

    def full_run(self, A: np.ndarray, iterations: int) -> SplittingRun:
        """With rows A (m, n), at most ``iterations`` each time."""
        ...


class OsqpSplitting:
    """A ``Splitting`` by OSQP."""

    def __init__(self, P: np.ndarray, q: np.ndarray, *, accuracy: float) -> None:
        self._P, self._q, self._accuracy = P, q, accuracy

    def warm_start(
        self, units: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None
    ) -> AdmmResult:
        """See ``Splitting``."""
        return _near(-(-len(units) // _ROWS) * _ROWS, units.shape[1]).run(units, lower, upper, start)

    @cached_property
    def _upper_half(self) -> sparse.csc_matrix:
        return sparse.csc_matrix(np.triu(self._P))

    def full_run(self, A: np.ndarray, iterations: int) -> OsqpIterations:
        """See ``Splitting``."""
        given: dict[str, Any] = {"P": self._upper_half, "q": self._q, "A": sparse.csc_matrix(A), "max_iter": iterations}
        return OsqpIterations({**given, "eps_abs": self._accuracy, "eps_rel": self._accuracy})


class OsqpIterations:
    """``Iterations`` by OSQP."""

    def __init__(self, given: dict[str, Any]) -> None:
        """``given``: what ``osqp.OSQP.setup`` takes besides the bounds and what is the same in all programs."""
        self._given = given
        self._solver: osqp.OSQP | None = None

    def run(self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> AdmmResult:
        """See ``Iterations``."""
        if self._solver is None:
            self._solver = osqp.OSQP(algebra="builtin")
            self._solver.setup(
                **self._given,
                l=lower,
                u=upper,
                verbose=False,
                scaling=SCALING_PASSES,
                polishing=False,  # it fails on redundant rows and took half of the time
                warm_starting=True,
                adaptive_rho=True,
                adaptive_rho_interval=RHO_UPDATE_INTERVAL,
                check_termination=25,
            )
        else:
            self._solver.update(l=lower, u=upper)
        if start is not None:
            self._solver.warm_start(x=start)
        return _iterate(_answer(self._solver))


def _iterate(result: Any) -> AdmmResult:
    ending = {
        _CODES.OSQP_SOLVED: AdmmStatus.SOLVED,
        _CODES.OSQP_SOLVED_INACCURATE: AdmmStatus.INEXACT,
        _CODES.OSQP_MAX_ITER_REACHED: AdmmStatus.LIMIT,
        _CODES.OSQP_PRIMAL_INFEASIBLE: AdmmStatus.INFEASIBLE,
        _CODES.OSQP_PRIMAL_INFEASIBLE_INACCURATE: AdmmStatus.DOUBTFUL,
    }.get(result.info.status_val, AdmmStatus.FAILED)
    return AdmmResult(ending, result.x, result.y, result.info.iter)


class OsqpWarmStart:
    """OSQP for programs of so many rows and unknowns: set up once, for only
    numbers change. It begins where it is told to, so what it was asked before does not matter."""

    def __init__(self, rows: int, unknowns: int) -> None:
        self._units, self._ones = np.zeros((unknowns, rows)), np.ones(rows)
        self._solver = osqp.OSQP(algebra="builtin")
        self._solver.setup(
            P=sparse.identity(unknowns, format="csc"),
            q=np.zeros(unknowns),
            # With ones in place of zeros, which it would leave out.
            A=sparse.csc_matrix(np.ones((rows, unknowns))),
            l=-self._ones,
            u=self._ones,
            rho=RHO,
            eps_abs=_ENOUGH,
            eps_rel=_ENOUGH,
            scaling=0,
            max_iter=WARM_START_ITERATIONS,
            adaptive_rho=False,
            polishing=False,
            verbose=False,
        )

    def run(self, units: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> AdmmResult:
        """See ``Splitting.near``."""
        m, n = units.shape
        self._units[:, :m], self._units[:, m:] = units.T, 0.0
        # Rows of zeros after the last have bounds, too: OSQP factors anew where some come or go.
        low, high = -self._ones, self._ones.copy()
        low[:m], high[:m] = lower, upper
        self._solver.update(Ax=self._units.ravel(), l=low, u=high)
        self._solver.warm_start(x=np.zeros(n) if start is None else start, y=np.zeros(len(low)))
        made = _iterate(_answer(self._solver))
        return replace(made, multipliers=made.multipliers[:m])


_near = thread_local_cache(16)(OsqpWarmStart)


def _answer(solver: osqp.OSQP) -> Any:
    result = solver.solve(raise_error=False)
    if result.info.status_val == _CODES.OSQP_SIGINT:
        # OSQP takes Ctrl-C for itself while it runs; the program would go on with what it had found by then.
        raise KeyboardInterrupt
    return result


class AdmmSplitting:
    """A ``Splitting`` by kernels."""

    def __init__(self, P: np.ndarray, q: np.ndarray, *, accuracy: float, device: Device) -> None:
        self._P, self._q, self._accuracy, self._device = P, q, accuracy, device

    def warm_start(
        self, units: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None
    ) -> AdmmResult:
        """See ``Splitting``."""
        rows = -(-len(units) // _ROWS) * _ROWS
        return _near_by_kernels(rows, units.shape[1], str(wp.get_device(self._device))).run(units, lower, upper, start)

    def full_run(self, A: np.ndarray, iterations: int) -> AdmmIterations:
        """See ``Splitting``."""
        programs = AdmmPrograms(
            [DenseQp(self._P, self._q, A)], device=self._device, scaling=SCALING_PASSES, adapt=RHO_UPDATE_INTERVAL
        )
        return AdmmIterations(programs, self._accuracy, iterations)


_near_by_kernels = thread_local_cache(16)(
    partial(AdmmWarmStart, accuracy=_ENOUGH, iterations=WARM_START_ITERATIONS, adapt=RHO_UPDATE_INTERVAL, rho=RHO)
)


@dataclass(frozen=True)
class AdmmIterations:
    """``Iterations`` by kernels."""

    programs: AdmmPrograms
    accuracy: float
    iterations: int

    def run(self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None) -> AdmmResult:
        """See ``Iterations``."""
        (end,) = self.programs.solve([lower], [upper], [start], accuracy=self.accuracy, iterations=self.iterations)
        return end
