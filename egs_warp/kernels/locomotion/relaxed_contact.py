"""The optimum of a step's program without complementarity: a block of threads on a GPU, one thread on a CPU.

What ``contact_pieces.solve_relaxed`` does on a host: see there, and docs/concepts/locomotion.md.
"""

import warp as wp

from egs_warp.kernels.block import sum_of_block, sync_block
from egs_warp.kernels.locomotion.active_set import FOUND, NUMERICAL_FAILURE
from egs_warp.kernels.locomotion.block_active_set import ActiveSet, UnitConstraints, find_optimum, is_cancelled
from egs_warp.kernels.locomotion.block_algebra import (
    apply_factor,
    gemm_add,
    lane_of_block,
    multiply,
    multiply_at,
    normalize_rows,
)
from egs_warp.kernels.locomotion.block_elimination import inverse_cholesky
from egs_warp.kernels.locomotion.block_mode_region import BOUND_PADDING, COSINES, ROW_TOLERANCE, SINES, Program
from egs_warp.kernels.locomotion.block_splitting import Splitting, iterate
from egs_warp.kernels.locomotion.mode_region import CONE_FACES, DELASSUS_REGULARIZATION
from egs_warp.kernels.locomotion.mode_search import BLOCK, HEADER_SIZE, INFEASIBLE_COST, crash_start, unpack_program
from egs_warp.kernels.locomotion.step_program import assemble_contact
from egs_warp.precision import Vec3, real

wp.set_module_options({"enable_backward": False})

_HEADER, _OF_FORCES = wp.constant(HEADER_SIZE), wp.constant(1 + CONE_FACES)
_SINGULAR = wp.constant(real(DELASSUS_REGULARIZATION))


@wp.struct
class Relaxed:
    """Scratch memory for N = m + 3n unknowns, m activations and the forces of n contacts, at most. Of k = m + 10n rows
    the first n are how fast contacts leave the ground, the next m the activations, then come the forces."""

    cost: wp.array2d[real]
    """(N, N)."""
    root: wp.array2d[real]
    """(N, N) of its inverse."""
    leaving: wp.array2d[real]
    """(n, N) the first rows."""
    minimum: wp.array[real]
    found: wp.array[real]
    slope: wp.array[real]
    values: wp.array[real]
    """(N,)."""
    speeds: wp.array[real]
    """(n,)."""
    lengths: wp.array[real]
    """(k,)."""
    bounds: wp.array2d[real]
    """(2, k)."""


@wp.func
def cone_component(friction: real, part: int):
    """Of a force, what is not negative: the normal one, or what a face around the cone leaves."""
    if part == 0:
        return wp.vec3d(real(1.0), real(0.0), real(0.0))
    return wp.vec3d(friction, -COSINES[part - 1], -SINES[part - 1])


@wp.func
def diagonal_shift(program: Program):
    """What is added to the diagonal of the cost."""
    mean = real(0.0)
    for i in range(lane_of_block(), program.size, wp.block_dim()):
        mean += program.packed[program.cost + i * (program.size + 1)] / real(program.size)
    mean = sum_of_block(mean)
    sync_block()
    return _SINGULAR * mean


@wp.func
def write_root(program: Program, relaxed: Relaxed, added: real):
    """Of the cost with so much ``added`` to its diagonal, and its minimum; by how much that is lower, -1 where there is
    no root."""
    lane = lane_of_block()
    size = program.size
    for e in range(lane, size * size, wp.block_dim()):
        value = program.packed[program.cost + e]
        if e % (size + 1) == 0:
            value += added
        relaxed.cost[e / size, e % size] = value
    for i in range(lane, size, wp.block_dim()):
        relaxed.slope[i] = program.packed[program.slope + i]
    sync_block()
    if inverse_cholesky(relaxed.cost, size, relaxed.root) == 0:
        return real(-1.0)
    apply_factor(relaxed.root, size, relaxed.slope, relaxed.values, relaxed.minimum)
    worth = real(0.0)
    for i in range(lane, size, wp.block_dim()):
        relaxed.minimum[i] = -relaxed.minimum[i]
        worth -= real(0.5) * relaxed.slope[i] * relaxed.minimum[i]
    worth = wp.max(sum_of_block(worth), real(1.0))
    sync_block()
    return worth


@wp.func
def normal_velocities(program: Program, relaxed: Relaxed, point: wp.array[real]):
    """How fast contacts leave the ground at the ``point``, but for the program's ``offset``."""
    multiply(relaxed.leaving, program.n, program.size, point, relaxed.speeds)


@wp.func
def row_value(program: Program, relaxed: Relaxed, row: int, point: wp.array[real]):
    """What a row is at the ``point``, whose speeds were seen last."""
    if row < program.n:
        return relaxed.speeds[row]
    k = row - program.n
    if k < program.m:
        return point[k]
    k -= program.m
    share = cone_component(program.friction, k % _OF_FORCES)
    value = real(0.0)
    for t in range(3):
        value += share[t] * point[program.m + 3 * (k / _OF_FORCES) + t]
    return value


@wp.func
def write_rows(program: Program, relaxed: Relaxed, rows: UnitConstraints, begun: wp.array[real]):
    """In coordinates whose squares are costs, from whose origin the search begins."""
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
        share = wp.vec3d(real(1.0), real(0.0), real(0.0))
        k = row - n - m
        if k >= 0:
            part = n + m + 3 * (k / _OF_FORCES)
            share = cone_component(program.friction, k % _OF_FORCES)
        for t in range(3):
            rows.base_rows[row, t] = wp.where(k >= 0, part + t, part)
            rows.coefficients[row, t] = share[t]
    sync_block()
    normalize_rows(rows.units, size, rows.base_rows, rows.coefficients, rows.count, relaxed.lengths)
    normal_velocities(program, relaxed, relaxed.minimum)
    for row in range(lane, rows.count, wp.block_dim()):
        least = real(0.0)
        most = real(wp.inf)
        if row < n:
            least = -program.packed[program.offset + 3 * row]
        elif row < n + m:
            least = program.packed[program.lower + row - n]
            most = program.packed[program.upper + row - n]
        relaxed.bounds[0, row] = least - BOUND_PADDING
        relaxed.bounds[1, row] = most + BOUND_PADDING
        length = relaxed.lengths[row]
        rows.values_at_origin[row] = row_value(program, relaxed, row, relaxed.minimum) / length
        rows.lower[row] = relaxed.bounds[0, row] / length
        rows.upper[row] = relaxed.bounds[1, row] / length
        rows.slack[row] = ROW_TOLERANCE * wp.max(real(1.0), length) / length
        begun[row] = real(0.0)
    sync_block()


@wp.func
def count_violations(program: Program, relaxed: Relaxed, count: int):
    """How many rows the point that was found breaks."""
    normal_velocities(program, relaxed, relaxed.found)
    missed = real(0.0)
    for row in range(lane_of_block(), count, wp.block_dim()):
        at = row_value(program, relaxed, row, relaxed.found)
        slack = real(10.0) * ROW_TOLERANCE * wp.max(real(1.0), relaxed.lengths[row])
        if not (at > relaxed.bounds[0, row] - slack and at < relaxed.bounds[1, row] + slack):
            missed += real(1.0)
    missed = sum_of_block(missed)
    sync_block()
    return int(missed)


@wp.func
def objective_at(program: Program, relaxed: Relaxed, added: real):
    """What the point that was found costs."""
    size = program.size
    multiply_at(program.packed, program.cost, size, size, size, relaxed.found, relaxed.values)
    total = real(0.0)
    for k in range(lane_of_block(), size, wp.block_dim()):
        at = relaxed.found[k]
        total += at * (real(0.5) * (relaxed.values[k] + added * at) + relaxed.slope[k])
    total = sum_of_block(total)
    sync_block()
    return total + program.constant


@wp.kernel(launch_bounds=BLOCK)
def relaxed_qp_kernel(
    # In:
    told: wp.array[real],
    # Scratch:
    relaxed: Relaxed,
    rows: UnitConstraints,
    holding: ActiveSet,
    splitting: Splitting,
    # Out:
    answer: wp.array[real],
):
    """``solve_relaxed`` of what is ``told``, as ``search_kernel`` reads it. ``answer``: how it ended, the objective;
    from ``HEADER`` on the activations (m,)."""
    lane = lane_of_block()
    program = unpack_program(told)
    size = program.size
    added = diagonal_shift(program)
    worth = write_root(program, relaxed, added)
    ended = NUMERICAL_FAILURE
    if worth > real(0.0) and not is_cancelled(rows):
        rows.unknowns = size
        rows.count = program.m + (1 + _OF_FORCES) * program.n
        rows.base_count = program.n + size
        rows.cost_limit = INFEASIBLE_COST * worth
        write_rows(program, relaxed, rows, splitting.initial_values)
        ended = FOUND
        for k in range(lane, size, wp.block_dim()):
            relaxed.found[k] = real(0.0)
        sync_block()
        if crash_start(rows, holding) > 0:
            iterate(rows, holding, splitting)
            ended = find_optimum(rows, holding)
            multiply(relaxed.root, size, size, holding.z, relaxed.found)
        for k in range(lane, size, wp.block_dim()):
            relaxed.found[k] = relaxed.found[k] + relaxed.minimum[k]
        sync_block()
    if ended == FOUND:
        if count_violations(program, relaxed, rows.count) > 0:
            ended = NUMERICAL_FAILURE
        objective = objective_at(program, relaxed, added)
        for k in range(lane, program.m, wp.block_dim()):
            answer[_HEADER + k] = wp.clamp(relaxed.found[k], told[program.lower + k], told[program.upper + k])
        if lane == 0:
            answer[1] = objective
    if lane == 0:
        answer[0] = real(ended)


@wp.kernel
def pack_search_kernel(
    # Model:
    weight: real,
    # In:
    activations: wp.array[real],
    forces: wp.array[Vec3],
    settled: wp.array[int],
    # Out:
    told_out: wp.array[real],
):
    """A search from these ``activations`` (m,), to which contact answers ``forces`` (K,) newtons, in place of the one
    that was told, or none if that is ``settled`` (1,); ``weight`` is newtons. m + K threads."""
    k = wp.tid()
    if k == 0 and settled[0] != 0:
        told_out[4] = real(0.0)
    program = unpack_program(told_out)
    begin = program.upper + program.m
    kinds = begin + program.m
    if k < program.m:
        told_out[begin + k] = activations[k]
    if k < program.n:
        assemble_contact(told_out, kinds, kinds + program.n, k, forces[k] / weight, program.friction)
