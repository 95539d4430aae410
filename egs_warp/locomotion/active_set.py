"""Solution of strictly convex QPs up to rounding, from a guess of the active constraints.

The method is the dual active-set method of Goldfarb and Idnani (1983), started at the guess. Its kernels are in
``egs_warp.kernels.locomotion.quadratic_program`` and ``active_set``; the mode search on a GPU uses ``active_set`` too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp
from scipy.linalg import get_lapack_funcs

from egs_warp.fem.batched import allocate_struct
from egs_warp.kernels.locomotion import quadratic_program as kernels
from egs_warp.kernels.locomotion.active_set import INFEASIBLE, NUMERICAL_FAILURE, ActiveSet, UnitConstraints
from egs_warp.launching import launch_cached, round_up, thread_local_cache

(_trtri,) = get_lapack_funcs(("trtri",), dtype=np.float64)
_ROW_STEP = 32
"""Multiple to which the row capacity of a workspace is rounded up."""
_BOUND_TOLERANCE = 1e-8
"""Tolerance of the bounds of a row, multiplied by the row's norm in z if that exceeds 1."""
_INFEASIBLE_COST = 1e6
"""Increase of the objective, in units of ``WhitenedQp.objective_drop``, above which bounds are treated as
infeasible."""


@dataclass(frozen=True)
class WhitenedQp:
    """QP min 1/2 x^T P x + q^T x with constraint rows A, in whitened coordinates.

    The coordinates are z = U^-1 (x - x0), with the unconstrained minimum x0 and P^-1 = U U^T. In z, the Hessian is the
    identity, and the objective is 1/2 |z|^2 plus its value at x0.
    """

    P: np.ndarray
    """(n, n) Hessian."""
    rows: np.ndarray
    """(m, n) constraint rows A."""
    root: np.ndarray
    """(n, n) upper triangular U."""
    unit_rows: np.ndarray
    """(m, n) rows in z, scaled to length 1; zero rows stay zero."""
    minimum: np.ndarray
    """(n,) x0, the unconstrained minimum."""
    values_at_minimum: np.ndarray
    """(m,) A x0."""
    row_norms: np.ndarray
    """(m,) norms of the rows in z; 1 for zero rows."""
    objective_drop: float
    """Decrease of the objective from x = 0 to x0, at least 1."""

    @classmethod
    def of(cls, P: np.ndarray, q: np.ndarray, A: np.ndarray) -> WhitenedQp:
        """Whiten the QP.

        Args:
            P: (n, n) Hessian.
            q: (n,) linear term.
            A: (m, n) constraint rows.

        Raises:
            numpy.linalg.LinAlgError: P is finite but not positive definite. If P is not finite, the minimum is NaN.
        """
        if np.isfinite(P).all():
            inverse, _ = _trtri(np.linalg.cholesky(P), lower=1)
            root = inverse.T
        else:
            root = np.full(P.shape, np.nan)
        minimum, rows = -(root @ (root.T @ q)), A @ root
        norms = np.sqrt(np.einsum("mn,mn->m", rows, rows))
        norms[norms == 0.0] = 1.0
        rows /= norms[:, None]
        return cls(P, A, root, rows, minimum, A @ minimum, norms, max(1.0, -0.5 * float(q @ minimum)))

    def whiten(self, x: np.ndarray) -> np.ndarray:
        """Return the whitened coordinates z (n,) of ``x`` (n,)."""
        return self.root.T @ (self.P @ (x - self.minimum))

    @cached_property
    def slack(self) -> np.ndarray:
        """(m,) tolerance of the bounds of each row."""
        return _BOUND_TOLERANCE * np.maximum(1.0, self.row_norms)


@dataclass(frozen=True)
class Optimum:
    """Result of the active-set method."""

    x: np.ndarray
    """(n,) optimal point."""
    multipliers: np.ndarray
    """(m,) multipliers, positive at an active upper bound."""
    feasible: bool
    """True if a point satisfies the bounds; otherwise ``x`` has no meaning."""


class _Workspace:
    """Workspace that is reused for all QPs of at most ``rows`` rows and ``unknowns`` unknowns."""

    def __init__(self, rows: int, unknowns: int) -> None:
        self._device, self._unknowns = wp.get_device("cpu"), unknowns
        never, self._ended = (wp.zeros(count, dtype=int, device=self._device) for count in (1, 2))
        row_shapes, state_shapes = active_set_shapes(rows, rows, unknowns)
        self._rows = allocate_struct(UnitConstraints, row_shapes, self._device, cancelled=never)
        self._state = allocate_struct(ActiveSet, state_shapes, self._device)
        names = ("values_at_origin", "lower", "upper", "slack")
        self._bounds = [getattr(self._rows, name).numpy() for name in names]
        self._units, self._side, self._status = (
            each.numpy() for each in (self._rows.units, self._state.side, self._ended)
        )
        self._active, self._multipliers, self._z = (
            each.numpy() for each in (self._state.active, self._state.multipliers, self._state.z)
        )
        # Each row is a base row.
        self._rows.base_rows.numpy()[:] = np.arange(rows)[:, None]
        self._rows.coefficients.numpy()[:, 0] = 1.0

    def search(
        self, qp: WhitenedQp, lower: np.ndarray, upper: np.ndarray, side: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Run the active-set method.

        Args:
            qp: the whitened QP.
            lower: (m,) lower bounds of the rows.
            upper: (m,) upper bounds.
            side: (m,) guess of the active bounds: 1 lower, -1 upper, 0 none.

        Returns:
            Status; active rows, their sides and their multipliers for unit rows, each (active count,); and the point
            (n,).
        """
        m = len(qp.rows)
        for target, values in zip(self._bounds, (qp.values_at_minimum, lower, upper, qp.slack), strict=True):
            np.divide(values, qp.row_norms, out=target[:m])
        self._units[:m], self._side[:m] = qp.unit_rows, side
        launch_cached(
            kernels.optimum_kernel,
            1,
            inputs=[m, self._unknowns, _INFEASIBLE_COST * qp.objective_drop, self._rows],
            outputs=[self._state, self._ended],
            device=self._device,
        )
        status, count = int(self._status[0]), min(int(self._status[1]), self._unknowns)
        active, multipliers = self._active[:count].copy(), self._multipliers[:count].copy()
        return status, active, self._side[active], multipliers, qp.minimum + qp.root @ self._z


_thread_workspace = thread_local_cache(16)(_Workspace)


def _workspace_for(A: np.ndarray) -> _Workspace:
    """Return the workspace of this thread for the size of ``A``."""
    return _thread_workspace(round_up(len(A), _ROW_STEP), A.shape[1])


def active_set_shapes(rows: int, base_rows: int, unknowns: int) -> tuple[dict[str, tuple[int, ...]], ...]:
    """Return the shapes of the arrays of ``UnitConstraints``, without ``cancelled``, and of ``ActiveSet``.

    Args:
        rows: row capacity.
        base_rows: number of base rows; each row is a combination of them.
        unknowns: maximum number of unknowns.
    """
    square = "active_rows", "active_columns", "products", "root", "inverse"
    vectors = "multipliers", "z", "dual_direction", "scratch_a", "scratch_b", "entering_row", "orthogonal_part"
    return (
        {
            **{"units": (base_rows, unknowns), "base_values": (base_rows,)},
            **dict.fromkeys(("base_rows", "coefficients"), (rows, 3)),
            **dict.fromkeys(("values_at_origin", "lower", "upper", "slack"), (rows,)),
        },
        {
            **{"side": (rows,), "active": (unknowns,), "values": (rows,)},
            **dict.fromkeys(square, (unknowns, unknowns)),
            **dict.fromkeys(vectors, (unknowns,)),
        },
    )


def solve_from_guess(
    qp: WhitenedQp, lower: np.ndarray, upper: np.ndarray, at_lower: np.ndarray, at_upper: np.ndarray
) -> Optimum | None:
    """Solve the QP subject to lower <= A x <= upper, lower < upper.

    Args:
        qp: the whitened QP.
        lower: (m,) lower bounds of the rows.
        upper: (m,) upper bounds of the rows.
        at_lower: (m,) bool, guess of the rows at their lower bound.
        at_upper: (m,) bool, guess of the rows at their upper bound.

    Returns:
        The optimum, or None on numerical failure.
    """
    m, n = qp.rows.shape
    side = np.where(at_lower & np.isfinite(lower), 1, np.where(at_upper & np.isfinite(upper), -1, 0))
    status, active, sides, active_multipliers, x = _workspace_for(qp.rows).search(qp, lower, upper, side)
    multipliers = np.zeros(m)
    if status == NUMERICAL_FAILURE:
        return None
    if status == INFEASIBLE:
        return Optimum(np.zeros(n), multipliers, False)
    multipliers[active] = -sides * active_multipliers / qp.row_norms[active]
    values, slack = qp.rows @ x, 10.0 * qp.slack
    # Contradictory rows have multipliers too, so the bounds must be checked.
    is_feasible = bool((values > lower - slack).all() and (values < upper + slack).all())
    return Optimum(x, multipliers, True) if is_feasible else None
