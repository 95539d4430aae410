"""Inverses of small triangles by a block of threads each, on a GPU."""

import warp as wp

from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

LARGEST = 64
"""Rows of a triangle at most."""
SHARE = 4
"""Threads for each of its columns on a GPU."""
BLOCK = LARGEST * SHARE


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    constexpr int WIDE = {LARGEST + 1}, SHARE = {SHARE};
    __shared__ double both[{LARGEST} * WIDE], over[{LARGEST}];
    const int lane = threadIdx.x, stride = given.strides[0] / 8, apart = made.strides[0] / 8;
    const double* const from = given.data + (size_t)block * side * (stride + 1);
    double* const to = made.data + (size_t)block * side * (apart + 1);
    for (int k = lane; k < side * {LARGEST}; k += blockDim.x) {{
        const int i = k / {LARGEST}, c = k % {LARGEST};
        if (c < i) both[i * WIDE + c] = from[(size_t)i * stride + c];
        if (c == i) over[i] = 1.0 / from[(size_t)i * stride + i];
    }}
    __syncthreads();
    // A column of the inverse is for some threads, who take turns in its sums: above the diagonal, turned, lies what
    // they have found. All threads of a warp go through all rows.
    const int column = lane / SHARE, part = lane % SHARE;
    double* const own = both + column * WIDE;
    const double first = column < side ? over[column] : 0.0;
    if (part == 0 && column < side) to[(size_t)column * apart + column] = first;
    for (int i = 1; i < side; ++i) {{
        const double* const row = both + i * WIDE;
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
            own[i] = -sum * over[i];
            to[(size_t)i * apart + column] = -sum * over[i];
        }}
        __syncwarp();
    }}
#else
    const int stride = given.strides[0] / 8, apart = made.strides[0] / 8;
    const double* const from = given.data + (size_t)block * side * (stride + 1);
    double* const to = made.data + (size_t)block * side * (apart + 1);
    for (int column = 0; column < side; ++column)
        for (int i = column; i < side; ++i) {{
            double sum = i == column ? 1.0 : 0.0;
            for (int k = column; k < i; ++k) sum -= from[(size_t)i * stride + k] * to[(size_t)k * apart + column];
            to[(size_t)i * apart + column] = sum / from[(size_t)i * stride + i];
        }}
#endif
""")
def invert_triangle(given: wp.array2d[real], side: int, block: int, made: wp.array2d[real]) -> None:
    """See ``invert_triangles_kernel``."""
    ...


@wp.kernel
def invert_triangles_kernel(
    # In:
    given: wp.array2d[real],
    side: int,
    # Out:
    made_out: wp.array2d[real],
):
    """Into ``made_out`` the inverses of the lower triangles of ``side`` rows, at most ``LARGEST``, along the diagonal
    of what is ``given``; what is above them stays."""
    block, _lane = wp.tid()
    invert_triangle(given, side, block, made_out)
