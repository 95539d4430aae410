"""Kernels that invert small matrices: diagonal blocks of a lower triangular matrix, with one thread block each, and a 3
x 3 matrix.
"""

import warp as wp

from egs_warp.precision import Mat33, real

wp.set_module_options({"enable_backward": False})

MAX_ROWS = 64
"""Maximum number of rows of a triangular matrix."""
COLUMN_THREADS = 4
"""Number of threads per column on a GPU."""
BLOCK = MAX_ROWS * COLUMN_THREADS
"""Number of threads of a block on a GPU."""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    constexpr int WIDE = {MAX_ROWS + 1}, SHARE = {COLUMN_THREADS};
    __shared__ double tile[{MAX_ROWS} * WIDE], reciprocals[{MAX_ROWS}];
    const int lane = threadIdx.x, stride = lower.strides[0] / 8, out_stride = inverse.strides[0] / 8;
    const double* const from = lower.data + (size_t)block * side * (stride + 1);
    double* const to = inverse.data + (size_t)block * side * (out_stride + 1);
    for (int k = lane; k < side * {MAX_ROWS}; k += blockDim.x) {{
        const int i = k / {MAX_ROWS}, c = k % {MAX_ROWS};
        if (c < i) tile[i * WIDE + c] = from[(size_t)i * stride + c];
        if (c == i) reciprocals[i] = 1.0 / from[(size_t)i * stride + i];
    }}
    __syncthreads();
    // SHARE threads compute a column of the inverse and split its sums. The results are stored transposed above the
    // diagonal. All threads of a warp loop over all rows.
    const int column = lane / SHARE, part = lane % SHARE;
    double* const own = tile + column * WIDE;
    const double first = column < side ? reciprocals[column] : 0.0;
    if (part == 0 && column < side) to[(size_t)column * out_stride + column] = first;
    for (int i = 1; i < side; ++i) {{
        const double* const row = tile + i * WIDE;
        const bool below = i > column;
        double sum = part == 0 && below ? row[column] * first : 0.0, other = 0.0;
        int k = column + 1 + part;
        for (; k + SHARE < i; k += 2 * SHARE) {{
            sum += row[k] * own[k];
            other += row[k + SHARE] * own[k + SHARE];
        }}
        if (k < i) sum += row[k] * own[k];
        sum += other;
        #pragma unroll
        for (int away = SHARE / 2; away > 0; away >>= 1) sum += __shfl_xor_sync(0xffffffffu, sum, away);
        if (part == 0 && below) {{
            own[i] = -sum * reciprocals[i];
            to[(size_t)i * out_stride + column] = -sum * reciprocals[i];
        }}
        __syncwarp();
    }}
#else
    const int stride = lower.strides[0] / 8, out_stride = inverse.strides[0] / 8;
    const double* const from = lower.data + (size_t)block * side * (stride + 1);
    double* const to = inverse.data + (size_t)block * side * (out_stride + 1);
    for (int column = 0; column < side; ++column)
        for (int i = column; i < side; ++i) {{
            double sum = i == column ? 1.0 : 0.0;
            for (int k = column; k < i; ++k) sum -= from[(size_t)i * stride + k] * to[(size_t)k * out_stride + column];
            to[(size_t)i * out_stride + column] = sum / from[(size_t)i * stride + i];
        }}
#endif
""")
def invert_triangle(lower: wp.array2d[real], side: int, block: int, inverse: wp.array2d[real]) -> None:
    """Invert the diagonal block with the index ``block`` of ``lower`` (native code of ``invert_triangles_kernel``)."""
    ...


@wp.kernel
def invert_triangles_kernel(
    # In:
    lower: wp.array2d[real],
    side: int,
    # Out:
    inverse_out: wp.array2d[real],
):
    """Invert the diagonal blocks of a lower triangular matrix; on a GPU one thread block inverts each, on a CPU one
    thread.

    Args:
        lower: (n, n) lower triangular matrix.
        side: number of rows of a diagonal block, at most ``MAX_ROWS``.
        inverse_out: (n, n), whose diagonal blocks are overwritten up to the diagonal; its other entries do not change.
    """
    block, _lane = wp.tid()
    invert_triangle(lower, side, block, inverse_out)


@wp.kernel
def invert_momentum_matrix_kernel(
    # In:
    ratio: real,
    momenta: wp.array[Mat33],
    # Out:
    inverse_out: wp.array[Mat33],
):
    """Invert ``ratio`` times the 3 x 3 matrix of angular momenta.

    Args:
        ratio: 1 + dt alpha (``ImplicitStep.inertia_ratio``).
        momenta: (1,) matrix (M T)^T U, the angular momenta of the columns of ``rotation_response``.
        inverse_out: (1,) the inverse.
    """
    inverse_out[0] = wp.inverse(ratio * momenta[0])
