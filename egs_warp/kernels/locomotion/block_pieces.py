"""The program of a piece of contact over activations alone, and the rows that say where it ends, by a block of threads.

What ``pieces`` and ``reduced_rows`` do by one thread of a CPU: see there, and docs/concepts/locomotion.md.
"""

import math

import warp as wp

from egs_warp.kernels.block import sum_of_block, wait_for_block
from egs_warp.kernels.locomotion.block_active_set import UnitRows
from egs_warp.kernels.locomotion.block_algebra import add_product, lane_of_block, multiply, normalise
from egs_warp.kernels.locomotion.block_elimination import eliminate
from egs_warp.kernels.locomotion.pieces import (
    BROKEN,
    FACES,
    FREE,
    LANDS,
    LEAVES,
    ROUNDING,
    SINGULAR,
    SLIDE,
    SLIPS,
    STICK,
    TURNS,
    WEDGE,
)
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

HERE, ONWARD, NEAREST, BESIDE = 0, 1, 2, 3
"""Modes that there is memory for, see ``Room``."""
LEFT = wp.constant(real(1e-8))
"""By which a row may leave its bounds, or times its length where that is more."""

_HERE = wp.constant(HERE)
_FREE, _STICK, _SLIDE = wp.constant(FREE), wp.constant(STICK), wp.constant(SLIDE)
_LEAVES, _SLIPS, _TURNS, _LANDS = wp.constant(LEAVES), wp.constant(SLIPS), wp.constant(TURNS), wp.constant(LANDS)
_FACES = wp.constant(FACES)
_Faces = wp.types.vector(FACES, real)
_ANGLES = [2.0 * math.pi * face / FACES for face in range(FACES)]
COSINES, SINES = (wp.constant(_Faces(*map(each, _ANGLES))) for each in (math.cos, math.sin))
_FACE_COSINE = wp.constant(real(math.cos(math.pi / FACES)))
_WEDGE_SINE, _WEDGE_COSINE = wp.constant(real(math.sin(WEDGE))), wp.constant(real(math.cos(WEDGE)))
_SINGULAR, _BROKEN, _ROUNDING = (wp.constant(real(each)) for each in (SINGULAR, BROKEN, ROUNDING))
_NO_PIVOT = wp.constant(real(1e-10))
"""Of the mean of the operator's diagonal."""
ROOM = wp.constant(real(9e-6))
"""By which bounds are moved apart, as by ``SplittingProgram``."""


@wp.struct
class Room:
    """Scratch memory for m activations and n contacts at most. T forces are of contacts that touch, h of them are held,
    v speeds say where a piece ends; its rows are m of the activations and k more."""

    held_place: wp.array[int]
    """(n,) of each contact that touches its first row among those that are held."""
    touching: wp.array[int]
    """(T,) forces."""
    held: wp.array[int]
    """(h,) forces, whose contact velocities are held at zero."""
    speeds: wp.array[int]
    """(v,) contact velocities."""
    parts: wp.array2d[int]
    """(k, 3) which of the T forces and v speeds a row is made of."""
    shares: wp.array2d[real]
    """(k, 3) and of how much."""
    contact: wp.array[int]
    onward: wp.array[int]
    """(k,) whose row it is, and what happens beyond."""
    first: wp.array[int]
    """(n,) of each contact's rows,"""
    next: wp.array[int]
    """(k,) and which comes after each of them, -1 for none."""
    equations: wp.array2d[real]
    """(h, h + m + 1)."""
    answers: wp.array2d[real]
    """(T + v, m + 1) by activations, the last column without any."""
    gathered: wp.array2d[real]
    """(m + T, T)."""
    moved: wp.array2d[real]
    """(m + T, m + 1)."""
    cost: wp.array2d[real]
    """(m, m)."""
    root: wp.array2d[real]
    """(m, m) of its inverse."""
    slope: wp.array[real]
    """(m,)."""
    minimum: wp.array[real]
    """(m,)."""
    found: wp.array[real]
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
    pushes: wp.array[real]
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

    told: wp.array[real]
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
def count_of(program: Program, room: Room, kind: int):
    """How many contacts move so."""
    count = int(0)
    for i in range(program.n):
        if room.kinds[_HERE, i] == kind:
            count += 1
    return count


@wp.func
def write_row(room: Room, before: int, row: int, contact: int, onward: int, parts: wp.vec3i, shares: wp.vec3d):
    """One of those that say where the piece ends, behind the one ``before`` of the same contact; which it is."""
    room.contact[row] = contact
    room.onward[row] = onward
    room.next[row] = -1
    if before >= 0:
        room.next[before] = row
    else:
        room.first[contact] = row
    for t in range(3):
        room.parts[row, t] = parts[t]
        room.shares[row, t] = shares[t]
    return row


@wp.func
def list_contacts(program: Program, room: Room, sticks: int, slides: int):
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
        room.held_place[i] = held
        if kind == _FREE:
            room.speeds[speed] = 3 * i
            row = 9 * sticks + 3 * slides + order
            p = touches + speed
            write_row(room, -1, row, i, _LANDS, wp.vec3i(p, p, p), wp.vec3d(real(1.0), zero, zero))
        else:
            for t in range(3):
                room.touching[place + t] = 3 * i + t
            room.held[held] = 3 * i
            parts = wp.vec3i(place, place + 1, place + 2)
            row = order
            if kind == _SLIDE:
                row += sticks
            last = write_row(room, -1, row, i, _LEAVES, parts, wp.vec3d(real(1.0), zero, zero))
            if kind == _STICK:
                room.held[held + 1] = 3 * i + 1
                room.held[held + 2] = 3 * i + 2
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
    wait_for_block()


@wp.func
def find_answers(program: Program, room: Room, touches: int, holds: int):
    """The forces that hold what is held, linear in the activations; 0 where that takes rows to be exchanged."""
    lane = lane_of_block()
    m = program.m
    width = holds + m + 1
    for e in range(lane, holds * width, wp.block_dim()):
        a = e / width
        c = e % width
        row = program.rows + room.held[a] * program.size
        value = real(0.0)
        if c < holds:
            f = room.held[c]
            i = f / 3
            value = program.told[row + m + f]
            if room.kinds[_HERE, i] == _SLIDE:
                value -= program.friction * (
                    program.told[row + m + f + 1] * room.slips[_HERE, i, 0]
                    + program.told[row + m + f + 2] * room.slips[_HERE, i, 1]
                )
        elif c < holds + m:
            value = -program.told[row + c - holds]
        else:
            value = -program.told[program.offset + room.held[a]]
        room.equations[a, c] = value
    wait_for_block()
    mean = real(0.0)
    for a in range(lane, holds, wp.block_dim()):
        mean += wp.abs(room.equations[a, a]) / real(holds)
    mean = sum_of_block(mean)
    wait_for_block()
    for a in range(lane, holds, wp.block_dim()):
        room.equations[a, a] = room.equations[a, a] + _SINGULAR * mean
    wait_for_block()
    if eliminate(room.equations, holds, width, _NO_PIVOT) == 0:
        return 0
    for e in range(lane, touches * (m + 1), wp.block_dim()):
        g = e / (m + 1)
        c = e % (m + 1)
        f = room.touching[g]
        i = f / 3
        t = f % 3
        a = room.held_place[i]
        share = real(1.0)
        if room.kinds[_HERE, i] == _STICK:
            a += t
        elif t > 0:
            share = -program.friction * room.slips[_HERE, i, t - 1]
        room.answers[g, c] = share * room.equations[a, holds + c]
    wait_for_block()
    return 1


@wp.func
def write_cost(program: Program, room: Room, touches: int):
    """Over activations alone; what of the speeds tells where the piece ends."""
    lane = lane_of_block()
    m = program.m
    for e in range(lane, (m + touches) * touches, wp.block_dim()):
        i = e / touches
        g = e % touches
        row = i
        if i >= m:
            row = m + room.touching[i - m]
        room.gathered[i, g] = program.told[program.cost + row * program.size + m + room.touching[g]]
    for e in range(lane, (m + touches) * (m + 1), wp.block_dim()):
        i = e / (m + 1)
        c = e % (m + 1)
        row = i
        if i >= m:
            row = m + room.touching[i - m]
        value = real(0.0)
        if c < m:
            value = program.told[program.cost + row * program.size + c]
        room.moved[i, c] = value
    wait_for_block()
    add_product(room.moved, room.gathered, room.answers, m + touches, m + 1, touches, 0)
    # Again by what contact answers, to the rows of the activations.
    for e in range(lane, touches * (m + 1), wp.block_dim()):
        g = e / (m + 1)
        c = e % (m + 1)
        room.equations[g, c] = room.moved[m + g, c]
    wait_for_block()
    add_product(room.moved, room.answers, room.equations, m, m + 1, touches, 1)
    for e in range(lane, m * m, wp.block_dim()):
        i = e / m
        k = e % m
        room.cost[i, k] = real(0.5) * (room.moved[i, k] + room.moved[k, i])
    for i in range(lane, m, wp.block_dim()):
        value = program.told[program.slope + i] + room.moved[i, m]
        for g in range(touches):
            value += room.answers[g, i] * program.told[program.slope + m + room.touching[g]]
        room.slope[i] = value
    wait_for_block()


@wp.func
def write_speeds(program: Program, room: Room, touches: int, speeds: int):
    """Behind the answers of the forces."""
    lane = lane_of_block()
    m = program.m
    for e in range(lane, speeds * touches, wp.block_dim()):
        s = e / touches
        g = e % touches
        room.gathered[s, g] = program.told[program.rows + room.speeds[s] * program.size + m + room.touching[g]]
    for e in range(lane, speeds * (m + 1), wp.block_dim()):
        s = e / (m + 1)
        c = e % (m + 1)
        value = program.told[program.offset + room.speeds[s]]
        if c < m:
            value = program.told[program.rows + room.speeds[s] * program.size + c]
        room.moved[s, c] = value
    wait_for_block()
    add_product(room.moved, room.gathered, room.answers, speeds, m + 1, touches, 0)
    for e in range(lane, speeds * (m + 1), wp.block_dim()):
        s = e / (m + 1)
        c = e % (m + 1)
        room.answers[touches + s, c] = room.moved[s, c]
    wait_for_block()


@wp.func
def of_row(room: Room, row: int, values: wp.array[real]):
    """What the ``values`` of the answers make of a row."""
    value = real(0.0)
    for t in range(3):
        value += room.shares[row, t] * values[room.parts[row, t]]
    return value


@wp.func
def offset_of_row(room: Room, row: int, m: int):
    """What it is without activations."""
    value = real(0.0)
    for t in range(3):
        value += room.shares[row, t] * room.answers[room.parts[row, t], m]
    return value


@wp.func
def write_rows(program: Program, room: Room, rows: UnitRows, begun: wp.array[real], answers: int, further: int):
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
                rows.parts[row, t] = answers + row
                rows.shares[row, t] = wp.where(t == 0, real(1.0), real(0.0))
            else:
                rows.parts[row, t] = room.parts[row - m, t]
                rows.shares[row, t] = room.shares[row - m, t]
    wait_for_block()
    add_product(rows.units, room.answers, room.root, answers, m, m, 0)
    multiply(room.answers, answers, m, room.minimum, room.at_minimum)
    multiply(room.answers, answers, m, room.start, room.at_start)
    normalise(rows.units, m, rows.parts, rows.shares, m + further, room.lengths)
    for row in range(lane, m + further, wp.block_dim()):
        length = room.lengths[row]
        free = real(0.0)
        start = real(0.0)
        if row < m:
            free = room.minimum[row]
            start = room.start[row]
            room.bounds[0, row] = program.told[program.lower + row] - ROOM
            room.bounds[1, row] = program.told[program.upper + row] + ROOM
        else:
            free = of_row(room, row - m, room.at_minimum)
            start = of_row(room, row - m, room.at_start)
            least = -offset_of_row(room, row - m, m)
            room.bounds[0, row] = wp.min(least, wp.max(start, least - _BROKEN)) - _ROUNDING - ROOM
            room.bounds[1, row] = real(wp.inf)
        rows.free[row] = free / length
        begun[row] = (start - free) / length
        rows.lower[row] = room.bounds[0, row] / length
        rows.upper[row] = room.bounds[1, row] / length
        rows.slack[row] = LEFT * wp.max(real(1.0), length) / length
    wait_for_block()
