"""The equations of a Newton step on contact forces: the derivative of their projections, and elimination.

A problem has a block of threads to itself, see ``kernels.contact.coulomb``; a thread is its ``lane``.
"""

import warp as wp

from egs_warp.kernels.block import wait_for_block
from egs_warp.kernels.vectors import ROW_ELIMINATION, on_cpu
from egs_warp.precision import Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})

_ACROSS = wp.constant(32)
"""Threads side by side in a row of the equations."""
_SINGULAR = wp.constant(real(1e-14))
"""Of the largest pivot so far: one that is smaller leaves its unknown at zero."""


@wp.struct
class Contacts:
    """n contacts; forces and velocities are contact-major: normal and two tangents. Arrays may have room for more."""

    count: int
    """n."""
    delassus: wp.array2d[real]
    """(3n, 3n) m/(N s)."""
    free: wp.array[real]
    """(3n,) m/s without forces."""
    shifts: wp.array[real]
    """(n,) m/s, added to the normal velocities."""
    friction: real


@wp.struct
class Newton:
    """Scratch memory of the search for 3n forces."""

    lane: int
    velocities: wp.array[real]
    values: wp.array[real]
    """(3n,) what the projection equations miss."""
    step: wp.array[real]
    change: wp.array[real]
    """(3n,) of the velocities by a whole step."""
    best: wp.array[real]
    unknowns: wp.array[int]
    """(3n,) rows that the equations do not give at once."""
    pivots: wp.array[int]
    """(3n,) in which of their columns each row has its pivot."""
    matrix: wp.array2d[Vec4]
    """(3n, >= (3n + 1) / 4) their linear equations, right sides last, columns by fours: taken at once."""


@wp.struct
class Pivots:
    """Of the elimination so far."""

    rank: int
    """Rows that have one."""
    largest: real
    found: int
    """In the last panel."""
    parts: wp.vec4i
    """In which of its columns."""


@wp.func
def rate_of(contacts: Contacts, i: int, scale: real):
    """Newtons for each m/s by which contact ``i`` is projected."""
    n = 3 * i
    trace = contacts.delassus[n, n] + contacts.delassus[n + 1, n + 1] + contacts.delassus[n + 2, n + 2]
    return scale * real(3.0) / trace


@wp.func_native("""
    const int n = row - row % 3, stride = delassus.strides[0] / 8;
    const double* const g = (const double*)delassus.data + n * stride;
    double* const out = (double*)((char*)matrix.data + a * matrix.strides[0]);
    const double w0 = weights[0], w1 = weights[1], w2 = weights[2];
    double right = -values.data[row];
    for (int c = 0; c < size; ++c) {
        const double moved = step.data[c];
        if (moved != 0.0) right -= (w0 * g[c] + w1 * g[stride + c] + w2 * g[2 * stride + c]) * moved;
    }
    for (int t = 0; t < 3; ++t) right -= own[t] * step.data[n + t];
    if (unknowns == size) {
        for (int c = 0; c < size; ++c) out[c] = w0 * g[c] + w1 * g[stride + c] + w2 * g[2 * stride + c];
        for (int t = 0; t < 3; ++t) out[n + t] += own[t];
    } else {
        for (int b = 0; b < unknowns; ++b) {
            const int c = columns.data[b];
            out[b] = w0 * g[c] + w1 * g[stride + c] + w2 * g[2 * stride + c];
            if (c >= n && c < n + 3) out[b] += own[c - n];
        }
    }
    out[unknowns] = right;
    for (int b = unknowns + 1; b & 3; ++b) out[b] = 0.0;
""")
def write_row(
    delassus: wp.array2d[real],
    step: wp.array[real],
    values: wp.array[real],
    columns: wp.array[int],
    size: int,
    unknowns: int,
    a: int,
    row: int,
    weights: Vec3,
    own: Vec3,
    matrix: wp.array2d[Vec4],
):
    """Row ``a`` of the equations, that of ``row`` of the derivative: ``weights`` of its contact's three rows of the
    Delassus operator and its ``own`` three entries, in the ``columns`` that are unknown; its right side, less what the
    others' steps move."""
    ...


@wp.func
def write_equations(contacts: Contacts, forces: wp.array[real], scale: real, short: real, newton: Newton):
    """The derivative of the values, row by row as each contact separates, sticks or slides, and how many unknowns it
    leaves: steps of forces that fall to zero are their values."""
    # Each lane writes the same here.
    unknowns = int(0)
    for i in range(contacts.count):
        n = 3 * i
        rate = rate_of(contacts, i, scale)
        if forces[n] - rate * newton.velocities[n] > real(0.0):
            newton.step[n] = real(0.0)
            newton.unknowns[unknowns] = n
            unknowns += 1
        else:
            newton.step[n] = -newton.values[n]
        first = forces[n + 1] - rate * newton.velocities[n + 1]
        second = forces[n + 2] - rate * newton.velocities[n + 2]
        if forces[n] <= real(0.0) and first * first + second * second > real(0.0):
            newton.step[n + 1] = -newton.values[n + 1]
            newton.step[n + 2] = -newton.values[n + 2]
        else:
            newton.step[n + 1] = real(0.0)
            newton.step[n + 2] = real(0.0)
            newton.unknowns[unknowns] = n + 1
            newton.unknowns[unknowns + 1] = n + 2
            unknowns += 2
    wait_for_block()
    for a in range(newton.lane, unknowns, wp.block_dim()):
        row = newton.unknowns[a]
        i = row / 3
        n = 3 * i
        rate = rate_of(contacts, i, scale)
        weights = Vec3()
        own = Vec3()
        weights[row - n] = rate
        own[row - n] = short
        if row > n:
            first = forces[n + 1] - rate * newton.velocities[n + 1]
            second = forces[n + 2] - rate * newton.velocities[n + 2]
            pull = wp.sqrt(first * first + second * second)
            radius = contacts.friction * wp.max(forces[n], real(0.0))
            if pull > radius:
                # Sliding: 1 - share (1 - d d^T) (1 - rate G) - friction d by the normal force.
                share = radius / pull
                d = wp.vec2d(first / pull, second / pull)
                mine = d[row - n - 1]
                along = wp.vec2d(-share * mine * d[0], -share * mine * d[1])
                along[row - n - 1] = share * (real(1.0) - mine * mine)
                weights = Vec3(real(0.0), rate * along[0], rate * along[1])
                own = Vec3(-contacts.friction * mine, -along[0], -along[1])
                own[row - n] = own[row - n] + real(1.0)
        write_row(
            contacts.delassus, newton.step, newton.values, newton.unknowns, 3 * contacts.count, unknowns, a, row,
            weights, own, newton.matrix,
        )  # fmt: skip
    wait_for_block()
    return unknowns


@wp.func
def entry(matrix: wp.array2d[Vec4], row: int, column: int):
    """Of a matrix by fours."""
    return matrix[row, column / 4][column % 4]


@wp.func
def eliminate_panel(panel: int, unknowns: int, pivots: Pivots, newton: Newton):
    """Find pivots in the four columns of a ``panel``, which alone are worked on; a row has its shares of the pivots'
    rows in their columns then."""
    lanes = wp.block_dim()
    pivots.found = 0
    for part in range(4):
        if 4 * panel + part < unknowns:
            pivot = int(pivots.rank)
            size = real(0.0)
            for a in range(pivots.rank, unknowns):
                candidate = wp.abs(newton.matrix[a, panel][part])
                if candidate > size:
                    size = candidate
                    pivot = a
            wait_for_block()
            if size > _SINGULAR * pivots.largest:
                pivots.largest = wp.max(pivots.largest, size)
                if pivot != pivots.rank:
                    for quad in range(panel + newton.lane, (unknowns + 4) / 4, lanes):
                        kept = newton.matrix[pivots.rank, quad]
                        newton.matrix[pivots.rank, quad] = newton.matrix[pivot, quad]
                        newton.matrix[pivot, quad] = kept
                wait_for_block()
                top = newton.matrix[pivots.rank, panel]
                for a in range(pivots.rank + 1 + newton.lane, unknowns, lanes):
                    row = newton.matrix[a, panel]
                    factor = row[part] / top[part]
                    row[part] = factor
                    for k in range(part + 1, 4):
                        row[k] = row[k] - factor * top[k]
                    newton.matrix[a, panel] = row
                wait_for_block()
                newton.pivots[pivots.rank] = 4 * panel + part
                pivots.parts[pivots.found] = part
                pivots.found += 1
                pivots.rank += 1
    return pivots


@wp.func_native(
    on_cpu(
        ROW_ELIMINATION
        + """
    double* const M = (double*)matrix.data;
    const int stride = matrix.strides[0] / 8;
    const int rank = eliminate_rows(M, stride, unknowns, (unknowns + 4) & ~3, singular, pivots.data);
    for (int back = rank - 1; back >= 0; back -= 1) {
        const double* const row = M + back * stride;
        const int j = pivots.data[back];
        double value = row[unknowns];
        for (int b = j + 1; b < unknowns; ++b) value -= row[b] * step.data[places.data[b]];
        step.data[places.data[j]] = value / row[j];
    }
""",
    )
)
def solve_alone(
    unknowns: int,
    singular: real,
    pivots: wp.array[int],
    places: wp.array[int],
    matrix: wp.array2d[Vec4],
    step: wp.array[real],
):
    """``solve_equations`` by one thread of a CPU, sixteen columns at a time."""
    ...


@wp.func
def eliminate(unknowns: int, newton: Newton):
    """The same by a block of threads, four columns at a time."""
    lanes = wp.block_dim()
    across = wp.min(lanes, _ACROSS)
    quads = (unknowns + 4) / 4
    pivots = Pivots()
    for panel in range((unknowns + 3) / 4):
        first = pivots.rank
        pivots = eliminate_panel(panel, unknowns, pivots, newton)
        # What the pivots' rows leave of each other in the columns to come, then of those below.
        for quad in range(panel + 1 + newton.lane, quads, lanes):
            for t in range(1, pivots.found):
                left = newton.matrix[first + t, quad]
                for s in range(t):
                    left -= newton.matrix[first + t, panel][pivots.parts[s]] * newton.matrix[first + s, quad]
                newton.matrix[first + t, quad] = left
        wait_for_block()
        for a in range(pivots.rank + newton.lane / across, unknowns, lanes / across):
            shares = newton.matrix[a, panel]
            if pivots.found == 4:
                for quad in range(panel + 1 + newton.lane % across, quads, across):
                    newton.matrix[a, quad] = newton.matrix[a, quad] - (
                        shares[0] * newton.matrix[first, quad]
                        + shares[1] * newton.matrix[first + 1, quad]
                        + shares[2] * newton.matrix[first + 2, quad]
                        + shares[3] * newton.matrix[first + 3, quad]
                    )
            else:
                for s in range(pivots.found):
                    share = shares[pivots.parts[s]]
                    for quad in range(panel + 1 + newton.lane % across, quads, across):
                        newton.matrix[a, quad] = newton.matrix[a, quad] - share * newton.matrix[first + s, quad]
        wait_for_block()
    return pivots


@wp.func
def solve_equations(unknowns: int, newton: Newton):
    """Gaussian elimination, rows exchanged; unknowns that the others make redundant stay zero,
    which keeps the forces bounded. The step has them in the end."""
    if wp.block_dim() == 1:
        solve_alone(unknowns, _SINGULAR, newton.pivots, newton.unknowns, newton.matrix, newton.step)
        return
    pivots = eliminate(unknowns, newton)
    # Each lane writes the same here.
    for back in range(pivots.rank):
        row = pivots.rank - 1 - back
        j = newton.pivots[row]
        value = entry(newton.matrix, row, unknowns)
        for b in range(j + 1, unknowns):
            value -= entry(newton.matrix, row, b) * newton.step[newton.unknowns[b]]
        newton.step[newton.unknowns[j]] = value / entry(newton.matrix, row, j)
    wait_for_block()
