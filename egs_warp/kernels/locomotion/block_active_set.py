"""``active_set`` by all threads of a block on a GPU, one thread on a CPU: min 1/2 z^T z subject to l <= free + R z <= u
with rows R of length 1.

Where threads wait for each other a triangular solve takes as long as its rows are many, a product does not. So of the
products of the rows that hold it has no factor but the inverse, which grows and shrinks with them; what that carries
along of rounding goes whenever all rows that hold are looked at anew.
"""

import warp as wp

from egs_warp.kernels.block import largest_of_block, sum_of_block, wait_for_block
from egs_warp.kernels.locomotion.active_set import (
    ASTRAY,
    DEPENDENT,
    FOUND,
    INFEASIBLE,
    MISSED,
    PULLS,
    REDUNDANT,
)
from egs_warp.kernels.locomotion.block_algebra import (
    add_product,
    apply_root,
    lane_of_block,
    largest_and_place,
    list_marked,
    multiply,
    multiply_across,
)
from egs_warp.kernels.locomotion.block_elimination import invert_root
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

PIVOTS = wp.constant(600)
"""At most, as on the host."""
_LOOKS = wp.constant(8)
"""Rows that join between two looks at what the point costs."""


@wp.struct
class UnitRows:
    """What is given."""

    unknowns: int
    """n."""
    count: int
    """m."""
    made_of: int
    """k."""
    units: wp.array2d[real]
    """(k, n) what R is made of: a row holds three of these at most."""
    parts: wp.array2d[int]
    """(m, 3) which,"""
    shares: wp.array2d[real]
    """(m, 3) and of how much."""
    seen: wp.array[real]
    """(k,) scratch: what R is made of, at some z."""
    free: wp.array[real]
    """(m,) the rows at z = 0."""
    lower: wp.array[real]
    upper: wp.array[real]
    slack: wp.array[real]
    """(m,) by how much a row may break its bounds."""
    most: real
    """Cost z^T z / 2 beyond which no point is looked for."""
    settled: wp.array[int]
    """(1,) not 0 as soon as nobody asks for a point."""


@wp.struct
class Holding:
    """Where the search is; k rows hold."""

    side: wp.array[int]
    """(m,) of rows that hold: 1 at the lower bound, -1 at the upper; else 0."""
    active: wp.array[int]
    """(n,) those rows."""
    pulls: wp.array[real]
    """(n,) their multipliers."""
    held: wp.array2d[real]
    """(k, n) the rows themselves."""
    held_across: wp.array2d[real]
    """(n, k) as they were looked at last."""
    products: wp.array2d[real]
    """(k, k) of them with each other."""
    root: wp.array2d[real]
    """(k, k) of the inverse of that."""
    inverse: wp.array2d[real]
    """(k, k)."""
    place: wp.array[real]
    """(n,) z."""
    at: wp.array[real]
    """(m,) all rows there."""
    ways: wp.array[real]
    """(k,) of the row that joins: ``inverse`` times its products with those that hold."""
    beside: wp.array[real]
    between: wp.array[real]
    """(n,) scratch."""
    joins: wp.array[real]
    """(n,) the row that joins."""
    outside: wp.array[real]
    """(n,) what of the row that joins lies outside of those that hold."""


@wp.func
def bound_of(rows: UnitRows, holding: Holding, row: int):
    """The bound that ``row`` is held at."""
    if holding.side[row] > 0:
        return rows.lower[row]
    return rows.upper[row]


@wp.func
def see(rows: UnitRows, holding: Holding):
    """All rows at the place."""
    multiply(rows.units, rows.made_of, rows.unknowns, holding.place, rows.seen)
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        at = rows.free[row]
        for t in range(3):
            at += rows.shares[row, t] * rows.seen[rows.parts[row, t]]
        holding.at[row] = at
    wait_for_block()


@wp.func
def unit_at(rows: UnitRows, row: int, c: int):
    """R there."""
    value = real(0.0)
    for t in range(3):
        value += rows.shares[row, t] * rows.units[rows.parts[row, t], c]
    return value


@wp.func
def gather(rows: UnitRows, holding: Holding, count: int, added: real):
    """The active rows, and their products with each other, with so much ``added`` to the diagonal."""
    lane = lane_of_block()
    for e in range(lane, count * rows.unknowns, wp.block_dim()):
        i = e / rows.unknowns
        c = e % rows.unknowns
        value = unit_at(rows, holding.active[i], c)
        holding.held[i, c] = value
        holding.held_across[c, i] = value
    for e in range(lane, count * count, wp.block_dim()):
        holding.products[e / count, e % count] = wp.where(e / count == e % count, added, real(0.0))
    wait_for_block()
    add_product(holding.products, holding.held, holding.held_across, count, count, rows.unknowns, 0)


@wp.func
def hold(rows: UnitRows, holding: Holding):
    """How many rows have a side, held at their bounds; -1 where that has no numbers."""
    lane = lane_of_block()
    count = list_marked(holding.side, rows.count, rows.unknowns, holding.active)
    if count > rows.unknowns:
        return -1
    gather(rows, holding, count, REDUNDANT)
    for i in range(lane, count, wp.block_dim()):
        row = holding.active[i]
        holding.beside[i] = bound_of(rows, holding, row) - rows.free[row]
    wait_for_block()
    if invert_root(holding.products, count, holding.root) == 0:
        return -1
    apply_root(holding.root, count, holding.beside, holding.between, holding.ways)
    for i in range(lane, count, wp.block_dim()):
        holding.pulls[i] = real(holding.side[holding.active[i]]) * holding.ways[i]
    multiply_across(holding.held, count, rows.unknowns, holding.ways, holding.place)
    see(rows, holding)
    return count


@wp.func
def write_inverse(holding: Holding, count: int):
    """Of the products of those that hold, from its root."""
    for e in range(lane_of_block(), count * count, wp.block_dim()):
        i = e / count
        k = e % count
        value = real(0.0)
        for c in range(wp.max(i, k), count):
            value += holding.root[i, c] * holding.root[k, c]
        holding.inverse[i, k] = value
    wait_for_block()


@wp.func
def let_go_of_wrong(rows: UnitRows, holding: Holding, count: int):
    """How many rows lose their side: those that pull the wrong way, or that the others keep from their bounds."""
    lane = lane_of_block()
    most = real(0.0)
    for i in range(lane, count, wp.block_dim()):
        most = wp.max(most, wp.abs(holding.pulls[i]))
    most = largest_of_block(most)
    wait_for_block()
    wrong = real(0.0)
    for i in range(lane, count, wp.block_dim()):
        row = holding.active[i]
        missed = wp.abs(holding.at[row] - bound_of(rows, holding, row))
        if holding.pulls[i] < -PULLS * most or missed > MISSED + rows.slack[row]:
            holding.side[row] = 0
            wrong += real(1.0)
    wrong = sum_of_block(wrong)
    wait_for_block()
    return int(wrong)


@wp.func
def let_go_of_all(rows: UnitRows, holding: Holding):
    """From where nothing holds there always is a way."""
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        holding.side[row] = 0
    wait_for_block()


@wp.func
def leave(rows: UnitRows, holding: Holding, count: int, place: int):
    """Let go of the active row at ``place``, which the last one takes."""
    lane = lane_of_block()
    last = count - 1
    for i in range(lane, count, wp.block_dim()):
        holding.beside[i] = holding.inverse[i, place]
    wait_for_block()
    by = real(1.0) / holding.beside[place]
    for e in range(lane, count * count, wp.block_dim()):
        i = e / count
        k = e % count
        holding.inverse[i, k] = holding.inverse[i, k] - holding.beside[i] * holding.beside[k] * by
    if lane == 0:
        holding.side[holding.active[place]] = 0
        holding.active[place] = holding.active[last]
        holding.pulls[place] = holding.pulls[last]
    wait_for_block()
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
        holding.held[place, c] = holding.held[last, c]
    wait_for_block()


@wp.func
def find_ways(rows: UnitRows, holding: Holding, count: int, towards: real):
    """What of the row that joins, in the direction that it is held ``towards``, lies outside of those that hold: the
    square of that."""
    multiply(holding.held, count, rows.unknowns, holding.joins, holding.beside)
    multiply(holding.inverse, count, count, holding.beside, holding.ways)
    multiply_across(holding.held, count, rows.unknowns, holding.ways, holding.outside)
    square = real(0.0)
    for c in range(lane_of_block(), rows.unknowns, wp.block_dim()):
        value = holding.joins[c] - holding.outside[c]
        holding.outside[c] = towards * value
        square += value * value
    square = sum_of_block(square)
    wait_for_block()
    return square


@wp.func
def join(rows: UnitRows, holding: Holding, active: int, row: int):
    """How many rows are active when ``row`` is held beside them, less those whose pull ends on the way; -1 where no
    point satisfies it beside those, -2 where rounding leaves no way."""
    lane = lane_of_block()
    count = int(active)
    sign = int(-1)
    bound = rows.upper[row]
    if holding.at[row] < rows.lower[row]:
        sign = 1
        bound = rows.lower[row]
    towards = real(sign)
    for c in range(lane, rows.unknowns, wp.block_dim()):
        holding.joins[c] = unit_at(rows, row, c)
    wait_for_block()
    pull = real(0.0)
    while True:
        apart = find_ways(rows, holding, count, towards)
        soonest = real(-wp.inf)
        first = int(-1)
        for i in range(lane, count, wp.block_dim()):
            rate = towards * real(holding.side[holding.active[i]]) * holding.ways[i]
            if rate > real(0.0):
                ends = -wp.max(holding.pulls[i], real(0.0)) / rate
                if ends > soonest:
                    soonest = ends
                    first = i
        found = largest_and_place(soonest, first)
        part = -found[0]
        first = int(found[1])
        whole = real(wp.inf)
        # As many rows as unknowns leave nothing outside, whatever rounding says.
        if apart > DEPENDENT and count < rows.unknowns:
            whole = towards * (bound - holding.at[row]) / apart
        step = wp.min(whole, part)
        if not apart < real(wp.inf):
            return -2
        if not step < real(wp.inf):
            return -1
        pull += step
        # All lanes have read where the row is.
        wait_for_block()
        for i in range(lane, count, wp.block_dim()):
            rate = towards * real(holding.side[holding.active[i]]) * holding.ways[i]
            holding.pulls[i] = holding.pulls[i] - step * rate
        if whole < real(wp.inf):
            for c in range(lane, rows.unknowns, wp.block_dim()):
                holding.place[c] = holding.place[c] + step * holding.outside[c]
            if lane == 0:
                holding.at[row] = holding.at[row] + towards * step * apart
        wait_for_block()
        if whole <= part:
            see(rows, holding)
            grow(rows, holding, count, apart + REDUNDANT)
            if lane == 0:
                holding.active[count] = row
                holding.pulls[count] = pull
                holding.side[row] = sign
            wait_for_block()
            return count + 1
        leave(rows, holding, count, first)
        count -= 1
    return count


@wp.func
def grow(rows: UnitRows, holding: Holding, count: int, apart: real):
    """The inverse, with the row that joins beside the others, of which so much of a square lies ``apart``."""
    lane = lane_of_block()
    by = real(1.0) / apart
    for e in range(lane, count * count, wp.block_dim()):
        i = e / count
        k = e % count
        holding.inverse[i, k] = holding.inverse[i, k] + by * holding.ways[i] * holding.ways[k]
    for i in range(lane, count, wp.block_dim()):
        holding.inverse[i, count] = -by * holding.ways[i]
        holding.inverse[count, i] = -by * holding.ways[i]
    if lane == 0:
        holding.inverse[count, count] = by
    for c in range(lane, rows.unknowns, wp.block_dim()):
        holding.held[count, c] = holding.joins[c]


@wp.func
def most_broken(rows: UnitRows, holding: Holding):
    """Of the rows without a side the one that breaks its bounds most, -1 where none does."""
    most = real(0.0)
    found = int(-1)
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        at = holding.at[row]
        breach = wp.max(rows.lower[row] - at, at - rows.upper[row]) - rows.slack[row]
        if holding.side[row] == 0 and breach > most:
            most = breach
            found = row
    return int(largest_and_place(most, found)[1])


@wp.func
def cost_of(rows: UnitRows, holding: Holding):
    """z^T z / 2."""
    cost = real(0.0)
    for c in range(lane_of_block(), rows.unknowns, wp.block_dim()):
        cost += real(0.5) * holding.place[c] * holding.place[c]
    cost = sum_of_block(cost)
    wait_for_block()
    return cost


@wp.func
def is_settled(rows: UnitRows):
    """Whether nobody asks for a point any more: somebody else's launch may say so meanwhile."""
    settled = real(0.0)
    if lane_of_block() == 0:
        settled = real(wp.atomic_add(rows.settled, 0, 0))
    settled = sum_of_block(settled)
    wait_for_block()
    return settled != real(0.0)


@wp.func
def descend(rows: UnitRows, holding: Holding, active: int):
    """From rows that all pull the right way: how many hold the optimum, -1 where there is no point, -2 where rounding
    leads astray. What is broken most joins first."""
    count = int(active)
    write_inverse(holding, count)
    for number in range(PIVOTS):
        row = most_broken(rows, holding)
        if row < 0:
            return count
        count = join(rows, holding, count, row)
        if count < 0:
            return count
        if number % _LOOKS == 0:
            if cost_of(rows, holding) > rows.most:
                return -1
            if is_settled(rows):
                return -2
    return -2


@wp.func
def refine(rows: UnitRows, holding: Holding, count: int):
    """Multipliers once more by what the rows miss of their bounds, and the place by these alone."""
    lane = lane_of_block()
    for i in range(lane, count, wp.block_dim()):
        row = holding.active[i]
        holding.beside[i] = bound_of(rows, holding, row) - holding.at[row]
    wait_for_block()
    multiply(holding.inverse, count, count, holding.beside, holding.ways)
    for i in range(lane, count, wp.block_dim()):
        side = real(holding.side[holding.active[i]])
        pull = holding.pulls[i] + side * holding.ways[i]
        holding.pulls[i] = pull
        holding.beside[i] = side * pull
    wait_for_block()
    multiply_across(holding.held, count, rows.unknowns, holding.beside, holding.place)
    see(rows, holding)


@wp.func
def find_optimum(rows: UnitRows, holding: Holding):
    """From the sides, a guess: how it ended. See ``active_set.optimum_kernel``.

    Of the guess those rows stay that pull the right way; then broken ones join one at a time. A round in which all that
    is wrong changes at once, as there, costs more here than the joins that it saves: 2.3 rows join less without any. Of
    3,459 recorded pieces none is wrong at the end, and of 1,025 programs without complementarity 12, where rows are too
    near to each other: to begin anew from there took these five times as long, and four of them to no end.
    """
    count = int(0)
    wrong = int(1)
    while wrong > 0:
        if is_settled(rows):
            return ASTRAY
        count = hold(rows, holding)
        if count < 0:
            let_go_of_all(rows, holding)
        else:
            wrong = let_go_of_wrong(rows, holding, count)
    count = descend(rows, holding, count)
    if count == -1:
        return INFEASIBLE
    if count >= 0:
        refine(rows, holding, count)
        if let_go_of_wrong(rows, holding, count) == 0 and most_broken(rows, holding) < 0:
            return FOUND
    return ASTRAY
