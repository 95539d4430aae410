"""Dual active-set method of Goldfarb and Idnani (1983), for all threads of a block on a GPU or one thread on a CPU.

The problem is min 1/2 z^T z subject to l <= free + R z <= u, where the rows of R have length 1. The solution is z = R^T
(s p), where p >= 0 are the multipliers of the active rows and s = +1 or -1 the sides at which they are active.

The inverse of the Gram matrix of the active rows is stored and updated instead of its Cholesky factor, because on a GPU
a triangular solve synchronises the threads once per row, while a matrix product does not. ``solve_active`` starts from
scratch, which removes the rounding errors that the updates have accumulated.
"""

import warp as wp

from egs_warp.kernels.block import block_max, sum_of_block, sync_block
from egs_warp.kernels.locomotion.block_algebra import (
    apply_factor,
    argmax_of_block,
    compact_indices,
    gemm_add,
    lane_of_block,
    multiply,
    multiply_transposed,
)
from egs_warp.kernels.locomotion.block_elimination import inverse_cholesky
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

OPTIMUM_FOUND, INFEASIBLE, NUMERICAL_FAILURE = wp.constant(0), wp.constant(1), wp.constant(2)
"""Status of a solve: optimum found, no point satisfies the bounds, or numerical failure."""

WRONG_SIGN_TOLERANCE = wp.constant(real(1e-9))
"""Tolerance of the signs of multipliers, as a fraction of the largest multiplier."""
REDUNDANCY_TOLERANCE = wp.constant(real(1e-12))
"""Shift of the diagonal of the Gram matrix of the active rows, which is singular if rows are redundant."""
BOUND_TOLERANCE = wp.constant(real(1e-7))
"""Maximum distance of an active row from its bound. A row that depends on other active rows can be further away."""
DEPENDENCE_TOLERANCE = wp.constant(real(1e-9))
"""Squared length of a row's part orthogonal to the active rows, below which the row depends on them."""
PIVOTS = wp.constant(600)
"""Maximum number of dual iterations."""
RESTARTS = wp.constant(8)
"""Maximum number of restarts if rounding leaves a violated row or a multiplier of the wrong sign."""
_CHECK_INTERVAL = wp.constant(8)
"""Number of dual iterations between two checks for the cost limit and for cancellation."""


@wp.struct
class UnitConstraints:
    """Input of a solve: rows R, bounds and limits."""

    unknowns: int
    """Number of unknowns n."""
    count: int
    """Number of rows m."""
    base_count: int
    """Number of base rows k."""
    units: wp.array2d[real]
    """(k, n) base rows; each row of R is a linear combination of at most three of them."""
    base_rows: wp.array2d[int]
    """(m, 3) indices of the base rows of each row of R."""
    coefficients: wp.array2d[real]
    """(m, 3) coefficients of the base rows in each row of R."""
    base_values: wp.array[real]
    """(k,) scratch memory for the values of the base rows at a point."""
    values_at_origin: wp.array[real]
    """(m,) row values at z = 0."""
    lower: wp.array[real]
    """(m,) lower bounds of the rows."""
    upper: wp.array[real]
    """(m,) upper bounds of the rows."""
    slack: wp.array[real]
    """(m,) amount by which a row may violate its bounds."""
    cost_limit: real
    """Cost z^T z / 2 above which the problem is treated as infeasible."""
    orthogonalizations: int
    """Number of passes, 1 or 2, that orthogonalise an entering row against the active rows. The second pass removes the
    rounding error of the first one. Restarts always use 2."""
    cancelled: wp.array[int]
    """(1,) set to a nonzero value by another launch once the result is no longer needed."""


@wp.struct
class ActiveSet:
    """State of a solve with k active rows; n is the capacity."""

    side: wp.array[int]
    """(m,) 1 for a row active at its lower bound, -1 at its upper bound, 0 for an inactive row."""
    active: wp.array[int]
    """(n,) indices of the active rows."""
    multipliers: wp.array[real]
    """(n,) multipliers of the active rows."""
    active_rows: wp.array2d[real]
    """(k, n) the active rows."""
    active_columns: wp.array2d[real]
    """(n, k) transpose of the active rows at the last call of ``gather_active``."""
    products: wp.array2d[real]
    """(k, k) Gram matrix of the active rows: their inner products."""
    root: wp.array2d[real]
    """(k, k) upper triangular U with products^-1 = U U^T."""
    inverse: wp.array2d[real]
    """(k, k) inverse of ``products``, updated as rows are added and dropped."""
    z: wp.array[real]
    """(n,) current point."""
    values: wp.array[real]
    """(m,) values free + R z of all rows at the current point."""
    dual_direction: wp.array[real]
    """(k,) ``inverse`` times the inner products of the active rows with the entering row."""
    scratch_a: wp.array[real]
    """(n,) scratch memory."""
    scratch_b: wp.array[real]
    """(n,) scratch memory."""
    entering_row: wp.array[real]
    """(n,) entering row."""
    orthogonal_part: wp.array[real]
    """(n,) part of the entering row that is orthogonal to the active rows."""


@wp.func
def bound_of(rows: UnitConstraints, state: ActiveSet, row: int):
    """Return the active bound of ``row``."""
    if state.side[row] > 0:
        return rows.lower[row]
    return rows.upper[row]


@wp.func
def evaluate(rows: UnitConstraints, state: ActiveSet):
    """Evaluate all rows at ``state.z`` into ``state.values``."""
    multiply(rows.units, rows.base_count, rows.unknowns, state.z, rows.base_values)
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        at = rows.values_at_origin[row]
        for t in range(3):
            at += rows.coefficients[row, t] * rows.base_values[rows.base_rows[row, t]]
        state.values[row] = at
    sync_block()


@wp.func
def unit_entry(rows: UnitConstraints, row: int, c: int):
    """Return entry (``row``, ``c``) of R."""
    value = real(0.0)
    for t in range(3):
        value += rows.coefficients[row, t] * rows.units[rows.base_rows[row, t], c]
    return value


@wp.func
def gather_active(rows: UnitConstraints, state: ActiveSet, count: int, added: real):
    """Gather the active rows and compute their Gram matrix, with ``added`` added to its diagonal."""
    lane = lane_of_block()
    for e in range(lane, count * rows.unknowns, wp.block_dim()):
        i = e / rows.unknowns
        c = e % rows.unknowns
        value = unit_entry(rows, state.active[i], c)
        state.active_rows[i, c] = value
        state.active_columns[c, i] = value
    for e in range(lane, count * count, wp.block_dim()):
        state.products[e / count, e % count] = wp.where(e / count == e % count, added, real(0.0))
    sync_block()
    gemm_add(state.products, state.active_rows, state.active_columns, count, count, rows.unknowns, 0)


@wp.func
def solve_active(rows: UnitConstraints, state: ActiveSet):
    """Solve for the z at which all rows with a side are at their bounds. Return the number of these rows; -1 if there
    are more than unknowns, or if their Gram matrix is not positive definite."""
    lane = lane_of_block()
    count = compact_indices(state.side, rows.count, rows.unknowns, state.active)
    if count > rows.unknowns:
        return -1
    gather_active(rows, state, count, REDUNDANCY_TOLERANCE)
    for i in range(lane, count, wp.block_dim()):
        row = state.active[i]
        state.scratch_a[i] = bound_of(rows, state, row) - rows.values_at_origin[row]
    sync_block()
    if inverse_cholesky(state.products, count, state.root) == 0:
        return -1
    apply_factor(state.root, count, state.scratch_a, state.scratch_b, state.dual_direction)
    for i in range(lane, count, wp.block_dim()):
        state.multipliers[i] = real(state.side[state.active[i]]) * state.dual_direction[i]
    multiply_transposed(state.active_rows, count, rows.unknowns, state.dual_direction, state.z)
    evaluate(rows, state)
    return count


@wp.func
def write_inverse(state: ActiveSet, count: int):
    """Compute the inverse of the Gram matrix of the active rows from ``state.root``."""
    for e in range(lane_of_block(), count * count, wp.block_dim()):
        i = e / count
        k = e % count
        value = real(0.0)
        for c in range(wp.max(i, k), count):
            value += state.root[i, c] * state.root[k, c]
        state.inverse[i, k] = value
    sync_block()


@wp.func
def count_wrong_rows(rows: UnitConstraints, state: ActiveSet, count: int, deactivate: int):
    """Return the number of active rows whose multiplier has the wrong sign or whose value is not at its bound, and
    deactivate these rows if ``deactivate`` is 1."""
    lane = lane_of_block()
    most = real(0.0)
    for i in range(lane, count, wp.block_dim()):
        most = wp.max(most, wp.abs(state.multipliers[i]))
    most = block_max(most)
    sync_block()
    wrong = real(0.0)
    for i in range(lane, count, wp.block_dim()):
        row = state.active[i]
        residual = wp.abs(state.values[row] - bound_of(rows, state, row))
        if state.multipliers[i] < -WRONG_SIGN_TOLERANCE * most or residual > BOUND_TOLERANCE + rows.slack[row]:
            wrong += real(1.0)
            if deactivate == 1:
                state.side[row] = 0
    wrong = sum_of_block(wrong)
    sync_block()
    return int(wrong)


@wp.func
def clear_active_set(rows: UnitConstraints, state: ActiveSet):
    """Deactivate all rows. The empty active set is always dual feasible."""
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        state.side[row] = 0
    sync_block()


@wp.func
def drop_constraint(rows: UnitConstraints, state: ActiveSet, count: int, place: int):
    """Drop the active row at index ``place`` of the active set, and move the last active row to this index."""
    lane = lane_of_block()
    last = count - 1
    for i in range(lane, count, wp.block_dim()):
        state.scratch_a[i] = state.inverse[i, place]
    sync_block()
    by = real(1.0) / state.scratch_a[place]
    for e in range(lane, count * count, wp.block_dim()):
        i = e / count
        k = e % count
        state.inverse[i, k] = state.inverse[i, k] - state.scratch_a[i] * state.scratch_a[k] * by
    if lane == 0:
        state.side[state.active[place]] = 0
        state.active[place] = state.active[last]
        state.multipliers[place] = state.multipliers[last]
    sync_block()
    if place == last:
        return
    for i in range(lane, last, wp.block_dim()):
        if i != place:
            value = state.inverse[i, last]
            state.inverse[i, place] = value
            state.inverse[place, i] = value
    if lane == 0:
        state.inverse[place, place] = state.inverse[last, last]
    for c in range(lane, rows.unknowns, wp.block_dim()):
        state.active_rows[place, c] = state.active_rows[last, c]
    sync_block()


@wp.func
def find_directions(rows: UnitConstraints, state: ActiveSet, count: int, direction: real):
    """Compute the dual direction of the entering row, and its part orthogonal to the active rows times ``direction``.
    Return the squared length of this part."""
    lane = lane_of_block()
    multiply(state.active_rows, count, rows.unknowns, state.entering_row, state.scratch_a)
    multiply(state.inverse, count, count, state.scratch_a, state.dual_direction)
    multiply_transposed(state.active_rows, count, rows.unknowns, state.dual_direction, state.orthogonal_part)
    for c in range(lane, rows.unknowns, wp.block_dim()):
        state.orthogonal_part[c] = state.entering_row[c] - state.orthogonal_part[c]
    sync_block()
    if rows.orthogonalizations > 1:
        # Orthogonalise again, because rounding has left a component along the active rows.
        multiply(state.active_rows, count, rows.unknowns, state.orthogonal_part, state.scratch_a)
        multiply(state.inverse, count, count, state.scratch_a, state.scratch_b)
        multiply_transposed(state.active_rows, count, rows.unknowns, state.scratch_b, state.scratch_a)
        for c in range(lane, rows.unknowns, wp.block_dim()):
            state.orthogonal_part[c] = state.orthogonal_part[c] - state.scratch_a[c]
        for i in range(lane, count, wp.block_dim()):
            state.dual_direction[i] = state.dual_direction[i] + state.scratch_b[i]
        sync_block()
    square = real(0.0)
    for c in range(lane, rows.unknowns, wp.block_dim()):
        value = state.orthogonal_part[c]
        state.orthogonal_part[c] = direction * value
        square += value * value
    square = sum_of_block(square)
    sync_block()
    return square


@wp.func
def add_constraint(rows: UnitConstraints, state: ActiveSet, active: int, row: int):
    """Add constraint ``row`` to the active set, dropping constraints whose multipliers reach zero before the step ends.

    Returns: number of active constraints; -1 if the constraints are inconsistent; -2 on numerical failure.
    """
    lane = lane_of_block()
    count = int(active)
    sign = int(-1)
    bound = rows.upper[row]
    if state.values[row] < rows.lower[row]:
        sign = 1
        bound = rows.lower[row]
    direction = real(sign)
    for c in range(lane, rows.unknowns, wp.block_dim()):
        state.entering_row[c] = unit_entry(rows, row, c)
    sync_block()
    multiplier = real(0.0)
    while True:
        orthogonal_square = find_directions(rows, state, count, direction)
        largest = real(-wp.inf)
        blocking = int(-1)
        for i in range(lane, count, wp.block_dim()):
            rate = direction * real(state.side[state.active[i]]) * state.dual_direction[i]
            if rate > real(0.0):
                zero_step = -wp.max(state.multipliers[i], real(0.0)) / rate
                if zero_step > largest:
                    largest = zero_step
                    blocking = i
        found = argmax_of_block(largest, blocking)
        dual_step = -found[0]
        blocking = int(found[1])
        primal_step = real(wp.inf)
        # With as many active rows as unknowns, the orthogonal part is zero up to rounding.
        if orthogonal_square > DEPENDENCE_TOLERANCE and count < rows.unknowns:
            primal_step = direction * (bound - state.values[row]) / orthogonal_square
        step = wp.min(primal_step, dual_step)
        if not orthogonal_square < real(wp.inf):
            return -2
        if not step < real(wp.inf):
            return -1
        multiplier += step
        # All threads must have read the value of the row before any thread changes it.
        sync_block()
        for i in range(lane, count, wp.block_dim()):
            rate = direction * real(state.side[state.active[i]]) * state.dual_direction[i]
            state.multipliers[i] = state.multipliers[i] - step * rate
        if primal_step < real(wp.inf):
            for c in range(lane, rows.unknowns, wp.block_dim()):
                state.z[c] = state.z[c] + step * state.orthogonal_part[c]
            if lane == 0:
                state.values[row] = state.values[row] + direction * step * orthogonal_square
        sync_block()
        if primal_step <= dual_step:
            evaluate(rows, state)
            extend_inverse(rows, state, count, orthogonal_square + REDUNDANCY_TOLERANCE)
            if lane == 0:
                state.active[count] = row
                state.multipliers[count] = multiplier
                state.side[row] = sign
            sync_block()
            return count + 1
        drop_constraint(rows, state, count, blocking)
        count -= 1
    return count


@wp.func
def extend_inverse(rows: UnitConstraints, state: ActiveSet, count: int, orthogonal_square: real):
    """Extend the inverse by the entering row, whose orthogonal part has the squared length ``orthogonal_square``."""
    lane = lane_of_block()
    by = real(1.0) / orthogonal_square
    for e in range(lane, count * count, wp.block_dim()):
        i = e / count
        k = e % count
        state.inverse[i, k] = state.inverse[i, k] + by * state.dual_direction[i] * state.dual_direction[k]
    for i in range(lane, count, wp.block_dim()):
        state.inverse[i, count] = -by * state.dual_direction[i]
        state.inverse[count, i] = -by * state.dual_direction[i]
    if lane == 0:
        state.inverse[count, count] = by
    for c in range(lane, rows.unknowns, wp.block_dim()):
        state.active_rows[count, c] = state.entering_row[c]


@wp.func
def most_violated(rows: UnitConstraints, state: ActiveSet):
    """Return the inactive row that violates its bounds most, or -1 if none does."""
    most = real(0.0)
    found = int(-1)
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        at = state.values[row]
        violation = wp.max(rows.lower[row] - at, at - rows.upper[row]) - rows.slack[row]
        if state.side[row] == 0 and violation > most:
            most = violation
            found = row
    return int(argmax_of_block(most, found)[1])


@wp.func
def cost_of(rows: UnitConstraints, state: ActiveSet):
    """Return the cost z^T z / 2."""
    cost = real(0.0)
    for c in range(lane_of_block(), rows.unknowns, wp.block_dim()):
        cost += real(0.5) * state.z[c] * state.z[c]
    cost = sum_of_block(cost)
    sync_block()
    return cost


@wp.func
def is_cancelled(rows: UnitConstraints):
    """Return True if another launch has set ``rows.cancelled``, so that the result is no longer needed."""
    cancelled_value = real(0.0)
    if lane_of_block() == 0:
        cancelled_value = real(wp.atomic_add(rows.cancelled, 0, 0))
    cancelled_value = sum_of_block(cancelled_value)
    sync_block()
    return cancelled_value != real(0.0)


@wp.func
def dual_iterations(rows: UnitConstraints, state: ActiveSet, active: int):
    """Run the dual iterations from a dual feasible active set, adding the most violated row first.

    Returns: number of active rows at the optimum; -1 if the problem is infeasible or exceeds the cost limit; -2 on
    numerical failure, on cancellation, or after ``PIVOTS`` iterations. Each added row raises the cost, so a cost that
    does not rise is a numerical failure.
    """
    count = int(active)
    last_cost = real(-1.0)
    write_inverse(state, count)
    for number in range(PIVOTS):
        row = most_violated(rows, state)
        if row < 0:
            return wp.where(cost_of(rows, state) > rows.cost_limit, -1, count)
        count = add_constraint(rows, state, count, row)
        if count < 0:
            return count
        if number % _CHECK_INTERVAL == 0:
            cost = cost_of(rows, state)
            if cost > rows.cost_limit:
                return -1
            if not cost > last_cost:
                return -2
            last_cost = cost
            if is_cancelled(rows):
                return -2
    return -2


@wp.func
def refine(rows: UnitConstraints, state: ActiveSet, count: int):
    """Correct the multipliers for the remaining distances of the active rows from their bounds, then recompute z and
    all row values."""
    lane = lane_of_block()
    for i in range(lane, count, wp.block_dim()):
        row = state.active[i]
        state.scratch_a[i] = bound_of(rows, state, row) - state.values[row]
    sync_block()
    multiply(state.inverse, count, count, state.scratch_a, state.dual_direction)
    for i in range(lane, count, wp.block_dim()):
        side = real(state.side[state.active[i]])
        multiplier = state.multipliers[i] + side * state.dual_direction[i]
        state.multipliers[i] = multiplier
        state.scratch_a[i] = side * multiplier
    sync_block()
    multiply_transposed(state.active_rows, count, rows.unknowns, state.scratch_a, state.z)
    evaluate(rows, state)


@wp.func
def find_optimum(rows: UnitConstraints, state: ActiveSet):
    """Solve from the guessed sides ``state.side``; return the status.

    Guessed rows with multipliers of the wrong sign are dropped, then violated rows are added one at a time. Adding
    nearly dependent rows makes the updated inverse inaccurate, even after these rows have been dropped again. The
    iterations may then fail, leave violated rows or multipliers of the wrong sign, or make the problem appear
    infeasible. In these cases the method restarts from all active rows, with a new inverse, at most ``RESTARTS`` times.
    """
    was_infeasible = int(0)
    restart = int(0)
    # Warp would unroll a loop over a range.
    while restart <= RESTARTS:
        count = int(0)
        dropped = int(1)
        while dropped > 0:
            if is_cancelled(rows):
                return NUMERICAL_FAILURE
            count = solve_active(rows, state)
            if count < 0:
                clear_active_set(rows, state)
            else:
                if restart > 0:
                    write_inverse(state, count)
                    refine(rows, state, count)
                dropped = count_wrong_rows(rows, state, count, 1)
        count = dual_iterations(rows, state, count)
        if count == -1 and (was_infeasible == 1 or restart == RESTARTS):
            return INFEASIBLE
        was_infeasible = wp.where(count == -1, 1, 0)
        if count >= 0:
            refine(rows, state, count)
            if count_wrong_rows(rows, state, count, 0) == 0 and most_violated(rows, state) < 0:
                return OPTIMUM_FOUND
        restart += 1
        rows.orthogonalizations = 2
    return NUMERICAL_FAILURE
