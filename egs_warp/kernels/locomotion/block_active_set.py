"""``active_set`` by all threads of a block on a GPU, one thread on a CPU: min 1/2 z^T z subject to l <= free + R z <= u
with rows R of length 1.

Where threads wait for each other a triangular solve takes as long as its rows are many, a product does not. So of the
products of the rows that hold it has no factor but the inverse, which grows and shrinks with them; what that carries
along of rounding goes whenever all rows that hold are looked at anew.
"""

import warp as wp

from egs_warp.kernels.block import block_max, sum_of_block, sync_block
from egs_warp.kernels.locomotion.active_set import (
    BOUND_TOLERANCE,
    DEPENDENCE_TOLERANCE,
    FOUND,
    INFEASIBLE,
    NUMERICAL_FAILURE,
    REDUNDANCY_TOLERANCE,
    WRONG_SIGN_TOLERANCE,
)
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

PIVOTS = wp.constant(600)
"""At most, as on the host."""
_LOOKS = wp.constant(8)
"""Rows that join between two looks at what the point costs."""


@wp.struct
class UnitConstraints:
    """What is given."""

    unknowns: int
    """n."""
    count: int
    """m."""
    base_count: int
    """k."""
    units: wp.array2d[real]
    """(k, n) what R is made of: a row holds three of these at most."""
    base_rows: wp.array2d[int]
    """(m, 3) which,"""
    coefficients: wp.array2d[real]
    """(m, 3) and of how much."""
    base_values: wp.array[real]
    """(k,) scratch: what R is made of, at some z."""
    values_at_origin: wp.array[real]
    """(m,) the rows at z = 0."""
    lower: wp.array[real]
    upper: wp.array[real]
    slack: wp.array[real]
    """(m,) by how much a row may break its bounds."""
    cost_limit: real
    """Cost z^T z / 2 beyond which no point is looked for."""
    cancelled: wp.array[int]
    """(1,) not 0 as soon as nobody asks for a point."""


@wp.struct
class ActiveSet:
    """Where the search is; k rows hold."""

    side: wp.array[int]
    """(m,) of rows that hold: 1 at the lower bound, -1 at the upper; else 0."""
    active: wp.array[int]
    """(n,) those rows."""
    multipliers: wp.array[real]
    """(n,) their multipliers."""
    active_rows: wp.array2d[real]
    """(k, n) the rows themselves."""
    active_columns: wp.array2d[real]
    """(n, k) as they were looked at last."""
    products: wp.array2d[real]
    """(k, k) of them with each other."""
    root: wp.array2d[real]
    """(k, k) of the inverse of that."""
    inverse: wp.array2d[real]
    """(k, k)."""
    z: wp.array[real]
    """(n,) z."""
    values: wp.array[real]
    """(m,) all rows there."""
    dual_direction: wp.array[real]
    """(k,) of the row that joins: ``inverse`` times its products with those that hold."""
    scratch_a: wp.array[real]
    scratch_b: wp.array[real]
    """(n,) scratch."""
    entering_row: wp.array[real]
    """(n,) the row that joins."""
    orthogonal_part: wp.array[real]
    """(n,) what of the row that joins lies outside of those that hold."""


@wp.func
def bound_of(rows: UnitConstraints, holding: ActiveSet, row: int):
    """The bound that ``row`` is held at."""
    if holding.side[row] > 0:
        return rows.lower[row]
    return rows.upper[row]


@wp.func
def evaluate(rows: UnitConstraints, holding: ActiveSet):
    """All rows at the place."""
    multiply(rows.units, rows.base_count, rows.unknowns, holding.z, rows.base_values)
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        at = rows.values_at_origin[row]
        for t in range(3):
            at += rows.coefficients[row, t] * rows.base_values[rows.base_rows[row, t]]
        holding.values[row] = at
    sync_block()


@wp.func
def unit_entry(rows: UnitConstraints, row: int, c: int):
    """R there."""
    value = real(0.0)
    for t in range(3):
        value += rows.coefficients[row, t] * rows.units[rows.base_rows[row, t], c]
    return value


@wp.func
def gather_active(rows: UnitConstraints, holding: ActiveSet, count: int, added: real):
    """The active rows, and their products with each other, with so much ``added`` to the diagonal."""
    lane = lane_of_block()
    for e in range(lane, count * rows.unknowns, wp.block_dim()):
        i = e / rows.unknowns
        c = e % rows.unknowns
        value = unit_entry(rows, holding.active[i], c)
        holding.active_rows[i, c] = value
        holding.active_columns[c, i] = value
    for e in range(lane, count * count, wp.block_dim()):
        holding.products[e / count, e % count] = wp.where(e / count == e % count, added, real(0.0))
    sync_block()
    gemm_add(holding.products, holding.active_rows, holding.active_columns, count, count, rows.unknowns, 0)


@wp.func
def solve_active(rows: UnitConstraints, holding: ActiveSet):
    """How many rows have a side, held at their bounds; -1 where that has no numbers."""
    lane = lane_of_block()
    count = compact_indices(holding.side, rows.count, rows.unknowns, holding.active)
    if count > rows.unknowns:
        return -1
    gather_active(rows, holding, count, REDUNDANCY_TOLERANCE)
    for i in range(lane, count, wp.block_dim()):
        row = holding.active[i]
        holding.scratch_a[i] = bound_of(rows, holding, row) - rows.values_at_origin[row]
    sync_block()
    if inverse_cholesky(holding.products, count, holding.root) == 0:
        return -1
    apply_factor(holding.root, count, holding.scratch_a, holding.scratch_b, holding.dual_direction)
    for i in range(lane, count, wp.block_dim()):
        holding.multipliers[i] = real(holding.side[holding.active[i]]) * holding.dual_direction[i]
    multiply_transposed(holding.active_rows, count, rows.unknowns, holding.dual_direction, holding.z)
    evaluate(rows, holding)
    return count


@wp.func
def write_inverse(holding: ActiveSet, count: int):
    """Of the products of those that hold, from its root."""
    for e in range(lane_of_block(), count * count, wp.block_dim()):
        i = e / count
        k = e % count
        value = real(0.0)
        for c in range(wp.max(i, k), count):
            value += holding.root[i, c] * holding.root[k, c]
        holding.inverse[i, k] = value
    sync_block()


@wp.func
def drop_wrong_sign(rows: UnitConstraints, holding: ActiveSet, count: int):
    """How many rows lose their side: those that pull the wrong way, or that the others keep from their bounds."""
    lane = lane_of_block()
    most = real(0.0)
    for i in range(lane, count, wp.block_dim()):
        most = wp.max(most, wp.abs(holding.multipliers[i]))
    most = block_max(most)
    sync_block()
    wrong = real(0.0)
    for i in range(lane, count, wp.block_dim()):
        row = holding.active[i]
        missed = wp.abs(holding.values[row] - bound_of(rows, holding, row))
        if holding.multipliers[i] < -WRONG_SIGN_TOLERANCE * most or missed > BOUND_TOLERANCE + rows.slack[row]:
            holding.side[row] = 0
            wrong += real(1.0)
    wrong = sum_of_block(wrong)
    sync_block()
    return int(wrong)


@wp.func
def clear_active_set(rows: UnitConstraints, holding: ActiveSet):
    """From where nothing holds there always is a way."""
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        holding.side[row] = 0
    sync_block()


@wp.func
def drop_constraint(rows: UnitConstraints, holding: ActiveSet, count: int, place: int):
    """Let go of the active row at ``place``, which the last one takes."""
    lane = lane_of_block()
    last = count - 1
    for i in range(lane, count, wp.block_dim()):
        holding.scratch_a[i] = holding.inverse[i, place]
    sync_block()
    by = real(1.0) / holding.scratch_a[place]
    for e in range(lane, count * count, wp.block_dim()):
        i = e / count
        k = e % count
        holding.inverse[i, k] = holding.inverse[i, k] - holding.scratch_a[i] * holding.scratch_a[k] * by
    if lane == 0:
        holding.side[holding.active[place]] = 0
        holding.active[place] = holding.active[last]
        holding.multipliers[place] = holding.multipliers[last]
    sync_block()
    if place == last:
        return
    for i in range(lane, last, wp.block_dim()):
        if i != place:
            value = holding.inverse[i, last]
            holding.inverse[i, place] = value
            holding.inverse[place, i] = value
    if lane == 0:
        holding.inverse[place, place] = holding.inverse[last, last]
    for c in range(lane, rows.unknowns, wp.block_dim()):
        holding.active_rows[place, c] = holding.active_rows[last, c]
    sync_block()


@wp.func
def find_directions(rows: UnitConstraints, holding: ActiveSet, count: int, towards: real):
    """What of the row that joins, in the direction that it is held ``towards``, lies outside of those that hold: the
    square of that."""
    multiply(holding.active_rows, count, rows.unknowns, holding.entering_row, holding.scratch_a)
    multiply(holding.inverse, count, count, holding.scratch_a, holding.dual_direction)
    multiply_transposed(holding.active_rows, count, rows.unknowns, holding.dual_direction, holding.orthogonal_part)
    square = real(0.0)
    for c in range(lane_of_block(), rows.unknowns, wp.block_dim()):
        value = holding.entering_row[c] - holding.orthogonal_part[c]
        holding.orthogonal_part[c] = towards * value
        square += value * value
    square = sum_of_block(square)
    sync_block()
    return square


@wp.func
def add_constraint(rows: UnitConstraints, holding: ActiveSet, active: int, row: int):
    """How many rows are active when ``row`` is held beside them, less those whose pull ends on the way; -1 where no
    point satisfies it beside those, -2 where rounding leaves no way."""
    lane = lane_of_block()
    count = int(active)
    sign = int(-1)
    bound = rows.upper[row]
    if holding.values[row] < rows.lower[row]:
        sign = 1
        bound = rows.lower[row]
    towards = real(sign)
    for c in range(lane, rows.unknowns, wp.block_dim()):
        holding.entering_row[c] = unit_entry(rows, row, c)
    sync_block()
    pull = real(0.0)
    while True:
        apart = find_directions(rows, holding, count, towards)
        soonest = real(-wp.inf)
        first = int(-1)
        for i in range(lane, count, wp.block_dim()):
            rate = towards * real(holding.side[holding.active[i]]) * holding.dual_direction[i]
            if rate > real(0.0):
                ends = -wp.max(holding.multipliers[i], real(0.0)) / rate
                if ends > soonest:
                    soonest = ends
                    first = i
        found = argmax_of_block(soonest, first)
        part = -found[0]
        first = int(found[1])
        whole = real(wp.inf)
        # As many rows as unknowns leave nothing outside, whatever rounding says.
        if apart > DEPENDENCE_TOLERANCE and count < rows.unknowns:
            whole = towards * (bound - holding.values[row]) / apart
        step = wp.min(whole, part)
        if not apart < real(wp.inf):
            return -2
        if not step < real(wp.inf):
            return -1
        pull += step
        # All lanes have read where the row is.
        sync_block()
        for i in range(lane, count, wp.block_dim()):
            rate = towards * real(holding.side[holding.active[i]]) * holding.dual_direction[i]
            holding.multipliers[i] = holding.multipliers[i] - step * rate
        if whole < real(wp.inf):
            for c in range(lane, rows.unknowns, wp.block_dim()):
                holding.z[c] = holding.z[c] + step * holding.orthogonal_part[c]
            if lane == 0:
                holding.values[row] = holding.values[row] + towards * step * apart
        sync_block()
        if whole <= part:
            evaluate(rows, holding)
            extend_inverse(rows, holding, count, apart + REDUNDANCY_TOLERANCE)
            if lane == 0:
                holding.active[count] = row
                holding.multipliers[count] = pull
                holding.side[row] = sign
            sync_block()
            return count + 1
        drop_constraint(rows, holding, count, first)
        count -= 1
    return count


@wp.func
def extend_inverse(rows: UnitConstraints, holding: ActiveSet, count: int, apart: real):
    """The inverse, with the row that joins beside the others, of which so much of a square lies ``apart``."""
    lane = lane_of_block()
    by = real(1.0) / apart
    for e in range(lane, count * count, wp.block_dim()):
        i = e / count
        k = e % count
        holding.inverse[i, k] = holding.inverse[i, k] + by * holding.dual_direction[i] * holding.dual_direction[k]
    for i in range(lane, count, wp.block_dim()):
        holding.inverse[i, count] = -by * holding.dual_direction[i]
        holding.inverse[count, i] = -by * holding.dual_direction[i]
    if lane == 0:
        holding.inverse[count, count] = by
    for c in range(lane, rows.unknowns, wp.block_dim()):
        holding.active_rows[count, c] = holding.entering_row[c]


@wp.func
def most_violated(rows: UnitConstraints, holding: ActiveSet):
    """Of the rows without a side the one that breaks its bounds most, -1 where none does."""
    most = real(0.0)
    found = int(-1)
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        at = holding.values[row]
        breach = wp.max(rows.lower[row] - at, at - rows.upper[row]) - rows.slack[row]
        if holding.side[row] == 0 and breach > most:
            most = breach
            found = row
    return int(argmax_of_block(most, found)[1])


@wp.func
def cost_of(rows: UnitConstraints, holding: ActiveSet):
    """z^T z / 2."""
    cost = real(0.0)
    for c in range(lane_of_block(), rows.unknowns, wp.block_dim()):
        cost += real(0.5) * holding.z[c] * holding.z[c]
    cost = sum_of_block(cost)
    sync_block()
    return cost


@wp.func
def is_cancelled(rows: UnitConstraints):
    """Whether nobody asks for a point any more: somebody else's launch may say so meanwhile."""
    settled = real(0.0)
    if lane_of_block() == 0:
        settled = real(wp.atomic_add(rows.cancelled, 0, 0))
    settled = sum_of_block(settled)
    sync_block()
    return settled != real(0.0)


@wp.func
def dual_iterations(rows: UnitConstraints, holding: ActiveSet, active: int):
    """From rows that all pull the right way: how many hold the optimum, -1 where there is no point, -2 where rounding
    leads astray. What is broken most joins first."""
    count = int(active)
    write_inverse(holding, count)
    for number in range(PIVOTS):
        row = most_violated(rows, holding)
        if row < 0:
            return count
        count = add_constraint(rows, holding, count, row)
        if count < 0:
            return count
        if number % _LOOKS == 0:
            if cost_of(rows, holding) > rows.cost_limit:
                return -1
            if is_cancelled(rows):
                return -2
    return -2


@wp.func
def refine(rows: UnitConstraints, holding: ActiveSet, count: int):
    """Multipliers once more by what the rows miss of their bounds, and the place by these alone."""
    lane = lane_of_block()
    for i in range(lane, count, wp.block_dim()):
        row = holding.active[i]
        holding.scratch_a[i] = bound_of(rows, holding, row) - holding.values[row]
    sync_block()
    multiply(holding.inverse, count, count, holding.scratch_a, holding.dual_direction)
    for i in range(lane, count, wp.block_dim()):
        side = real(holding.side[holding.active[i]])
        pull = holding.multipliers[i] + side * holding.dual_direction[i]
        holding.multipliers[i] = pull
        holding.scratch_a[i] = side * pull
    sync_block()
    multiply_transposed(holding.active_rows, count, rows.unknowns, holding.scratch_a, holding.z)
    evaluate(rows, holding)


@wp.func
def find_optimum(rows: UnitConstraints, holding: ActiveSet):
    """From the sides, a guess: how it ended. See ``active_set.optimum_kernel``.

    Of the guess those rows stay that pull the right way; then broken ones join one at a time. A round in which all that
    is wrong changes at once, as there, costs more here than the joins that it saves: 2.3 rows join less without any. Of
    3,459 recorded pieces none is wrong at the end, and of 1,025 programs without complementarity 12, where rows are too
    near to each other: to begin anew from there took these five times as long, and four of them to no end.
    """
    count = int(0)
    wrong = int(1)
    while wrong > 0:
        if is_cancelled(rows):
            return NUMERICAL_FAILURE
        count = solve_active(rows, holding)
        if count < 0:
            clear_active_set(rows, holding)
        else:
            wrong = drop_wrong_sign(rows, holding, count)
    count = dual_iterations(rows, holding, count)
    if count == -1:
        return INFEASIBLE
    if count >= 0:
        refine(rows, holding, count)
        if drop_wrong_sign(rows, holding, count) == 0 and most_violated(rows, holding) < 0:
            return FOUND
    return NUMERICAL_FAILURE
