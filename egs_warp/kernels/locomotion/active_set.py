"""The dual active-set method of Goldfarb and Idnani (1983) for a program whose Hessian is the identity.

min 1/2 z^T z subject to l <= free + R z <= u, rows R of length 1. In the multipliers p >= 0 of the rows that hold, each
in the direction of its side s, z = R^T (s p), so all that is needed of R are its products with itself.
"""

import warp as wp

from egs_warp.precision import Vec4, real

wp.set_module_options({"enable_backward": False})

FOUND, INFEASIBLE, ASTRAY = wp.constant(0), wp.constant(1), wp.constant(2)
"""How a search ends: at the optimum, where no point satisfies the bounds, or led by rounding to neither."""

_ROUNDS = wp.constant(3)
"""In which rows are let go and held by all that is wrong at once, before one at a time."""
_REVISIONS = wp.constant(4)
"""In which multipliers that were carried along are found anew."""
_PULLS = wp.constant(real(1e-9))
"""Of the largest multiplier: sign of one that holds its row from the wrong side."""
_REDUNDANT = wp.constant(real(1e-12))
"""Rows that repeat each other leave the matrix of their products singular."""
_MISSED = wp.constant(real(1e-7))
"""From its bound: a row that the others keep from there."""
_DEPENDENT = wp.constant(real(1e-9))
"""Of a row's square: what of it lies outside of the rows that hold, if it follows from them."""


@wp.struct
class Program:
    """What is given. Columns of matrices lie by fours, which a processor takes at once, zeros after the last. Rows of
    zeros without bounds may follow."""

    rows: wp.array2d[Vec4]
    """(m, n) R."""
    products: wp.array2d[Vec4]
    """(m, m) R R^T."""
    free: wp.array[Vec4]
    """(m,) by fours, the rows at z = 0."""
    lower: wp.array[real]
    upper: wp.array[real]
    slack: wp.array[real]
    """(m,) by how much a row may break its bounds."""
    most: wp.array[real]
    """(1,) cost z^T z / 2 beyond which no point is looked for."""


@wp.struct
class Search:
    """Where the search is."""

    side: wp.array[int]
    """(m,) of rows that hold: 1 at the lower bound, -1 at the upper; else 0."""
    active: wp.array[int]
    """(n,) those rows, in the order in which they have joined."""
    pulls: wp.array[real]
    """(n,) their multipliers."""
    factor: wp.array2d[real]
    """(n, n) lower triangle L of their products, each in the direction of its side."""
    at: wp.array[Vec4]
    """(m,) all rows, by fours."""
    rates: wp.array[real]
    """(n,) by how much each multiplier falls for one of the row that joins."""
    across: wp.array[real]
    """(n,) L^-1 of the products of the row that joins."""
    outside: wp.array[Vec4]
    """(n,) by fours: what of the row that joins lies outside of those that hold."""


@wp.func
def bound_of(program: Program, search: Search, row: int):
    """The bound that ``row`` is held at."""
    if search.side[row] > 0:
        return program.lower[row]
    return program.upper[row]


@wp.func
def place_of(search: Search, row: int):
    """Where ``row`` is."""
    return search.at[row / 4][row % 4]


@wp.func
def product_of(program: Program, row: int, other: int):
    """Of two rows."""
    return program.products[row, other / 4][other % 4]


@wp.func
def solve_lower(factor: wp.array2d[real], count: int, x: wp.array[real]):
    """x <- L^-1 x."""
    for i in range(count):
        value = x[i]
        for k in range(i):
            value -= factor[i, k] * x[k]
        x[i] = value / factor[i, i]


@wp.func
def solve_upper(factor: wp.array2d[real], count: int, x: wp.array[real]):
    """x <- L^-T x, row by row of L as it lies in memory."""
    for back in range(count):
        i = count - 1 - back
        value = x[i] / factor[i, i]
        x[i] = value
        for k in range(i):
            x[k] = x[k] - factor[i, k] * value


@wp.func
def move_rows(program: Program, search: Search, row: int, by: real):
    """All rows where the multiplier of ``row`` is greater ``by``."""
    for quad in range(search.at.shape[0]):
        search.at[quad] = search.at[quad] + by * program.products[row, quad]


@wp.func
def hold(program: Program, search: Search):
    """How many rows have a side, held at their bounds; -1 where that has no numbers."""
    count = int(0)
    for quad in range(search.at.shape[0]):
        search.at[quad] = program.free[quad]
    for row in range(search.side.shape[0]):
        if search.side[row] != 0:
            if count == search.active.shape[0]:
                return -1
            search.active[count] = row
            count += 1
    for i in range(count):
        row = search.active[i]
        sign = real(search.side[row])
        for k in range(i + 1):
            other = search.active[k]
            value = sign * real(search.side[other]) * product_of(program, row, other)
            if k == i:
                value += _REDUNDANT
            for j in range(k):
                value -= search.factor[i, j] * search.factor[k, j]
            if k < i:
                search.factor[i, k] = value / search.factor[k, k]
            else:
                if not value > real(0.0):
                    return -1
                search.factor[i, i] = wp.sqrt(value)
        search.pulls[i] = sign * (bound_of(program, search, row) - program.free[row / 4][row % 4])
    solve_lower(search.factor, count, search.pulls)
    solve_upper(search.factor, count, search.pulls)
    for i in range(count):
        row = search.active[i]
        move_rows(program, search, row, real(search.side[row]) * search.pulls[i])
    return count


@wp.func
def let_go_of_wrong(program: Program, search: Search, count: int):
    """How many rows lose their side: those that pull the wrong way, or that the others keep from their bounds."""
    most = real(0.0)
    for i in range(count):
        most = wp.max(most, wp.abs(search.pulls[i]))
    wrong = int(0)
    for i in range(count):
        row = search.active[i]
        missed = wp.abs(place_of(search, row) - bound_of(program, search, row))
        if search.pulls[i] < -_PULLS * most or missed > _MISSED + program.slack[row]:
            search.side[row] = 0
            wrong += 1
    return wrong


@wp.func
def breach_of(program: Program, search: Search, row: int):
    """By how much more than it may ``row`` breaks its bounds, negative where it does not."""
    at = place_of(search, row)
    return wp.max(program.lower[row] - at, at - program.upper[row]) - program.slack[row]


@wp.func
def hold_broken(program: Program, search: Search):
    """How many rows without a side break their bounds; they are given one."""
    broken = int(0)
    for row in range(search.side.shape[0]):
        if search.side[row] == 0 and breach_of(program, search, row) > real(0.0):
            search.side[row] = wp.where(place_of(search, row) < program.lower[row], 1, -1)
            broken += 1
    return broken


@wp.func
def hold_those_that_pull(program: Program, search: Search):
    """How many rows are held, all of which pull the right way."""
    count = hold(program, search)
    if count < 0:
        # From where nothing holds there always is a way.
        for row in range(search.side.shape[0]):
            search.side[row] = 0
        return hold(program, search)
    while let_go_of_wrong(program, search, count) > 0:
        count = hold(program, search)
        if count < 0:
            for row in range(search.side.shape[0]):
                search.side[row] = 0
            count = hold(program, search)
    return count


@wp.func
def leave(search: Search, count: int, place: int):
    """Let go of the active row at ``place``; Givens rotations bring its column of the factor into the others."""
    search.side[search.active[place]] = 0
    left = count - 1
    for i in range(place, left):
        search.active[i] = search.active[i + 1]
        search.pulls[i] = search.pulls[i + 1]
        search.across[i] = search.factor[i + 1, place]
        for k in range(place):
            search.factor[i, k] = search.factor[i + 1, k]
    for j in range(place, left):
        a = search.factor[j + 1, j + 1]
        b = search.across[j]
        length = wp.sqrt(a * a + b * b)
        c = a / length
        s = b / length
        search.factor[j, j] = length
        for i in range(j + 1, left):
            below = search.factor[i + 1, j + 1]
            beside = search.across[i]
            search.factor[i, j] = c * below + s * beside
            search.across[i] = c * beside - s * below


@wp.func
def join(program: Program, search: Search, active: int, row: int):
    """How many rows are active when ``row`` is held beside them, less those whose pull ends on the way; -1 where no
    point satisfies it beside those, -2 where rounding leaves no way."""
    count = int(active)
    sign = int(-1)
    bound = program.upper[row]
    if place_of(search, row) < program.lower[row]:
        sign = 1
        bound = program.lower[row]
    towards = real(sign)
    square = product_of(program, row, row)
    pull = real(0.0)
    while True:
        for i in range(count):
            other = search.active[i]
            value = towards * real(search.side[other]) * product_of(program, row, other)
            search.across[i] = value
        solve_lower(search.factor, count, search.across)
        for i in range(count):
            search.rates[i] = search.across[i]
        solve_upper(search.factor, count, search.rates)
        for quad in range(search.outside.shape[0]):
            search.outside[quad] = towards * program.rows[row, quad]
        part = real(wp.inf)
        first = int(-1)
        for i in range(count):
            other = search.active[i]
            rate = search.rates[i]
            share = real(search.side[other]) * rate
            for quad in range(search.outside.shape[0]):
                search.outside[quad] = search.outside[quad] - share * program.rows[other, quad]
            if rate > real(0.0):
                ends = wp.max(search.pulls[i], real(0.0)) / rate
                if ends < part:
                    part = ends
                    first = i
        apart = real(0.0)
        for quad in range(search.outside.shape[0]):
            apart += wp.dot(search.outside[quad], search.outside[quad])
        whole = real(wp.inf)
        if apart > _DEPENDENT * square:
            whole = towards * (bound - place_of(search, row)) / apart
        step = wp.min(whole, part)
        if not apart < real(wp.inf):
            return -2
        if not step < real(wp.inf):
            return -1
        pull += step
        if whole < real(wp.inf):
            move_rows(program, search, row, towards * step)
            for i in range(count):
                other = search.active[i]
                move_rows(program, search, other, -real(search.side[other]) * search.rates[i] * step)
        for i in range(count):
            search.pulls[i] = search.pulls[i] - step * search.rates[i]
        if whole <= part:
            if count == search.active.shape[0]:
                return -2
            for i in range(count):
                search.factor[count, i] = search.across[i]
            search.factor[count, count] = wp.sqrt(apart + _REDUNDANT)
            search.active[count] = row
            search.pulls[count] = pull
            search.side[row] = sign
            return count + 1
        leave(search, count, first)
        count -= 1
    return count


@wp.func
def cost_of(program: Program, search: Search, count: int):
    """z^T z / 2."""
    cost = real(0.0)
    for i in range(count):
        row = search.active[i]
        cost += (
            real(0.5)
            * real(search.side[row])
            * search.pulls[i]
            * (place_of(search, row) - program.free[row / 4][row % 4])
        )
    return cost


@wp.func
def descend(program: Program, search: Search, active: int, pivots: int):
    """From rows that all pull the right way; how the search ends. What is broken most joins first."""
    count = int(active)
    for _ in range(pivots):
        most = real(0.0)
        row = int(-1)
        for j in range(search.side.shape[0]):
            if search.side[j] == 0:
                breach = breach_of(program, search, j)
                if breach > most:
                    most = breach
                    row = j
        if row < 0:
            return FOUND
        count = join(program, search, count, row)
        if count == -2:
            return ASTRAY
        if count < 0:
            return INFEASIBLE
        if cost_of(program, search, count) > program.most[0]:
            return INFEASIBLE
    return ASTRAY


@wp.kernel
def optimum_kernel(
    program: Program,
    pivots: int,
    # In and out:
    search: Search,
    # Out:
    ended: wp.array[int],
):
    """From ``search.side``, a guess, to the optimum; how it ended. One thread.

    The guessed rows are held at their bounds, which is one system of linear equations in their multipliers; rows that
    pull the wrong way are let go, rows that break their bounds are held instead. Where that goes on for long, rows that
    break their bounds join one at a time, at the dual's best step: that ends.
    """
    ended[0] = FOUND
    for _ in range(_ROUNDS):
        count = hold(program, search)
        if count < 0:
            break
        if let_go_of_wrong(program, search, count) + hold_broken(program, search) == 0:
            return
    for _ in range(_REVISIONS):
        count = hold_those_that_pull(program, search)
        ended[0] = descend(program, search, count, pivots)
        if ended[0] != FOUND:
            return
        # Once more without what rounding has carried along.
        count = hold(program, search)
        if count < 0:
            continue
        if let_go_of_wrong(program, search, count) + hold_broken(program, search) == 0:
            return
    ended[0] = ASTRAY
