"""The program of a piece of contact over activations alone, and the rows that say where it ends, by a block of threads.

What ``pieces`` and ``reduced_rows`` do by one thread of a CPU: see there, and docs/concepts/locomotion.md.
"""

import math

import warp as wp

from egs_warp.kernels.block import sum_of_block, sync_block
from egs_warp.kernels.locomotion.block_active_set import UnitConstraints
from egs_warp.kernels.locomotion.block_algebra import gemm_add, lane_of_block, multiply, normalize_rows
from egs_warp.kernels.locomotion.block_elimination import eliminate
from egs_warp.kernels.locomotion.mode_region import (
    BROKEN,
    CONE_FACES,
    DELASSUS_REGULARIZATION,
    FREE,
    ROUNDING,
    SLIDE,
    SLIDE_SECTOR,
    STICK,
    TO_FREE,
    TO_OTHER_DIRECTION,
    TO_SLIDE,
    TO_TOUCHING,
)
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

CURRENT, NEXT, NEXT_SINGLE, WARM_START = 0, 1, 2, 3
"""Modes that there is memory for, see ``Room``."""
ROW_TOLERANCE = wp.constant(real(1e-8))
"""By which a row may leave its bounds, or times its length where that is more."""

_HERE = wp.constant(CURRENT)
_FREE, _STICK, _SLIDE = wp.constant(FREE), wp.constant(STICK), wp.constant(SLIDE)
_LEAVES, _SLIPS, _TURNS, _LANDS = (
    wp.constant(TO_FREE),
    wp.constant(TO_SLIDE),
    wp.constant(TO_OTHER_DIRECTION),
    wp.constant(TO_TOUCHING),
)
_FACES = wp.constant(CONE_FACES)
_Faces = wp.types.vector(CONE_FACES, real)
_ANGLES = [2.0 * math.pi * face / CONE_FACES for face in range(CONE_FACES)]
COSINES, SINES = (wp.constant(_Faces(*map(each, _ANGLES))) for each in (math.cos, math.sin))
_FACE_COSINE = wp.constant(real(math.cos(math.pi / CONE_FACES)))
_WEDGE_SINE, _WEDGE_COSINE = wp.constant(real(math.sin(SLIDE_SECTOR))), wp.constant(real(math.cos(SLIDE_SECTOR)))
_SINGULAR, _BROKEN, _ROUNDING = (wp.constant(real(each)) for each in (DELASSUS_REGULARIZATION, BROKEN, ROUNDING))
_MIN_PIVOT = wp.constant(real(1e-10))
"""Of the mean of the operator's diagonal."""
BOUND_PADDING = wp.constant(real(9e-6))
"""By which bounds are moved apart, as by ``SplittingProgram``."""


@wp.struct
class Workspace:
    """Scratch memory for m activations and n contacts at most. T forces are of contacts that touch, h of them are held,
    v speeds say where a piece ends; its rows are m of the activations and k more."""

    held_index: wp.array[int]
    """(n,) of each contact that touches its first row among those that are held."""
    closed_forces: wp.array[int]
    """(T,) forces."""
    held_forces: wp.array[int]
    """(h,) forces, whose contact velocities are held at zero."""
    speeds: wp.array[int]
    """(v,) contact velocities."""
    base_rows: wp.array2d[int]
    """(k, 3) which of the T forces and v speeds a row is made of."""
    coefficients: wp.array2d[real]
    """(k, 3) and of how much."""
    contact: wp.array[int]
    transition: wp.array[int]
    """(k,) whose row it is, and what happens beyond."""
    first: wp.array[int]
    """(n,) of each contact's rows,"""
    next: wp.array[int]
    """(k,) and which comes after each of them, -1 for none."""
    equations: wp.array2d[real]
    """(h, h + m + 1)."""
    force_map: wp.array2d[real]
    """(T + v, m + 1) by activations, the last column without any."""
    cost_rows: wp.array2d[real]
    """(m + T, T)."""
    cost_products: wp.array2d[real]
    """(m + T, m + 1)."""
    cost: wp.array2d[real]
    """(m, m)."""
    root: wp.array2d[real]
    """(m, m) of its inverse."""
    slope: wp.array[real]
    """(m,)."""
    minimum: wp.array[real]
    """(m,)."""
    optimum: wp.array[real]
    """(m,) the optimum."""
    at_minimum: wp.array[real]
    at_start: wp.array[real]
    at_found: wp.array[real]
    """(T + v,) the answers there, without the last column."""
    lengths: wp.array[real]
    """(m + k,)."""
    bounds: wp.array2d[real]
    """(2, m + k) as they were given."""
    values: wp.array[real]
    """(m + 3n,)."""
    multipliers: wp.array[real]
    """(k,)."""
    kinds: wp.array2d[int]
    """(4, n) of the piece that is solved, of the one onward of it, of that in which only one contact goes on, and of
    the same beside the best."""
    slips: wp.array3d[real]
    """(4, n, 2)."""
    start: wp.array[real]
    """(m,) activations from which the piece is entered."""
    trial: wp.array[real]
    """(m + 3n,)."""


@wp.struct
class Program:
    """What is told, one behind the other, and where each begins."""

    packed: wp.array[real]
    m: int
    n: int
    size: int
    """m + 3n."""
    friction: real
    constant: real
    cost: int
    slope: int
    rows: int
    offset: int
    lower: int
    upper: int


@wp.func
def count_of(program: Program, room: Workspace, kind: int):
    """How many contacts move so."""
    count = int(0)
    for i in range(program.n):
        if room.kinds[_HERE, i] == kind:
            count += 1
    return count


@wp.func
def write_row(room: Workspace, before: int, row: int, contact: int, onward: int, parts: wp.vec3i, shares: wp.vec3d):
    """One of those that say where the piece ends, behind the one ``before`` of the same contact; which it is."""
    room.contact[row] = contact
    room.transition[row] = onward
    room.next[row] = -1
    if before >= 0:
        room.next[before] = row
    else:
        room.first[contact] = row
    for t in range(3):
        room.base_rows[row, t] = parts[t]
        room.coefficients[row, t] = shares[t]
    return row


@wp.func
def list_contact_rows(program: Program, room: Workspace, sticks: int, slides: int):
    """Which forces touch and are held, which speeds tell, and what the rows are made of."""
    touches = 3 * (sticks + slides)
    mu = program.friction
    zero = real(0.0)
    for i in range(lane_of_block(), program.n, wp.block_dim()):
        before = wp.vec3i(0, 0, 0)
        kind = room.kinds[_HERE, i]
        for j in range(i):
            other = room.kinds[_HERE, j]
            before[other] = before[other] + 1
        order = before[kind]
        place = 3 * (before[1] + before[2])
        held = 3 * before[1] + before[2]
        speed = 2 * before[2] + before[0]
        room.held_index[i] = held
        if kind == _FREE:
            room.speeds[speed] = 3 * i
            row = 9 * sticks + 3 * slides + order
            p = touches + speed
            write_row(room, -1, row, i, _LANDS, wp.vec3i(p, p, p), wp.vec3d(real(1.0), zero, zero))
        else:
            for t in range(3):
                room.closed_forces[place + t] = 3 * i + t
            room.held_forces[held] = 3 * i
            parts = wp.vec3i(place, place + 1, place + 2)
            row = order
            if kind == _SLIDE:
                row += sticks
            last = write_row(room, -1, row, i, _LEAVES, parts, wp.vec3d(real(1.0), zero, zero))
            if kind == _STICK:
                room.held_forces[held + 1] = 3 * i + 1
                room.held_forces[held + 2] = 3 * i + 2
                for face in range(_FACES):
                    row = sticks + slides + face * sticks + order
                    share = wp.vec3d(mu * _FACE_COSINE, -COSINES[face], -SINES[face])
                    last = write_row(room, last, row, i, _SLIPS, parts, share)
            else:
                room.speeds[speed] = 3 * i + 1
                room.speeds[speed + 1] = 3 * i + 2
                p = touches + speed
                parts = wp.vec3i(p, p + 1, p + 1)
                d0 = room.slips[_HERE, i, 0]
                d1 = room.slips[_HERE, i, 1]
                for half in range(2):
                    side = real(1 - 2 * half)
                    row = 9 * sticks + slides + half * slides + order
                    share = wp.vec3d(
                        _WEDGE_SINE * d0 - side * _WEDGE_COSINE * d1,
                        _WEDGE_SINE * d1 + side * _WEDGE_COSINE * d0,
                        zero,
                    )
                    last = write_row(room, last, row, i, _TURNS, parts, share)
    sync_block()


@wp.func
def solve_force_map(program: Program, room: Workspace, touches: int, holds: int):
    """The forces that hold what is held, linear in the activations; 0 where that takes rows to be exchanged."""
    lane = lane_of_block()
    m = program.m
    width = holds + m + 1
    for e in range(lane, holds * width, wp.block_dim()):
        a = e / width
        c = e % width
        row = program.rows + room.held_forces[a] * program.size
        value = real(0.0)
        if c < holds:
            f = room.held_forces[c]
            i = f / 3
            value = program.packed[row + m + f]
            if room.kinds[_HERE, i] == _SLIDE:
                value -= program.friction * (
                    program.packed[row + m + f + 1] * room.slips[_HERE, i, 0]
                    + program.packed[row + m + f + 2] * room.slips[_HERE, i, 1]
                )
        elif c < holds + m:
            value = -program.packed[row + c - holds]
        else:
            value = -program.packed[program.offset + room.held_forces[a]]
        room.equations[a, c] = value
    sync_block()
    mean = real(0.0)
    for a in range(lane, holds, wp.block_dim()):
        mean += wp.abs(room.equations[a, a]) / real(holds)
    mean = sum_of_block(mean)
    sync_block()
    for a in range(lane, holds, wp.block_dim()):
        room.equations[a, a] = room.equations[a, a] + _SINGULAR * mean
    sync_block()
    if eliminate(room.equations, holds, width, _MIN_PIVOT) == 0:
        return 0
    for e in range(lane, touches * (m + 1), wp.block_dim()):
        g = e / (m + 1)
        c = e % (m + 1)
        f = room.closed_forces[g]
        i = f / 3
        t = f % 3
        a = room.held_index[i]
        share = real(1.0)
        if room.kinds[_HERE, i] == _STICK:
            a += t
        elif t > 0:
            share = -program.friction * room.slips[_HERE, i, t - 1]
        room.force_map[g, c] = share * room.equations[a, holds + c]
    sync_block()
    return 1


@wp.func
def write_cost(program: Program, room: Workspace, touches: int):
    """Over activations alone; what of the speeds tells where the piece ends."""
    lane = lane_of_block()
    m = program.m
    for e in range(lane, (m + touches) * touches, wp.block_dim()):
        i = e / touches
        g = e % touches
        row = i
        if i >= m:
            row = m + room.closed_forces[i - m]
        room.cost_rows[i, g] = program.packed[program.cost + row * program.size + m + room.closed_forces[g]]
    for e in range(lane, (m + touches) * (m + 1), wp.block_dim()):
        i = e / (m + 1)
        c = e % (m + 1)
        row = i
        if i >= m:
            row = m + room.closed_forces[i - m]
        value = real(0.0)
        if c < m:
            value = program.packed[program.cost + row * program.size + c]
        room.cost_products[i, c] = value
    sync_block()
    gemm_add(room.cost_products, room.cost_rows, room.force_map, m + touches, m + 1, touches, 0)
    # Again by what contact answers, to the rows of the activations.
    for e in range(lane, touches * (m + 1), wp.block_dim()):
        g = e / (m + 1)
        c = e % (m + 1)
        room.equations[g, c] = room.cost_products[m + g, c]
    sync_block()
    gemm_add(room.cost_products, room.force_map, room.equations, m, m + 1, touches, 1)
    for e in range(lane, m * m, wp.block_dim()):
        i = e / m
        k = e % m
        room.cost[i, k] = real(0.5) * (room.cost_products[i, k] + room.cost_products[k, i])
    for i in range(lane, m, wp.block_dim()):
        value = program.packed[program.slope + i] + room.cost_products[i, m]
        for g in range(touches):
            value += room.force_map[g, i] * program.packed[program.slope + m + room.closed_forces[g]]
        room.slope[i] = value
    sync_block()


@wp.func
def write_speeds(program: Program, room: Workspace, touches: int, speeds: int):
    """Behind the answers of the forces."""
    lane = lane_of_block()
    m = program.m
    for e in range(lane, speeds * touches, wp.block_dim()):
        s = e / touches
        g = e % touches
        room.cost_rows[s, g] = program.packed[program.rows + room.speeds[s] * program.size + m + room.closed_forces[g]]
    for e in range(lane, speeds * (m + 1), wp.block_dim()):
        s = e / (m + 1)
        c = e % (m + 1)
        value = program.packed[program.offset + room.speeds[s]]
        if c < m:
            value = program.packed[program.rows + room.speeds[s] * program.size + c]
        room.cost_products[s, c] = value
    sync_block()
    gemm_add(room.cost_products, room.cost_rows, room.force_map, speeds, m + 1, touches, 0)
    for e in range(lane, speeds * (m + 1), wp.block_dim()):
        s = e / (m + 1)
        c = e % (m + 1)
        room.force_map[touches + s, c] = room.cost_products[s, c]
    sync_block()


@wp.func
def row_value(room: Workspace, row: int, values: wp.array[real]):
    """What the ``values`` of the answers make of a row."""
    value = real(0.0)
    for t in range(3):
        value += room.coefficients[row, t] * values[room.base_rows[row, t]]
    return value


@wp.func
def row_offset(room: Workspace, row: int, m: int):
    """What it is without activations."""
    value = real(0.0)
    for t in range(3):
        value += room.coefficients[row, t] * room.force_map[room.base_rows[row, t], m]
    return value


@wp.func
def write_rows(
    program: Program, room: Workspace, rows: UnitConstraints, begun: wp.array[real], answers: int, further: int
):
    """In coordinates whose squares are costs, and how far the start is from the minimum."""
    lane = lane_of_block()
    m = program.m
    for e in range(lane, answers * m, wp.block_dim()):
        rows.units[e / m, e % m] = real(0.0)
    for e in range(lane, m * m, wp.block_dim()):
        rows.units[answers + e / m, e % m] = room.root[e / m, e % m]
    for row in range(lane, m + further, wp.block_dim()):
        for t in range(3):
            if row < m:
                rows.base_rows[row, t] = answers + row
                rows.coefficients[row, t] = wp.where(t == 0, real(1.0), real(0.0))
            else:
                rows.base_rows[row, t] = room.base_rows[row - m, t]
                rows.coefficients[row, t] = room.coefficients[row - m, t]
    sync_block()
    gemm_add(rows.units, room.force_map, room.root, answers, m, m, 0)
    multiply(room.force_map, answers, m, room.minimum, room.at_minimum)
    multiply(room.force_map, answers, m, room.start, room.at_start)
    normalize_rows(rows.units, m, rows.base_rows, rows.coefficients, m + further, room.lengths)
    for row in range(lane, m + further, wp.block_dim()):
        length = room.lengths[row]
        free = real(0.0)
        start = real(0.0)
        if row < m:
            free = room.minimum[row]
            start = room.start[row]
            room.bounds[0, row] = program.packed[program.lower + row] - BOUND_PADDING
            room.bounds[1, row] = program.packed[program.upper + row] + BOUND_PADDING
        else:
            free = row_value(room, row - m, room.at_minimum)
            start = row_value(room, row - m, room.at_start)
            least = -row_offset(room, row - m, m)
            room.bounds[0, row] = wp.min(least, wp.max(start, least - _BROKEN)) - _ROUNDING - BOUND_PADDING
            room.bounds[1, row] = real(wp.inf)
        rows.values_at_origin[row] = free / length
        begun[row] = (start - free) / length
        rows.lower[row] = room.bounds[0, row] / length
        rows.upper[row] = room.bounds[1, row] / length
        rows.slack[row] = ROW_TOLERANCE * wp.max(real(1.0), length) / length
    sync_block()
