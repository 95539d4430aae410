"""The search over pieces of contact in one launch: a block of threads on a GPU, one thread on a CPU.

What ``contact_pieces`` does on a host: see there, and docs/concepts/locomotion.md.
"""

import warp as wp

from egs_warp.kernels.block import sum_of_block, wait_for_block
from egs_warp.kernels.locomotion.active_set import ASTRAY, FOUND, INFEASIBLE
from egs_warp.kernels.locomotion.block_active_set import Holding, UnitRows, find_optimum
from egs_warp.kernels.locomotion.block_algebra import (
    apply_root,
    lane_of_block,
    largest_and_place,
    multiply,
    multiply_at,
)
from egs_warp.kernels.locomotion.block_elimination import invert_root
from egs_warp.kernels.locomotion.block_pieces import (
    BESIDE,
    HERE,
    LEFT,
    NEAREST,
    ONWARD,
    Program,
    Room,
    count_of,
    find_answers,
    list_contacts,
    of_row,
    write_cost,
    write_rows,
    write_speeds,
)
from egs_warp.kernels.locomotion.block_splitting import Splitting, iterate
from egs_warp.kernels.locomotion.pieces import ACTIVE, FREE, GAIN, LEAVES, SLIDE, SLIPS, SLOWEST, STICK
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

BLOCK = 512
"""Threads on a GPU."""
HEADER = 8
"""Numbers before those of the program, and before the point of the answer."""

_FREE, _STICK, _SLIDE = wp.constant(FREE), wp.constant(STICK), wp.constant(SLIDE)
_LEAVES, _SLIPS = wp.constant(LEAVES), wp.constant(SLIPS)
_HERE, _ONWARD = wp.constant(HERE), wp.constant(ONWARD)
_NEAREST, _BESIDE = wp.constant(NEAREST), wp.constant(BESIDE)
_HEADER = wp.constant(HEADER)
HOPELESS = wp.constant(real(1e6))
"""As on the host."""
_ACTIVE, _GAIN, _SLOWEST = (wp.constant(real(each)) for each in (ACTIVE, GAIN, SLOWEST))


@wp.func
def guess(rows: UnitRows, holding: Holding):
    """How many rows the minimum without bounds breaks: they get a side."""
    broken = real(0.0)
    for row in range(lane_of_block(), rows.count, wp.block_dim()):
        side = int(0)
        if rows.free[row] < rows.lower[row]:
            side = 1
        elif rows.free[row] > rows.upper[row]:
            side = -1
        holding.side[row] = side
        if side != 0:
            broken += real(1.0)
    broken = sum_of_block(broken)
    wait_for_block()
    return int(broken)


@wp.func
def misses(program: Program, room: Room, answers: int, further: int):
    """How many rows the point that was found breaks."""
    m = program.m
    multiply(room.answers, answers, m, room.found, room.at_found)
    missed = real(0.0)
    for row in range(lane_of_block(), m + further, wp.block_dim()):
        at = real(0.0)
        if row < m:
            at = room.found[row]
        else:
            at = of_row(room, row - m, room.at_found)
        slack = real(10.0) * LEFT * wp.max(real(1.0), room.lengths[row])
        if not (at > room.bounds[0, row] - slack and at < room.bounds[1, row] + slack):
            missed += real(1.0)
    missed = sum_of_block(missed)
    wait_for_block()
    return int(missed)


@wp.func
def write_point(program: Program, room: Room, touches: int):
    """What contact answers to the optimum within its bounds, and what all costs."""
    lane = lane_of_block()
    m = program.m
    for k in range(lane, program.size, wp.block_dim()):
        value = real(0.0)
        if k < m:
            value = wp.clamp(room.found[k], program.told[program.lower + k], program.told[program.upper + k])
        room.trial[k] = value
    wait_for_block()
    multiply(room.answers, touches, m, room.trial, room.at_found)
    for g in range(lane, touches, wp.block_dim()):
        room.trial[m + room.touching[g]] = room.at_found[g] + room.answers[g, m]
    wait_for_block()
    size = program.size
    multiply_at(program.told, program.cost, size, size, size, room.trial, room.values)
    total = real(0.0)
    for k in range(lane, size, wp.block_dim()):
        total += room.trial[k] * (real(0.5) * room.values[k] + program.told[program.slope + k])
    total = sum_of_block(total)
    wait_for_block()
    return total + program.constant


@wp.func
def unit_of(first: real, second: real):
    """Their direction, the first axis where they have none."""
    length = wp.sqrt(first * first + second * second)
    if length > real(0.0):
        return wp.vec2d(first / length, second / length)
    return wp.vec2d(real(1.0), real(0.0))


@wp.func
def beyond(program: Program, room: Room, contact: int, onward: int, which: int):
    """``contact`` goes ``onward`` in the modes ``which``."""
    m = program.m
    if onward == _LEAVES:
        room.kinds[which, contact] = _FREE
    elif onward == _SLIPS:
        way = unit_of(-room.trial[m + 3 * contact + 1], -room.trial[m + 3 * contact + 2])
        room.kinds[which, contact] = _SLIDE
        room.slips[which, contact, 0] = way[0]
        room.slips[which, contact, 1] = way[1]
    else:
        first = room.values[3 * contact + 1]
        second = room.values[3 * contact + 2]
        if wp.sqrt(first * first + second * second) > _SLOWEST:
            way = unit_of(first, second)
            room.kinds[which, contact] = _SLIDE
            room.slips[which, contact, 0] = way[0]
            room.slips[which, contact, 1] = way[1]
        else:
            room.kinds[which, contact] = _STICK


@wp.func
def look_beyond(program: Program, room: Room, holding: Holding, holds: int, further: int, objective: real):
    """How many rows hold the optimum back: modes onward of all of them, and of the one that is pushed most alone."""
    lane = lane_of_block()
    m = program.m
    multiply_at(program.told, program.rows, program.size, 3 * program.n, program.size, room.trial, room.values)
    for k in range(lane, 3 * program.n, wp.block_dim()):
        room.values[k] = room.values[k] + program.told[program.offset + k]
    for row in range(lane, further, wp.block_dim()):
        room.pushes[row] = real(0.0)
    for i in range(lane, program.n, wp.block_dim()):
        for which in range(_ONWARD, _BESIDE):
            room.kinds[which, i] = room.kinds[_HERE, i]
            room.slips[which, i, 0] = room.slips[_HERE, i, 0]
            room.slips[which, i, 1] = room.slips[_HERE, i, 1]
    wait_for_block()
    for i in range(lane, holds, wp.block_dim()):
        row = holding.active[i]
        if row >= m:
            room.pushes[row - m] = holding.pulls[i] / room.lengths[row]
    wait_for_block()
    least = _ACTIVE * wp.max(wp.abs(objective), real(1e-9))
    count = real(0.0)
    most = real(0.0)
    place = int(-1)
    for row in range(lane, further, wp.block_dim()):
        if room.pushes[row] > least:
            count += real(1.0)
            if room.pushes[row] > most:
                most = room.pushes[row]
                place = row
    count = sum_of_block(count)
    found = largest_and_place(most, place)
    for i in range(lane, program.n, wp.block_dim()):
        # The most pushed one's word is the last.
        strongest = least
        last = int(-1)
        row = room.first[i]
        while row >= 0:
            if room.pushes[row] > least and room.pushes[row] >= strongest:
                strongest = room.pushes[row]
                last = row
            row = room.next[row]
        if last >= 0:
            beyond(program, room, i, room.onward[last], _ONWARD)
    if lane == 0 and count > real(0.0):
        row = int(found[1])
        beyond(program, room, room.contact[row], room.onward[row], _NEAREST)
    wait_for_block()
    return int(count)


@wp.struct
class Solved:
    """How a piece ended."""

    ended: int
    objective: real
    pushed: int
    """Rows that hold the optimum back."""


@wp.func
def solve_piece(program: Program, room: Room, rows: UnitRows, holding: Holding, splitting: Splitting, first: int):
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
    solved = Solved()
    solved.ended = INFEASIBLE
    list_contacts(program, room, sticks, slides)
    if find_answers(program, room, touches, 3 * sticks + slides) == 0:
        solved.ended = ASTRAY
        return solved
    write_cost(program, room, touches)
    write_speeds(program, room, touches, speeds)
    if invert_root(room.cost, m, room.root) == 0:
        solved.ended = ASTRAY
        return solved
    apply_root(room.root, m, room.slope, room.values, room.minimum)
    worth = real(0.0)
    for c in range(lane, m, wp.block_dim()):
        room.minimum[c] = -room.minimum[c]
        worth -= real(0.5) * room.slope[c] * room.minimum[c]
    worth = wp.max(sum_of_block(worth), real(1.0))
    wait_for_block()
    write_rows(program, room, rows, splitting.begun, answers, further)
    rows.unknowns = m
    rows.count = m + further
    rows.made_of = m + answers
    rows.most = HOPELESS * worth
    holds = int(0)
    solved.ended = FOUND
    if guess(rows, holding) > 0:
        if first == 1:
            iterate(rows, holding, splitting)
        solved.ended = find_optimum(rows, holding)
        if solved.ended != FOUND:
            return solved
        multiply(room.root, m, m, holding.place, room.found)
        held = real(0.0)
        for row in range(lane, rows.count, wp.block_dim()):
            if holding.side[row] != 0:
                held += real(1.0)
        holds = int(sum_of_block(held))
    else:
        for c in range(lane, m, wp.block_dim()):
            room.found[c] = real(0.0)
    wait_for_block()
    for c in range(lane, m, wp.block_dim()):
        room.found[c] = room.found[c] + room.minimum[c]
    wait_for_block()
    missed = int(0)
    if holds > 0:
        missed = misses(program, room, answers, further)
    if missed > 0:
        solved.ended = ASTRAY
        return solved
    solved.objective = write_point(program, room, touches)
    solved.pushed = look_beyond(program, room, holding, holds, further, solved.objective)
    return solved


@wp.func
def take_modes(room: Room, n: int, source: int, target: int):
    """The modes ``target`` are those of ``source`` then."""
    for i in range(lane_of_block(), n, wp.block_dim()):
        room.kinds[target, i] = room.kinds[source, i]
        for t in range(2):
            room.slips[target, i, t] = room.slips[source, i, t]
    wait_for_block()


@wp.func
def program_in(told: wp.array[real]):
    """What the header says of the numbers behind it."""
    program = Program()
    program.told = told
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
def search_kernel(
    # In:
    told: wp.array[real],
    costly: real,
    # Scratch:
    room: Room,
    rows: UnitRows,
    holding: Holding,
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
    program = program_in(told)
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
    wait_for_block()
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
        if solved.ended == ASTRAY:
            ended = ASTRAY
        elif solved.ended == INFEASIBLE:
            infeasible += 1
            if there == 0 and infeasible == 1 and sliding > real(0.0):
                # What slides is not held, then.
                for i in range(lane, n, wp.block_dim()):
                    room.kinds[_HERE, i] = int(told[begin + m + i])
                wait_for_block()
                going = 1
        elif there == 1 and solved.objective >= best:
            # Together the contacts went too far; the one that is pushed most may still gain.
            if several == 1 and nearest == 0:
                take_modes(room, n, _BESIDE, _HERE)
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
            if solved.pushed > 1:
                several = 1
            nearest = 0
            take_modes(room, n, _NEAREST, _BESIDE)
            if solved.pushed > 0 and not enough:
                take_modes(room, n, _ONWARD, _HERE)
                going = 1
    if lane == 0:
        answer[0] = real(ended)
        answer[1] = real(count)
        answer[2] = real(infeasible)
        answer[3] = best
        answer[4] = real(there)
