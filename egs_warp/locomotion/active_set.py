"""The optimum of a strictly convex quadratic program to rounding, from a guess of the rows that hold it.

The dual active-set method of Goldfarb and Idnani (1983), begun where a guess leaves it, as a kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from egs_warp.kernels.locomotion import active_set as kernels
from egs_warp.kernels.locomotion.whitened_constraints import STEP, WhitenedConstraints, reduce_kernel, room_of
from egs_warp.launching import thread_local_cache
from egs_warp.precision import Vec4, real

_PIVOTS = 600
_BROKEN = 1e-8
"""By which a row may leave its bounds, or times its length by z where that is more."""
_HOPELESS = 1e6
"""Times all that the objective can fall: bounds that cost more are met by no point."""


@dataclass(frozen=True)
class WhitenedQp:
    """The rows A of min 1/2 x^T P x + q^T x in coordinates z = D^1/2 L^T (x - x0), P = L D L^T, in which distances from
    the minimum x0 are costs."""

    P: np.ndarray
    """(n, n)."""
    q: np.ndarray
    """(n,)."""
    rows: np.ndarray
    """(m, n) A."""
    minimum: np.ndarray
    """(n,) x0, without any bounds."""
    values_at_minimum: np.ndarray
    """(m,) A x0."""
    row_norms: np.ndarray
    """(m,) of the rows by z, 1 for those without any."""
    objective_drop: float
    """By how much the objective is lower at x0 than at 0, or 1 if that is less."""

    @classmethod
    def of(cls, P: np.ndarray, q: np.ndarray, A: np.ndarray) -> WhitenedQp:
        """Of P (n, n), q (n,) and A (m, n). Raises ``numpy.linalg.LinAlgError`` where P is not positive definite; one
        that holds no number has no minimum."""
        P, q, A = (np.asarray(each, dtype=np.float64) for each in (P, q, A))
        minimum, free, lengths = _room_for(A).reduce(P, q, A)
        return cls(P, q, A, minimum, free, lengths, max(1.0, -0.5 * float(q @ minimum)))

    @property
    def unit_rows(self) -> np.ndarray:
        """(m, n) the rows by z, each of length 1 or 0; as long as no others of as many are made."""
        return _room_for(self.rows).units(self)

    def whiten(self, x: np.ndarray) -> np.ndarray:
        """(n,) z of ``x`` (n,)."""
        return _room_for(self.rows).place(self, x)

    @cached_property
    def slack(self) -> np.ndarray:
        """(m,) by how much each row may break its bounds."""
        return _BROKEN * np.maximum(1.0, self.row_norms)


@dataclass(frozen=True)
class Optimum:
    """Where the search has ended."""

    x: np.ndarray
    """(n,)."""
    multipliers: np.ndarray
    """(m,) positive where the upper bound pushes."""
    feasible: bool
    """Whether any point satisfies the bounds; else ``x`` means nothing."""


class _Workspace:
    """Memory for a program of so many rows and unknowns, and launches that are made again and again: a new one takes
    longer than the search. It has the rows of one program at a time, the last that was asked for."""

    def __init__(self, rows: int, unknowns: int) -> None:
        wide = -(-unknowns // 8) * 8
        self._minimum, self._free, self._lengths = np.zeros(unknowns), np.zeros(rows), np.zeros(rows)
        self._units, self._unknowns = np.zeros((rows, wide)), unknowns
        reduced = WhitenedConstraints()
        self._transpose, self._roots = np.zeros((unknowns, wide)), np.zeros(unknowns)
        reduced.lower, reduced.columns = _zeros((unknowns, wide)), _zeros((unknowns, rows))
        reduced.upper, reduced.roots = _shared(self._transpose), _shared(self._roots)
        reduced.scratch = _zeros((room_of(unknowns, wide),))
        reduced.minimum, reduced.free, reduced.lengths = map(_shared, (self._minimum, self._free, self._lengths))
        reduced.rows, reduced.products = map(_by_fours, (self._units, np.zeros((rows, rows))))
        reduced.has_products = wp.zeros(rows, dtype=int, device="cpu")
        self._definite, self._at_zero = np.zeros(1, np.int32), np.zeros(rows)
        self._lower, self._upper, self._slack = np.zeros((3, rows))
        self._most, self._pulls = np.zeros(1), np.zeros(unknowns)
        self._side, self._active, self._ended = (np.zeros(count, np.int32) for count in (rows, unknowns, 2))
        program, search = kernels.Program(), kernels.ActiveSetState()
        program.constraints, program.values_at_origin = reduced, _by_fours(self._at_zero)
        program.lower, program.upper, program.slack = map(_shared, (self._lower, self._upper, self._slack))
        program.cost_limit, search.multipliers = _shared(self._most), _shared(self._pulls)
        search.side, search.active = _shared(self._side), _shared(self._active)
        search.values, search.orthogonal_part = _by_fours(np.zeros(rows)), _by_fours(np.zeros(wide))
        search.factor = _zeros((unknowns, unknowns))
        search.rates, search.solved_products = _zeros((unknowns,)), _zeros((unknowns,))
        self._reducing: Any = wp.launch(
            reduce_kernel,
            1,
            inputs=[0, 0, 0, 0, 0, 0],
            outputs=[reduced, _shared(self._definite)],
            device="cpu",
            record_cmd=True,
        )
        self._searching: Any = wp.launch(
            kernels.optimum_kernel,
            1,
            inputs=[program, _PIVOTS, search],
            outputs=[_shared(self._ended), 0],
            device="cpu",
            record_cmd=True,
        )
        # The launches have where these lie.
        self._held = reduced, program, search
        self._has: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def reduce(self, P: np.ndarray, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Minimum, rows at it and their lengths: see ``ReducedRows``."""
        P, q, A = (each if each.strides[-1] == 8 else np.ascontiguousarray(each) for each in (P, q, A))
        given = P.ctypes.data, P.strides[0] // 8, q.ctypes.data, A.ctypes.data, A.strides[0] // 8, len(A)
        for place, value in enumerate(given):
            self._reducing.set_param_at_index_from_ctype(place, value)
        self._reducing.launch()
        self._has = P, q, A
        if not self._definite[0]:
            if np.isfinite(P).all():
                raise np.linalg.LinAlgError("the Hessian is not positive definite")
            self._minimum[:], self._free[:], self._lengths[:] = np.nan, np.nan, 1.0
        return self._minimum.copy(), self._free[: len(A)].copy(), self._lengths[: len(A)].copy()

    def units(self, reduced: WhitenedQp) -> np.ndarray:
        """See ``ReducedRows``."""
        self._take(reduced)
        return self._units[: len(reduced.rows), : self._unknowns]

    def place(self, reduced: WhitenedQp, x: np.ndarray) -> np.ndarray:
        """See ``ReducedRows``."""
        self._take(reduced)
        away = x - reduced.minimum
        return (away + self._transpose[:, : self._unknowns] @ away) / self._roots

    def _take(self, reduced: WhitenedQp) -> None:
        wanted = reduced.P, reduced.q, reduced.rows
        if self._has is None or any(one is not other for one, other in zip(self._has, wanted, strict=True)):
            self.reduce(*wanted)
            self._has = wanted

    def search(
        self, reduced: WhitenedQp, lower: np.ndarray, upper: np.ndarray, side: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """How it ended, of the rows that hold the numbers, the sides and the multipliers, and the point."""
        self._take(reduced)
        m, point = len(reduced.rows), np.empty(self._unknowns)
        self._at_zero[:m], self._at_zero[m:] = reduced.values_at_minimum / reduced.row_norms, 0.0
        self._lower[:m], self._lower[m:] = lower / reduced.row_norms, -np.inf
        self._upper[:m], self._upper[m:] = upper / reduced.row_norms, np.inf
        self._slack[:m], self._slack[m:] = reduced.slack / reduced.row_norms, 0.0
        self._side[:m], self._side[m:] = side, 0
        self._most[0] = _HOPELESS * reduced.objective_drop
        self._searching.set_param_at_index_from_ctype(4, point.ctypes.data)
        self._searching.launch()
        how, count = self._ended.tolist()
        active = self._active[:count].copy()
        return how, active, self._side[active], self._pulls[:count].copy(), point


_room = thread_local_cache(16)(_Workspace)


def _room_for(A: np.ndarray) -> _Workspace:
    return _room(-(-len(A) // STEP) * STEP, A.shape[1])


def _zeros(shape: tuple[int, ...]) -> wp.array:
    return wp.zeros(shape, dtype=real, device="cpu")


def _shared(values: np.ndarray) -> wp.array:
    return wp.array(values, dtype=real if values.dtype == np.float64 else int, device="cpu", copy=False)


def _by_fours(values: np.ndarray) -> wp.array:
    return wp.array(values.reshape(*values.shape[:-1], -1, 4), dtype=Vec4, device="cpu", copy=False)


def solve_from_guess(
    reduced: WhitenedQp, lower: np.ndarray, upper: np.ndarray, low: np.ndarray, high: np.ndarray
) -> Optimum | None:
    """Of l <= A x <= u, l < u; ``low`` and ``high`` (m,) guess which rows lie at which bound. None where rounding leads
    the search astray.
    """
    m, n = reduced.rows.shape
    side = np.where(low & np.isfinite(lower), 1, np.where(high & np.isfinite(upper), -1, 0))
    how, active, sides, pulls, x = _room_for(reduced.rows).search(reduced, lower, upper, side)
    multipliers = np.zeros(m)
    if how == kernels.NUMERICAL_FAILURE:
        return None
    if how == kernels.INFEASIBLE:
        return Optimum(np.zeros(n), multipliers, False)
    multipliers[active] = -sides * pulls / reduced.row_norms[active]
    at, slack = reduced.rows @ x, 10.0 * reduced.slack
    # Rows that contradict each other are met by none, whatever their multipliers.
    met = bool((at > lower - slack).all() and (at < upper + slack).all())
    return Optimum(x, multipliers, True) if met else None
