"""Search over contact modes in a single launch, with one thread block on a GPU or one thread on a CPU.

On the host, ``contact_modes.search_modes`` is the same search. See docs/concepts/locomotion.md.
"""

import warp as wp

from egs_warp.kernels.block import sum_of_block, sync_block
from egs_warp.kernels.locomotion.active_set import (
    INFEASIBLE,
    NUMERICAL_FAILURE,
    OPTIMUM_FOUND,
    ActiveSet,
    UnitConstraints,
    find_optimum,
)
from egs_warp.kernels.locomotion.block_algebra import (
    apply_factor,
    argmax_of_block,
    lane_of_block,
    multiply,
    multiply_at,
)
from egs_warp.kernels.locomotion.block_elimination import inverse_cholesky
from egs_warp.kernels.locomotion.mode_region import (
    CURRENT,
    FREE,
    MIN_GAIN_FRACTION,
    MIN_MULTIPLIER,
    NEXT,
    NEXT_SINGLE,
    ROW_TOLERANCE,
    SLIDE,
    STICK,
    TO_FREE,
    TO_SLIDE,
    WARM_START,
    ZERO_SPEED,
    Program,
    Workspace,
    count_of,
    list_contact_rows,
    row_value,
    solve_force_map,
    write_cost,
    write_rows,
    write_speeds,
)
from egs_warp.kernels.locomotion.splitting import Splitting, iterate
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

BLOCK = 512
"""Number of threads of the block on a GPU."""
HEADER_SIZE = 8
"""Number of entries of the header before the QP in the packed input, and before the point in the packed result."""

_FREE, _STICK, _SLIDE = wp.constant(FREE), wp.constant(STICK), wp.constant(SLIDE)
_TO_FREE, _TO_SLIDE = wp.constant(TO_FREE), wp.constant(TO_SLIDE)
_CURRENT, _NEXT = wp.constant(CURRENT), wp.constant(NEXT)
_NEXT_SINGLE, _WARM_START = wp.constant(NEXT_SINGLE), wp.constant(WARM_START)
_HEADER = wp.constant(HEADER_SIZE)
INFEASIBLE_COST = wp.constant(real(1e6))
"""Cost above which a QP is treated as infeasible, relative to the decrease of the objective from the origin to the
unconstrained minimum. The host uses the same value."""
_ACTIVE, _GAIN, _ZERO_SPEED = (wp.constant(real(each)) for each in (MIN_MULTIPLIER, MIN_GAIN_FRACTION, ZERO_SPEED))


@wp.func
def crash_start(rows: UnitConstraints, state: ActiveSet):
    """Activate the rows that the unconstrained minimum violates, and return their number."""
    activated = real(0.0)
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        side = int(0)
        if rows.values_at_origin[row] < rows.lower[row]:
            side = 1
        elif rows.values_at_origin[row] > rows.upper[row]:
            side = -1
        state.side[row] = side
        if side != 0:
            activated += real(1.0)
    activated = sum_of_block(activated)
    sync_block()
    return int(activated)


@wp.func
def count_violations(program: Program, workspace: Workspace, map_rows: int, mode_rows: int):
    """Return the number of rows that ``workspace.optimum`` violates, the activation bounds included."""
    m = program.m
    multiply(workspace.force_map, map_rows, m, workspace.optimum, workspace.at_optimum)
    violations = real(0.0)
    for row in range(lane_of_block(), m + mode_rows, wp.block_dim()):
        at = real(0.0)
        if row < m:
            at = workspace.optimum[row]
        else:
            at = row_value(workspace, row - m, workspace.at_optimum)
        slack = real(10.0) * ROW_TOLERANCE * wp.max(real(1.0), workspace.lengths[row])
        if not (at > workspace.bounds[0, row] - slack and at < workspace.bounds[1, row] + slack):
            violations += real(1.0)
    violations = sum_of_block(violations)
    sync_block()
    return int(violations)


@wp.func
def scatter_optimum(program: Program, workspace: Workspace, closed_count: int):
    """Write the optimal activations, clamped to their bounds, and the contact forces for them to ``workspace.trial``.
    Return the objective at this point."""
    lane = lane_of_block()
    m = program.m
    for k in range(lane, program.size, wp.block_dim()):
        value = real(0.0)
        if k < m:
            value = wp.clamp(workspace.optimum[k], program.packed[program.lower + k], program.packed[program.upper + k])
        workspace.trial[k] = value
    sync_block()
    multiply(workspace.force_map, closed_count, m, workspace.trial, workspace.at_optimum)
    for g in range(lane, closed_count, wp.block_dim()):
        workspace.trial[m + workspace.closed_forces[g]] = workspace.at_optimum[g] + workspace.force_map[g, m]
    sync_block()
    size = program.size
    multiply_at(program.packed, program.cost, size, size, size, workspace.trial, workspace.values)
    total = real(0.0)
    for k in range(lane, size, wp.block_dim()):
        total += workspace.trial[k] * (real(0.5) * workspace.values[k] + program.packed[program.slope + k])
    total = sum_of_block(total)
    sync_block()
    return total + program.constant


@wp.func
def normalized(first: real, second: real):
    """Return the unit vector along (``first``, ``second``), or the first axis for a zero vector."""
    length = wp.sqrt(first * first + second * second)
    if length > real(0.0):
        return wp.vec2d(first / length, second / length)
    return wp.vec2d(real(1.0), real(0.0))


@wp.func
def apply_transition(program: Program, workspace: Workspace, contact: int, transition: int, which: int):
    """Apply ``transition`` to the mode of ``contact`` in slot ``which``."""
    m = program.m
    if transition == _TO_FREE:
        workspace.kinds[which, contact] = _FREE
    elif transition == _TO_SLIDE:
        direction = normalized(-workspace.trial[m + 3 * contact + 1], -workspace.trial[m + 3 * contact + 2])
        workspace.kinds[which, contact] = _SLIDE
        workspace.slips[which, contact, 0] = direction[0]
        workspace.slips[which, contact, 1] = direction[1]
    else:
        first = workspace.values[3 * contact + 1]
        second = workspace.values[3 * contact + 2]
        if wp.sqrt(first * first + second * second) > _ZERO_SPEED:
            direction = normalized(first, second)
            workspace.kinds[which, contact] = _SLIDE
            workspace.slips[which, contact, 0] = direction[0]
            workspace.slips[which, contact, 1] = direction[1]
        else:
            workspace.kinds[which, contact] = _STICK


@wp.func
def find_next_modes(
    program: Program, workspace: Workspace, state: ActiveSet, active_count: int, mode_rows: int, objective: real
):
    """Write two candidates for the next modes, to the slots ``NEXT`` and ``NEXT_SINGLE``: the modes beyond all bounds
    with significant multipliers, and the modes beyond the one with the largest multiplier only.

    Returns: number of bounds with significant multipliers.
    """
    lane = lane_of_block()
    m = program.m
    multiply_at(
        program.packed, program.rows, program.size, 3 * program.n, program.size, workspace.trial, workspace.values
    )
    for k in range(lane, 3 * program.n, wp.block_dim()):
        workspace.values[k] = workspace.values[k] + program.packed[program.offset + k]
    for row in range(lane, mode_rows, wp.block_dim()):
        workspace.multipliers[row] = real(0.0)
    for i in range(lane, program.n, wp.block_dim()):
        for which in range(_NEXT, _WARM_START):
            workspace.kinds[which, i] = workspace.kinds[_CURRENT, i]
            workspace.slips[which, i, 0] = workspace.slips[_CURRENT, i, 0]
            workspace.slips[which, i, 1] = workspace.slips[_CURRENT, i, 1]
    sync_block()
    for i in range(lane, active_count, wp.block_dim()):
        row = state.active[i]
        if row >= m:
            workspace.multipliers[row - m] = state.multipliers[i] / workspace.lengths[row]
    sync_block()
    min_multiplier = _ACTIVE * wp.max(wp.abs(objective), real(1e-9))
    count = real(0.0)
    max_multiplier = real(0.0)
    place = int(-1)
    for row in range(lane, mode_rows, wp.block_dim()):
        if workspace.multipliers[row] > min_multiplier:
            count += real(1.0)
            if workspace.multipliers[row] > max_multiplier:
                max_multiplier = workspace.multipliers[row]
                place = row
    count = sum_of_block(count)
    strongest_row = argmax_of_block(max_multiplier, place)
    for i in range(lane, program.n, wp.block_dim()):
        # Among the rows of a contact, the one with the largest multiplier determines its transition.
        strongest = min_multiplier
        last = int(-1)
        row = workspace.first[i]
        while row >= 0:
            if workspace.multipliers[row] > min_multiplier and workspace.multipliers[row] >= strongest:
                strongest = workspace.multipliers[row]
                last = row
            row = workspace.next[row]
        if last >= 0:
            apply_transition(program, workspace, i, workspace.transition[last], _NEXT)
    if lane == 0 and count > real(0.0):
        row = int(strongest_row[1])
        apply_transition(program, workspace, workspace.contact[row], workspace.transition[row], _NEXT_SINGLE)
    sync_block()
    return int(count)


@wp.struct
class ModeRegionResult:
    """Result of ``solve_mode_region``."""

    ended: int
    """Status of the solve, ``OPTIMUM_FOUND``, ``INFEASIBLE`` or ``NUMERICAL_FAILURE``."""
    objective: real
    """Objective at the optimum."""
    active_count: int
    """Number of active mode rows with significant multipliers."""


@wp.func
def solve_mode_region(
    program: Program, workspace: Workspace, rows: UnitConstraints, state: ActiveSet, splitting: Splitting, first: int
):
    """Solve the QP of the region ``CURRENT``, entered from ``workspace.start``. ``first`` is 1 until a region has been
    solved."""
    lane = lane_of_block()
    m = program.m
    sticks = count_of(program, workspace, _STICK)
    slides = count_of(program, workspace, _SLIDE)
    frees = program.n - sticks - slides
    closed_count = 3 * (sticks + slides)
    speeds = 2 * slides + frees
    mode_rows = 9 * sticks + 3 * slides + frees
    map_rows = closed_count + speeds
    solved = ModeRegionResult()
    solved.ended = INFEASIBLE
    list_contact_rows(program, workspace, sticks, slides)
    if solve_force_map(program, workspace, closed_count, 3 * sticks + slides) == 0:
        solved.ended = NUMERICAL_FAILURE
        return solved
    write_cost(program, workspace, closed_count)
    write_speeds(program, workspace, closed_count, speeds)
    if inverse_cholesky(workspace.cost, m, workspace.root) == 0:
        solved.ended = NUMERICAL_FAILURE
        return solved
    apply_factor(workspace.root, m, workspace.slope, workspace.values, workspace.minimum)
    objective_drop = real(0.0)
    for c in range(lane, m, wp.block_dim()):
        workspace.minimum[c] = -workspace.minimum[c]
        objective_drop -= real(0.5) * workspace.slope[c] * workspace.minimum[c]
    objective_drop = wp.max(sum_of_block(objective_drop), real(1.0))
    sync_block()
    write_rows(program, workspace, rows, splitting.initial_values, map_rows, mode_rows)
    rows.unknowns = m
    rows.count = m + mode_rows
    rows.base_count = m + map_rows
    rows.cost_limit = INFEASIBLE_COST * objective_drop
    rows.orthogonalizations = 1
    active_count = int(0)
    solved.ended = OPTIMUM_FOUND
    if crash_start(rows, state) > 0:
        if first == 1:
            iterate(rows, state, splitting)
        solved.ended = find_optimum(rows, state)
        if solved.ended != OPTIMUM_FOUND:
            return solved
        multiply(workspace.root, m, m, state.z, workspace.optimum)
        active_rows = real(0.0)
        for row in range(lane, rows.count, wp.block_dim()):
            if state.side[row] != 0:
                active_rows += real(1.0)
        active_count = int(sum_of_block(active_rows))
    else:
        for c in range(lane, m, wp.block_dim()):
            workspace.optimum[c] = real(0.0)
    sync_block()
    for c in range(lane, m, wp.block_dim()):
        workspace.optimum[c] = workspace.optimum[c] + workspace.minimum[c]
    sync_block()
    violations = int(0)
    if active_count > 0:
        violations = count_violations(program, workspace, map_rows, mode_rows)
    if violations > 0:
        solved.ended = NUMERICAL_FAILURE
        return solved
    solved.objective = scatter_optimum(program, workspace, closed_count)
    solved.active_count = find_next_modes(program, workspace, state, active_count, mode_rows, solved.objective)
    return solved


@wp.func
def copy_modes(workspace: Workspace, n: int, source: int, target: int):
    """Copy the modes of ``n`` contacts and their slip directions from slot ``source`` to slot ``target``."""
    for i in range(lane_of_block(), n, wp.block_dim()):
        workspace.kinds[target, i] = workspace.kinds[source, i]
        for t in range(2):
            workspace.slips[target, i, t] = workspace.slips[source, i, t]
    sync_block()


@wp.func
def unpack_program(packed: wp.array[real]):
    """Return the ``Program`` of a packed input, with the offsets that follow from its header."""
    program = Program()
    program.packed = packed
    program.m = int(packed[0])
    program.n = int(packed[1])
    program.friction = packed[2]
    program.constant = packed[3]
    program.size = program.m + 3 * program.n
    program.cost = _HEADER
    program.slope = program.cost + program.size * program.size
    program.rows = program.slope + program.size
    program.offset = program.rows + 3 * program.n * program.size
    program.lower = program.offset + 3 * program.n
    program.upper = program.lower + program.m
    return program


@wp.func
def search(
    packed: wp.array[real],
    restart_cost: real,
    workspace: Workspace,
    rows: UnitConstraints,
    state: ActiveSet,
    splitting: Splitting,
    answer: wp.array[real],
    settled_out: wp.array[int],
):
    """Run the search of ``contact_modes.search_modes`` in one world; arguments as in ``mode_search_kernel``."""
    lane = lane_of_block()
    program = unpack_program(packed)
    m = program.m
    n = program.n
    begin = program.upper + m
    sliding = real(0.0)
    for k in range(lane, m, wp.block_dim()):
        workspace.start[k] = packed[begin + k]
    for i in range(lane, n, wp.block_dim()):
        kind = int(packed[begin + m + i])
        if kind == _SLIDE:
            sliding += real(1.0)
            kind = _STICK
        workspace.kinds[_CURRENT, i] = kind
        for t in range(2):
            workspace.slips[_CURRENT, i, t] = packed[begin + m + n + 2 * i + t]
    sliding = sum_of_block(sliding)
    sync_block()
    count = int(0)
    infeasible = int(0)
    has_point = int(0)
    has_several = int(0)
    is_single = int(0)
    best = real(wp.inf)
    ended = OPTIMUM_FOUND
    limit = int(packed[4])
    continues = int(1)
    while continues == 1 and count < limit:
        count += 1
        continues = 0
        solved = solve_mode_region(program, workspace, rows, state, splitting, 1 - has_point)
        if solved.ended == NUMERICAL_FAILURE:
            ended = NUMERICAL_FAILURE
        elif solved.ended == INFEASIBLE:
            infeasible += 1
            if has_point == 0 and infeasible == 1 and sliding > real(0.0):
                # The search began with sliding contacts set to stick. Retry with the original modes of the start.
                for i in range(lane, n, wp.block_dim()):
                    workspace.kinds[_CURRENT, i] = int(packed[begin + m + i])
                sync_block()
                continues = 1
        elif has_point == 1 and solved.objective >= best:
            # All transitions together raised the objective. The transition with the largest multiplier alone may still
            # lower it.
            if has_several == 1 and is_single == 0:
                copy_modes(workspace, n, _WARM_START, _CURRENT)
                is_single = 1
                continues = 1
        else:
            is_small_gain = has_point == 1 and best - solved.objective < _GAIN * wp.abs(best)
            has_point = 1
            best = solved.objective
            if lane == 0 and best < restart_cost:
                wp.atomic_max(settled_out, 0, 1)
            for k in range(lane, program.size, wp.block_dim()):
                answer[_HEADER + k] = workspace.trial[k]
                if k < m:
                    workspace.start[k] = workspace.trial[k]
            has_several = int(0)
            if solved.active_count > 1:
                has_several = 1
            is_single = 0
            copy_modes(workspace, n, _NEXT_SINGLE, _WARM_START)
            if solved.active_count > 0 and not is_small_gain:
                copy_modes(workspace, n, _NEXT, _CURRENT)
                continues = 1
    if lane == 0:
        answer[0] = real(ended)
        answer[1] = real(count)
        answer[2] = real(infeasible)
        answer[3] = best
        answer[4] = real(has_point)


@wp.kernel(launch_bounds=BLOCK)
def mode_search_kernel(
    # In:
    packed: wp.array2d[real],
    restart_cost: real,
    # Scratch:
    workspaces: wp.array[Workspace],
    rows: wp.array[UnitConstraints],
    states: wp.array[ActiveSet],
    splittings: wp.array[Splitting],
    # Out:
    answers: wp.array2d[real],
    settled_out: wp.array2d[int],
):
    """Run the search of ``contact_modes.search_modes`` on packed input, in B worlds with one thread block for each.

    The launch dimensions are (B, threads of a block).

    Args:
        packed: (B, ...) input of each world: m, n, friction, constant, maximum number of QPs, and padding up to
            ``HEADER_SIZE``; then P, q, rows, offset, lower and upper bounds of the activations; then the activations
            (m,), contact modes (n,) and slip directions (n, 2) at the start of the search.
        restart_cost: objective below which no restart is needed.
        workspaces, rows, states, splittings: (B,) scratch memory of each world.
        answers: (B, ...) result of each world: status, number of QPs, number of infeasible QPs, objective, 1 if a point
            was found; from ``HEADER_SIZE`` on, the point (m + 3n,).
        settled_out: (B, 1) set to 1 once a point with an objective below ``restart_cost`` is found.
    """
    world, _ = wp.tid()
    search(
        packed[world],
        restart_cost,
        workspaces[world],
        rows[world],
        states[world],
        splittings[world],
        answers[world],
        settled_out[world],
    )
