"""The dual active-set method of Goldfarb and Idnani (1983) for a program whose Hessian is the identity.

min 1/2 z^T z subject to l <= free + R z <= u, rows R of length 1. In the multipliers p >= 0 of the rows that hold, each
in the direction of its side s, z = R^T (s p), so all that is needed of R are its products with itself.
"""

import warp as wp

from egs_warp.kernels.locomotion.whitened_constraints import WhitenedConstraints, fetch_products, write_point
from egs_warp.kernels.vectors import on_cpu
from egs_warp.precision import Vec4, real

wp.set_module_options({"enable_backward": False})

FOUND, INFEASIBLE, NUMERICAL_FAILURE = wp.constant(0), wp.constant(1), wp.constant(2)
"""How a search ends: at the optimum, where no point satisfies the bounds, or led by rounding to neither."""

_ROUNDS = wp.constant(3)
"""In which rows are let go and held by all that is wrong at once, before one at a time."""
REFINEMENTS = wp.constant(4)
"""In which multipliers that were carried along are found anew."""
WRONG_SIGN_TOLERANCE = wp.constant(real(1e-9))
"""Of the largest multiplier: sign of one that holds its row from the wrong side."""
REDUNDANCY_TOLERANCE = wp.constant(real(1e-12))
"""Rows that repeat each other leave the matrix of their products singular."""
BOUND_TOLERANCE = wp.constant(real(1e-7))
"""From its bound: a row that the others keep from there."""
DEPENDENCE_TOLERANCE = wp.constant(real(1e-9))
"""Of a row's square: what of it lies outside of the rows that hold, if it follows from them."""


@wp.struct
class Program:
    """What is given. Columns of matrices lie by fours, which a processor takes at once, zeros after the last. Rows of
    zeros without bounds may follow."""

    constraints: WhitenedConstraints
    """The rows R, n unknowns wide, and their products with each other."""
    values_at_origin: wp.array[Vec4]
    """(m,) by fours, the rows at z = 0."""
    lower: wp.array[real]
    upper: wp.array[real]
    slack: wp.array[real]
    """(m,) by how much a row may break its bounds."""
    cost_limit: wp.array[real]
    """(1,) cost z^T z / 2 beyond which no point is looked for."""


@wp.struct
class ActiveSetState:
    """Where the search is."""

    side: wp.array[int]
    """(m,) of rows that hold: 1 at the lower bound, -1 at the upper; else 0."""
    active: wp.array[int]
    """(n,) those rows, in the order in which they have joined."""
    multipliers: wp.array[real]
    """(n,) their multipliers."""
    factor: wp.array2d[real]
    """(n, n) lower triangle L of their products, each in the direction of its side."""
    values: wp.array[Vec4]
    """(m,) all rows, by fours."""
    rates: wp.array[real]
    """(n,) by how much each multiplier falls for one of the row that joins."""
    solved_products: wp.array[real]
    """(n,) L^-1 of the products of the row that joins."""
    orthogonal_part: wp.array[Vec4]
    """(n,) by fours: what of the row that joins lies outside of those that hold."""


@wp.func
def bound_of(program: Program, search: ActiveSetState, row: int):
    """The bound that ``row`` is held at."""
    if search.side[row] > 0:
        return program.lower[row]
    return program.upper[row]


@wp.func
def value_of(search: ActiveSetState, row: int):
    """Where ``row`` is."""
    return search.values[row / 4][row % 4]


@wp.func
def product_of(program: Program, row: int, other: int):
    """Of two rows."""
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
                value += redundant;
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
def factored(
    products: wp.array2d[Vec4],
    active: wp.array[wp.int32],
    side: wp.array[wp.int32],
    count: wp.int32,
    redundant: real,
    factor: wp.array2d[real],
) -> wp.int32:
    """The first ``count`` rows of the factor; whether their products have one."""
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
    """x <- L^-1 x."""
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
    """x <- L^-T x, row by row of L as it lies in memory."""
    ...


@wp.func
def fetch_active_products(program: Program, search: ActiveSetState, count: int, row: int):
    """The products of the active rows and of ``row``."""
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
    """See ``move_rows``."""
    ...


@wp.func
def move_rows_by(program: Program, search: ActiveSetState, row: int, by: real):
    """All rows where the multiplier of ``row`` is greater ``by``."""
    axpy_values(program.constraints.products, row, by, search.values)


@wp.func_native(
    on_cpu(
        """
    const int wide = rows.strides[0] / 8;
    const double* const Z = (const double*)rows.data;
    double* const to = (double*)outside.data;
    for (int c = 0; c < wide; c += 4) *(v4*)(to + c) = towards * *(const v4*)(Z + row * wide + c);
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
    towards: real,
    active: wp.array[wp.int32],
    side: wp.array[wp.int32],
    rates: wp.array[real],
    count: wp.int32,
    outside: wp.array[Vec4],
) -> real:
    """Of ``row``, in the direction that it is held ``towards``, what lies outside of those that hold, and its
    square."""
    ...


@wp.func_native(
    on_cpu(
        """
    const double* const place = (const double*)at.data;
    int found = -1;
    double most = 0.0;
    for (int i = 0; i < side.shape[0]; ++i) {
        const double below = lower.data[i] - place[i], above = place[i] - upper.data[i];
        const double breach = (below > above ? below : above) - slack.data[i];
        if (side.data[i] == 0 && breach > most) {
            most = breach;
            found = i;
        }
    }
    return found;
""",
        elsewhere="return -1;",
    )
)
def most_violated(
    lower: wp.array[real], upper: wp.array[real], slack: wp.array[real], side: wp.array[wp.int32], at: wp.array[Vec4]
) -> wp.int32:
    """Of the rows without a side the one that breaks its bounds most, -1 where none does."""
    ...


@wp.func
def solve_active(program: Program, search: ActiveSetState):
    """How many rows have a side, held at their bounds; -1 where that has no numbers."""
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
        factored(program.constraints.products, search.active, search.side, count, REDUNDANCY_TOLERANCE, search.factor)
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
    """How many rows lose their side: those that pull the wrong way, or that the others keep from their bounds."""
    most = real(0.0)
    for i in range(count):
        most = wp.max(most, wp.abs(search.multipliers[i]))
    wrong = int(0)
    for i in range(count):
        row = search.active[i]
        missed = wp.abs(value_of(search, row) - bound_of(program, search, row))
        if search.multipliers[i] < -WRONG_SIGN_TOLERANCE * most or missed > BOUND_TOLERANCE + program.slack[row]:
            search.side[row] = 0
            wrong += 1
    return wrong


@wp.func
def violation_of(program: Program, search: ActiveSetState, row: int):
    """By how much more than it may ``row`` breaks its bounds, negative where it does not."""
    at = value_of(search, row)
    return wp.max(program.lower[row] - at, at - program.upper[row]) - program.slack[row]


@wp.func
def add_violated(program: Program, search: ActiveSetState):
    """How many rows without a side break their bounds; they are given one."""
    broken = int(0)
    for row in range(search.side.shape[0]):
        if search.side[row] == 0 and violation_of(program, search, row) > real(0.0):
            search.side[row] = wp.where(value_of(search, row) < program.lower[row], 1, -1)
            broken += 1
    return broken


@wp.func
def crash_start(program: Program, search: ActiveSetState):
    """How many rows are held, all of which pull the right way."""
    count = solve_active(program, search)
    if count < 0:
        # From where nothing holds there always is a way.
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
    """Let go of the active row at ``place``; Givens rotations bring its column of the factor into the others."""
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
            beside = search.solved_products[i]
            search.factor[i, j] = c * below + s * beside
            search.solved_products[i] = c * beside - s * below


@wp.func
def add_constraint(program: Program, search: ActiveSetState, active: int, row: int):
    """How many rows are active when ``row`` is held beside them, less those whose pull ends on the way; -1 where no
    point satisfies it beside those, -2 where rounding leaves no way."""
    count = int(active)
    sign = int(-1)
    bound = program.upper[row]
    if value_of(search, row) < program.lower[row]:
        sign = 1
        bound = program.lower[row]
    towards = real(sign)
    fetch_active_products(program, search, 0, row)
    square = product_of(program, row, row)
    pull = real(0.0)
    while True:
        for i in range(count):
            other = search.active[i]
            value = towards * real(search.side[other]) * product_of(program, row, other)
            search.solved_products[i] = value
        solve_lower(search.factor, count, search.solved_products)
        for i in range(count):
            search.rates[i] = search.solved_products[i]
        solve_upper(search.factor, count, search.rates)
        apart = orthogonal_norm2(
            program.constraints.rows,
            row,
            towards,
            search.active,
            search.side,
            search.rates,
            count,
            search.orthogonal_part,
        )
        part = real(wp.inf)
        first = int(-1)
        for i in range(count):
            rate = search.rates[i]
            if rate > real(0.0):
                ends = wp.max(search.multipliers[i], real(0.0)) / rate
                if ends < part:
                    part = ends
                    first = i
        whole = real(wp.inf)
        # As many rows as unknowns leave nothing outside, whatever rounding says.
        if apart > DEPENDENCE_TOLERANCE * square and count < search.active.shape[0]:
            whole = towards * (bound - value_of(search, row)) / apart
        step = wp.min(whole, part)
        if not apart < real(wp.inf):
            return -2
        if not step < real(wp.inf):
            return -1
        pull += step
        if whole < real(wp.inf):
            move_rows_by(program, search, row, towards * step)
            for i in range(count):
                other = search.active[i]
                move_rows_by(program, search, other, -real(search.side[other]) * search.rates[i] * step)
        for i in range(count):
            search.multipliers[i] = search.multipliers[i] - step * search.rates[i]
        if whole <= part:
            for i in range(count):
                search.factor[count, i] = search.solved_products[i]
            search.factor[count, count] = wp.sqrt(apart + REDUNDANCY_TOLERANCE)
            search.active[count] = row
            search.multipliers[count] = pull
            search.side[row] = sign
            return count + 1
        drop_constraint(search, count, first)
        count -= 1
    return count


@wp.func
def cost_of(program: Program, search: ActiveSetState, count: int):
    """z^T z / 2."""
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
    """From rows that all pull the right way; how the search ends. What is broken most joins first."""
    count = int(active)
    for _ in range(pivots):
        row = most_violated(program.lower, program.upper, program.slack, search.side, search.values)
        if row < 0:
            return FOUND
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
    """See ``optimum_kernel``."""
    for _ in range(_ROUNDS):
        count = solve_active(program, search)
        if count < 0:
            break
        if drop_wrong_sign(program, search, count) + add_violated(program, search) == 0:
            return FOUND
    for _ in range(REFINEMENTS):
        count = crash_start(program, search)
        ended = dual_iterations(program, search, count, pivots)
        if ended != FOUND:
            return ended
        # Once more without what rounding has carried along.
        count = solve_active(program, search)
        if count < 0:
            continue
        if drop_wrong_sign(program, search, count) + add_violated(program, search) == 0:
            return FOUND
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
    """From ``search.side``, a guess, to the optimum; how it ended, and where there is one how many rows hold it and
    the ``point`` x, n numbers at an address. One thread of a CPU.

    The guessed rows are held at their bounds, which is one system of linear equations in their multipliers; rows that
    pull the wrong way are let go, rows that break their bounds are held instead. Where that goes on for long, rows that
    break their bounds join one at a time, at the dual's best step: that ends.
    """
    ended[0] = find_optimum(program, pivots, search)
    ended[1] = 0
    if ended[0] != FOUND:
        # What holds then says nothing: more rows than there are unknowns may have a side.
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
