"""OSQP iterations that guess the active rows of an optimum, for all threads of a block (Stellato, Banjac, Goulart,
Bemporad and Boyd 2020).

The Hessian is the identity, so each iteration changes z by a linear combination of the k selected rows of R. Therefore
only the coefficients in z = ``share`` z_0 + R^T ``sums`` are updated, from the initial point z_0.
"""

import warp as wp

from egs_warp.kernels.block import sync_block
from egs_warp.kernels.locomotion.active_set import ActiveSet, UnitConstraints, evaluate, gather_active
from egs_warp.kernels.locomotion.block_algebra import apply_factor, compact_indices, lane_of_block, multiply_transposed
from egs_warp.kernels.locomotion.block_elimination import inverse_cholesky
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

_ITERATIONS = wp.constant(15)
_RHO = wp.constant(real(1.0))
"""Number of iterations and step size parameter rho, both as in ``egs_warp/locomotion/operator_splitting.py``."""
_SIGMA = wp.constant(real(1e-6))
_ALPHA = wp.constant(real(1.6))
"""Regularisation sigma and over-relaxation factor alpha, with the default values of OSQP."""


@wp.struct
class Splitting:
    """State of the iterations on k selected rows, of m."""

    rows: wp.array[real]
    """(k,) R z, values of the selected rows."""
    projected: wp.array[real]
    """(k,) R z projected onto the bounds."""
    multipliers: wp.array[real]
    """(k,) multipliers."""
    sums: wp.array[real]
    """(k,) coefficients of the selected rows in z."""
    right: wp.array[real]
    """(k,) scratch memory: right-hand side of an iteration."""
    between: wp.array[real]
    """(k,) scratch memory of ``apply_factor``."""
    step: wp.array[real]
    """(k,) scratch memory: solution of an iteration."""
    initial_values: wp.array[real]
    """(m,) R z_0 of all rows."""
    all_multipliers: wp.array[real]
    """(m,) multipliers of all rows."""


@wp.func
def iterate(rows: UnitConstraints, state: ActiveSet, splitting: Splitting):
    """Replace the guess ``state.side`` by the rows that are active after a fixed number of OSQP iterations.

    The iterations consider only the rows with a side in the guess. If there are more of them than unknowns, or if their
    Gram matrix cannot be factored, the guess does not change.
    """
    lane = lane_of_block()
    one = real(1.0)
    count = compact_indices(state.side, rows.count, rows.unknowns, state.active)
    if count > rows.unknowns:
        return
    gather_active(rows, state, count, (one + _SIGMA) / _RHO)
    if inverse_cholesky(state.products, count, state.root) == 0:
        return
    for i in range(lane, count, wp.block_dim()):
        splitting.rows[i] = splitting.initial_values[state.active[i]]
        splitting.projected[i] = splitting.initial_values[state.active[i]]
        splitting.multipliers[i] = real(0.0)
        splitting.sums[i] = real(0.0)
    share = real(1.0)
    # Warp would unroll a loop over a range.
    iteration = int(0)
    while iteration < _ITERATIONS:
        iteration += 1
        for i in range(lane, count, wp.block_dim()):
            splitting.right[i] = _SIGMA * splitting.rows[i] + (one + _SIGMA) * (
                splitting.multipliers[i] / _RHO - splitting.projected[i]
            )
        sync_block()
        apply_factor(state.root, count, splitting.right, splitting.between, splitting.step)
        for i in range(lane, count, wp.block_dim()):
            row = state.active[i]
            nu = splitting.step[i]
            projected = splitting.projected[i]
            multiplier = splitting.multipliers[i]
            target = projected + (nu - multiplier) / _RHO
            splitting.rows[i] = _ALPHA * target + (one - _ALPHA) * splitting.rows[i]
            splitting.sums[i] = (
                _ALPHA * (_SIGMA * splitting.sums[i] - nu) / (one + _SIGMA) + (one - _ALPHA) * (splitting.sums[i])
            )
            relaxed = _ALPHA * target + (one - _ALPHA) * projected
            free = rows.values_at_origin[row]
            clamped = wp.clamp(relaxed + multiplier / _RHO, rows.lower[row] - free, rows.upper[row] - free)
            splitting.projected[i] = clamped
            splitting.multipliers[i] = multiplier + _RHO * (relaxed - clamped)
        share = _ALPHA * _SIGMA * share / (one + _SIGMA) + (one - _ALPHA) * share
    sync_block()
    multiply_transposed(state.active_rows, count, rows.unknowns, splitting.sums, state.z)
    evaluate(rows, state)
    for row in range(lane, rows.count, wp.block_dim()):
        splitting.all_multipliers[row] = real(0.0)
    sync_block()
    for i in range(lane, count, wp.block_dim()):
        splitting.all_multipliers[state.active[i]] = splitting.multipliers[i]
    sync_block()
    for row in range(lane, rows.count, wp.block_dim()):
        at = state.values[row] + share * splitting.initial_values[row]
        multiplier = splitting.all_multipliers[row]
        side = int(0)
        if at - rows.lower[row] < -multiplier:
            side = 1
        elif rows.upper[row] - at < multiplier:
            side = -1
        state.side[row] = side
    sync_block()
