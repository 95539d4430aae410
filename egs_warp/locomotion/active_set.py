"""The optimum of a strictly convex quadratic program to rounding, from a guess of the rows that hold it.

The dual active-set method of Goldfarb and Idnani (1983), begun where a guess leaves it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as dense

_ROUNDS = 3
"""In which rows are let go and held by all that is wrong at once, before one at a time."""
_PIVOTS = 600
_BROKEN = 1e-8
"""By which a row may leave its bounds, or times its length by z where that is more."""
_PULLS = 1e-9
"""Of the largest multiplier: sign of one that holds its row from the wrong side."""
_REDUNDANT = 1e-12
"""Of the multipliers' matrix of rows of length 1: rows that repeat each other leave it singular."""
_MISSED = 1e-7
"""From its bound: a row that the others keep from there."""
_HOPELESS = 1e6
"""Times all that the objective can fall: bounds that cost more are met by no point."""
_DEPENDENT = 1e-9
"""Of a row's square: what of it lies outside of the rows that hold, if it follows from them."""

_FACTOR, _SOLVE = dense.get_lapack_funcs(("potrf", "potrs"), dtype=np.float64)


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
    def scaled(self) -> np.ndarray:
        """(n, m) the rows as columns, by z."""
        return dense.solve_triangular(self.factor, self.rows.T, lower=True, check_finite=False)

    @cached_property
    def products(self) -> np.ndarray:
        """(m, m) of the rows with each other, by z."""
        return self.scaled.T @ self.scaled

    @cached_property
    def slack(self) -> np.ndarray:
        """(m,) by how much each row may break its bounds."""
        return _BROKEN * np.maximum(1.0, np.sqrt(self.products.diagonal()))

    def point(self, multipliers: np.ndarray) -> np.ndarray:
        """(n,) x that ``multipliers`` (m,) hold, positive where an upper bound pushes."""
        move = -self.scaled @ multipliers
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


def optimum_near(
    reduced: ReducedRows, lower: np.ndarray, upper: np.ndarray, low: np.ndarray, high: np.ndarray
) -> Optimum | None:
    """Of l <= A x <= u, l < u; ``low`` and ``high`` (m,) guess which rows lie at which bound. None where rounding leads
    the search astray.

    The guessed rows are held at their bounds, which is one system of linear equations in their multipliers; rows that
    pull the wrong way are let go, rows that break their bounds are held instead. Where that goes on for long, rows
    that break their bounds join one at a time, at the dual's best step: that ends.
    """
    side = np.where(low & np.isfinite(lower), 1, np.where(high & np.isfinite(upper), -1, 0))
    search = _Search(reduced, lower, upper)
    for _ in range(_ROUNDS):
        if not search.hold(side):
            return None
        wrong = search.wrong()
        breach = search.breaches()
        if not wrong.any() and not breach.any():
            return search.optimum()
        side = np.where(wrong, 0, search.side)
        at = search.at()
        broken = (search.side == 0) & (breach > 0.0)
        side[broken] = np.where(at[broken] < lower[broken], 1, -1)
    return search.optimum() if search.descend(side) else None


class _Search:
    """Rows that hold, and their multipliers in the direction of their side."""

    def __init__(self, reduced: ReducedRows, lower: np.ndarray, upper: np.ndarray) -> None:
        self.reduced, self.lower, self.upper = reduced, lower, upper
        self.feasible = True
        self._take(np.zeros(len(lower), int))

    def _take(self, side: np.ndarray) -> bool:
        """The rows of ``side`` (m,), +1 at the lower bound and -1 at the upper, and the factors of their matrix; False
        where it has none."""
        self.side, self.active = side, np.flatnonzero(side)
        self.signs, self.columns = side[self.active], self.reduced.scaled[:, self.active]
        self.pulls, self.place = np.zeros(len(self.active)), np.zeros(len(self.reduced.minimum))
        if len(self.active) == 0:
            return True
        matrix = self.reduced.products[self.active[:, None], self.active]
        self._unit = self.signs / np.sqrt(matrix.diagonal())
        matrix *= self._unit[:, None]
        matrix *= self._unit
        matrix[np.diag_indices_from(matrix)] += _REDUNDANT
        self._factor, info = _FACTOR(matrix, lower=1, overwrite_a=1)
        return info == 0

    def _solve(self, right: np.ndarray) -> np.ndarray:
        """With the matrix of the active rows' products, each in the direction of its side."""
        if len(self.active) == 0:
            return np.zeros(0)
        unit = np.abs(self._unit)
        return unit * _SOLVE(self._factor, unit * right, lower=1)[0]

    def hold(self, side: np.ndarray) -> bool:
        """Hold the rows of ``side`` (m,) at their bounds; False where that has no numbers."""
        if not self._take(side):
            return False
        self.pulls = self._solve(self.signs * (self._bounds() - self.reduced.free[self.active]))
        self.place = self.columns @ (self.signs * self.pulls)
        return True

    def _bounds(self) -> np.ndarray:
        return np.where(self.signs > 0, self.lower[self.active], self.upper[self.active])

    def at(self) -> np.ndarray:
        """(m,) the rows."""
        return self.reduced.free + self.reduced.scaled.T @ self.place

    def breaches(self) -> np.ndarray:
        """(m,) by how much more than it may each row breaks its bounds."""
        at = self.at()
        return np.maximum(np.maximum(self.lower - at, at - self.upper) - self.reduced.slack, 0.0)

    def wrong(self) -> np.ndarray:
        """(m,) rows that are held and pull the wrong way, or that the others keep from their bounds."""
        pulled = self.pulls < -_PULLS * np.abs(self.pulls).max(initial=0.0)
        missed = np.abs(self.at()[self.active] - self._bounds()) > _MISSED + self.reduced.slack[self.active]
        wrong = np.zeros(len(self.side), bool)
        wrong[self.active] = pulled | missed
        return wrong

    def descend(self, side: np.ndarray) -> bool:
        """From the rows of ``side`` (m,) that pull the right way to the optimum, or to what has no point at all."""
        if not self.hold(side):
            return False
        while (wrong := self.wrong()).any():
            if not self.hold(np.where(wrong, 0, self.side)):
                return False
        most = _HOPELESS * self.reduced.worth
        for _ in range(_PIVOTS):
            breach = np.where(self.side == 0, self.breaches(), 0.0)
            row = int(np.argmax(breach))
            if breach[row] <= 0.0:
                return True
            if not self._join(row):
                return False
            if not self.feasible or 0.5 * float(self.place @ self.place) > most:
                self.feasible = False
                return True
        return False

    def _join(self, row: int) -> bool:
        """Hold ``row``, letting go of rows whose pull ends on the way; ``feasible`` no longer where no point satisfies
        it beside those."""
        own, square = self.reduced.scaled[:, row], self.reduced.products[row, row]
        below = self.reduced.free[row] + float(own @ self.place) < self.lower[row]
        sign, bound = (1, self.lower[row]) if below else (-1, self.upper[row])
        while True:
            rates = self._solve(sign * self.signs * self.reduced.products[self.active, row])
            # What of the row lies outside of those that hold.
            outside = sign * own - self.columns @ (self.signs * rates)
            apart = float(outside @ outside)
            lacking = sign * (bound - self.reduced.free[row] - float(own @ self.place))
            whole = lacking / apart if apart > _DEPENDENT * square else np.inf
            ends = rates > 0.0
            steps = np.full(len(rates), np.inf)
            steps[ends] = np.maximum(self.pulls[ends], 0.0) / rates[ends]
            first = int(np.argmin(steps)) if len(steps) else -1
            part = float(steps[first]) if first >= 0 else np.inf
            side = self.side.copy()
            if whole <= part:
                self.feasible = bool(np.isfinite(whole))
                side[row] = sign
                return self.hold(side)
            side[self.active[first]] = 0
            pulls = np.delete(self.pulls - part * rates, first)
            place = self.place if np.isinf(whole) else self.place + part * outside
            if not self._take(side):
                return False
            self.pulls, self.place = pulls, place

    def optimum(self) -> Optimum | None:
        """The point, once more with the rows themselves."""
        multipliers = np.zeros(len(self.side))
        multipliers[self.active] = -self.signs * self.pulls
        if not self.feasible:
            return Optimum(np.zeros(len(self.reduced.minimum)), multipliers, False)
        x = self.reduced.point(multipliers)
        at, slack = self.reduced.rows @ x, 10.0 * self.reduced.slack
        # Rows that contradict each other are met by none, whatever their multipliers.
        met = bool((at > self.lower - slack).all() and (at < self.upper + slack).all())
        return Optimum(x, multipliers, True) if met else None
