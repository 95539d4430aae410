"""Dual active-set method of Goldfarb and Idnani (1983) for a QP whose Hessian is the identity, as native CPU code.

min 1/2 z^T z subject to l <= free + R z <= u, with rows R of length 1. The solution is z = R^T (s p), where p >= 0 are
the multipliers of the active rows and s = +1 or -1 the sides at which they are active. So only the inner products of
the rows are needed, not R itself. Host code: ``egs_warp/locomotion/active_set.py``.
"""

import warp as wp

from egs_warp.kernels.locomotion.whitened_constraints import WhitenedConstraints, fetch_products, write_point
from egs_warp.kernels.vectors import on_cpu
from egs_warp.precision import Vec4, real

wp.set_module_options({"enable_backward": False})

OPTIMUM_FOUND, INFEASIBLE, NUMERICAL_FAILURE = wp.constant(0), wp.constant(1), wp.constant(2)
"""Status of a solve: optimum found, no point satisfies the bounds, or numerical failure."""

_ROUNDS = wp.constant(3)
"""Maximum number of rounds that add and drop all wrong rows at once, before rows are exchanged one at a time."""
REFINEMENTS = wp.constant(4)
"""Maximum number of restarts of the dual iterations with recomputed multipliers, which remove accumulated rounding."""
WRONG_SIGN_TOLERANCE = wp.constant(real(1e-9))
"""A multiplier below minus this fraction of the largest multiplier has the wrong sign."""
REDUNDANCY_TOLERANCE = wp.constant(real(1e-12))
"""Shift that is added to the diagonal of the products of active rows, which are singular if rows are redundant."""
BOUND_TOLERANCE = wp.constant(real(1e-7))
"""Distance from its bound above which an active row counts as violated, because it depends on other active rows."""
DEPENDENCE_TOLERANCE = wp.constant(real(1e-9))
"""A row depends on the active rows if its part orthogonal to them is below this fraction of its squared length."""


@wp.struct
class Program:
    """Input of a solve. Vectors over rows are padded with zeros to a multiple of four, the width of a SIMD vector. Rows
    of zeros without bounds may follow the program's own."""

    constraints: WhitenedConstraints
    """Rows R (m, n) and their inner products."""
    values_at_origin: wp.array[Vec4]
    """(m,) in vectors of four, row values at z = 0."""
    lower: wp.array[real]
    upper: wp.array[real]
    slack: wp.array[real]
    """(m,) amount by which a row may violate its bounds."""
    cost_limit: wp.array[real]
    """(1,) cost z^T z / 2 above which the program counts as infeasible."""


@wp.struct
class ActiveSetState:
    """State of a solve."""

    side: wp.array[int]
    """(m,) 1 for a row active at its lower bound, -1 at its upper bound, 0 for an inactive row."""
    active: wp.array[int]
    """(n,) indices of the active rows, in the order in which they were added."""
    multipliers: wp.array[real]
    """(n,) multipliers of the active rows."""
    factor: wp.array2d[real]
    """(n, n) lower Cholesky factor L of the inner products of the active rows, each row times its side."""
    values: wp.array[Vec4]
    """(m,) in vectors of four, values of all rows at the current z."""
    rates: wp.array[real]
    """(n,) decrease of each multiplier per unit of the entering row's multiplier."""
    solved_products: wp.array[real]
    """(n,) L^-1 times the inner products of the entering row with the active rows."""
    orthogonal_part: wp.array[Vec4]
    """(n,) in vectors of four, part of the entering row that is orthogonal to the active rows."""


@wp.func
def bound_of(program: Program, search: ActiveSetState, row: int):
    """Return the bound at which ``row`` is active."""
    if search.side[row] > 0:
        return program.lower[row]
    return program.upper[row]


@wp.func
def value_of(search: ActiveSetState, row: int):
    """Return the value of ``row`` at the current z."""
    return search.values[row / 4][row % 4]


@wp.func
def product_of(program: Program, row: int, other: int):
    """Return the inner product of two rows."""
    return program.constraints.products[row, other / 4][other % 4]


@wp.func_native(
    on_cpu(
        """
    const int stride = factor.strides[0] / 8, across = products.strides[0] / 8;
    double* const L = factor.data;
    const double* const all = (const double*)products.data;
    for (int i = 0; i < count; ++i) {
        double* const row = L + i * stride;
        const double* const from = all + active.data[i] * across;
        const int sign = side.data[active.data[i]];
        for (int k = 0; k <= i; ++k) {
            const double* const by = L + k * stride;
            const int other = active.data[k];
            double value = sign * side.data[other] * from[other];
            v4 sum = 0.0;
            int j = 0;
            for (; j + 4 <= k; j += 4) sum += *(const v4*)(row + j) * *(const v4*)(by + j);
            value -= (sum[0] + sum[1]) + (sum[2] + sum[3]);
            for (; j < k; ++j) value -= row[j] * by[j];
            if (k < i) {
                row[k] = value / by[k];
            } else {
                value += shift;
                if (!(value > 0.0)) return 0;
                row[i] = __builtin_sqrt(value);
            }
        }
    }
    return 1;
""",
        elsewhere="return 0;",
    )
)
def factorize(
    products: wp.array2d[Vec4],
    active: wp.array[wp.int32],
    side: wp.array[wp.int32],
    count: wp.int32,
    shift: real,
    factor: wp.array2d[real],
) -> wp.int32:
    """Factorize the products of the first ``count`` active rows, plus ``shift`` on the diagonal. Return 1, or 0 if they
    are not positive definite."""
    ...


@wp.func_native(
    on_cpu(
        """
    const int stride = factor.strides[0] / 8;
    double* const to = x.data;
    for (int i = 0; i < count; ++i) {
        const double* const row = factor.data + i * stride;
        v4 sum = 0.0;
        int k = 0;
        for (; k + 4 <= i; k += 4) sum += *(const v4*)(row + k) * *(const v4*)(to + k);
        double value = to[i] - ((sum[0] + sum[1]) + (sum[2] + sum[3]));
        for (; k < i; ++k) value -= row[k] * to[k];
        to[i] = value / row[i];
    }
"""
    )
)
def solve_lower(factor: wp.array2d[real], count: wp.int32, x: wp.array[real]):
    """Compute x <- L^-1 x."""
    ...


@wp.func_native(
    on_cpu(
        """
    const int stride = factor.strides[0] / 8;
    double* const to = x.data;
    for (int i = count - 1; i >= 0; i -= 1) {
        const double* const row = factor.data + i * stride;
        const double value = to[i] / row[i];
        to[i] = value;
        int k = 0;
        for (; k + 4 <= i; k += 4) *(v4*)(to + k) -= *(const v4*)(row + k) * value;
        for (; k < i; ++k) to[k] -= row[k] * value;
    }
"""
    )
)
def solve_upper(factor: wp.array2d[real], count: wp.int32, x: wp.array[real]):
    """Compute x <- L^-T x, traversing L row by row for contiguous access."""
    ...


@wp.func
def fetch_active_products(program: Program, search: ActiveSetState, count: int, row: int):
    """Compute the products of the active rows and of ``row`` (-1: none) with all rows, unless they are cached."""
    reduced = program.constraints
    fetch_products(
        reduced.minimum.shape[0], search.active, count, row, reduced.rows, reduced.columns, reduced.products,
        reduced.has_products, reduced.scratch,
    )  # fmt: skip


@wp.func_native(
    on_cpu(
        """
    const int tall = products.strides[0] / 8;
    const double* const from = (const double*)products.data + row * tall;
    double* const to = (double*)at.data;
    for (int i = 0; i < tall; i += 4) *(v4*)(to + i) += by * *(const v4*)(from + i);
"""
    )
)
def axpy_values(products: wp.array2d[Vec4], row: wp.int32, by: real, at: wp.array[Vec4]):
    """Add ``by`` times the products of ``row`` with all rows to the values ``at``."""
    ...


@wp.func
def move_rows_by(program: Program, search: ActiveSetState, row: int, by: real):
    """Update all row values for a change ``by`` of the multiplier of ``row``."""
    axpy_values(program.constraints.products, row, by, search.values)


@wp.func_native(
    on_cpu(
        """
    const int wide = rows.strides[0] / 8;
    const double* const Z = (const double*)rows.data;
    double* const to = (double*)orthogonal_part.data;
    for (int c = 0; c < wide; c += 4) *(v4*)(to + c) = direction * *(const v4*)(Z + row * wide + c);
    for (int i = 0; i < count; ++i) {
        const int other = active.data[i];
        const double share = side.data[other] * rates.data[i];
        for (int c = 0; c < wide; c += 4) *(v4*)(to + c) -= share * *(const v4*)(Z + other * wide + c);
    }
    v4 square = 0.0;
    for (int c = 0; c < wide; c += 4) square += *(v4*)(to + c) * *(v4*)(to + c);
    return (square[0] + square[1]) + (square[2] + square[3]);
""",
        elsewhere="return 0.0;",
    )
)
def orthogonal_norm2(
    rows: wp.array2d[Vec4],
    row: wp.int32,
    direction: real,
    active: wp.array[wp.int32],
    side: wp.array[wp.int32],
    rates: wp.array[real],
    count: wp.int32,
    orthogonal_part: wp.array[Vec4],
) -> real:
    """Write the part of ``direction * row`` orthogonal to the active rows to ``orthogonal_part``; return its squared
    length."""
    ...


@wp.func_native(
    on_cpu(
        """
    const double* const values = (const double*)at.data;
    int result = -1;
    double max_violation = 0.0;
    for (int i = 0; i < side.shape[0]; ++i) {
        const double below = lower.data[i] - values[i], above = values[i] - upper.data[i];
        const double violation = (below > above ? below : above) - slack.data[i];
        if (side.data[i] == 0 && violation > max_violation) {
            max_violation = violation;
            result = i;
        }
    }
    return result;
""",
        elsewhere="return -1;",
    )
)
def most_violated(
    lower: wp.array[real], upper: wp.array[real], slack: wp.array[real], side: wp.array[wp.int32], at: wp.array[Vec4]
) -> wp.int32:
    """Return the inactive row that violates its bounds most, or -1 if none does."""
    ...


@wp.func
def solve_active(program: Program, search: ActiveSetState):
    """Solve for z with the rows that have a side at their bounds; return the number of active rows.

    Returns -1 if there are more active rows than unknowns or their products are not positive definite.
    """
    count = int(0)
    for quad in range(search.values.shape[0]):
        search.values[quad] = program.values_at_origin[quad]
    for row in range(search.side.shape[0]):
        if search.side[row] != 0:
            if count == search.active.shape[0]:
                return -1
            search.active[count] = row
            count += 1
    fetch_active_products(program, search, count, -1)
    if (
        factorize(program.constraints.products, search.active, search.side, count, REDUNDANCY_TOLERANCE, search.factor)
        == 0
    ):
        return -1
    for i in range(count):
        row = search.active[i]
        sign = real(search.side[row])
        search.multipliers[i] = sign * (bound_of(program, search, row) - program.values_at_origin[row / 4][row % 4])
    solve_lower(search.factor, count, search.multipliers)
    solve_upper(search.factor, count, search.multipliers)
    for i in range(count):
        row = search.active[i]
        move_rows_by(program, search, row, real(search.side[row]) * search.multipliers[i])
    return count


@wp.func
def drop_wrong_sign(program: Program, search: ActiveSetState, count: int):
    """Deactivate rows whose multiplier has the wrong sign or whose value is off its bound; return their number."""
    max_multiplier = real(0.0)
    for i in range(count):
        max_multiplier = wp.max(max_multiplier, wp.abs(search.multipliers[i]))
    wrong = int(0)
    for i in range(count):
        row = search.active[i]
        residual = wp.abs(value_of(search, row) - bound_of(program, search, row))
        if (
            search.multipliers[i] < -WRONG_SIGN_TOLERANCE * max_multiplier
            or residual > BOUND_TOLERANCE + program.slack[row]
        ):
            search.side[row] = 0
            wrong += 1
    return wrong


@wp.func
def violation_of(program: Program, search: ActiveSetState, row: int):
    """Return the amount by which ``row`` violates its bounds beyond its slack; negative if it does not."""
    at = value_of(search, row)
    return wp.max(program.lower[row] - at, at - program.upper[row]) - program.slack[row]


@wp.func
def add_violated(program: Program, search: ActiveSetState):
    """Activate all inactive rows that violate their bounds; return their number."""
    added = int(0)
    for row in range(search.side.shape[0]):
        if search.side[row] == 0 and violation_of(program, search, row) > real(0.0):
            search.side[row] = wp.where(value_of(search, row) < program.lower[row], 1, -1)
            added += 1
    return added


@wp.func
def crash_start(program: Program, search: ActiveSetState):
    """Reduce the guess to a dual feasible active set, where no multiplier has the wrong sign; return the number of
    active rows."""
    count = solve_active(program, search)
    if count < 0:
        # The empty active set is always dual feasible.
        for row in range(search.side.shape[0]):
            search.side[row] = 0
        return solve_active(program, search)
    while drop_wrong_sign(program, search, count) > 0:
        count = solve_active(program, search)
        if count < 0:
            for row in range(search.side.shape[0]):
                search.side[row] = 0
            count = solve_active(program, search)
    return count


@wp.func
def drop_constraint(search: ActiveSetState, count: int, place: int):
    """Drop the active row at index ``place``; Givens rotations merge its column of the factor into the others."""
    search.side[search.active[place]] = 0
    left = count - 1
    for i in range(place, left):
        search.active[i] = search.active[i + 1]
        search.multipliers[i] = search.multipliers[i + 1]
        search.solved_products[i] = search.factor[i + 1, place]
        for k in range(place):
            search.factor[i, k] = search.factor[i + 1, k]
    for j in range(place, left):
        a = search.factor[j + 1, j + 1]
        b = search.solved_products[j]
        length = wp.sqrt(a * a + b * b)
        c = a / length
        s = b / length
        search.factor[j, j] = length
        for i in range(j + 1, left):
            below = search.factor[i + 1, j + 1]
            merged = search.solved_products[i]
            search.factor[i, j] = c * below + s * merged
            search.solved_products[i] = c * merged - s * below


@wp.func
def add_constraint(program: Program, search: ActiveSetState, active: int, row: int):
    """Add constraint ``row`` to the active set, dropping constraints whose multiplier reaches zero before the step
    ends.

    Returns: number of active constraints; -1 if the constraints are inconsistent; -2 on numerical failure.
    """
    count = int(active)
    sign = int(-1)
    bound = program.upper[row]
    if value_of(search, row) < program.lower[row]:
        sign = 1
        bound = program.lower[row]
    direction = real(sign)
    fetch_active_products(program, search, 0, row)
    square = product_of(program, row, row)
    multiplier = real(0.0)
    while True:
        for i in range(count):
            other = search.active[i]
            value = direction * real(search.side[other]) * product_of(program, row, other)
            search.solved_products[i] = value
        solve_lower(search.factor, count, search.solved_products)
        for i in range(count):
            search.rates[i] = search.solved_products[i]
        solve_upper(search.factor, count, search.rates)
        orthogonal_square = orthogonal_norm2(
            program.constraints.rows,
            row,
            direction,
            search.active,
            search.side,
            search.rates,
            count,
            search.orthogonal_part,
        )
        dual_step = real(wp.inf)
        blocking = int(-1)
        for i in range(count):
            rate = search.rates[i]
            if rate > real(0.0):
                zero_step = wp.max(search.multipliers[i], real(0.0)) / rate
                if zero_step < dual_step:
                    dual_step = zero_step
                    blocking = i
        primal_step = real(wp.inf)
        # With as many active rows as unknowns the orthogonal part is zero, up to rounding.
        if orthogonal_square > DEPENDENCE_TOLERANCE * square and count < search.active.shape[0]:
            primal_step = direction * (bound - value_of(search, row)) / orthogonal_square
        step = wp.min(primal_step, dual_step)
        if not orthogonal_square < real(wp.inf):
            return -2
        if not step < real(wp.inf):
            return -1
        multiplier += step
        if primal_step < real(wp.inf):
            move_rows_by(program, search, row, direction * step)
            for i in range(count):
                other = search.active[i]
                move_rows_by(program, search, other, -real(search.side[other]) * search.rates[i] * step)
        for i in range(count):
            search.multipliers[i] = search.multipliers[i] - step * search.rates[i]
        if primal_step <= dual_step:
            for i in range(count):
                search.factor[count, i] = search.solved_products[i]
            search.factor[count, count] = wp.sqrt(orthogonal_square + REDUNDANCY_TOLERANCE)
            search.active[count] = row
            search.multipliers[count] = multiplier
            search.side[row] = sign
            return count + 1
        drop_constraint(search, count, blocking)
        count -= 1
    return count


@wp.func
def cost_of(program: Program, search: ActiveSetState, count: int):
    """Return the cost z^T z / 2."""
    cost = real(0.0)
    for i in range(count):
        row = search.active[i]
        cost += (
            real(0.5)
            * real(search.side[row])
            * search.multipliers[i]
            * (value_of(search, row) - program.values_at_origin[row / 4][row % 4])
        )
    return cost


@wp.func
def dual_iterations(program: Program, search: ActiveSetState, active: int, pivots: int):
    """Run the dual iterations from a dual feasible active set, the most violated row first; return the status."""
    count = int(active)
    for _ in range(pivots):
        row = most_violated(program.lower, program.upper, program.slack, search.side, search.values)
        if row < 0:
            return OPTIMUM_FOUND
        count = add_constraint(program, search, count, row)
        if count == -2:
            return NUMERICAL_FAILURE
        if count < 0:
            return INFEASIBLE
        if cost_of(program, search, count) > program.cost_limit[0]:
            return INFEASIBLE
    return NUMERICAL_FAILURE


@wp.func
def find_optimum(program: Program, pivots: int, search: ActiveSetState):
    """Solve from the guess ``search.side``, as described at ``optimum_kernel``; return the status."""
    for _ in range(_ROUNDS):
        count = solve_active(program, search)
        if count < 0:
            break
        if drop_wrong_sign(program, search, count) + add_violated(program, search) == 0:
            return OPTIMUM_FOUND
    for _ in range(REFINEMENTS):
        count = crash_start(program, search)
        ended = dual_iterations(program, search, count, pivots)
        if ended != OPTIMUM_FOUND:
            return ended
        # Solve again from the active set alone, without the accumulated rounding.
        count = solve_active(program, search)
        if count < 0:
            continue
        if drop_wrong_sign(program, search, count) + add_violated(program, search) == 0:
            return OPTIMUM_FOUND
    return NUMERICAL_FAILURE


@wp.kernel
def optimum_kernel(
    program: Program,
    pivots: int,
    # In and out:
    search: ActiveSetState,
    # Out:
    ended: wp.array[int],
    point: wp.uint64,
):
    """Solve the program from the guessed active set ``search.side``, with one CPU thread.

    First the guessed rows are set to their bounds, which is one linear system in their multipliers. Rows with
    multipliers of the wrong sign are dropped and violated rows are added, all at once. If that does not end within a
    few rounds, the dual method adds the most violated row, one at a time, which terminates.

    Args:
        program: the QP.
        pivots: maximum number of dual iterations.
        search: state; ``side`` is the guess on entry and the active set at the end.
        ended: (2,) status, and the number of active rows if the optimum was found.
        point: address of the n numbers x of the optimum, written only if it was found.
    """
    ended[0] = find_optimum(program, pivots, search)
    ended[1] = 0
    if ended[0] != OPTIMUM_FOUND:
        # The active set is meaningless then: more rows than unknowns may have a side.
        return
    count = int(0)
    for row in range(search.side.shape[0]):
        if search.side[row] != 0:
            count += 1
    ended[1] = count
    reduced = program.constraints
    write_point(
        reduced.lower, reduced.roots, reduced.minimum, reduced.rows, search.active, search.side,
        search.multipliers, count,
        point,
    )  # fmt: skip
