"""Linear equations of a Newton step on contact forces: the generalised Jacobian of the projection equations, and its
elimination.

The elimination here is the general one, with row exchanges; ``coulomb_step`` and ``coulomb_wide_step`` are faster on a
GPU. A block of threads solves each problem (see ``kernels.contact.coulomb``); ``lane`` is the index of a thread.
"""

import warp as wp

from egs_warp.kernels.block import sync_block
from egs_warp.kernels.vectors import ROW_ELIMINATION, on_cpu
from egs_warp.precision import Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})

_ACROSS = wp.constant(32)
"""Number of threads that share a row of the equations."""
_SINGULAR = wp.constant(real(1e-14))
"""Relative pivot threshold. An unknown stays zero if its pivot is not larger than this fraction of the largest pivot so
far."""


@wp.struct
class Contacts:
    """Coulomb problem of n contacts. Forces and velocities are stored contact by contact: one normal and two tangential
    components. Arrays may have extra capacity."""

    count: int
    """Number n of contacts."""
    delassus: wp.array2d[real]
    """(3n, 3n) m/(N s), Delassus operator."""
    free_velocity: wp.array[real]
    """(3n,) m/s, contact velocities without contact forces."""
    normal_bias: wp.array[real]
    """(n,) m/s, bias that is added to the normal velocities."""
    friction: real
    """Coulomb coefficient mu."""


@wp.struct
class Newton:
    """Workspace of the Newton method for 3n forces."""

    lane: int
    """Index of the thread in its block."""
    velocities: wp.array[real]
    """(3n,) m/s, contact velocities, including the normal bias."""
    residual: wp.array[real]
    """(3n,) newtons, residual of the projection equations."""
    step: wp.array[real]
    """(3n,) newtons, full Newton step."""
    velocity_change: wp.array[real]
    """(3n,) m/s, change of the velocities in the full step."""
    best_forces: wp.array[real]
    """(3n,) newtons, forces with the smallest residual so far."""
    unknowns: wp.array[int]
    """(3n,) indices of the step components that are unknowns of the linear equations."""
    pivots: wp.array[int]
    """(3n,) pivot column of each row."""
    matrix: wp.array2d[Vec4]
    """(3n, >= (3n + 1) / 4) linear equations, four columns to a vector; the right-hand side is the last column."""


@wp.struct
class Pivots:
    """State of the elimination."""

    rank: int
    """Number of rows with a pivot."""
    largest: real
    """Largest pivot so far."""
    panel_count: int
    """Number of pivots in the last panel."""
    parts: wp.vec4i
    """Columns of the pivots in the last panel, within the panel."""


@wp.func
def rate_of(contacts: Contacts, i: int, scale: real):
    """Return the projection rate of contact ``i`` in N s/m: ``scale`` divided by the mean diagonal entry of the
    contact's block of the Delassus operator."""
    n = 3 * i
    trace = contacts.delassus[n, n] + contacts.delassus[n + 1, n + 1] + contacts.delassus[n + 2, n + 2]
    return scale * real(3.0) / trace


@wp.func_native("""
    const int n = row - row % 3, stride = delassus.strides[0] / 8;
    const double* const g = (const double*)delassus.data + n * stride;
    double* const out = (double*)((char*)matrix.data + a * matrix.strides[0]);
    const double w0 = weights[0], w1 = weights[1], w2 = weights[2];
#if defined(__CUDA_ARCH__)
    double right = 0.0;
    for (int c = place; c < size; c += places)
        right -= (w0 * g[c] + w1 * g[stride + c] + w2 * g[2 * stride + c]) * step.data[c];
    for (int other = 16; other > 0; other >>= 1) right += __shfl_xor_sync(0xffffffffu, right, other);
    right -= values.data[row];
    for (int t = 0; t < 3; ++t) right -= own[t] * step.data[n + t];
    for (int b = place; b < unknowns; b += places) {
        const int c = columns.data[b];
        double entry = w0 * g[c] + w1 * g[stride + c] + w2 * g[2 * stride + c];
        for (int t = 0; t < 3; ++t)
            if (c == n + t) entry += own[t];
        out[b] = entry;
    }
    if (place != 0) return;
#else
    double right = -values.data[row];
    for (int c = 0; c < size; ++c) {
        const double moved = step.data[c];
        if (moved != 0.0) right -= (w0 * g[c] + w1 * g[stride + c] + w2 * g[2 * stride + c]) * moved;
    }
    for (int t = 0; t < 3; ++t) right -= own[t] * step.data[n + t];
    if (unknowns == size) {
        for (int c = 0; c < size; ++c) out[c] = w0 * g[c] + w1 * g[stride + c] + w2 * g[2 * stride + c];
        for (int t = 0; t < 3; ++t) out[n + t] += own[t];
    } else {
        for (int b = 0; b < unknowns; ++b) {
            const int c = columns.data[b];
            out[b] = w0 * g[c] + w1 * g[stride + c] + w2 * g[2 * stride + c];
            if (c >= n && c < n + 3) out[b] += own[c - n];
        }
    }
#endif
    out[unknowns] = right;
    for (int b = unknowns + 1; b & 3; ++b) out[b] = 0.0;
""")
def write_row(
    delassus: wp.array2d[real],
    step: wp.array[real],
    values: wp.array[real],
    columns: wp.array[int],
    size: int,
    unknowns: int,
    a: int,
    row: int,
    weights: Vec3,
    own: Vec3,
    place: int,
    places: int,
    matrix: wp.array2d[Vec4],
):
    """Write row ``row`` of the generalised Jacobian and its right-hand side as row ``a`` of the linear equations.

    The row is the sum of the contact's three rows of the Delassus operator with the coefficients ``weights``, plus the
    three entries ``own`` in the columns of the contact. Only the columns of unknowns are stored; the contributions of
    known components of the step are moved to the right-hand side.

    Args:
        delassus: (3n, 3n) m/(N s), Delassus operator.
        step: (3n,) newtons, known components of the step; 0 for unknowns.
        values: (3n,) newtons, residual of the projection equations.
        columns: (unknowns,) indices of the unknown components.
        size: 3n.
        unknowns: number of unknowns.
        a: row of the linear equations.
        row: row of the generalised Jacobian.
        weights: N s/m, coefficients of the contact's rows of the Delassus operator.
        own: entries that are added in the columns of the contact.
        place: index of the thread in its warp; on a GPU it writes every entry ``place`` + k ``places``.
        places: number of threads that write the row: 32 on a GPU.
        matrix: output, the linear equations.
    """
    ...


@wp.func
def write_equations(contacts: Contacts, forces: wp.array[real], scale: real, regularization: real, newton: Newton):
    """Assemble the linear equations of a Newton step according to the state of each contact: separating, sticking or
    sliding.

    Components that project to zero are known: their step is minus the residual.

    Args:
        contacts: the problem.
        forces: (3n,) newtons, forces at the start of the step.
        scale: scale of the projection rates (``rate_of``).
        regularization: added to the diagonal of normal and sticking components.
        newton: workspace, with the velocities and the residual at ``forces``.

    Returns:
        The number of unknowns.
    """
    # All lanes write the same values here.
    unknowns = int(0)
    for i in range(contacts.count):
        n = 3 * i
        rate = rate_of(contacts, i, scale)
        if forces[n] - rate * newton.velocities[n] > real(0.0):
            newton.step[n] = real(0.0)
            newton.unknowns[unknowns] = n
            unknowns += 1
        else:
            newton.step[n] = -newton.residual[n]
        first = forces[n + 1] - rate * newton.velocities[n + 1]
        second = forces[n + 2] - rate * newton.velocities[n + 2]
        if forces[n] <= real(0.0) and first * first + second * second > real(0.0):
            newton.step[n + 1] = -newton.residual[n + 1]
            newton.step[n + 2] = -newton.residual[n + 2]
        else:
            newton.step[n + 1] = real(0.0)
            newton.step[n + 2] = real(0.0)
            newton.unknowns[unknowns] = n + 1
            newton.unknowns[unknowns + 1] = n + 2
            unknowns += 2
    sync_block()
    across = wp.min(wp.block_dim(), _ACROSS)
    for a in range(newton.lane / across, unknowns, wp.block_dim() / across):
        row = newton.unknowns[a]
        i = row / 3
        n = 3 * i
        rate = rate_of(contacts, i, scale)
        weights = Vec3()
        own = Vec3()
        weights[row - n] = rate
        own[row - n] = regularization
        if row > n:
            first = forces[n + 1] - rate * newton.velocities[n + 1]
            second = forces[n + 2] - rate * newton.velocities[n + 2]
            pull = wp.sqrt(first * first + second * second)
            radius = contacts.friction * wp.max(forces[n], real(0.0))
            if pull > radius:
                # Sliding: I - share (I - d d^T) (I - rate G) with the Delassus operator G; -friction d in the column of
                # f_n.
                share = radius / pull
                d = wp.vec2d(first / pull, second / pull)
                mine = d[row - n - 1]
                along = wp.vec2d(-share * mine * d[0], -share * mine * d[1])
                along[row - n - 1] = share * (real(1.0) - mine * mine)
                weights = Vec3(real(0.0), rate * along[0], rate * along[1])
                own = Vec3(-contacts.friction * mine, -along[0], -along[1])
                own[row - n] = own[row - n] + real(1.0)
        write_row(
            contacts.delassus, newton.step, newton.residual, newton.unknowns, 3 * contacts.count, unknowns, a, row,
            weights, own, newton.lane % across, across, newton.matrix,
        )  # fmt: skip
    sync_block()
    return unknowns


@wp.func_native("""
    int best = rank;
#if defined(__CUDA_ARCH__)
    // Entries are compared in single precision, which is enough for a pivot. Positive floats sort like their bits.
    __shared__ unsigned int sizes[32];
    __shared__ int rows[32];
    const double* const M = (const double*)matrix.data;
    const int stride = matrix.strides[0] / 8;
    unsigned int size = 0;
    for (int a = rank + lane; a < unknowns; a += blockDim.x) {
        const float candidate = (float)fabs(M[a * stride + column]);
        const unsigned int bits = candidate > 0.0f ? __float_as_uint(candidate) : 0;
        if (bits > size) { size = bits; best = a; }
    }
    for (int other = 16; other > 0; other >>= 1) {
        const unsigned int theirs = __shfl_xor_sync(0xffffffffu, size, other);
        const int row = __shfl_xor_sync(0xffffffffu, best, other);
        if (theirs > size || (theirs == size && row < best)) { size = theirs; best = row; }
    }
    if ((lane & 31) == 0) { sizes[lane >> 5] = size; rows[lane >> 5] = best; }
    __syncthreads();
    size = sizes[0];
    best = rows[0];
    for (int i = 1; i < blockDim.x >> 5; ++i)
        if (sizes[i] > size || (sizes[i] == size && rows[i] < best)) { size = sizes[i]; best = rows[i]; }
#endif
    return best;
""")
def pivot_row(
    matrix: wp.array2d[Vec4], column: wp.int32, rank: wp.int32, unknowns: wp.int32, lane: wp.int32
) -> wp.int32:
    """Return the row, from ``rank`` on, with the entry of largest magnitude in ``column``, found by a block of
    threads."""
    ...


@wp.func
def eliminate_panel(panel: int, unknowns: int, pivots: Pivots, newton: Newton):
    """Find the pivots in the four columns of ``panel`` and eliminate within the panel. Below the pivots, the panel then
    contains the multipliers of the pivot rows."""
    lanes = wp.block_dim()
    pivots.panel_count = 0
    for part in range(4):
        if 4 * panel + part < unknowns:
            pivot = pivot_row(newton.matrix, 4 * panel + part, pivots.rank, unknowns, newton.lane)
            size = wp.abs(newton.matrix[pivot, panel][part])
            sync_block()
            if size > _SINGULAR * pivots.largest:
                pivots.largest = wp.max(pivots.largest, size)
                if pivot != pivots.rank:
                    for quad in range(panel + newton.lane, (unknowns + 4) / 4, lanes):
                        swapped = newton.matrix[pivots.rank, quad]
                        newton.matrix[pivots.rank, quad] = newton.matrix[pivot, quad]
                        newton.matrix[pivot, quad] = swapped
                sync_block()
                top = newton.matrix[pivots.rank, panel]
                for a in range(pivots.rank + 1 + newton.lane, unknowns, lanes):
                    row = newton.matrix[a, panel]
                    factor = row[part] / top[part]
                    row[part] = factor
                    for k in range(part + 1, 4):
                        row[k] = row[k] - factor * top[k]
                    newton.matrix[a, panel] = row
                sync_block()
                newton.pivots[pivots.rank] = 4 * panel + part
                pivots.parts[pivots.panel_count] = part
                pivots.panel_count += 1
                pivots.rank += 1
    return pivots


@wp.func_native(
    on_cpu(
        ROW_ELIMINATION
        + """
    double* const M = (double*)matrix.data;
    const int stride = matrix.strides[0] / 8;
    const int rank = eliminate_rows(M, stride, unknowns, (unknowns + 4) & ~3, singular, pivots.data);
    for (int back = rank - 1; back >= 0; back -= 1) {
        const double* const row = M + back * stride;
        const int j = pivots.data[back];
        double value = row[unknowns];
        for (int b = j + 1; b < unknowns; ++b) value -= row[b] * step.data[places.data[b]];
        step.data[places.data[j]] = value / row[j];
    }
"""
    )
)
def solve_alone(
    unknowns: int,
    singular: real,
    pivots: wp.array[int],
    places: wp.array[int],
    matrix: wp.array2d[Vec4],
    step: wp.array[real],
):
    """Solve for the step like ``solve_equations``, with one CPU thread, sixteen columns at a time."""
    ...


@wp.func
def eliminate(unknowns: int, newton: Newton):
    """Eliminate the unknowns with a block of threads, in panels of four columns."""
    lanes = wp.block_dim()
    across = wp.min(lanes, _ACROSS)
    quads = (unknowns + 4) / 4
    pivots = Pivots()
    for panel in range((unknowns + 3) / 4):
        first = pivots.rank
        pivots = eliminate_panel(panel, unknowns, pivots, newton)
        # Update the pivot rows in the later columns, then the rows below them.
        for quad in range(panel + 1 + newton.lane, quads, lanes):
            for t in range(1, pivots.panel_count):
                left = newton.matrix[first + t, quad]
                for s in range(t):
                    left -= newton.matrix[first + t, panel][pivots.parts[s]] * newton.matrix[first + s, quad]
                newton.matrix[first + t, quad] = left
        sync_block()
        for a in range(pivots.rank + newton.lane / across, unknowns, lanes / across):
            shares = newton.matrix[a, panel]
            if pivots.panel_count == 4:
                for quad in range(panel + 1 + newton.lane % across, quads, across):
                    newton.matrix[a, quad] = newton.matrix[a, quad] - (
                        shares[0] * newton.matrix[first, quad]
                        + shares[1] * newton.matrix[first + 1, quad]
                        + shares[2] * newton.matrix[first + 2, quad]
                        + shares[3] * newton.matrix[first + 3, quad]
                    )
            else:
                for s in range(pivots.panel_count):
                    share = shares[pivots.parts[s]]
                    for quad in range(panel + 1 + newton.lane % across, quads, across):
                        newton.matrix[a, quad] = newton.matrix[a, quad] - share * newton.matrix[first + s, quad]
        sync_block()
    return pivots


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // Two slots are used in turn, so that none is overwritten before all threads have read it.
    __shared__ double solved[2];
    double* const M = (double*)matrix.data;
    const int stride = matrix.strides[0] / 8;
    for (int a = lane; a < rank; a += blockDim.x) M[a * stride + pivots.data[a]] = 1.0 / M[a * stride + pivots.data[a]];
    for (int back = rank - 1; back >= 0; back -= 1) {
        const int j = pivots.data[back];
        if (lane == back % blockDim.x) {
            const double own = M[back * stride + unknowns] * M[back * stride + j];
            solved[back & 1] = own;
            step.data[places.data[j]] = own;
        }
        __syncthreads();
        const double value = solved[back & 1];
        for (int a = lane; a < back; a += blockDim.x) M[a * stride + unknowns] -= M[a * stride + j] * value;
    }
    __syncthreads();
#endif
""")
def substitute(
    matrix: wp.array2d[Vec4],
    unknowns: wp.int32,
    rank: wp.int32,
    pivots: wp.array[wp.int32],
    places: wp.array[wp.int32],
    lane: wp.int32,
    step: wp.array[real],
):
    """Back-substitute with a block of threads: after each unknown, every thread updates the right-hand sides of its
    rows."""
    ...


@wp.func
def solve_equations(unknowns: int, newton: Newton):
    """Solve the linear equations for the Newton step by Gaussian elimination with row exchanges. Redundant unknowns are
    set to zero, which keeps the forces bounded."""
    if wp.block_dim() == 1:
        solve_alone(unknowns, _SINGULAR, newton.pivots, newton.unknowns, newton.matrix, newton.step)
        return
    pivots = eliminate(unknowns, newton)
    substitute(newton.matrix, unknowns, pivots.rank, newton.pivots, newton.unknowns, newton.lane, newton.step)
