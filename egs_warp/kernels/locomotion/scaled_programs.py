"""Dense quadratic programs as OSQP's iterations have them: scaled, many side by side.

See ``kernels.locomotion.admm``.
"""

import warp as wp

from egs_warp.kernels.block import block_max, sum_of_block, sync_block
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

BY_VARIABLE, BY_ROW = 5, 9
"""Arrays that a program has by variable and by row."""

_FLAT, _STEEP = wp.constant(real(1e-4)), wp.constant(real(1e4))
"""A row or column is taken for one of length 1 where it is shorter, and for no longer where it is longer."""


@wp.struct
class Programs:
    """k programs of up to n variables and m rows each; what lies beyond a program's own is not read."""

    P: wp.array3d[real]
    """(k, n, n)."""
    q: wp.array2d[real]
    """(k, n)."""
    A: wp.array3d[real]
    """(k, m, n)."""
    lower: wp.array2d[real]
    upper: wp.array2d[real]
    """(k, m)."""
    variables: wp.array[int]
    rows: wp.array[int]
    """(k,) of each program."""


@wp.struct
class Iterates:
    """Where iterations start, and where they have ended."""

    x: wp.array2d[real]
    """(k, n)."""
    y: wp.array2d[real]
    """(k, m) multipliers, positive where the upper bound pushes."""
    rho: wp.array[real]
    """(k,)."""


@wp.struct
class AdmmWorkspace:
    """Of all programs, scaled: x = D x', y = E y' / c, P' = c D P D, A' = E A D."""

    P: wp.array3d[real]
    """(k, n, n) P'."""
    inverse: wp.array3d[real]
    """(k, n, n) minus the inverse of K."""
    rows: wp.array3d[real]
    """(k, m, n) A'."""
    columns: wp.array3d[real]
    """(k, n, m) A'^T."""
    by_variable: wp.array3d[real]
    """(k, 5, n): q', D, x', the step to the next x', and what is worked with."""
    by_row: wp.array3d[real]
    """(k, 9, m): l', u', E, rho, A' x', z', y', its last change, and what is worked with."""


@wp.struct
class Scaled:
    """``Memory`` of one program."""

    variables: int
    row_count: int
    P: wp.array2d[real]
    inverse: wp.array2d[real]
    rows: wp.array2d[real]
    columns: wp.array2d[real]
    q: wp.array[real]
    stretch: wp.array[real]
    """D."""
    x: wp.array[real]
    step: wp.array[real]
    slope: wp.array[real]
    """(n,) what is worked with."""
    lower: wp.array[real]
    upper: wp.array[real]
    weight: wp.array[real]
    """E."""
    rho: wp.array[real]
    at: wp.array[real]
    """A' x'."""
    z: wp.array[real]
    y: wp.array[real]
    change: wp.array[real]
    """Of y', in the last iteration."""
    push: wp.array[real]
    """(m,) what is worked with."""


@wp.func
def memory_of(program: int, programs: Programs, memory: AdmmWorkspace):
    """What belongs to ``program``."""
    own = Scaled()
    own.variables = programs.variables[program]
    own.row_count = programs.rows[program]
    own.P = memory.P[program]
    own.inverse = memory.inverse[program]
    own.rows = memory.rows[program]
    own.columns = memory.columns[program]
    own.q = memory.by_variable[program, 0]
    own.stretch = memory.by_variable[program, 1]
    own.x = memory.by_variable[program, 2]
    own.step = memory.by_variable[program, 3]
    own.slope = memory.by_variable[program, 4]
    own.lower = memory.by_row[program, 0]
    own.upper = memory.by_row[program, 1]
    own.weight = memory.by_row[program, 2]
    own.rho = memory.by_row[program, 3]
    own.at = memory.by_row[program, 4]
    own.z = memory.by_row[program, 5]
    own.y = memory.by_row[program, 6]
    own.change = memory.by_row[program, 7]
    own.push = memory.by_row[program, 8]
    return own


@wp.func
def largest_across(matrix: wp.array2d[real], column: int, vector: wp.array[real], count: int):
    """Largest of the products of a ``column`` of ``count`` entries with ``vector``, of which none is negative."""
    most = real(0.0)
    for i in range(count):
        most = wp.max(most, wp.abs(matrix[i, column]) * vector[i])
    return most


@wp.func
def length_of(norm: real):
    """By whose root something of this ``norm`` is divided."""
    if norm < _FLAT:
        return real(1.0)
    return wp.min(norm, _STEEP)


@wp.func
def equilibrate(lane: int, P: wp.array2d[real], q: wp.array[real], A: wp.array2d[real], passes: int, own: Scaled):
    """D and E by ``passes`` of Ruiz's equilibration, which bring the largest entry of each row and column of the
    conditions of the optimum near 1; returns c, which brings the objective's there. As in OSQP 1.1, whose iterations
    are to be these, only the upper triangle of P counts."""
    n = own.variables
    m = own.row_count
    for j in range(lane, n, wp.block_dim()):
        own.stretch[j] = real(1.0)
    for i in range(lane, m, wp.block_dim()):
        own.weight[i] = real(1.0)
    cost = real(1.0)
    sync_block()
    for _ in range(passes):
        for j in range(lane, n, wp.block_dim()):
            most = cost * largest_across(P, j, own.stretch, j + 1)
            most = own.stretch[j] * wp.max(most, largest_across(A, j, own.weight, m))
            own.slope[j] = own.stretch[j] / wp.sqrt(length_of(most))
        for i in range(lane, m, wp.block_dim()):
            most = real(0.0)
            for j in range(n):
                most = wp.max(most, wp.abs(A[i, j]) * own.stretch[j])
            own.push[i] = own.weight[i] / wp.sqrt(length_of(own.weight[i] * most))
        sync_block()
        for j in range(lane, n, wp.block_dim()):
            own.stretch[j] = own.slope[j]
        for i in range(lane, m, wp.block_dim()):
            own.weight[i] = own.push[i]
        sync_block()
        norms = real(0.0)
        most = real(0.0)
        for j in range(lane, n, wp.block_dim()):
            norms += own.stretch[j] * largest_across(P, j, own.stretch, j + 1)
            most = wp.max(most, own.stretch[j] * wp.abs(q[j]))
        mean = sum_of_block(norms) / real(n)
        most = length_of(cost * block_max(most))
        cost = cost / length_of(wp.max(cost * mean, most))
    return cost


@wp.func
def write_scaled(lane: int, P: wp.array2d[real], q: wp.array[real], A: wp.array2d[real], cost: real, own: Scaled):
    """P', q' and A'."""
    n = own.variables
    for entry in range(lane, n * n, wp.block_dim()):
        i = entry / n
        j = entry - i * n
        own.P[i, j] = cost * own.stretch[i] * own.stretch[j] * P[i, j]
    for entry in range(lane, own.row_count * n, wp.block_dim()):
        i = entry / n
        j = entry - i * n
        value = own.weight[i] * own.stretch[j] * A[i, j]
        own.rows[i, j] = value
        own.columns[j, i] = value
    for j in range(lane, n, wp.block_dim()):
        own.q[j] = cost * own.stretch[j] * q[j]
