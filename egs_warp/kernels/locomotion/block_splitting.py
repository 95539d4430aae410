"""OSQP's iterations by all threads of a block, in coordinates whose squares are costs: they tell which rows hold an
optimum (Stellato, Banjac, Goulart, Bemporad and Boyd 2020).

With P = 1 a step to the next z is a combination of rows, so it takes place in the multipliers of the k rows that are
looked at: z = share z_0 + R^T sums.
"""

import warp as wp

from egs_warp.kernels.block import sync_block
from egs_warp.kernels.locomotion.block_active_set import ActiveSet, UnitConstraints, evaluate, gather_active
from egs_warp.kernels.locomotion.block_algebra import (
    apply_factor,
    compact_indices,
    lane_of_block,
    multiply_transposed,
)
from egs_warp.kernels.locomotion.block_elimination import inverse_cholesky
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

_ITERATIONS = wp.constant(15)
_RHO = wp.constant(real(1.0))
"""Both as in ``egs_warp/locomotion/operator_splitting.py``."""
_SIGMA = wp.constant(real(1e-6))
_OVER = wp.constant(real(1.6))
"""alpha, relaxation beyond a whole step. OSQP's defaults."""


@wp.struct
class Splitting:
    """Where the iterations are."""

    rows: wp.array[real]
    """(k,) R z."""
    projected: wp.array[real]
    """(k,) what of that is within the bounds."""
    multipliers: wp.array[real]
    """(k,) multipliers."""
    sums: wp.array[real]
    """(k,)."""
    right: wp.array[real]
    between: wp.array[real]
    step: wp.array[real]
    """(k,) scratch."""
    initial_values: wp.array[real]
    """(m,) R z_0 of all rows."""
    all_multipliers: wp.array[real]
    """(m,) multipliers of all rows."""


@wp.func
def iterate(rows: UnitConstraints, holding: ActiveSet, splitting: Splitting):
    """From rows with a side, those that are looked at, to a guess of the rows that hold the optimum; the guess that
    there is stays where they are more than there are unknowns, or have no factors."""
    lane = lane_of_block()
    one = real(1.0)
    count = compact_indices(holding.side, rows.count, rows.unknowns, holding.active)
    if count > rows.unknowns:
        return
    gather_active(rows, holding, count, (one + _SIGMA) / _RHO)
    if inverse_cholesky(holding.products, count, holding.root) == 0:
        return
    for i in range(lane, count, wp.block_dim()):
        splitting.rows[i] = splitting.initial_values[holding.active[i]]
        splitting.projected[i] = splitting.initial_values[holding.active[i]]
        splitting.multipliers[i] = real(0.0)
        splitting.sums[i] = real(0.0)
    share = real(1.0)
    # Not a range, which would be written out.
    done = int(0)
    while done < _ITERATIONS:
        done += 1
        for i in range(lane, count, wp.block_dim()):
            splitting.right[i] = _SIGMA * splitting.rows[i] + (one + _SIGMA) * (
                splitting.multipliers[i] / _RHO - splitting.projected[i]
            )
        sync_block()
        apply_factor(holding.root, count, splitting.right, splitting.between, splitting.step)
        for i in range(lane, count, wp.block_dim()):
            row = holding.active[i]
            nu = splitting.step[i]
            near = splitting.projected[i]
            push = splitting.multipliers[i]
            ahead = near + (nu - push) / _RHO
            splitting.rows[i] = _OVER * ahead + (one - _OVER) * splitting.rows[i]
            splitting.sums[i] = (
                _OVER * (_SIGMA * splitting.sums[i] - nu) / (one + _SIGMA) + (one - _OVER) * (splitting.sums[i])
            )
            relaxed = _OVER * ahead + (one - _OVER) * near
            free = rows.values_at_origin[row]
            within = wp.clamp(relaxed + push / _RHO, rows.lower[row] - free, rows.upper[row] - free)
            splitting.projected[i] = within
            splitting.multipliers[i] = push + _RHO * (relaxed - within)
        share = _OVER * _SIGMA * share / (one + _SIGMA) + (one - _OVER) * share
    sync_block()
    multiply_transposed(holding.active_rows, count, rows.unknowns, splitting.sums, holding.z)
    evaluate(rows, holding)
    for row in range(lane, rows.count, wp.block_dim()):
        splitting.all_multipliers[row] = real(0.0)
    sync_block()
    for i in range(lane, count, wp.block_dim()):
        splitting.all_multipliers[holding.active[i]] = splitting.multipliers[i]
    sync_block()
    for row in range(lane, rows.count, wp.block_dim()):
        at = holding.values[row] + share * splitting.initial_values[row]
        push = splitting.all_multipliers[row]
        side = int(0)
        if at - rows.lower[row] < -push:
            side = 1
        elif rows.upper[row] - at < push:
            side = -1
        holding.side[row] = side
    sync_block()
