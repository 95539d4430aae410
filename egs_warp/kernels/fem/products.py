"""Products of a sparse symmetric matrix with many vectors, on a CPU."""

import warp as wp

from egs_warp.kernels.vectors import on_cpu
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

STRIP = 8
"""Columns at a time."""


@wp.func_native(
    on_cpu("""
    const double* const x = (const double*)vectors;
    double* const y = (double*)products;
    const int from = strip * 8, width = columns - from < 8 ? columns - from : 8;
    for (int i = 0; i < rows; ) {
        const int begin = offsets.data[i], count = offsets.data[i + 1] - begin;
        // The rows of a node have the same columns.
        int alike = 1;
        while (alike < 3 && i + alike < rows && heads.data[i + alike] == 0) ++alike;
        const int* const to = indices.data + begin;
        const double* const l0 = values.data + begin;
        const double *const l1 = alike > 1 ? l0 + count : l0, *const l2 = alike > 2 ? l1 + count : l0;
        double sums[24];
        if (width == 8) {
            v4 a0 = 0.0, a1 = 0.0, b0 = 0.0, b1 = 0.0, c0 = 0.0, c1 = 0.0;
            for (int j = 0; j < count; ++j) {
                const double* const z = x + (long long)to[j] * columns + from;
                const v4 x0 = *(const v4*)z, x1 = *(const v4*)(z + 4);
                a0 += l0[j] * x0; a1 += l0[j] * x1; b0 += l1[j] * x0; b1 += l1[j] * x1;
                c0 += l2[j] * x0; c1 += l2[j] * x1;
            }
            *(v4*)sums = a0; *(v4*)(sums + 4) = a1; *(v4*)(sums + 8) = b0; *(v4*)(sums + 12) = b1;
            *(v4*)(sums + 16) = c0; *(v4*)(sums + 20) = c1;
        } else {
            for (int q = 0; q < 24; ++q) sums[q] = 0.0;
            for (int j = 0; j < count; ++j) {
                const double* const z = x + (long long)to[j] * columns + from;
                for (int q = 0; q < width; ++q) {
                    sums[q] += l0[j] * z[q]; sums[8 + q] += l1[j] * z[q]; sums[16 + q] += l2[j] * z[q];
                }
            }
        }
        for (int t = 0; t < alike; ++t)
            for (int q = 0; q < width; ++q) y[(long long)(i + t) * columns + from + q] = sums[8 * t + q];
        i += alike;
    }
""")
)
def strip_of_products(
    rows: wp.int32,
    offsets: wp.array[wp.int32],
    indices: wp.array[wp.int32],
    heads: wp.array[wp.int32],
    values: wp.array[real],
    vectors: wp.uint64,
    columns: wp.int32,
    strip: wp.int32,
    products: wp.uint64,
) -> None:
    """Eight columns of a product; see ``product_kernel``."""
    ...


@wp.kernel
def product_kernel(
    first_strip: wp.int32,
    rows: wp.int32,
    offsets: wp.array[wp.int32],
    indices: wp.array[wp.int32],
    heads: wp.array[wp.int32],
    values: wp.array[real],
    vectors: wp.uint64,
    columns: wp.int32,
    products: wp.uint64,
) -> None:
    """Of a matrix by rows (``offsets``, ``indices``, ``values``) with ``vectors`` (rows, columns), an address, row by
    row, as ``products`` are; ``heads`` are zero for rows with the same columns as the row before. One thread for each
    ``STRIP`` columns."""
    strip_of_products(rows, offsets, indices, heads, values, vectors, columns, first_strip + wp.tid(), products)
