"""The optimum of a strictly convex quadratic program to rounding, from a guess of the rows that hold it.

The dual active-set method of Goldfarb and Idnani (1983), begun where a guess leaves it, as a kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg as dense
import warp as wp

from egs_warp.kernels.locomotion import active_set as kernels
from egs_warp.launching import kept_by_thread
from egs_warp.precision import Vec4, real

_PIVOTS = 600
_BROKEN = 1e-8
"""By which a row may leave its bounds, or times its length by z where that is more."""
_HOPELESS = 1e6
"""Times all that the objective can fall: bounds that cost more are met by no point."""


@dataclass(frozen=True)
class ReducedRows:
    """The rows A of min 1/2 x^T P x + q^T x in coordinates z = L^T (x - x0), P = L L^T, in which distances from the
    minimum x0 are costs."""

    factor: np.ndarray
    """(n, n) L."""
    minimum: np.ndarray
    """(n,) x0, without any bounds."""
    free: np.ndarray
    """(m,) A x0."""
    rows: np.ndarray
    """(m, n) A."""
    worth: float
    """By how much the objective is lower at x0 than at 0, or 1 if that is less."""

    @classmethod
    def of(cls, P: np.ndarray, q: np.ndarray, A: np.ndarray) -> ReducedRows:
        """Of P (n, n), positive definite, q (n,) and A (m, n)."""
        factor = dense.cholesky(P, lower=True, check_finite=False)
        minimum = dense.cho_solve((factor, True), -q, check_finite=False)
        return cls(factor, minimum, A @ minimum, A, max(1.0, -0.5 * float(q @ minimum)))

    @cached_property
    def _by_z(self) -> tuple[np.ndarray, np.ndarray]:
        """(m, n) the rows by z, each of length 1 or 0, and their lengths (m,), 1 for those without any."""
        scaled = dense.solve_triangular(self.factor, self.rows.T, lower=True, check_finite=False).T
        lengths = np.linalg.norm(scaled, axis=1)
        lengths[lengths == 0.0] = 1.0
        return np.ascontiguousarray(scaled / lengths[:, None]), lengths

    @property
    def units(self) -> np.ndarray:
        """(m, n) the rows by z, each of length 1 or 0."""
        return self._by_z[0]

    @property
    def lengths(self) -> np.ndarray:
        """(m,) of the rows by z."""
        return self._by_z[1]

    @cached_property
    def slack(self) -> np.ndarray:
        """(m,) by how much each row may break its bounds."""
        return _BROKEN * np.maximum(1.0, self.lengths)

    def point(self, multipliers: np.ndarray) -> np.ndarray:
        """(n,) x that ``multipliers`` (m,) hold, positive where an upper bound pushes."""
        move = -self.units.T @ (self.lengths * multipliers)
        return self.minimum + dense.solve_triangular(self.factor, move, lower=True, trans=1, check_finite=False)


@dataclass(frozen=True)
class Optimum:
    """Where the search has ended."""

    x: np.ndarray
    """(n,)."""
    multipliers: np.ndarray
    """(m,) positive where the upper bound pushes."""
    feasible: bool
    """Whether any point satisfies the bounds; else ``x`` means nothing."""


class _Room:
    """Memory for a program of so many rows and unknowns, and a launch that is made again and again: a new one takes
    longer than the search."""

    def __init__(self, rows: int, unknowns: int) -> None:
        columns = -(-unknowns // 4) * 4
        self._rows, self._products = np.zeros((rows, columns)), np.zeros((rows, rows))
        self._free, self._at, self._outside = np.zeros(rows), np.zeros(rows), np.zeros(columns)
        self._lower, self._upper, self._slack = np.zeros((3, rows))
        self._most, self._pulls = np.zeros(1), np.zeros(unknowns)
        self._side, self._active, self._ended = (np.zeros(count, np.int32) for count in (rows, unknowns, 1))
        program, search = kernels.Program(), kernels.Search()
        program.rows, program.products = _by_fours(self._rows), _by_fours(self._products)
        program.free, search.at, search.outside = (
            _by_fours(values) for values in (self._free, self._at, self._outside)
        )
        program.lower, program.upper, program.slack = map(_shared, (self._lower, self._upper, self._slack))
        program.most, search.pulls = _shared(self._most), _shared(self._pulls)
        search.side, search.active = _shared(self._side), _shared(self._active)
        search.factor = wp.zeros((unknowns, unknowns), dtype=real, device="cpu")
        search.rates, search.across = (wp.zeros(unknowns, dtype=real, device="cpu") for _ in range(2))
        self._launch: Any = wp.launch(
            kernels.optimum_kernel,
            1,
            inputs=[program, _PIVOTS, search],
            outputs=[_shared(self._ended)],
            device="cpu",
            record_cmd=True,
        )
        # The launch has where these lie.
        self._held = program, search

    def search(
        self, reduced: ReducedRows, lower: np.ndarray, upper: np.ndarray, side: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
        """How it ended, and of the rows that hold the numbers, the sides and the multipliers."""
        m, n = reduced.rows.shape
        self._rows[:m, :n], self._rows[m:] = reduced.units, 0.0
        np.matmul(self._rows, self._rows.T, out=self._products)
        self._free[:m], self._free[m:] = reduced.free / reduced.lengths, 0.0
        self._lower[:m], self._lower[m:] = lower / reduced.lengths, -np.inf
        self._upper[:m], self._upper[m:] = upper / reduced.lengths, np.inf
        self._slack[:m], self._slack[m:] = reduced.slack / reduced.lengths, 0.0
        self._side[:m], self._side[m:] = side, 0
        self._most[0] = _HOPELESS * reduced.worth
        self._launch.launch()
        active = self._active[: np.count_nonzero(self._side)].copy()
        return int(self._ended[0]), active, self._side[active], self._pulls[: len(active)].copy()


_room = kept_by_thread(16)(_Room)
_STEP = 32
"""Rows by which the sizes differ that memory is kept for."""


def _shared(values: np.ndarray) -> wp.array:
    return wp.array(values, dtype=real if values.dtype == np.float64 else int, device="cpu", copy=False)


def _by_fours(values: np.ndarray) -> wp.array:
    return wp.array(values.reshape(*values.shape[:-1], -1, 4), dtype=Vec4, device="cpu", copy=False)


def optimum_near(
    reduced: ReducedRows, lower: np.ndarray, upper: np.ndarray, low: np.ndarray, high: np.ndarray
) -> Optimum | None:
    """Of l <= A x <= u, l < u; ``low`` and ``high`` (m,) guess which rows lie at which bound. None where rounding leads
    the search astray.
    """
    m, n = reduced.rows.shape
    side = np.where(low & np.isfinite(lower), 1, np.where(high & np.isfinite(upper), -1, 0))
    how, active, sides, pulls = _room(-(-m // _STEP) * _STEP, n).search(reduced, lower, upper, side)
    multipliers = np.zeros(m)
    if how == kernels.ASTRAY:
        return None
    if how == kernels.INFEASIBLE:
        return Optimum(np.zeros(n), multipliers, False)
    multipliers[active] = -sides * pulls / reduced.lengths[active]
    x = reduced.point(multipliers)
    at, slack = reduced.rows @ x, 10.0 * reduced.slack
    # Rows that contradict each other are met by none, whatever their multipliers.
    met = bool((at > lower - slack).all() and (at < upper + slack).all())
    return Optimum(x, multipliers, True) if met else None
