"""Batches of dense quadratic programs, scaled by equilibration as in OSQP.

The iterations are in ``egs_warp/kernels/locomotion/admm.py``, host code in ``egs_warp/locomotion/admm.py``.
"""

import warp as wp

from egs_warp.kernels.block import block_max, sum_of_block, sync_block
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

BY_VARIABLE, BY_ROW = 5, 9
"""Numbers of vectors per program in ``AdmmWorkspace.by_variable`` and ``AdmmWorkspace.by_row``."""

_MIN_NORM, _MAX_NORM = wp.constant(real(1e-4)), wp.constant(real(1e4))
"""Norms below the first value are replaced by 1 in the scaling; norms above the second are clamped to it."""


@wp.struct
class Programs:
    """k programs of up to n variables and m rows each. Entries outside a program's own size are not read."""

    P: wp.array3d[real]
    """(k, n, n)."""
    q: wp.array2d[real]
    """(k, n)."""
    A: wp.array3d[real]
    """(k, m, n)."""
    lower: wp.array2d[real]
    upper: wp.array2d[real]
    """(k, m) bounds of A x."""
    variables: wp.array[int]
    rows: wp.array[int]
    """(k,) numbers of variables and rows of each program."""


@wp.struct
class Iterates:
    """Starting point of the iterations, and their last iterates on return."""

    x: wp.array2d[real]
    """(k, n)."""
    y: wp.array2d[real]
    """(k, m) multipliers, positive where the upper bound is active."""
    rho: wp.array[real]
    """(k,) step size of the splitting."""


@wp.struct
class AdmmWorkspace:
    """Scaled data of all programs: x = D x', y = E y' / c, P' = c D P D, A' = E A D."""

    P: wp.array3d[real]
    """(k, n, n) P'."""
    inverse: wp.array3d[real]
    """(k, n, n) minus the inverse of K."""
    rows: wp.array3d[real]
    """(k, m, n) A'."""
    columns: wp.array3d[real]
    """(k, n, m) A'^T."""
    by_variable: wp.array3d[real]
    """(k, 5, n): q', D, x', the step to the next x', and scratch."""
    by_row: wp.array3d[real]
    """(k, 9, m): l', u', E, rho, A' x', z', y', the last change of y', and scratch."""


@wp.struct
class Scaled:
    """Views of one program's data in ``AdmmWorkspace``."""

    variables: int
    row_count: int
    P: wp.array2d[real]
    inverse: wp.array2d[real]
    rows: wp.array2d[real]
    columns: wp.array2d[real]
    q: wp.array[real]
    column_scale: wp.array[real]
    """(n,) D."""
    x: wp.array[real]
    step: wp.array[real]
    variable_scratch: wp.array[real]
    """(n,) scratch."""
    lower: wp.array[real]
    upper: wp.array[real]
    row_scale: wp.array[real]
    """(m,) E."""
    rho: wp.array[real]
    row_values: wp.array[real]
    """(m,) A' x'."""
    z: wp.array[real]
    y: wp.array[real]
    change: wp.array[real]
    """(m,) change of y' in the last iteration."""
    row_scratch: wp.array[real]
    """(m,) scratch."""


@wp.func
def program_view(program: int, programs: Programs, memory: AdmmWorkspace):
    """Return the views of ``program``'s data."""
    own = Scaled()
    own.variables = programs.variables[program]
    own.row_count = programs.rows[program]
    own.P = memory.P[program]
    own.inverse = memory.inverse[program]
    own.rows = memory.rows[program]
    own.columns = memory.columns[program]
    own.q = memory.by_variable[program, 0]
    own.column_scale = memory.by_variable[program, 1]
    own.x = memory.by_variable[program, 2]
    own.step = memory.by_variable[program, 3]
    own.variable_scratch = memory.by_variable[program, 4]
    own.lower = memory.by_row[program, 0]
    own.upper = memory.by_row[program, 1]
    own.row_scale = memory.by_row[program, 2]
    own.rho = memory.by_row[program, 3]
    own.row_values = memory.by_row[program, 4]
    own.z = memory.by_row[program, 5]
    own.y = memory.by_row[program, 6]
    own.change = memory.by_row[program, 7]
    own.row_scratch = memory.by_row[program, 8]
    return own


@wp.func
def max_abs_entry(matrix: wp.array2d[real], column: int, vector: wp.array[real], count: int):
    """Return the largest absolute entry of ``column`` (first ``count`` entries) times ``vector``, which is
    nonnegative."""
    max_entry = real(0.0)
    for i in range(count):
        max_entry = wp.max(max_entry, wp.abs(matrix[i, column]) * vector[i])
    return max_entry


@wp.func
def limited_norm(norm: real):
    """Return ``norm``, limited as in OSQP, by whose square root a row or column is divided."""
    if norm < _MIN_NORM:
        return real(1.0)
    return wp.min(norm, _MAX_NORM)


@wp.func
def equilibrate(lane: int, P: wp.array2d[real], q: wp.array[real], A: wp.array2d[real], passes: int, own: Scaled):
    """Compute D and E by ``passes`` of Ruiz equilibration; return the cost scale c.

    D and E bring the largest entry of each row and column of the KKT matrix near 1, c does so for the objective. As in
    OSQP 1.1, whose iterations these reproduce, only the upper triangle of P is read.
    """
    n = own.variables
    m = own.row_count
    for j in range(lane, n, wp.block_dim()):
        own.column_scale[j] = real(1.0)
    for i in range(lane, m, wp.block_dim()):
        own.row_scale[i] = real(1.0)
    cost = real(1.0)
    sync_block()
    for _ in range(passes):
        for j in range(lane, n, wp.block_dim()):
            max_entry = cost * max_abs_entry(P, j, own.column_scale, j + 1)
            max_entry = own.column_scale[j] * wp.max(max_entry, max_abs_entry(A, j, own.row_scale, m))
            own.variable_scratch[j] = own.column_scale[j] / wp.sqrt(limited_norm(max_entry))
        for i in range(lane, m, wp.block_dim()):
            max_entry = real(0.0)
            for j in range(n):
                max_entry = wp.max(max_entry, wp.abs(A[i, j]) * own.column_scale[j])
            own.row_scratch[i] = own.row_scale[i] / wp.sqrt(limited_norm(own.row_scale[i] * max_entry))
        sync_block()
        for j in range(lane, n, wp.block_dim()):
            own.column_scale[j] = own.variable_scratch[j]
        for i in range(lane, m, wp.block_dim()):
            own.row_scale[i] = own.row_scratch[i]
        sync_block()
        norms = real(0.0)
        max_entry = real(0.0)
        for j in range(lane, n, wp.block_dim()):
            norms += own.column_scale[j] * max_abs_entry(P, j, own.column_scale, j + 1)
            max_entry = wp.max(max_entry, own.column_scale[j] * wp.abs(q[j]))
        mean = sum_of_block(norms) / real(n)
        max_entry = limited_norm(cost * block_max(max_entry))
        cost = cost / limited_norm(wp.max(cost * mean, max_entry))
    return cost


@wp.func
def write_scaled(lane: int, P: wp.array2d[real], q: wp.array[real], A: wp.array2d[real], cost: real, own: Scaled):
    """Write P', q' and A' to the workspace."""
    n = own.variables
    for entry in range(lane, n * n, wp.block_dim()):
        i = entry / n
        j = entry - i * n
        own.P[i, j] = cost * own.column_scale[i] * own.column_scale[j] * P[i, j]
    for entry in range(lane, own.row_count * n, wp.block_dim()):
        i = entry / n
        j = entry - i * n
        value = own.row_scale[i] * own.column_scale[j] * A[i, j]
        own.rows[i, j] = value
        own.columns[j, i] = value
    for j in range(lane, n, wp.block_dim()):
        own.q[j] = cost * own.column_scale[j] * q[j]
