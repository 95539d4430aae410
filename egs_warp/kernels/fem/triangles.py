"""Inverses of small triangles by a block of threads each, on a GPU."""

import warp as wp

from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

LARGEST = 64
"""Rows of a triangle at most, and threads for each on a GPU."""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    constexpr int WIDE = {LARGEST + 1};
    __shared__ double both[{LARGEST} * WIDE];
    const int lane = threadIdx.x, stride = given.strides[0] / 8, apart = made.strides[0] / 8;
    const double* const from = given.data + (size_t)block * side * (stride + 1);
    double* const to = made.data + (size_t)block * side * (apart + 1);
    for (int i = 0; i < side; ++i)
        if (lane <= i) both[i * WIDE + lane] = from[(size_t)i * stride + lane];
    __syncthreads();
    // A column of the inverse is a thread's: above the diagonal, turned, lies what it has found.
    if (lane < side) {{
        double* const own = both + lane * WIDE;
        const double first = 1.0 / own[lane];
        to[(size_t)lane * apart + lane] = first;
        for (int i = 1; i < side; ++i) {{
            if (i <= lane) continue;
            const double* const row = both + i * WIDE;
            double sums[4] = {{row[lane] * first, 0.0, 0.0, 0.0}};
            int k = lane + 1;
            for (; k + 4 <= i; k += 4) {{
                #pragma unroll
                for (int t = 0; t < 4; ++t) sums[t] += row[k + t] * own[k + t];
            }}
            for (; k < i; ++k) sums[0] += row[k] * own[k];
            const double value = -((sums[0] + sums[1]) + (sums[2] + sums[3])) / row[i];
            own[i] = value;
            to[(size_t)i * apart + lane] = value;
        }}
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
