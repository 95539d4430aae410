"""Optimum of a step's QP without complementarity of the contacts, with one thread block on a GPU or one thread on a
CPU.

On the host, ``contact_modes.solve_relaxed`` computes the same optimum. See docs/concepts/locomotion.md.
"""

import warp as wp

from egs_warp.kernels.block import sum_of_block, sync_block
from egs_warp.kernels.locomotion.active_set import (
    NUMERICAL_FAILURE,
    OPTIMUM_FOUND,
    ActiveSet,
    UnitConstraints,
    find_optimum,
    is_cancelled,
)
from egs_warp.kernels.locomotion.block_algebra import (
    apply_factor,
    gemm_add,
    lane_of_block,
    multiply,
    multiply_at,
    normalize_rows,
)
from egs_warp.kernels.locomotion.block_elimination import inverse_cholesky
from egs_warp.kernels.locomotion.mode_region import (
    BOUND_PADDING,
    CONE_FACES,
    COSINES,
    DELASSUS_REGULARIZATION,
    ROW_TOLERANCE,
    SINES,
    Program,
)
from egs_warp.kernels.locomotion.mode_search import BLOCK, HEADER_SIZE, INFEASIBLE_COST, crash_start, unpack_program
from egs_warp.kernels.locomotion.splitting import Splitting, iterate
from egs_warp.kernels.locomotion.step_program import assemble_contact
from egs_warp.precision import Vec3, real

wp.set_module_options({"enable_backward": False})

_HEADER, _ROWS_PER_FORCE = wp.constant(HEADER_SIZE), wp.constant(1 + CONE_FACES)
_REGULARIZATION = wp.constant(real(DELASSUS_REGULARIZATION))


@wp.struct
class Relaxed:
    """Scratch memory for at most N = m + 3n unknowns: m activations and the forces of n contacts.

    The QP has k = m + 10n rows: the n normal contact velocities, the m activations, and nine cone components of each
    contact force (``cone_component``).
    """

    cost: wp.array2d[real]
    """(N, N) Hessian of the cost."""
    root: wp.array2d[real]
    """(N, N) upper triangular U with Hessian^-1 = U U^T."""
    leaving: wp.array2d[real]
    """(n, N) rows that give the normal contact velocities."""
    minimum: wp.array[real]
    """(N,) unconstrained minimum."""
    optimum: wp.array[real]
    """(N,) optimum."""
    slope: wp.array[real]
    """(N,) linear term of the objective."""
    values: wp.array[real]
    """(N,) scratch memory."""
    speeds: wp.array[real]
    """(n,) normal contact velocities."""
    lengths: wp.array[real]
    """(k,) lengths of the rows before scaling."""
    bounds: wp.array2d[real]
    """(2, k) lower and upper bounds before scaling."""


@wp.func
def cone_component(friction: real, part: int):
    """Return the coefficients of one component of a contact force that must not be negative: the normal force for
    ``part`` 0, otherwise the distance to face ``part`` - 1 of the friction pyramid."""
    if part == 0:
        return wp.vec3d(real(1.0), real(0.0), real(0.0))
    return wp.vec3d(friction, -COSINES[part - 1], -SINES[part - 1])


@wp.func
def diagonal_shift(program: Program):
    """Return the regularisation that is added to the diagonal of the Hessian."""
    mean = real(0.0)
    for i in range(lane_of_block(), program.size, wp.block_dim()):
        mean += program.packed[program.cost + i * (program.size + 1)] / real(program.size)
    mean = sum_of_block(mean)
    sync_block()
    return _REGULARIZATION * mean


@wp.func
def write_root(program: Program, relaxed: Relaxed, shift: real):
    """Compute ``relaxed.root`` of the Hessian with ``shift`` added to its diagonal, and the unconstrained minimum.

    Returns: decrease of the objective from zero to the minimum, at least 1; -1 if the Hessian is not positive definite.
    """
    lane = lane_of_block()
    size = program.size
    for e in range(lane, size * size, wp.block_dim()):
        value = program.packed[program.cost + e]
        if e % (size + 1) == 0:
            value += shift
        relaxed.cost[e / size, e % size] = value
    for i in range(lane, size, wp.block_dim()):
        relaxed.slope[i] = program.packed[program.slope + i]
    sync_block()
    if inverse_cholesky(relaxed.cost, size, relaxed.root) == 0:
        return real(-1.0)
    apply_factor(relaxed.root, size, relaxed.slope, relaxed.values, relaxed.minimum)
    objective_drop = real(0.0)
    for i in range(lane, size, wp.block_dim()):
        relaxed.minimum[i] = -relaxed.minimum[i]
        objective_drop -= real(0.5) * relaxed.slope[i] * relaxed.minimum[i]
    objective_drop = wp.max(sum_of_block(objective_drop), real(1.0))
    sync_block()
    return objective_drop


@wp.func
def normal_velocities(program: Program, relaxed: Relaxed, point: wp.array[real]):
    """Compute the normal contact velocities ``relaxed.speeds`` at ``point`` (N,), without their constants."""
    multiply(relaxed.leaving, program.n, program.size, point, relaxed.speeds)


@wp.func
def row_value(program: Program, relaxed: Relaxed, row: int, point: wp.array[real]):
    """Return the value of ``row`` at ``point``, without its constant; ``normal_velocities`` must have been called for
    the same point."""
    if row < program.n:
        return relaxed.speeds[row]
    k = row - program.n
    if k < program.m:
        return point[k]
    k -= program.m
    coefficients = cone_component(program.friction, k % _ROWS_PER_FORCE)
    value = real(0.0)
    for t in range(3):
        value += coefficients[t] * point[program.m + 3 * (k / _ROWS_PER_FORCE) + t]
    return value


@wp.func
def write_rows(program: Program, relaxed: Relaxed, rows: UnitConstraints, initial_values: wp.array[real]):
    """Write all rows in whitened coordinates, scaled to length 1, and their bounds, to ``rows``; ``initial_values``
    becomes zero."""
    lane = lane_of_block()
    m = program.m
    n = program.n
    size = program.size
    for e in range(lane, n * size, wp.block_dim()):
        relaxed.leaving[e / size, e % size] = program.packed[program.rows + 3 * (e / size) * size + e % size]
        rows.units[e / size, e % size] = real(0.0)
    sync_block()
    gemm_add(rows.units, relaxed.leaving, relaxed.root, n, size, size, 0)
    for e in range(lane, size * size, wp.block_dim()):
        rows.units[n + e / size, e % size] = relaxed.root[e / size, e % size]
    for row in range(lane, rows.count, wp.block_dim()):
        part = row
        coefficients = wp.vec3d(real(1.0), real(0.0), real(0.0))
        k = row - n - m
        if k >= 0:
            part = n + m + 3 * (k / _ROWS_PER_FORCE)
            coefficients = cone_component(program.friction, k % _ROWS_PER_FORCE)
        for t in range(3):
            rows.base_rows[row, t] = wp.where(k >= 0, part + t, part)
            rows.coefficients[row, t] = coefficients[t]
    sync_block()
    normalize_rows(rows.units, size, rows.base_rows, rows.coefficients, rows.count, relaxed.lengths)
    normal_velocities(program, relaxed, relaxed.minimum)
    for row in range(lane, rows.count, wp.block_dim()):
        lower = real(0.0)
        upper = real(wp.inf)
        if row < n:
            lower = -program.packed[program.offset + 3 * row]
        elif row < n + m:
            lower = program.packed[program.lower + row - n]
            upper = program.packed[program.upper + row - n]
        relaxed.bounds[0, row] = lower - BOUND_PADDING
        relaxed.bounds[1, row] = upper + BOUND_PADDING
        length = relaxed.lengths[row]
        rows.values_at_origin[row] = row_value(program, relaxed, row, relaxed.minimum) / length
        rows.lower[row] = relaxed.bounds[0, row] / length
        rows.upper[row] = relaxed.bounds[1, row] / length
        rows.slack[row] = ROW_TOLERANCE * wp.max(real(1.0), length) / length
        initial_values[row] = real(0.0)
    sync_block()


@wp.func
def count_violations(program: Program, relaxed: Relaxed, count: int):
    """Return the number of rows that the point ``relaxed.optimum`` violates."""
    normal_velocities(program, relaxed, relaxed.optimum)
    violations = real(0.0)
    for row in range(lane_of_block(), count, wp.block_dim()):
        at = row_value(program, relaxed, row, relaxed.optimum)
        slack = real(10.0) * ROW_TOLERANCE * wp.max(real(1.0), relaxed.lengths[row])
        if not (at > relaxed.bounds[0, row] - slack and at < relaxed.bounds[1, row] + slack):
            violations += real(1.0)
    violations = sum_of_block(violations)
    sync_block()
    return int(violations)


@wp.func
def objective_at(program: Program, relaxed: Relaxed, shift: real):
    """Return the objective at ``relaxed.optimum``, with ``shift`` added to the diagonal of the Hessian."""
    size = program.size
    multiply_at(program.packed, program.cost, size, size, size, relaxed.optimum, relaxed.values)
    total = real(0.0)
    for k in range(lane_of_block(), size, wp.block_dim()):
        at = relaxed.optimum[k]
        total += at * (real(0.5) * (relaxed.values[k] + shift * at) + relaxed.slope[k])
    total = sum_of_block(total)
    sync_block()
    return total + program.constant


@wp.func
def relax(
    packed: wp.array[real],
    relaxed: Relaxed,
    rows: UnitConstraints,
    state: ActiveSet,
    splitting: Splitting,
    answer: wp.array[real],
):
    """Run the solve of ``contact_modes.solve_relaxed`` in one world; arguments as in ``relaxed_qp_kernel``."""
    lane = lane_of_block()
    program = unpack_program(packed)
    size = program.size
    shift = diagonal_shift(program)
    objective_drop = write_root(program, relaxed, shift)
    ended = NUMERICAL_FAILURE
    if objective_drop > real(0.0) and not is_cancelled(rows):
        rows.unknowns = size
        rows.count = program.m + (1 + _ROWS_PER_FORCE) * program.n
        rows.base_count = program.n + size
        rows.cost_limit = INFEASIBLE_COST * objective_drop
        rows.orthogonalizations = 1
        write_rows(program, relaxed, rows, splitting.initial_values)
        ended = OPTIMUM_FOUND
        for k in range(lane, size, wp.block_dim()):
            relaxed.optimum[k] = real(0.0)
        sync_block()
        if crash_start(rows, state) > 0:
            iterate(rows, state, splitting)
            ended = find_optimum(rows, state)
            multiply(relaxed.root, size, size, state.z, relaxed.optimum)
        for k in range(lane, size, wp.block_dim()):
            relaxed.optimum[k] = relaxed.optimum[k] + relaxed.minimum[k]
        sync_block()
    if ended == OPTIMUM_FOUND:
        if count_violations(program, relaxed, rows.count) > 0:
            ended = NUMERICAL_FAILURE
        objective = objective_at(program, relaxed, shift)
        for k in range(lane, program.m, wp.block_dim()):
            answer[_HEADER + k] = wp.clamp(relaxed.optimum[k], packed[program.lower + k], packed[program.upper + k])
        if lane == 0:
            answer[1] = objective
    if lane == 0:
        answer[0] = real(ended)


@wp.kernel(launch_bounds=BLOCK)
def relaxed_qp_kernel(
    # In:
    packed: wp.array2d[real],
    # Scratch:
    relaxed: wp.array[Relaxed],
    rows: wp.array[UnitConstraints],
    states: wp.array[ActiveSet],
    splittings: wp.array[Splitting],
    # Out:
    answers: wp.array2d[real],
):
    """Run the solve of ``contact_modes.solve_relaxed`` on packed input, in B worlds with one thread block for each.

    The launch dimensions are (B, threads of a block).

    Args:
        packed: (B, ...) packed input of ``mode_search_kernel``.
        relaxed, rows, states, splittings: (B,) scratch memory of each world.
        answers: (B, ...) result of each world: status and objective; from ``HEADER_SIZE`` on, the activations (m,).
    """
    world, _ = wp.tid()
    relax(packed[world], relaxed[world], rows[world], states[world], splittings[world], answers[world])


@wp.kernel
def pack_search_kernel(
    # Model:
    weight: real,
    # In:
    activations: wp.array2d[real],
    forces: wp.array2d[Vec3],
    is_settled: wp.array[int],
    # Out:
    packed_out: wp.array2d[real],
):
    """Replace the start of the packed search in each world; where ``is_settled``, disable the search.

    The launch dimensions are (B, m + K).

    Args:
        weight: body weight, N.
        activations: (B, m) activations at the new start.
        forces: (B, K) N, contact forces for these activations.
        is_settled: (B,) nonzero to set the maximum number of QPs to 0.
        packed_out: (B, ...) packed input of ``mode_search_kernel``.
    """
    world, k = wp.tid()
    packed = packed_out[world]
    if k == 0 and is_settled[world] != 0:
        packed[4] = real(0.0)
    program = unpack_program(packed)
    begin = program.upper + program.m
    kinds = begin + program.m
    if k < program.m:
        packed[begin + k] = activations[world, k]
    if k < program.n:
        assemble_contact(packed, kinds, kinds + program.n, k, forces[world, k] / weight, program.friction)
