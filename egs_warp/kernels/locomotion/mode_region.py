"""QP for one assignment of contact modes, with the activations as its only unknowns, and the rows that bound its
region.

All threads of a block on a GPU, or one thread on a CPU, call the functions. See docs/concepts/locomotion.md#modes.
"""

import math

import warp as wp

from egs_warp.kernels.block import sum_of_block, sync_block
from egs_warp.kernels.locomotion.active_set import UnitConstraints
from egs_warp.kernels.locomotion.block_algebra import gemm_add, lane_of_block, multiply, normalize_rows
from egs_warp.kernels.locomotion.block_elimination import eliminate
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

FREE, STICK, SLIDE = 0, 1, 2
"""Contact modes, as values of ``Workspace.kinds``."""
TO_FREE, TO_SLIDE, TO_OTHER_DIRECTION, TO_TOUCHING = 0, 1, 2, 3
"""Mode transitions. A contact makes one when a row that bounds the region becomes active."""
CONE_FACES = 8
"""Number of faces of the pyramid that replaces the friction cone of a sticking contact."""
SLIDE_SECTOR = math.radians(30.0)
"""Maximum angle in radians between the slip of a sliding contact and the direction that its friction opposes. If a foot
slipped in another direction, the fixed friction direction would propel the body unphysically."""
DELASSUS_REGULARIZATION = 1e-7
"""Diagonal shift of the Delassus operator, relative to the mean of its diagonal. The operator is singular if there are
more contacts than the cage can resolve."""
ZERO_FORCE = 1e-9
"""Normal force, in body weights, up to which a contact is treated as open."""
CONE_FRACTION = 1.0 - 1e-6
"""Fraction of the radius of the friction cone above which a tangential force is treated as sliding friction."""
ZERO_SPEED = 1e-9
"""Tangential speed, in units of sqrt(g H), below which the slip has no direction."""
MIN_MULTIPLIER = 1e-3
"""Minimum multiplier of a mode constraint at which the search crosses the constraint, as a fraction of the objective.
The multiplier is the decrease of the objective per unit of the row."""
MIN_GAIN_FRACTION = 5e-3
"""Minimum relative decrease of the objective at which the search continues in the next region."""
MAX_START_VIOLATION = 0.02
"""Maximum amount by which the start may violate a row of its region."""
START_ROUNDING = 1e-6
"""Amount by which rows are relaxed. The start may be the only point of its region, for example if contacts are
redundant."""

CURRENT, NEXT, NEXT_SINGLE, WARM_START = 0, 1, 2, 3
"""Slots of ``Workspace.kinds`` and ``Workspace.slips``; ``Workspace.kinds`` describes them."""
ROW_TOLERANCE = wp.constant(real(1e-8))
"""Tolerated violation of a row. For rows longer than 1, it is multiplied by the length of the row."""

_CURRENT = wp.constant(CURRENT)
_FREE, _STICK, _SLIDE = wp.constant(FREE), wp.constant(STICK), wp.constant(SLIDE)
_TO_FREE, _TO_SLIDE, _TO_OTHER_DIRECTION, _TO_TOUCHING = (
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
_SECTOR_SINE, _SECTOR_COSINE = wp.constant(real(math.sin(SLIDE_SECTOR))), wp.constant(real(math.cos(SLIDE_SECTOR)))
_REGULARIZATION, _BROKEN, _ROUNDING = (
    wp.constant(real(each)) for each in (DELASSUS_REGULARIZATION, MAX_START_VIOLATION, START_ROUNDING)
)
_MIN_PIVOT = wp.constant(real(1e-10))
"""Minimum pivot, relative to the mean of the diagonal of the Delassus operator."""
BOUND_PADDING = wp.constant(real(9e-6))
"""Amount by which bounds are relaxed, as in ``SplittingProgram``."""


@wp.struct
class Workspace:
    """Workspace for at most m activations and n contacts.

    T is the number of force components of closed contacts, h the number of contact velocity components that are held at
    zero, and v the number of contact velocity components that bound the region. The region is bounded by m rows for the
    activations and k rows for the contact modes.
    """

    held_index: wp.array[int]
    """(n,) first row of each closed contact among the ``held_forces``."""
    closed_forces: wp.array[int]
    """(T,) indices of the force components of closed contacts."""
    held_forces: wp.array[int]
    """(h,) indices of the force components whose contact velocities are held at zero."""
    speeds: wp.array[int]
    """(v,) indices of the contact velocities that bound the region."""
    base_rows: wp.array2d[int]
    """(k, 3) indices of the three terms of each mode row among the T forces and v velocities."""
    coefficients: wp.array2d[real]
    """(k, 3) coefficients of the three terms of each mode row."""
    contact: wp.array[int]
    """(k,) contact of each mode row."""
    transition: wp.array[int]
    """(k,) transition that the contact makes when the search crosses the row."""
    first: wp.array[int]
    """(n,) first mode row of each contact."""
    next: wp.array[int]
    """(k,) next mode row of the same contact, -1 if there is none."""
    equations: wp.array2d[real]
    """(h, h + m + 1) linear system for the forces: coefficients, then right-hand sides."""
    force_map: wp.array2d[real]
    """(T + v, m + 1) forces and velocities as affine functions of the activations, with the constant in the last
    column.
    """
    cost_rows: wp.array2d[real]
    """(m + T, T) columns of P that belong to the forces of closed contacts; also scratch memory of ``write_speeds``."""
    cost_products: wp.array2d[real]
    """(m + T, m + 1) P times the affine map from activations to activations and forces; also scratch memory of
    ``write_speeds``."""
    cost: wp.array2d[real]
    """(m, m) Hessian of the cost over the activations."""
    root: wp.array2d[real]
    """(m, m) upper triangular U with cost^-1 = U U^T."""
    slope: wp.array[real]
    """(m,) gradient of the cost over the activations, at zero activations."""
    minimum: wp.array[real]
    """(m,) activations at the unconstrained minimum."""
    optimum: wp.array[real]
    """(m,) activations at the optimum."""
    at_minimum: wp.array[real]
    """(T + v,) forces and velocities at ``minimum``, without the constant."""
    at_start: wp.array[real]
    """(T + v,) forces and velocities at ``start``, without the constant."""
    at_optimum: wp.array[real]
    """(T + v,) forces and velocities at ``optimum``, without the constant."""
    lengths: wp.array[real]
    """(m + k,) lengths of the rows before scaling."""
    bounds: wp.array2d[real]
    """(2, m + k) lower and upper bounds before scaling."""
    values: wp.array[real]
    """(m + 3n,) scratch memory for products of the QP's matrices with ``trial``."""
    multipliers: wp.array[real]
    """(k,) multipliers of the mode rows."""
    kinds: wp.array2d[int]
    """(4, n) contact modes in four slots: ``CURRENT``, the region being solved; ``NEXT``, the region beyond all of its
    active bounds; ``NEXT_SINGLE``, the region beyond its strongest active bound only; ``WARM_START``, the
    ``NEXT_SINGLE`` of the best region so far."""
    slips: wp.array3d[real]
    """(4, n, 2) slip directions in the four slots of ``kinds``."""
    start: wp.array[real]
    """(m,) activations at which the search enters the region."""
    trial: wp.array[real]
    """(m + 3n,) activations, clamped to their bounds, and the contact forces for them."""


@wp.struct
class Program:
    """Packed QP (``CoulombProgram``) and the offset of each of its parts in ``packed``."""

    packed: wp.array[real]
    """Packed QP, in the layout that ``mode_search_kernel`` documents."""
    m: int
    """Number of activations."""
    n: int
    """Number of contacts."""
    size: int
    """m + 3n."""
    friction: real
    """Coulomb coefficient mu."""
    constant: real
    """Constant of the objective."""
    cost: int
    """Offset of P (m + 3n, m + 3n)."""
    slope: int
    """Offset of q (m + 3n,)."""
    rows: int
    """Offset of the rows (3n, m + 3n) of the contact velocities."""
    offset: int
    """Offset of the constants (3n,) of the contact velocities."""
    lower: int
    """Offset of the lower bounds (m,) of the activations."""
    upper: int
    """Offset of the upper bounds (m,) of the activations."""


@wp.func
def count_of(program: Program, workspace: Workspace, kind: int):
    """Return the number of contacts in mode ``kind``."""
    count = int(0)
    for i in range(program.n):
        if workspace.kinds[_CURRENT, i] == kind:
            count += 1
    return count


@wp.func
def write_row(
    workspace: Workspace, before: int, row: int, contact: int, transition: int, terms: wp.vec3i, coefficients: wp.vec3d
):
    """Write mode row ``row`` of ``contact``, and append it to the list of this contact's rows after row ``before`` (-1
    if it is the first); return its index.
    """
    workspace.contact[row] = contact
    workspace.transition[row] = transition
    workspace.next[row] = -1
    if before >= 0:
        workspace.next[before] = row
    else:
        workspace.first[contact] = row
    for t in range(3):
        workspace.base_rows[row, t] = terms[t]
        workspace.coefficients[row, t] = coefficients[t]
    return row


@wp.func
def list_contact_rows(program: Program, workspace: Workspace, sticks: int, slides: int):
    """List the force components of closed contacts, the velocities that bound the region, and the terms of all mode
    rows, for ``sticks`` sticking and ``slides`` sliding contacts.
    """
    closed_count = 3 * (sticks + slides)
    mu = program.friction
    zero = real(0.0)
    for i in range(lane_of_block(), program.n, wp.block_dim()):
        before = wp.vec3i(0, 0, 0)
        kind = workspace.kinds[_CURRENT, i]
        for j in range(i):
            other = workspace.kinds[_CURRENT, j]
            before[other] = before[other] + 1
        order = before[kind]
        closed_row = 3 * (before[1] + before[2])
        held_row = 3 * before[1] + before[2]
        speed = 2 * before[2] + before[0]
        workspace.held_index[i] = held_row
        if kind == _FREE:
            workspace.speeds[speed] = 3 * i
            row = 9 * sticks + 3 * slides + order
            p = closed_count + speed
            write_row(workspace, -1, row, i, _TO_TOUCHING, wp.vec3i(p, p, p), wp.vec3d(real(1.0), zero, zero))
        else:
            for t in range(3):
                workspace.closed_forces[closed_row + t] = 3 * i + t
            workspace.held_forces[held_row] = 3 * i
            terms = wp.vec3i(closed_row, closed_row + 1, closed_row + 2)
            row = order
            if kind == _SLIDE:
                row += sticks
            last = write_row(workspace, -1, row, i, _TO_FREE, terms, wp.vec3d(real(1.0), zero, zero))
            if kind == _STICK:
                workspace.held_forces[held_row + 1] = 3 * i + 1
                workspace.held_forces[held_row + 2] = 3 * i + 2
                for face in range(_FACES):
                    row = sticks + slides + face * sticks + order
                    coefficient = wp.vec3d(mu * _FACE_COSINE, -COSINES[face], -SINES[face])
                    last = write_row(workspace, last, row, i, _TO_SLIDE, terms, coefficient)
            else:
                workspace.speeds[speed] = 3 * i + 1
                workspace.speeds[speed + 1] = 3 * i + 2
                p = closed_count + speed
                terms = wp.vec3i(p, p + 1, p + 1)
                d0 = workspace.slips[_CURRENT, i, 0]
                d1 = workspace.slips[_CURRENT, i, 1]
                for half in range(2):
                    side = real(1 - 2 * half)
                    row = 9 * sticks + slides + half * slides + order
                    coefficient = wp.vec3d(
                        _SECTOR_SINE * d0 - side * _SECTOR_COSINE * d1,
                        _SECTOR_SINE * d1 + side * _SECTOR_COSINE * d0,
                        zero,
                    )
                    last = write_row(workspace, last, row, i, _TO_OTHER_DIRECTION, terms, coefficient)
    sync_block()


@wp.func
def solve_force_map(program: Program, workspace: Workspace, closed_count: int, held_count: int):
    """Compute the forces of closed contacts as affine functions of the activations, such that the held contact
    velocities are zero.

    The elimination does not exchange rows.

    Returns: 1, or 0 if a pivot is too small.
    """
    lane = lane_of_block()
    m = program.m
    width = held_count + m + 1
    for e in range(lane, held_count * width, wp.block_dim()):
        a = e / width
        c = e % width
        row = program.rows + workspace.held_forces[a] * program.size
        value = real(0.0)
        if c < held_count:
            f = workspace.held_forces[c]
            i = f / 3
            value = program.packed[row + m + f]
            if workspace.kinds[_CURRENT, i] == _SLIDE:
                value -= program.friction * (
                    program.packed[row + m + f + 1] * workspace.slips[_CURRENT, i, 0]
                    + program.packed[row + m + f + 2] * workspace.slips[_CURRENT, i, 1]
                )
        elif c < held_count + m:
            value = -program.packed[row + c - held_count]
        else:
            value = -program.packed[program.offset + workspace.held_forces[a]]
        workspace.equations[a, c] = value
    sync_block()
    mean = real(0.0)
    for a in range(lane, held_count, wp.block_dim()):
        mean += wp.abs(workspace.equations[a, a]) / real(held_count)
    mean = sum_of_block(mean)
    sync_block()
    for a in range(lane, held_count, wp.block_dim()):
        workspace.equations[a, a] = workspace.equations[a, a] + _REGULARIZATION * mean
    sync_block()
    if eliminate(workspace.equations, held_count, width, _MIN_PIVOT) == 0:
        return 0
    for e in range(lane, closed_count * (m + 1), wp.block_dim()):
        g = e / (m + 1)
        c = e % (m + 1)
        f = workspace.closed_forces[g]
        i = f / 3
        t = f % 3
        a = workspace.held_index[i]
        coefficient = real(1.0)
        if workspace.kinds[_CURRENT, i] == _STICK:
            a += t
        elif t > 0:
            coefficient = -program.friction * workspace.slips[_CURRENT, i, t - 1]
        workspace.force_map[g, c] = coefficient * workspace.equations[a, held_count + c]
    sync_block()
    return 1


@wp.func
def write_cost(program: Program, workspace: Workspace, closed_count: int):
    """Compute the quadratic cost of the activations alone by eliminating the forces."""
    lane = lane_of_block()
    m = program.m
    for e in range(lane, (m + closed_count) * closed_count, wp.block_dim()):
        i = e / closed_count
        g = e % closed_count
        row = i
        if i >= m:
            row = m + workspace.closed_forces[i - m]
        workspace.cost_rows[i, g] = program.packed[program.cost + row * program.size + m + workspace.closed_forces[g]]
    for e in range(lane, (m + closed_count) * (m + 1), wp.block_dim()):
        i = e / (m + 1)
        c = e % (m + 1)
        row = i
        if i >= m:
            row = m + workspace.closed_forces[i - m]
        value = real(0.0)
        if c < m:
            value = program.packed[program.cost + row * program.size + c]
        workspace.cost_products[i, c] = value
    sync_block()
    gemm_add(
        workspace.cost_products, workspace.cost_rows, workspace.force_map, m + closed_count, m + 1, closed_count, 0
    )
    # Add the transposed force map times the force rows to the activation rows.
    for e in range(lane, closed_count * (m + 1), wp.block_dim()):
        g = e / (m + 1)
        c = e % (m + 1)
        workspace.equations[g, c] = workspace.cost_products[m + g, c]
    sync_block()
    gemm_add(workspace.cost_products, workspace.force_map, workspace.equations, m, m + 1, closed_count, 1)
    for e in range(lane, m * m, wp.block_dim()):
        i = e / m
        k = e % m
        workspace.cost[i, k] = real(0.5) * (workspace.cost_products[i, k] + workspace.cost_products[k, i])
    for i in range(lane, m, wp.block_dim()):
        value = program.packed[program.slope + i] + workspace.cost_products[i, m]
        for g in range(closed_count):
            value += workspace.force_map[g, i] * program.packed[program.slope + m + workspace.closed_forces[g]]
        workspace.slope[i] = value
    sync_block()


@wp.func
def write_speeds(program: Program, workspace: Workspace, closed_count: int, speeds: int):
    """Append the contact velocities that bound the region to ``force_map``, as affine functions of the activations."""
    lane = lane_of_block()
    m = program.m
    for e in range(lane, speeds * closed_count, wp.block_dim()):
        s = e / closed_count
        g = e % closed_count
        workspace.cost_rows[s, g] = program.packed[
            program.rows + workspace.speeds[s] * program.size + m + workspace.closed_forces[g]
        ]
    for e in range(lane, speeds * (m + 1), wp.block_dim()):
        s = e / (m + 1)
        c = e % (m + 1)
        value = program.packed[program.offset + workspace.speeds[s]]
        if c < m:
            value = program.packed[program.rows + workspace.speeds[s] * program.size + c]
        workspace.cost_products[s, c] = value
    sync_block()
    gemm_add(workspace.cost_products, workspace.cost_rows, workspace.force_map, speeds, m + 1, closed_count, 0)
    for e in range(lane, speeds * (m + 1), wp.block_dim()):
        s = e / (m + 1)
        c = e % (m + 1)
        workspace.force_map[closed_count + s, c] = workspace.cost_products[s, c]
    sync_block()


@wp.func
def row_value(workspace: Workspace, row: int, values: wp.array[real]):
    """Return the value of mode row ``row`` without its constant, from the ``values`` (T + v,) of forces and
    velocities.
    """
    value = real(0.0)
    for t in range(3):
        value += workspace.coefficients[row, t] * values[workspace.base_rows[row, t]]
    return value


@wp.func
def row_offset(workspace: Workspace, row: int, m: int):
    """Return the constant of mode row ``row``: its value at zero activations. ``m`` is the number of activations."""
    value = real(0.0)
    for t in range(3):
        value += workspace.coefficients[row, t] * workspace.force_map[workspace.base_rows[row, t], m]
    return value


@wp.func
def write_rows(
    program: Program,
    workspace: Workspace,
    rows: UnitConstraints,
    initial_values: wp.array[real],
    map_rows: int,
    mode_rows: int,
):
    """Write all rows in whitened coordinates, scaled to length 1, and their bounds, to ``rows``.

    Args:
        initial_values: (m + mode_rows,) output: scaled row values at the start minus those at the unconstrained
            minimum.
        map_rows: number of rows of ``force_map``.
        mode_rows: number of mode rows.
    """
    lane = lane_of_block()
    m = program.m
    for e in range(lane, map_rows * m, wp.block_dim()):
        rows.units[e / m, e % m] = real(0.0)
    for e in range(lane, m * m, wp.block_dim()):
        rows.units[map_rows + e / m, e % m] = workspace.root[e / m, e % m]
    for row in range(lane, m + mode_rows, wp.block_dim()):
        for t in range(3):
            if row < m:
                rows.base_rows[row, t] = map_rows + row
                rows.coefficients[row, t] = wp.where(t == 0, real(1.0), real(0.0))
            else:
                rows.base_rows[row, t] = workspace.base_rows[row - m, t]
                rows.coefficients[row, t] = workspace.coefficients[row - m, t]
    sync_block()
    gemm_add(rows.units, workspace.force_map, workspace.root, map_rows, m, m, 0)
    multiply(workspace.force_map, map_rows, m, workspace.minimum, workspace.at_minimum)
    multiply(workspace.force_map, map_rows, m, workspace.start, workspace.at_start)
    normalize_rows(rows.units, m, rows.base_rows, rows.coefficients, m + mode_rows, workspace.lengths)
    for row in range(lane, m + mode_rows, wp.block_dim()):
        length = workspace.lengths[row]
        free = real(0.0)
        start = real(0.0)
        if row < m:
            free = workspace.minimum[row]
            start = workspace.start[row]
            workspace.bounds[0, row] = program.packed[program.lower + row] - BOUND_PADDING
            workspace.bounds[1, row] = program.packed[program.upper + row] + BOUND_PADDING
        else:
            free = row_value(workspace, row - m, workspace.at_minimum)
            start = row_value(workspace, row - m, workspace.at_start)
            lower = -row_offset(workspace, row - m, m)
            workspace.bounds[0, row] = wp.min(lower, wp.max(start, lower - _BROKEN)) - _ROUNDING - BOUND_PADDING
            workspace.bounds[1, row] = real(wp.inf)
        rows.values_at_origin[row] = free / length
        initial_values[row] = (start - free) / length
        rows.lower[row] = workspace.bounds[0, row] / length
        rows.upper[row] = workspace.bounds[1, row] / length
        rows.slack[row] = ROW_TOLERANCE * wp.max(real(1.0), length) / length
    sync_block()
