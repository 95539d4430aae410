"""The equations of a Newton step on contact forces: the derivative of their projections, and elimination.

A problem has a block of threads to itself, see ``kernels.contact.coulomb``; a thread is its ``lane``.
"""

import warp as wp

from egs_warp.kernels.block import wait_for_block
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
    """(3n,) of the velocities by a whole step; while one is sought, the shares of the pivot's row in others."""
    best: wp.array[real]
    unknowns: wp.array[int]
    """(3n,) rows that the equations do not give at once."""
    pivots: wp.array[int]
    """(3n,) in which of their columns each row has its pivot."""
    matrix: wp.array2d[Vec4]
    """(3n, >= (3n + 1) / 4) their linear equations, right sides last, columns by fours: taken at once."""


@wp.func
def rate_of(contacts: Contacts, i: int, scale: real):
    """Newtons for each m/s by which contact ``i`` is projected."""
    n = 3 * i
    trace = contacts.delassus[n, n] + contacts.delassus[n + 1, n + 1] + contacts.delassus[n + 2, n + 2]
    return scale * real(3.0) / trace


@wp.func
def equation_entry(contacts: Contacts, weights: Vec3, own: Vec3, n: int, column: int):
    """Of a row of the derivative: ``weights`` of the contact's three rows of the Delassus operator, and what is added
    in its ``own`` three columns, from ``n`` on."""
    value = (
        weights[0] * contacts.delassus[n, column]
        + weights[1] * contacts.delassus[n + 1, column]
        + weights[2] * contacts.delassus[n + 2, column]
    )
    if column >= n and column < n + 3:
        value += own[column - n]
    return value


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
        right = -newton.values[row]
        for c in range(3 * contacts.count):
            if newton.step[c] != real(0.0):
                right -= equation_entry(contacts, weights, own, n, c) * newton.step[c]
        for quad in range((unknowns + 4) / 4):
            four = Vec4()
            for k in range(4):
                b = 4 * quad + k
                if b < unknowns:
                    four[k] = equation_entry(contacts, weights, own, n, newton.unknowns[b])
                if b == unknowns:
                    four[k] = right
            newton.matrix[a, quad] = four
    wait_for_block()
    return unknowns


@wp.func
def entry(matrix: wp.array2d[Vec4], row: int, column: int):
    """Of a matrix by fours."""
    return matrix[row, column / 4][column % 4]


@wp.func
def solve_equations(unknowns: int, newton: Newton):
    """Gaussian elimination, rows exchanged; unknowns that the others make redundant stay zero, which keeps the forces
    bounded. The step has them in the end."""
    lanes = wp.block_dim()
    across = wp.min(lanes, _ACROSS)
    rank = int(0)
    largest = real(0.0)
    quads = (unknowns + 4) / 4
    for j in range(unknowns):
        pivot = int(rank)
        size = real(0.0)
        for a in range(rank, unknowns):
            candidate = wp.abs(entry(newton.matrix, a, j))
            if candidate > size:
                size = candidate
                pivot = a
        wait_for_block()
        if size > _SINGULAR * largest:
            largest = wp.max(largest, size)
            if pivot != rank:
                for quad in range(j / 4 + newton.lane, quads, lanes):
                    kept = newton.matrix[rank, quad]
                    newton.matrix[rank, quad] = newton.matrix[pivot, quad]
                    newton.matrix[pivot, quad] = kept
            wait_for_block()
            own = entry(newton.matrix, rank, j)
            for a in range(rank + 1 + newton.lane, unknowns, lanes):
                newton.change[a] = entry(newton.matrix, a, j) / own
            wait_for_block()
            for a in range(rank + 1 + newton.lane / across, unknowns, lanes / across):
                factor = newton.change[a]
                if factor != real(0.0):
                    for quad in range(j / 4 + newton.lane % across, quads, across):
                        newton.matrix[a, quad] = newton.matrix[a, quad] - factor * newton.matrix[rank, quad]
            wait_for_block()
            newton.pivots[rank] = j
            rank += 1
    # Each lane writes the same here.
    for back in range(rank):
        row = rank - 1 - back
        j = newton.pivots[row]
        value = entry(newton.matrix, row, unknowns)
        for b in range(j + 1, unknowns):
            value -= entry(newton.matrix, row, b) * newton.step[newton.unknowns[b]]
        newton.step[newton.unknowns[j]] = value / entry(newton.matrix, row, j)
    wait_for_block()
