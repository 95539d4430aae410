"""OSQP's operator splitting for dense quadratic programs (Stellato, Banjac, Goulart, Bemporad and Boyd 2020, "OSQP: an
operator splitting solver for quadratic programs").

min 1/2 x^T P x + q^T x subject to l <= A x <= u, for many programs at once: one thread block per program on a GPU, one
thread on a CPU, with the same mathematics. K = P + sigma I + A^T diag(rho) A is inverted whenever rho changes, so an
iteration consists of matrix-vector products. Triangular solves with a factor would synchronise the threads once per
unknown instead. Constants are the defaults that OSQP documents. Host code: ``egs_warp/locomotion/admm.py``.
"""

import warp as wp

from egs_warp.kernels.block import block_max, sum_of_block, sync_block
from egs_warp.kernels.locomotion.scaled_programs import (
    AdmmWorkspace,
    Iterates,
    Programs,
    Scaled,
    equilibrate,
    program_view,
    write_scaled,
)
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

SOLVED, INEXACT, LIMIT = wp.constant(0), wp.constant(1), wp.constant(2)
INFEASIBLE, INFEASIBLE_INEXACT = wp.constant(3), wp.constant(4)
"""Status of the iterations, see ``AdmmStatus``."""
BLOCK = 256
"""Threads per program on a GPU."""
CHECK = wp.constant(25)
"""Iterations between two evaluations of the residuals."""

_SIGMA = wp.constant(real(1e-6))
_ALPHA = wp.constant(real(1.6))
"""alpha, the over-relaxation factor."""
_MIN_RHO, _MAX_RHO = wp.constant(real(1e-6)), wp.constant(real(1e6))
_EQUALITY_GAP, _EQUALITY_RHO_FACTOR = wp.constant(real(1e-4)), wp.constant(real(1e3))
"""A row with bounds closer than the first value counts as an equation; its rho is multiplied by the second value."""
_RHO_UPDATE_FACTOR = wp.constant(real(5.0))
"""Factor by which a better rho must differ to be worth another inverse."""
_CERTIFICATE_TOLERANCE = wp.constant(real(1e-4))
"""Accuracy of an infeasibility certificate, relative to the last change of the multipliers."""
_LOOSE_FACTOR = wp.constant(real(10.0))
"""Factor on the accuracies for the inexact statuses, tested at the last iteration."""
_TINY = wp.constant(real(1e-30))
"""Added to denominators."""


@wp.struct
class Residuals:
    """Residuals, and the magnitudes of the terms of each."""

    primal: real
    primal_size: real
    dual: real
    dual_size: real
    gap: real
    gap_size: real
    """Residual and magnitude of the duality gap, in the units of the unscaled program."""
    ratio: real
    """Ratio of the scaled primal to the scaled dual residual, each relative to the magnitude of its terms."""


@wp.func
def product(matrix: wp.array2d[real], transposed: wp.array2d[real], row: int, vector: wp.array[real], count: int):
    """Return the product of ``row`` of the matrix (``count`` entries) with ``vector``. Both layouts are given: threads
    of a block read adjacent numbers of the transpose, a single thread reads the row contiguously."""
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
    """Set rho of each row and compute minus the inverse of K, by sweeps over its diagonal (Goodnight 1979), which keep
    a symmetric matrix symmetric. K is positive definite, so no pivoting is needed."""
    n = own.variables
    for i in range(lane, own.row_count, wp.block_dim()):
        row_rho = rho
        if own.upper[i] - own.lower[i] < _EQUALITY_GAP:
            row_rho = _EQUALITY_RHO_FACTOR * rho
        elif own.lower[i] == real(-wp.inf) and own.upper[i] == real(wp.inf):
            row_rho = _MIN_RHO
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
            own.variable_scratch[j] = own.inverse[pivot, j]
        sync_block()
        scale = real(1.0) / own.variable_scratch[pivot]
        for entry in range(lane, n * n, wp.block_dim()):
            i = entry / n
            j = entry - i * n
            if i == pivot and j == pivot:
                own.inverse[i, j] = -scale
            elif i == pivot:
                own.inverse[i, j] = scale * own.variable_scratch[j]
            elif j == pivot:
                own.inverse[i, j] = scale * own.variable_scratch[i]
            else:
                own.inverse[i, j] = own.inverse[i, j] - scale * own.variable_scratch[i] * own.variable_scratch[j]
    sync_block()


@wp.func
def iterate(lane: int, own: Scaled):
    """Run one iteration. It computes the step to the next x' instead of x' itself, so that the rounding of the inverse
    shrinks with the residuals."""
    n = own.variables
    m = own.row_count
    for i in range(lane, m, wp.block_dim()):
        own.row_scratch[i] = own.y[i] + own.rho[i] * (own.row_values[i] - own.z[i])
    sync_block()
    for j in range(lane, n, wp.block_dim()):
        own.variable_scratch[j] = (
            own.q[j] + product(own.P, own.P, j, own.x, n) + product(own.columns, own.rows, j, own.row_scratch, m)
        )
    sync_block()
    for j in range(lane, n, wp.block_dim()):
        own.step[j] = product(own.inverse, own.inverse, j, own.variable_scratch, n)
    sync_block()
    for j in range(lane, n, wp.block_dim()):
        own.x[j] = own.x[j] + _ALPHA * own.step[j]
    for i in range(lane, m, wp.block_dim()):
        row_step = product(own.rows, own.columns, i, own.step, n)
        target = _ALPHA * (own.row_values[i] + row_step) + (real(1.0) - _ALPHA) * own.z[i] + own.y[i] / own.rho[i]
        own.row_values[i] = own.row_values[i] + _ALPHA * row_step
        own.z[i] = wp.min(wp.max(target, own.lower[i]), own.upper[i])
        multiplier = own.rho[i] * (target - own.z[i])
        own.change[i] = multiplier - own.y[i]
        own.y[i] = multiplier
    sync_block()


@wp.func
def residuals(lane: int, cost: real, own: Scaled):
    """Compute the residuals of the optimality conditions and the duality gap."""
    n = own.variables
    m = own.row_count
    primal = real(0.0)
    primal_size = real(0.0)
    scaled_primal = real(0.0)
    scaled_primal_size = real(0.0)
    support = real(0.0)
    for i in range(lane, m, wp.block_dim()):
        # Recompute A' x': the iterations accumulate rounding in it.
        row_values = product(own.rows, own.columns, i, own.x, n)
        own.row_values[i] = row_values
        size = wp.max(wp.abs(row_values), wp.abs(own.z[i]))
        residual = wp.abs(row_values - own.z[i])
        scaled_primal = wp.max(scaled_primal, residual)
        scaled_primal_size = wp.max(scaled_primal_size, size)
        primal = wp.max(primal, residual / own.row_scale[i])
        primal_size = wp.max(primal_size, size / own.row_scale[i])
        # The multiplier of an infinite bound is exactly zero.
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
        Px = product(own.P, own.P, j, own.x, n)
        Aty = product(own.columns, own.rows, j, own.y, m)
        square += own.x[j] * Px
        linear += own.x[j] * own.q[j]
        size = wp.max(wp.max(wp.abs(Px), wp.abs(Aty)), wp.abs(own.q[j]))
        residual = wp.abs(Px + own.q[j] + Aty)
        scaled_dual = wp.max(scaled_dual, residual)
        scaled_dual_size = wp.max(scaled_dual_size, size)
        dual = wp.max(dual, residual / own.column_scale[j])
        dual_size = wp.max(dual_size, size / own.column_scale[j])
    result = Residuals()
    result.primal = block_max(primal)
    result.primal_size = block_max(primal_size)
    result.dual = block_max(dual) / cost
    result.dual_size = block_max(dual_size) / cost
    square = sum_of_block(square)
    linear = sum_of_block(linear)
    support = sum_of_block(support)
    result.gap = wp.abs(square + linear + support) / cost
    result.gap_size = wp.max(wp.max(wp.abs(square), wp.abs(linear)), wp.abs(support)) / cost
    primal_part = block_max(scaled_primal) / (block_max(scaled_primal_size) + _TINY)
    dual_part = block_max(scaled_dual) / (block_max(scaled_dual_size) + _TINY)
    result.ratio = primal_part / (dual_part + _TINY)
    return result


@wp.func
def is_within(result: Residuals, accuracy: real):
    """Return True if all residuals are at most ``accuracy``, absolute plus relative to their terms."""
    return (
        result.primal <= accuracy * (real(1.0) + result.primal_size)
        and result.dual <= accuracy * (real(1.0) + result.dual_size)
        and result.gap <= accuracy * (real(1.0) + result.gap_size)
    )


@wp.func
def is_infeasible(lane: int, accuracy: real, own: Scaled):
    """Return True if the last change d of the multipliers certifies that no point satisfies the bounds: A^T d = 0 and
    u^T d+ + l^T d- < 0."""
    norm = real(0.0)
    support = real(0.0)
    for i in range(lane, own.row_count, wp.block_dim()):
        change = own.change[i]
        # An infinite bound has no multiplier.
        if own.upper[i] == real(wp.inf):
            change = wp.min(change, real(0.0))
        if own.lower[i] == real(-wp.inf):
            change = wp.max(change, real(0.0))
        own.row_scratch[i] = change
        norm = wp.max(norm, own.row_scale[i] * wp.abs(change))
        if change > real(0.0):
            support += own.upper[i] * change
        elif change < real(0.0):
            support += own.lower[i] * change
    norm = block_max(norm)
    support = sum_of_block(support)
    dual_residual = real(0.0)
    for j in range(lane, own.variables, wp.block_dim()):
        dual_residual = wp.max(
            dual_residual,
            wp.abs(product(own.columns, own.rows, j, own.row_scratch, own.row_count)) / own.column_scale[j],
        )
    dual_residual = block_max(dual_residual)
    return norm > _TINY and support < real(0.0) and dual_residual <= accuracy * norm


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
    iteration_counts: wp.array[int],
):
    """Solve each program from ``iterates``, which hold the last iterates on return. One block per program.

    Args:
        programs: k programs.
        accuracy: absolute and relative tolerance of the residuals.
        iterations: maximum number of iterations.
        passes: equilibration passes.
        adapt: iterations between two updates of rho, a multiple of ``CHECK``.
        memory: scratch.
        iterates: x, multipliers and rho.
        ended: (k,) status.
        iteration_counts: (k,) number of iterations.
    """
    program = wp.tid() / wp.block_dim()
    lane = wp.tid() - program * wp.block_dim()
    own = program_view(program, programs, memory)
    n = own.variables
    m = own.row_count
    cost = equilibrate(lane, programs.P[program], programs.q[program], programs.A[program], passes, own)
    write_scaled(lane, programs.P[program], programs.q[program], programs.A[program], cost, own)
    for j in range(lane, n, wp.block_dim()):
        own.x[j] = iterates.x[program, j] / own.column_scale[j]
    sync_block()
    for i in range(lane, m, wp.block_dim()):
        own.lower[i] = own.row_scale[i] * programs.lower[program, i]
        own.upper[i] = own.row_scale[i] * programs.upper[program, i]
        own.y[i] = cost * iterates.y[program, i] / own.row_scale[i]
        own.row_values[i] = product(own.rows, own.columns, i, own.x, n)
        own.z[i] = own.row_values[i]
    rho = iterates.rho[program]
    invert(lane, rho, own)
    status = int(LIMIT)
    iteration = int(0)
    while iteration < iterations:
        iterate(lane, own)
        iteration += 1
        if iteration % CHECK == 0 or iteration == iterations:
            result = residuals(lane, cost, own)
            if is_within(result, accuracy):
                status = SOLVED
                break
            if is_infeasible(lane, _CERTIFICATE_TOLERANCE, own):
                status = INFEASIBLE
                break
            if iteration == iterations:
                if is_within(result, _LOOSE_FACTOR * accuracy):
                    status = INEXACT
                elif is_infeasible(lane, _LOOSE_FACTOR * _CERTIFICATE_TOLERANCE, own):
                    status = INFEASIBLE_INEXACT
            elif iteration % adapt == 0:
                better = wp.min(wp.max(rho * wp.sqrt(result.ratio), _MIN_RHO), _MAX_RHO)
                if better > _RHO_UPDATE_FACTOR * rho or _RHO_UPDATE_FACTOR * better < rho:
                    rho = better
                    invert(lane, rho, own)
    for j in range(lane, n, wp.block_dim()):
        iterates.x[program, j] = own.column_scale[j] * own.x[j]
    for i in range(lane, m, wp.block_dim()):
        iterates.y[program, i] = own.row_scale[i] * own.y[i] / cost
    if lane == 0:
        iterates.rho[program] = rho
        ended[program] = status
        iteration_counts[program] = iteration
