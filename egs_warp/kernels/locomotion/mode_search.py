"""The search over pieces of contact in one launch: a block of threads on a GPU, one thread on a CPU.

What ``contact_pieces`` does on a host: see there, and docs/concepts/locomotion.md.
"""

import warp as wp

from egs_warp.kernels.block import sum_of_block, sync_block
from egs_warp.kernels.locomotion.active_set import FOUND, INFEASIBLE, NUMERICAL_FAILURE
from egs_warp.kernels.locomotion.block_active_set import ActiveSet, UnitConstraints, find_optimum
from egs_warp.kernels.locomotion.block_algebra import (
    apply_factor,
    argmax_of_block,
    lane_of_block,
    multiply,
    multiply_at,
)
from egs_warp.kernels.locomotion.block_elimination import inverse_cholesky
from egs_warp.kernels.locomotion.block_mode_region import (
    CURRENT,
    NEXT,
    NEXT_SINGLE,
    ROW_TOLERANCE,
    WARM_START,
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
from egs_warp.kernels.locomotion.block_splitting import Splitting, iterate
from egs_warp.kernels.locomotion.mode_region import ACTIVE, FREE, GAIN, SLIDE, STICK, TO_FREE, TO_SLIDE, ZERO_SPEED
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

BLOCK = 512
"""Threads on a GPU."""
HEADER_SIZE = 8
"""Numbers before those of the program, and before the point of the answer."""

_FREE, _STICK, _SLIDE = wp.constant(FREE), wp.constant(STICK), wp.constant(SLIDE)
_LEAVES, _SLIPS = wp.constant(TO_FREE), wp.constant(TO_SLIDE)
_HERE, _ONWARD = wp.constant(CURRENT), wp.constant(NEXT)
_NEAREST, _BESIDE = wp.constant(NEXT_SINGLE), wp.constant(WARM_START)
_HEADER = wp.constant(HEADER_SIZE)
INFEASIBLE_COST = wp.constant(real(1e6))
"""As on the host."""
_ACTIVE, _GAIN, _SLOWEST = (wp.constant(real(each)) for each in (ACTIVE, GAIN, ZERO_SPEED))


@wp.func
def crash_start(rows: UnitConstraints, holding: ActiveSet):
    """How many rows the minimum without bounds breaks: they get a side."""
    broken = real(0.0)
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        side = int(0)
        if rows.values_at_origin[row] < rows.lower[row]:
            side = 1
        elif rows.values_at_origin[row] > rows.upper[row]:
            side = -1
        holding.side[row] = side
        if side != 0:
            broken += real(1.0)
    broken = sum_of_block(broken)
    sync_block()
    return int(broken)


@wp.func
def count_violations(program: Program, room: Workspace, answers: int, further: int):
    """How many rows the point that was found breaks."""
    m = program.m
    multiply(room.force_map, answers, m, room.optimum, room.at_found)
    missed = real(0.0)
    for row in range(lane_of_block(), m + further, wp.block_dim()):
        at = real(0.0)
        if row < m:
            at = room.optimum[row]
        else:
            at = row_value(room, row - m, room.at_found)
        slack = real(10.0) * ROW_TOLERANCE * wp.max(real(1.0), room.lengths[row])
        if not (at > room.bounds[0, row] - slack and at < room.bounds[1, row] + slack):
            missed += real(1.0)
    missed = sum_of_block(missed)
    sync_block()
    return int(missed)


@wp.func
def scatter_optimum(program: Program, room: Workspace, touches: int):
    """What contact answers to the optimum within its bounds, and what all costs."""
    lane = lane_of_block()
    m = program.m
    for k in range(lane, program.size, wp.block_dim()):
        value = real(0.0)
        if k < m:
            value = wp.clamp(room.optimum[k], program.packed[program.lower + k], program.packed[program.upper + k])
        room.trial[k] = value
    sync_block()
    multiply(room.force_map, touches, m, room.trial, room.at_found)
    for g in range(lane, touches, wp.block_dim()):
        room.trial[m + room.closed_forces[g]] = room.at_found[g] + room.force_map[g, m]
    sync_block()
    size = program.size
    multiply_at(program.packed, program.cost, size, size, size, room.trial, room.values)
    total = real(0.0)
    for k in range(lane, size, wp.block_dim()):
        total += room.trial[k] * (real(0.5) * room.values[k] + program.packed[program.slope + k])
    total = sum_of_block(total)
    sync_block()
    return total + program.constant


@wp.func
def normalized(first: real, second: real):
    """Their direction, the first axis where they have none."""
    length = wp.sqrt(first * first + second * second)
    if length > real(0.0):
        return wp.vec2d(first / length, second / length)
    return wp.vec2d(real(1.0), real(0.0))


@wp.func
def apply_transition(program: Program, room: Workspace, contact: int, onward: int, which: int):
    """``contact`` goes ``onward`` in the modes ``which``."""
    m = program.m
    if onward == _LEAVES:
        room.kinds[which, contact] = _FREE
    elif onward == _SLIPS:
        way = normalized(-room.trial[m + 3 * contact + 1], -room.trial[m + 3 * contact + 2])
        room.kinds[which, contact] = _SLIDE
        room.slips[which, contact, 0] = way[0]
        room.slips[which, contact, 1] = way[1]
    else:
        first = room.values[3 * contact + 1]
        second = room.values[3 * contact + 2]
        if wp.sqrt(first * first + second * second) > _SLOWEST:
            way = normalized(first, second)
            room.kinds[which, contact] = _SLIDE
            room.slips[which, contact, 0] = way[0]
            room.slips[which, contact, 1] = way[1]
        else:
            room.kinds[which, contact] = _STICK


@wp.func
def find_next_modes(program: Program, room: Workspace, holding: ActiveSet, holds: int, further: int, objective: real):
    """How many rows hold the optimum back: modes onward of all of them, and of the one that is pushed most alone."""
    lane = lane_of_block()
    m = program.m
    multiply_at(program.packed, program.rows, program.size, 3 * program.n, program.size, room.trial, room.values)
    for k in range(lane, 3 * program.n, wp.block_dim()):
        room.values[k] = room.values[k] + program.packed[program.offset + k]
    for row in range(lane, further, wp.block_dim()):
        room.multipliers[row] = real(0.0)
    for i in range(lane, program.n, wp.block_dim()):
        for which in range(_ONWARD, _BESIDE):
            room.kinds[which, i] = room.kinds[_HERE, i]
            room.slips[which, i, 0] = room.slips[_HERE, i, 0]
            room.slips[which, i, 1] = room.slips[_HERE, i, 1]
    sync_block()
    for i in range(lane, holds, wp.block_dim()):
        row = holding.active[i]
        if row >= m:
            room.multipliers[row - m] = holding.multipliers[i] / room.lengths[row]
    sync_block()
    least = _ACTIVE * wp.max(wp.abs(objective), real(1e-9))
    count = real(0.0)
    most = real(0.0)
    place = int(-1)
    for row in range(lane, further, wp.block_dim()):
        if room.multipliers[row] > least:
            count += real(1.0)
            if room.multipliers[row] > most:
                most = room.multipliers[row]
                place = row
    count = sum_of_block(count)
    found = argmax_of_block(most, place)
    for i in range(lane, program.n, wp.block_dim()):
        # The most pushed one's word is the last.
        strongest = least
        last = int(-1)
        row = room.first[i]
        while row >= 0:
            if room.multipliers[row] > least and room.multipliers[row] >= strongest:
                strongest = room.multipliers[row]
                last = row
            row = room.next[row]
        if last >= 0:
            apply_transition(program, room, i, room.transition[last], _ONWARD)
    if lane == 0 and count > real(0.0):
        row = int(found[1])
        apply_transition(program, room, room.contact[row], room.transition[row], _NEAREST)
    sync_block()
    return int(count)


@wp.struct
class ModeRegionResult:
    """How a piece ended."""

    ended: int
    objective: real
    active_count: int
    """Rows that hold the optimum back."""


@wp.func
def solve_piece(
    program: Program, room: Workspace, rows: UnitConstraints, holding: ActiveSet, splitting: Splitting, first: int
):
    """That of the modes at hand, entered from the start; ``first`` is 1 as long as none is solved."""
    lane = lane_of_block()
    m = program.m
    sticks = count_of(program, room, _STICK)
    slides = count_of(program, room, _SLIDE)
    frees = program.n - sticks - slides
    touches = 3 * (sticks + slides)
    speeds = 2 * slides + frees
    further = 9 * sticks + 3 * slides + frees
    answers = touches + speeds
    solved = ModeRegionResult()
    solved.ended = INFEASIBLE
    list_contact_rows(program, room, sticks, slides)
    if solve_force_map(program, room, touches, 3 * sticks + slides) == 0:
        solved.ended = NUMERICAL_FAILURE
        return solved
    write_cost(program, room, touches)
    write_speeds(program, room, touches, speeds)
    if inverse_cholesky(room.cost, m, room.root) == 0:
        solved.ended = NUMERICAL_FAILURE
        return solved
    apply_factor(room.root, m, room.slope, room.values, room.minimum)
    worth = real(0.0)
    for c in range(lane, m, wp.block_dim()):
        room.minimum[c] = -room.minimum[c]
        worth -= real(0.5) * room.slope[c] * room.minimum[c]
    worth = wp.max(sum_of_block(worth), real(1.0))
    sync_block()
    write_rows(program, room, rows, splitting.initial_values, answers, further)
    rows.unknowns = m
    rows.count = m + further
    rows.base_count = m + answers
    rows.cost_limit = INFEASIBLE_COST * worth
    holds = int(0)
    solved.ended = FOUND
    if crash_start(rows, holding) > 0:
        if first == 1:
            iterate(rows, holding, splitting)
        solved.ended = find_optimum(rows, holding)
        if solved.ended != FOUND:
            return solved
        multiply(room.root, m, m, holding.z, room.optimum)
        held = real(0.0)
        for row in range(lane, rows.count, wp.block_dim()):
            if holding.side[row] != 0:
                held += real(1.0)
        holds = int(sum_of_block(held))
    else:
        for c in range(lane, m, wp.block_dim()):
            room.optimum[c] = real(0.0)
    sync_block()
    for c in range(lane, m, wp.block_dim()):
        room.optimum[c] = room.optimum[c] + room.minimum[c]
    sync_block()
    missed = int(0)
    if holds > 0:
        missed = count_violations(program, room, answers, further)
    if missed > 0:
        solved.ended = NUMERICAL_FAILURE
        return solved
    solved.objective = scatter_optimum(program, room, touches)
    solved.active_count = find_next_modes(program, room, holding, holds, further, solved.objective)
    return solved


@wp.func
def copy_modes(room: Workspace, n: int, source: int, target: int):
    """The modes ``target`` are those of ``source`` then."""
    for i in range(lane_of_block(), n, wp.block_dim()):
        room.kinds[target, i] = room.kinds[source, i]
        for t in range(2):
            room.slips[target, i, t] = room.slips[source, i, t]
    sync_block()


@wp.func
def unpack_program(told: wp.array[real]):
    """What the header says of the numbers behind it."""
    program = Program()
    program.packed = told
    program.m = int(told[0])
    program.n = int(told[1])
    program.friction = told[2]
    program.constant = told[3]
    program.size = program.m + 3 * program.n
    program.cost = _HEADER
    program.slope = program.cost + program.size * program.size
    program.rows = program.slope + program.size
    program.offset = program.rows + 3 * program.n * program.size
    program.lower = program.offset + 3 * program.n
    program.upper = program.lower + program.m
    return program


@wp.kernel(launch_bounds=BLOCK)
def mode_search_kernel(
    # In:
    told: wp.array[real],
    costly: real,
    # Scratch:
    room: Workspace,
    rows: UnitConstraints,
    holding: ActiveSet,
    splitting: Splitting,
    # Out:
    answer: wp.array[real],
    settled_out: wp.array[int],
):
    """``search_pieces`` of what is ``told``: m, n, friction, the constant, the most programs, numbers that mean nothing
    up to ``HEADER``; P, q, rows, offset, bounds of the activations; the activations of the start (m,), how each contact
    moves there (n,), and its slip (n, 2). ``answer``: how it ended, programs, those without a solution among them, the
    objective, whether there is a point; from ``HEADER`` on the point (m + 3n,). ``settled_out`` (1,) is 1 as soon as
    one is found that is not ``costly``."""
    lane = lane_of_block()
    program = unpack_program(told)
    m = program.m
    n = program.n
    begin = program.upper + m
    sliding = real(0.0)
    for k in range(lane, m, wp.block_dim()):
        room.start[k] = told[begin + k]
    for i in range(lane, n, wp.block_dim()):
        kind = int(told[begin + m + i])
        if kind == _SLIDE:
            sliding += real(1.0)
            kind = _STICK
        room.kinds[_HERE, i] = kind
        for t in range(2):
            room.slips[_HERE, i, t] = told[begin + m + n + 2 * i + t]
    sliding = sum_of_block(sliding)
    sync_block()
    count = int(0)
    infeasible = int(0)
    there = int(0)
    several = int(0)
    nearest = int(0)
    best = real(wp.inf)
    ended = FOUND
    limit = int(told[4])
    going = int(1)
    while going == 1 and count < limit:
        count += 1
        going = 0
        solved = solve_piece(program, room, rows, holding, splitting, 1 - there)
        if solved.ended == NUMERICAL_FAILURE:
            ended = NUMERICAL_FAILURE
        elif solved.ended == INFEASIBLE:
            infeasible += 1
            if there == 0 and infeasible == 1 and sliding > real(0.0):
                # What slides is not held, then.
                for i in range(lane, n, wp.block_dim()):
                    room.kinds[_HERE, i] = int(told[begin + m + i])
                sync_block()
                going = 1
        elif there == 1 and solved.objective >= best:
            # Together the contacts went too far; the one that is pushed most may still gain.
            if several == 1 and nearest == 0:
                copy_modes(room, n, _BESIDE, _HERE)
                nearest = 1
                going = 1
        else:
            enough = there == 1 and best - solved.objective < _GAIN * wp.abs(best)
            there = 1
            best = solved.objective
            if lane == 0 and best < costly:
                wp.atomic_max(settled_out, 0, 1)
            for k in range(lane, program.size, wp.block_dim()):
                answer[_HEADER + k] = room.trial[k]
                if k < m:
                    room.start[k] = room.trial[k]
            several = int(0)
            if solved.active_count > 1:
                several = 1
            nearest = 0
            copy_modes(room, n, _NEAREST, _BESIDE)
            if solved.active_count > 0 and not enough:
                copy_modes(room, n, _ONWARD, _HERE)
                going = 1
    if lane == 0:
        answer[0] = real(ended)
        answer[1] = real(count)
        answer[2] = real(infeasible)
        answer[3] = best
        answer[4] = real(there)
