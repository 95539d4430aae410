"""Constraints of a QP in whitened coordinates, where the Hessian is the identity, and their inner products, as native
CPU code with vectors of four.

Host code: ``egs_warp/locomotion/active_set.py``.
"""

import warp as wp

from egs_warp.kernels.vectors import FRONT_ELIMINATION, on_cpu
from egs_warp.precision import Vec4, real

wp.set_module_options({"enable_backward": False})

STEP = 32
"""Granularity of the row capacity."""


@wp.struct
class WhitenedConstraints:
    """Constraints in coordinates z = D^1/2 L^T (x - x0) of a QP with Hessian P = L D L^T and minimum x0.

    The capacity is m rows, a multiple of ``STEP``. n is the number of unknowns, ``wide`` is n rounded up to a multiple
    of 8.
    """

    lower: wp.array2d[real]
    """(n, wide) L; its unit diagonal is not stored."""
    upper: wp.array2d[real]
    """(n, wide) transpose of L."""
    roots: wp.array[real]
    """(n,) D^-1/2."""
    minimum: wp.array[real]
    """(n,) x0."""
    rows: wp.array2d[Vec4]
    """(m, wide / 4) rows over z, each of length 1 or 0."""
    columns: wp.array2d[real]
    """(n, m) transpose of ``rows``."""
    free: wp.array[real]
    """(m,) values of the original rows at x0."""
    lengths: wp.array[real]
    """(m,) lengths of the rows over z before scaling, 1 for rows of zeros."""
    products: wp.array2d[Vec4]
    """(m, m / 4) inner products of the scaled rows, computed on demand."""
    has_products: wp.array[wp.int32]
    """(m,) 1 if the products of a row have been computed."""
    scratch: wp.array[real]
    """(``scratch_size``,) scratch."""


def scratch_size(unknowns: int, wide: int) -> int:
    """Return the size of the scratch memory in float64 numbers."""
    return 16 * wide + 512 * (wide // 16 + 1) + unknowns


@wp.func_native(
    on_cpu(
        FRONT_ELIMINATION
        + """
    const int wide = lower.strides[0] / 8, tall = columns.strides[0] / 8, blocks = (n + BLOCK - 1) / BLOCK;
    const double *const P = (const double*)hessian, *const q = (const double*)slope, *const A = (const double*)matrix;
    double *const L = lower.data, *const U = upper.data, *const x = minimum.data, *const Z = (double*)rows.data;
    double *const T = scratch.data, *const inverses = T + BLOCK * wide;
    double *const flipped = inverses + BLOCK * BLOCK * blocks, *const reciprocals = flipped + BLOCK * BLOCK * blocks;
    for (int i = 0; i < n; ++i) {
        for (int k = 0; k <= i; ++k) L[i * wide + k] = P[i * hessian_stride + k];
        for (int k = i + 1; k < wide; ++k) L[i * wide + k] = 0.0;
    }
    if (eliminate_front(L, n, n, wide, T, 0.0, inverses, reciprocals) != 0) return 0;
    for (int i = 0; i < n; ++i) {
        for (int k = 0; k < i; ++k) U[k * wide + i] = L[i * wide + k];
        roots.data[i] = __builtin_sqrt(reciprocals[i]);
        x[i] = -q[i];
    }
    for (int k = 0; k < n; ++k)
        for (int i = n; i < wide; ++i) U[k * wide + i] = 0.0;
    for (int k = 0; k < n; ++k) {
        const double by = x[k];
        for (int i = k + 1; i < n; ++i) x[i] -= U[k * wide + i] * by;
    }
    for (int k = n - 1; k >= 0; k -= 1) x[k] *= reciprocals[k];
    for (int k = n - 1; k >= 0; k -= 1) {
        const double by = x[k];
        for (int i = 0; i < k; ++i) x[i] -= L[k * wide + i] * by;
    }
    for (int b = 0; b < blocks; ++b)
        for (int i = 0; i < BLOCK; ++i)
            for (int k = 0; k < BLOCK; ++k)
                flipped[(b * BLOCK + k) * BLOCK + i] = -inverses[(b * BLOCK + i) * BLOCK + k];
    for (int i = 0; i < tall; i += 4) {
        double* const z = Z + i * wide;
        for (int t = 0; t < 4; ++t) {
            double at = 0.0;
            const double* const a = A + (long long)(i + t) * matrix_stride;
            const int valid = i + t < m ? n : 0;
            for (int c = 0; c < valid; ++c) z[t * wide + c] = a[c];
            for (int c = valid; c < wide; ++c) z[t * wide + c] = 0.0;
            v4 sum = 0.0;
            int c = 0;
            for (; c + 4 <= valid; c += 4) sum += *(const v4*)(a + c) * *(const v4*)(x + c);
            for (; c < valid; ++c) at += a[c] * x[c];
            free.data[i + t] = at + ((sum[0] + sum[1]) + (sum[2] + sum[3]));
            known.data[i + t] = 0;
        }
        for (int b = 0; b < n; b += BLOCK) {
            const int some = n - b < BLOCK ? n - b : BLOCK;
            double own[4 * BLOCK] = {0.0};
            for (int c = 0; c < some; c += 8) {
                double* const y = z + b + c;
                take_off(y, y + wide, y + 2 * wide, y + 3 * wide, z, z + wide, z + 2 * wide, z + 3 * wide, U + b + c,
                         wide, b);
            }
            for (int c = 0; c < some; c += 8)
                take_off(own + c, own + BLOCK + c, own + 2 * BLOCK + c, own + 3 * BLOCK + c, z + b, z + wide + b,
                         z + 2 * wide + b, z + 3 * wide + b, flipped + b * BLOCK + c, BLOCK, some);
            for (int t = 0; t < 4; ++t)
                for (int c = 0; c < some; ++c) z[t * wide + b + c] = own[t * BLOCK + c];
        }
        for (int t = 0; t < 4; ++t) {
            double* const row = z + t * wide;
            v4 sum = 0.0;
            for (int c = 0; c < n; ++c) row[c] *= roots.data[c];
            for (int c = 0; c < wide; c += 4) sum += *(v4*)(row + c) * *(v4*)(row + c);
            const double square = (sum[0] + sum[1]) + (sum[2] + sum[3]);
            const double length = square > 0.0 ? __builtin_sqrt(square) : 1.0, by = 1.0 / length;
            lengths.data[i + t] = length;
            for (int c = 0; c < wide; c += 4) *(v4*)(row + c) *= by;
        }
        for (int c = 0; c < n; ++c) {
            const v4 column = {z[c], z[wide + c], z[2 * wide + c], z[3 * wide + c]};
            *(v4*)(columns.data + c * tall + i) = column;
        }
    }
    return 1;
""",
        elsewhere="return 0;",
    )
)
def whiten_native(
    n: wp.int32,
    m: wp.int32,
    hessian: wp.uint64,
    hessian_stride: wp.int32,
    slope: wp.uint64,
    matrix: wp.uint64,
    matrix_stride: wp.int32,
    lower: wp.array2d[real],
    upper: wp.array2d[real],
    roots: wp.array[real],
    minimum: wp.array[real],
    rows: wp.array2d[Vec4],
    columns: wp.array2d[real],
    free: wp.array[real],
    lengths: wp.array[real],
    known: wp.array[wp.int32],
    scratch: wp.array[real],
) -> wp.int32:
    """Whiten the constraints as described at ``reduce_kernel``; return 1, or 0 if the Hessian is not positive
    definite."""
    ...


@wp.func_native(
    on_cpu(
        """
    const int wide = rows.strides[0] / 8, tall = columns.strides[0] / 8;
    const double* const Z = (const double*)rows.data;
    double *const minus = scratch.data, *const out = (double*)products.data;
    int some = 0, which[4];
    for (int i = 0; i <= count; ++i) {
        const int row = i < count ? active.data[i] : further;
        if (row >= 0 && !known.data[row]) {
            known.data[row] = 1;
            for (int c = 0; c < wide; ++c) minus[some * wide + c] = -Z[row * wide + c];
            for (int c = 0; c < tall; ++c) out[row * tall + c] = 0.0;
            which[some++] = row;
        }
        if (some == 4)
            for (int c = 0; c < tall; c += 8)
                take_off(out + which[0] * tall + c, out + which[1] * tall + c, out + which[2] * tall + c,
                         out + which[3] * tall + c, minus, minus + wide, minus + 2 * wide, minus + 3 * wide,
                         columns.data + c, tall, n);
        else if (i == count)
            for (int s = 0; s < some; ++s)
                for (int c = 0; c < tall; c += 8)
                    take_off_one(out + which[s] * tall + c, minus + s * wide, columns.data + c, tall, n);
        if (some == 4) some = 0;
    }
"""
    )
)
def fetch_products(
    n: wp.int32,
    active: wp.array[wp.int32],
    count: wp.int32,
    further: wp.int32,
    rows: wp.array2d[Vec4],
    columns: wp.array2d[real],
    products: wp.array2d[Vec4],
    known: wp.array[wp.int32],
    scratch: wp.array[real],
):
    """Compute the products of the first ``count`` rows in ``active``, and of row ``further`` (-1: none), with all rows.
    Cached products are not recomputed."""
    ...


@wp.func_native(
    on_cpu(
        """
    const int wide = lower.strides[0] / 8, n = minimum.shape[0];
    double* const to = (double*)point;
    for (int c = 0; c < n; ++c) to[c] = 0.0;
    for (int i = 0; i < count; ++i) {
        const int row = active.data[i];
        const double by = side.data[row] > 0 ? multipliers.data[i] : -multipliers.data[i];
        const double* const z = (const double*)rows.data + row * wide;
        for (int c = 0; c < n; ++c) to[c] += by * z[c];
    }
    for (int c = 0; c < n; ++c) to[c] *= roots.data[c];
    for (int k = n - 1; k >= 0; k -= 1) {
        const double by = to[k];
        for (int i = 0; i < k; ++i) to[i] -= lower.data[k * wide + i] * by;
    }
    for (int c = 0; c < n; ++c) to[c] += minimum.data[c];
"""
    )
)
def write_point(
    lower: wp.array2d[real],
    roots: wp.array[real],
    minimum: wp.array[real],
    rows: wp.array2d[Vec4],
    active: wp.array[wp.int32],
    side: wp.array[wp.int32],
    multipliers: wp.array[real],
    count: wp.int32,
    point: wp.uint64,
):
    """Write the n numbers of x to the address ``point``, given the ``multipliers`` of the ``active`` rows and their
    sides."""
    ...


@wp.kernel
def reduce_kernel(
    # In:
    hessian: wp.uint64,
    hessian_stride: wp.int32,
    slope: wp.uint64,
    matrix: wp.uint64,
    matrix_stride: wp.int32,
    rows: wp.int32,
    # Out:
    reduced_out: WhitenedConstraints,
    definite: wp.array[wp.int32],
) -> None:
    """Whiten the QP min 1/2 x^T P x + q^T x with constraint rows A, in one thread.

    Array arguments other than the outputs are addresses; strides are in numbers.

    Args:
        hessian: P (n, n), of which the lower triangle is read.
        hessian_stride: row stride of P.
        slope: q (n,).
        matrix: A (rows, n).
        matrix_stride: row stride of A.
        rows: number of rows.
        reduced_out: whitened constraints.
        definite: (1,) 1, or 0 if P is not positive definite.
    """
    definite[0] = whiten_native(
        reduced_out.minimum.shape[0], rows, hessian, hessian_stride, slope, matrix, matrix_stride, reduced_out.lower,
        reduced_out.upper, reduced_out.roots, reduced_out.minimum, reduced_out.rows, reduced_out.columns,
        reduced_out.free, reduced_out.lengths, reduced_out.has_products, reduced_out.scratch,
    )  # fmt: skip
