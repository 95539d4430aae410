"""OSQP's operator splitting for dense quadratic programs (Stellato, Banjac, Goulart, Bemporad and Boyd 2020, "OSQP: an
operator splitting solver for quadratic programs").

min 1/2 x^T P x + q^T x subject to l <= A x <= u, many programs at once: a block of threads for each on a GPU, one
thread on a CPU, with the same mathematics. K = P + sigma I + A^T diag(rho) A is inverted whenever rho changes, so that
an iteration has only products with matrices, in which threads do not wait for each other: the triangular solves of a
factor would have them wait for each unknown. Constants are the defaults that OSQP documents.
"""

import warp as wp

from egs_warp.kernels.block import block_max, sum_of_block, sync_block
from egs_warp.kernels.locomotion.scaled_programs import (
    AdmmWorkspace,
    Iterates,
    Programs,
    Scaled,
    equilibrate,
    memory_of,
    write_scaled,
)
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

SOLVED, INEXACT, LIMIT = wp.constant(0), wp.constant(1), wp.constant(2)
INFEASIBLE, DOUBTFUL = wp.constant(3), wp.constant(4)
"""How iterations end, see ``AdmmEnding``."""
BLOCK = 256
"""Threads of a program on a GPU."""
CHECK = wp.constant(25)
"""Iterations between two looks at the residuals."""

_SIGMA = wp.constant(real(1e-6))
_OVER = wp.constant(real(1.6))
"""alpha, relaxation beyond a whole step."""
_LEAST_RHO, _MOST_RHO = wp.constant(real(1e-6)), wp.constant(real(1e6))
_HELD, _STIFFER = wp.constant(real(1e-4)), wp.constant(real(1e3))
"""Room between the bounds of a row that counts as an equation, and by how much its rho is larger."""
_OTHER_RHO = wp.constant(real(5.0))
"""By how much another rho is better that is worth another inverse."""
_CERTAIN = wp.constant(real(1e-4))
"""Of the multipliers' last change: accuracy of a certificate."""
_LOOSE = wp.constant(real(10.0))
"""Times the accuracy: what is told apart at the last iteration."""
_NOTHING = wp.constant(real(1e-30))
"""Added to what is divided by."""


@wp.struct
class Residuals:
    """What is missed, and how large the terms of each are."""

    primal: real
    primal_size: real
    dual: real
    dual_size: real
    gap: real
    gap_size: real
    """In the program's own units."""
    ratio: real
    """Of the scaled primal to the scaled dual residual, each in the size of its terms."""


@wp.func
def product(matrix: wp.array2d[real], transposed: wp.array2d[real], row: int, vector: wp.array[real], count: int):
    """Of a ``row`` of ``count`` entries with ``vector``. Threads side by side read numbers side by side, a thread alone
    reads one after another."""
    value = real(0.0)
    if wp.block_dim() == 1:
        for i in range(count):
            value += matrix[row, i] * vector[i]
    else:
        for i in range(count):
            value += transposed[i, row] * vector[i]
    return value


@wp.func
def invert(lane: int, rho: real, own: Scaled):
    """rho of each row, and the inverse of K by sweeps over its diagonal, which leave a symmetric matrix symmetric and
    end at minus the inverse (Goodnight 1979); K is positive definite, so no pivot need be looked for."""
    n = own.variables
    for i in range(lane, own.row_count, wp.block_dim()):
        row_rho = rho
        if own.upper[i] - own.lower[i] < _HELD:
            row_rho = _STIFFER * rho
        elif own.lower[i] == real(-wp.inf) and own.upper[i] == real(wp.inf):
            row_rho = _LEAST_RHO
        own.rho[i] = row_rho
    sync_block()
    for entry in range(lane, n * n, wp.block_dim()):
        i = entry / n
        j = entry - i * n
        value = own.P[i, j]
        if i == j:
            value += _SIGMA
        for row in range(own.row_count):
            value += own.rho[row] * own.rows[row, i] * own.rows[row, j]
        own.inverse[i, j] = value
    for pivot in range(n):
        sync_block()
        for j in range(lane, n, wp.block_dim()):
            own.slope[j] = own.inverse[pivot, j]
        sync_block()
        scale = real(1.0) / own.slope[pivot]
        for entry in range(lane, n * n, wp.block_dim()):
            i = entry / n
            j = entry - i * n
            if i == pivot and j == pivot:
                own.inverse[i, j] = -scale
            elif i == pivot:
                own.inverse[i, j] = scale * own.slope[j]
            elif j == pivot:
                own.inverse[i, j] = scale * own.slope[i]
            else:
                own.inverse[i, j] = own.inverse[i, j] - scale * own.slope[i] * own.slope[j]
    sync_block()


@wp.func
def iterate(lane: int, own: Scaled):
    """One iteration. The next x' is looked for as a step from this one: where the residuals are small, so is what the
    inverse's rounding adds."""
    n = own.variables
    m = own.row_count
    for i in range(lane, m, wp.block_dim()):
        own.push[i] = own.y[i] + own.rho[i] * (own.at[i] - own.z[i])
    sync_block()
    for j in range(lane, n, wp.block_dim()):
        own.slope[j] = own.q[j] + product(own.P, own.P, j, own.x, n) + product(own.columns, own.rows, j, own.push, m)
    sync_block()
    for j in range(lane, n, wp.block_dim()):
        own.step[j] = product(own.inverse, own.inverse, j, own.slope, n)
    sync_block()
    for j in range(lane, n, wp.block_dim()):
        own.x[j] = own.x[j] + _OVER * own.step[j]
    for i in range(lane, m, wp.block_dim()):
        move = product(own.rows, own.columns, i, own.step, n)
        wish = _OVER * (own.at[i] + move) + (real(1.0) - _OVER) * own.z[i] + own.y[i] / own.rho[i]
        own.at[i] = own.at[i] + _OVER * move
        own.z[i] = wp.min(wp.max(wish, own.lower[i]), own.upper[i])
        pull = own.rho[i] * (wish - own.z[i])
        own.change[i] = pull - own.y[i]
        own.y[i] = pull
    sync_block()


@wp.func
def residuals(lane: int, cost: real, own: Scaled):
    """Of the conditions of the optimum, and of its objective to the dual's."""
    n = own.variables
    m = own.row_count
    primal = real(0.0)
    primal_size = real(0.0)
    scaled_primal = real(0.0)
    scaled_primal_size = real(0.0)
    support = real(0.0)
    for i in range(lane, m, wp.block_dim()):
        # Anew: what iterations carry along gathers rounding.
        at = product(own.rows, own.columns, i, own.x, n)
        own.at[i] = at
        size = wp.max(wp.abs(at), wp.abs(own.z[i]))
        missed = wp.abs(at - own.z[i])
        scaled_primal = wp.max(scaled_primal, missed)
        scaled_primal_size = wp.max(scaled_primal_size, size)
        primal = wp.max(primal, missed / own.weight[i])
        primal_size = wp.max(primal_size, size / own.weight[i])
        # Multipliers that push at a bound that is none are exactly zero.
        if own.y[i] > real(0.0):
            support += own.upper[i] * own.y[i]
        elif own.y[i] < real(0.0):
            support += own.lower[i] * own.y[i]
    dual = real(0.0)
    dual_size = real(0.0)
    scaled_dual = real(0.0)
    scaled_dual_size = real(0.0)
    square = real(0.0)
    linear = real(0.0)
    for j in range(lane, n, wp.block_dim()):
        bent = product(own.P, own.P, j, own.x, n)
        pushed = product(own.columns, own.rows, j, own.y, m)
        square += own.x[j] * bent
        linear += own.x[j] * own.q[j]
        size = wp.max(wp.max(wp.abs(bent), wp.abs(pushed)), wp.abs(own.q[j]))
        missed = wp.abs(bent + own.q[j] + pushed)
        scaled_dual = wp.max(scaled_dual, missed)
        scaled_dual_size = wp.max(scaled_dual_size, size)
        dual = wp.max(dual, missed / own.stretch[j])
        dual_size = wp.max(dual_size, size / own.stretch[j])
    found = Residuals()
    found.primal = block_max(primal)
    found.primal_size = block_max(primal_size)
    found.dual = block_max(dual) / cost
    found.dual_size = block_max(dual_size) / cost
    square = sum_of_block(square)
    linear = sum_of_block(linear)
    support = sum_of_block(support)
    found.gap = wp.abs(square + linear + support) / cost
    found.gap_size = wp.max(wp.max(wp.abs(square), wp.abs(linear)), wp.abs(support)) / cost
    primal_part = block_max(scaled_primal) / (block_max(scaled_primal_size) + _NOTHING)
    dual_part = block_max(scaled_dual) / (block_max(scaled_dual_size) + _NOTHING)
    found.ratio = primal_part / (dual_part + _NOTHING)
    return found


@wp.func
def within(found: Residuals, accuracy: real):
    """Whether nothing is missed by more than ``accuracy``, of 1 and of the terms."""
    return (
        found.primal <= accuracy * (real(1.0) + found.primal_size)
        and found.dual <= accuracy * (real(1.0) + found.dual_size)
        and found.gap <= accuracy * (real(1.0) + found.gap_size)
    )


@wp.func
def is_infeasible(lane: int, accuracy: real, own: Scaled):
    """Whether the last change d of the multipliers certifies that no point satisfies the bounds: A^T d = 0, while
    u^T d+ + l^T d- < 0."""
    norm = real(0.0)
    support = real(0.0)
    for i in range(lane, own.row_count, wp.block_dim()):
        change = own.change[i]
        # No multiplier pushes at a bound that is none.
        if own.upper[i] == real(wp.inf):
            change = wp.min(change, real(0.0))
        if own.lower[i] == real(-wp.inf):
            change = wp.max(change, real(0.0))
        own.push[i] = change
        norm = wp.max(norm, own.weight[i] * wp.abs(change))
        if change > real(0.0):
            support += own.upper[i] * change
        elif change < real(0.0):
            support += own.lower[i] * change
    norm = block_max(norm)
    support = sum_of_block(support)
    left = real(0.0)
    for j in range(lane, own.variables, wp.block_dim()):
        left = wp.max(left, wp.abs(product(own.columns, own.rows, j, own.push, own.row_count)) / own.stretch[j])
    left = block_max(left)
    return norm > _NOTHING and support < real(0.0) and left <= accuracy * norm


@wp.kernel(grid_stride=False)
def admm_kernel(
    programs: Programs,
    accuracy: real,
    iterations: int,
    passes: int,
    adapt: int,
    memory: AdmmWorkspace,
    # In and out:
    iterates: Iterates,
    # Out:
    ended: wp.array[int],
    taken: wp.array[int],
):
    """From ``iterates`` to the optimum of each program: how it ended, and the iterations that it took, at most
    ``iterations``. ``passes`` equilibrate; rho may change every ``adapt`` iterations, a multiple of ``CHECK``. A block
    a program."""
    program = wp.tid() / wp.block_dim()
    lane = wp.tid() - program * wp.block_dim()
    own = memory_of(program, programs, memory)
    n = own.variables
    m = own.row_count
    cost = equilibrate(lane, programs.P[program], programs.q[program], programs.A[program], passes, own)
    write_scaled(lane, programs.P[program], programs.q[program], programs.A[program], cost, own)
    for j in range(lane, n, wp.block_dim()):
        own.x[j] = iterates.x[program, j] / own.stretch[j]
    sync_block()
    for i in range(lane, m, wp.block_dim()):
        own.lower[i] = own.weight[i] * programs.lower[program, i]
        own.upper[i] = own.weight[i] * programs.upper[program, i]
        own.y[i] = cost * iterates.y[program, i] / own.weight[i]
        own.at[i] = product(own.rows, own.columns, i, own.x, n)
        own.z[i] = own.at[i]
    rho = iterates.rho[program]
    invert(lane, rho, own)
    end = int(LIMIT)
    last = int(0)
    while last < iterations:
        iterate(lane, own)
        last += 1
        if last % CHECK == 0 or last == iterations:
            found = residuals(lane, cost, own)
            if within(found, accuracy):
                end = SOLVED
                break
            if is_infeasible(lane, _CERTAIN, own):
                end = INFEASIBLE
                break
            if last == iterations:
                if within(found, _LOOSE * accuracy):
                    end = INEXACT
                elif is_infeasible(lane, _LOOSE * _CERTAIN, own):
                    end = DOUBTFUL
            elif last % adapt == 0:
                better = wp.min(wp.max(rho * wp.sqrt(found.ratio), _LEAST_RHO), _MOST_RHO)
                if better > _OTHER_RHO * rho or _OTHER_RHO * better < rho:
                    rho = better
                    invert(lane, rho, own)
    for j in range(lane, n, wp.block_dim()):
        iterates.x[program, j] = own.stretch[j] * own.x[j]
    for i in range(lane, m, wp.block_dim()):
        iterates.y[program, i] = own.weight[i] * own.y[i] / cost
    if lane == 0:
        iterates.rho[program] = rho
        ended[program] = end
        taken[program] = last
