"""The optimum of a strictly convex quadratic program to rounding, from a guess of the rows that hold it.

The dual active-set method of Goldfarb and Idnani (1983), begun where a guess leaves it, as a kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as dense
import warp as wp

from egs_warp.kernels.locomotion import active_set as kernels
from egs_warp.launching import empty_together
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

    @cached_property
    def products(self) -> np.ndarray:
        """(m, m) of the unit rows with each other."""
        return self.units @ self.units.T

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


def by_fours(values: np.ndarray) -> wp.array:
    """``values`` (..., k) with zeros to the next four, as vectors of four."""
    count = values.shape[-1]
    padded = np.zeros((*values.shape[:-1], -(-count // 4), 4))
    padded.reshape(*values.shape[:-1], -1)[..., :count] = values
    return wp.array(padded, dtype=Vec4, device="cpu", copy=False)


def optimum_near(
    reduced: ReducedRows, lower: np.ndarray, upper: np.ndarray, low: np.ndarray, high: np.ndarray
) -> Optimum | None:
    """Of l <= A x <= u, l < u; ``low`` and ``high`` (m,) guess which rows lie at which bound. None where rounding leads
    the search astray.
    """
    m, n = reduced.rows.shape
    program, search = kernels.Program(), kernels.Search()
    program.rows, program.products = by_fours(reduced.units), by_fours(reduced.products)
    program.free = by_fours(reduced.free / reduced.lengths)
    program.lower, program.upper, program.slack = (
        wp.array(value / reduced.lengths, dtype=real, device="cpu", copy=False)
        for value in (lower, upper, reduced.slack)
    )
    program.most = _HOPELESS * reduced.worth
    side = np.where(low & np.isfinite(lower), 1, np.where(high & np.isfinite(upper), -1, 0)).astype(np.int32)
    search.side = wp.array(side, dtype=int, device="cpu", copy=False)
    fours = (-(-m // 4), Vec4), (-(-n // 4), Vec4)
    search.active, ended, search.factor, search.at, search.outside, *vectors = empty_together(
        "cpu", (n, int), (1, int), ((n, n), real), *fours, *((n, real),) * 3
    )
    search.pulls, search.rates, search.across = vectors
    wp.launch(kernels.optimum_kernel, 1, inputs=[program, _PIVOTS, search], outputs=[ended], device="cpu")
    how = int(ended.numpy()[0])
    multipliers = np.zeros(m)
    if how == kernels.ASTRAY:
        return None
    if how == kernels.INFEASIBLE:
        return Optimum(np.zeros(n), multipliers, False)
    count = int(np.count_nonzero(side))
    active = search.active.numpy()[:count]
    multipliers[active] = -side[active] * search.pulls.numpy()[:count] / reduced.lengths[active]
    x = reduced.point(multipliers)
    at, slack = reduced.rows @ x, 10.0 * reduced.slack
    # Rows that contradict each other are met by none, whatever their multipliers.
    met = bool((at > lower - slack).all() and (at < upper + slack).all())
    return Optimum(x, multipliers, True) if met else None
