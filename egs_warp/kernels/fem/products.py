"""Products of a sparse symmetric matrix with panels of vectors, and products of panels with each other, on a CPU.

Threads take panels from a shared counter, so a slow or late thread processes fewer panels. The host code is in
``egs_warp.fem.multifrontal``.
"""

import warp as wp

from egs_warp.kernels.vectors import on_cpu
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

PANEL, STRIP = 16, 8
"""Number of vectors in a panel, and number of vectors that one pass over the matrix processes. A panel is stored with
one row per unknown."""


@wp.struct
class Rows:
    """Sparse matrix in CSR format."""

    offsets: wp.array[wp.int32]
    """(n + 1,) row offsets."""
    indices: wp.array[wp.int32]
    """(nnz,) column of each entry."""
    first_of_equal_rows: wp.array[wp.int32]
    """(n,) 0 for rows with the same columns as the previous row, else 1."""
    values: wp.array[real]
    """(nnz,) entries."""


@wp.func_native("return __atomic_fetch_add(&counters.data[which], 1, __ATOMIC_ACQ_REL);")
def claim_next(counters: wp.array[wp.int32], which: wp.int32) -> wp.int32:
    """Increment the shared counter ``which`` atomically and return its previous value."""
    ...


@wp.func_native("while (__atomic_load_n(&counters.data[which], __ATOMIC_ACQUIRE) < count) {}")
def wait_for(counters: wp.array[wp.int32], which: wp.int32, count: wp.int32) -> None:
    """Spin until counter ``which`` is at least ``count``. Writes of other threads before they incremented the counter
    are then visible."""
    ...


@wp.func_native("return (wp::uint64)values.data;")
def address_of(values: wp.array2d[real]) -> wp.uint64:
    """Return the address of the first element of ``values``."""
    ...


@wp.func_native(
    on_cpu("""
    const double* const x = (const double*)vectors;
    double* const y = (double*)products;
    const int from = strip * 8;
    for (int i = 0; i < rows; ) {
        const int begin = matrix.offsets.data[i], count = matrix.offsets.data[i + 1] - begin;
        // The three rows of a node have the same columns.
        int equal = 1;
        while (equal < 3 && i + equal < rows && matrix.first_of_equal_rows.data[i + equal] == 0) ++equal;
        const int* const to = matrix.indices.data + begin;
        const double* const l0 = matrix.values.data + begin;
        const double *const l1 = equal > 1 ? l0 + count : l0, *const l2 = equal > 2 ? l1 + count : l0;
        double sums[24];
        {
            v4 a0 = 0.0, a1 = 0.0, b0 = 0.0, b1 = 0.0, c0 = 0.0, c1 = 0.0;
            for (int j = 0; j < count; ++j) {
                const double* const z = x + (long long)to[j] * columns + from;
                const v4 x0 = *(const v4*)z, x1 = *(const v4*)(z + 4);
                a0 += l0[j] * x0; a1 += l0[j] * x1; b0 += l1[j] * x0; b1 += l1[j] * x1;
                c0 += l2[j] * x0; c1 += l2[j] * x1;
            }
            *(v4*)sums = a0; *(v4*)(sums + 4) = a1; *(v4*)(sums + 8) = b0; *(v4*)(sums + 12) = b1;
            *(v4*)(sums + 16) = c0; *(v4*)(sums + 20) = c1;
        }
        for (int t = 0; t < equal; ++t)
            for (int q = 0; q < 8; ++q) y[(long long)(i + t) * columns + from + q] = sums[8 * t + q];
        i += equal;
    }
""")
)
def multiply_strip(
    rows: wp.int32, matrix: Rows, vectors: wp.uint64, columns: wp.int32, strip: wp.int32, products: wp.uint64
) -> None:
    """Compute ``STRIP`` columns of the product of a sparse symmetric ``matrix`` with ``vectors``.

    Args:
        rows: number of rows n.
        matrix: the matrix.
        vectors: address of (n, columns) float64.
        columns: row length of the vectors and the products.
        strip: index of the strip.
        products: address of (n, columns) float64, output.
    """
    ...


@wp.func_native(
    on_cpu("""
    const int n = moves.shape[0], width = moves.shape[1];
    double* const X = (double*)moves.data;
    for (int q = 0; q < width; ++q) linear.data[q] = 0.0;
    for (int i = 0; i < n; ++i) {
        double* const row = X + i * width;
        if (columns <= width) row[columns - 1] -= reference.data[i];
        for (int q = columns; q < width; ++q) row[q] = 0.0;
        for (int q = 0; q < width; ++q) linear.data[q] += gradient.data[i] * row[q];
    }
""")
)
def finish_moves(
    columns: wp.int32,
    reference: wp.array[real],
    gradient: wp.array[real],
    moves: wp.array2d[real],
    linear: wp.array[real],
) -> None:
    """Complete a panel of displacements X and compute its linear terms X^T g.

    If the panel contains the last valid column, ``reference`` is subtracted from this column, and the columns behind it
    are set to zero.

    Args:
        columns: number of valid columns in this and the following panels.
        reference: (n,) subtracted from the last valid column.
        gradient: (n,) g.
        moves: (n, ``PANEL``) X, modified in place.
        linear: (``PANEL``,) X^T g, output.
    """
    ...


@wp.func_native(
    on_cpu("""
    constexpr int PANEL = 16, CHUNK = 128;
    const int n = moves.shape[0], stride = quadratic.strides[0] / 8;
    double sums[PANEL][PANEL] = {{0.0}};
    for (int begin = 0; begin < n; begin += CHUNK) {
        const int rows = n - begin < CHUNK ? n - begin : CHUNK;
        for (int i = 0; i < PANEL; i += 4)
            for (int c = 0; c < PANEL; c += 8) {
                const double* x = (const double*)moves.data + begin * PANEL + i;
                const double* y = (const double*)products.data + begin * PANEL + c;
                v4 a0 = 0.0, a1 = 0.0, b0 = 0.0, b1 = 0.0, c0 = 0.0, c1 = 0.0, d0 = 0.0, d1 = 0.0;
                for (int k = 0; k < rows; ++k, x += PANEL, y += PANEL) {
                    const v4 y0 = *(const v4*)y, y1 = *(const v4*)(y + 4);
                    a0 += x[0] * y0; a1 += x[0] * y1; b0 += x[1] * y0; b1 += x[1] * y1;
                    c0 += x[2] * y0; c1 += x[2] * y1; d0 += x[3] * y0; d1 += x[3] * y1;
                }
                const v4 parts[8] = {a0, a1, b0, b1, c0, c1, d0, d1};
                for (int q = 0; q < 8; ++q) *(v4*)(sums[i + q / 2] + c + 4 * (q % 2)) += parts[q];
            }
    }
    double* const to = (double*)quadratic.data;
    for (int i = 0; i < PANEL; ++i)
        for (int c = 0; c < PANEL; ++c) {
            to[(first * PANEL + i) * stride + second * PANEL + c] = sums[i][c];
            if (first != second) to[(second * PANEL + c) * stride + first * PANEL + i] = sums[i][c];
        }
""")
)
def write_quadratic(
    first: wp.int32, second: wp.int32, moves: wp.array2d[real], products: wp.array2d[real], quadratic: wp.array2d[real]
) -> None:
    """Write block (first, second) of the symmetric matrix X^T Y to ``quadratic``, and its transpose to block (second,
    first).

    X are the displacements ``moves`` (n, ``PANEL``) of panel ``first``, and Y = H X the ``products`` of panel
    ``second``.
    """
    ...
