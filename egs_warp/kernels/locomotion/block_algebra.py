"""Dense linear algebra in float64 for all threads of a block on a GPU, or one thread on a CPU.

All threads of the block must call each function. After a call, its results are visible to all threads.
"""

import warp as wp

from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

_THREADS = """
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x, lanes = blockDim.x, own = lane & 31, warp = lane >> 5, warps = lanes >> 5;
    constexpr int WIDE = 32;
    #define WAIT __syncthreads()
#else
    const int lane = 0, lanes = 1, own = 0, warp = 0, warps = 1;
    constexpr int WIDE = 1;
    #define WAIT
#endif
    (void)lane, (void)lanes, (void)own, (void)warp, (void)warps;
"""


def by_block(body: str) -> str:
    """Return C++ code that runs ``body`` on a GPU and on a CPU.

    ``body`` may use ``WAIT`` (a barrier), ``lane`` and ``lanes`` (index of this thread in its block, and number of
    threads of the block), ``own`` and ``WIDE`` (index in its warp, and number of threads of a warp), and ``warp`` and
    ``warps`` (index of the warp, and number of warps).
    """
    return f"{_THREADS}{body}\n#undef WAIT\n"


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return threadIdx.x;
#else
    return 0;
#endif
""")
def lane_of_block() -> int:
    """Return the index of this thread in its block, 0 on a CPU."""
    ...


@wp.func_native(
    by_block("""
    double* const C = to.data;
    const double *const A = one.data, *const B = other.data;
    const int cs = to.strides[0] / 8, bs = other.strides[0] / 8;
    const int as = transpose ? 1 : one.strides[0] / 8, ak = transpose ? one.strides[0] / 8 : 1;
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
    // A warp computes a tile of 16 x 32 entries, in 8 x 8 fragments with four products each.
    constexpr int DOWN = 2, ACROSS = 4;
    const int across = (columns + 8 * ACROSS - 1) / (8 * ACROSS), down = (rows + 8 * DOWN - 1) / (8 * DOWN);
    const int quad = own >> 2, place = own & 3;
    for (int tile = warp; tile < across * down; tile += warps) {
        const int first = tile / across * 8 * DOWN + quad, begin = tile % across * 8 * ACROSS;
        const double *a[DOWN], *b[ACROSS];
        double sum[DOWN][ACROSS][2];
        #pragma unroll
        for (int i = 0; i < DOWN; ++i) a[i] = A + (first + 8 * i < rows ? first + 8 * i : rows - 1) * as;
        #pragma unroll
        for (int k = 0; k < ACROSS; ++k) {
            const int c = begin + 8 * k + quad;
            b[k] = B + (c < columns ? c : columns - 1);
        }
        #pragma unroll
        for (int i = 0; i < DOWN; ++i)
            #pragma unroll
            for (int k = 0; k < ACROSS; ++k) sum[i][k][0] = sum[i][k][1] = 0.0;
        #pragma unroll 4
        for (int s = 0; s < inner; s += 4) {
            const bool valid = s + place < inner;
            const int at = valid ? s + place : 0;
            double left[DOWN], right[ACROSS];
            #pragma unroll
            for (int i = 0; i < DOWN; ++i) left[i] = valid ? a[i][at * ak] : 0.0;
            #pragma unroll
            for (int k = 0; k < ACROSS; ++k) right[k] = valid ? b[k][at * bs] : 0.0;
            #pragma unroll
            for (int i = 0; i < DOWN; ++i)
                #pragma unroll
                for (int k = 0; k < ACROSS; ++k)
                    asm volatile("mma.sync.aligned.m8n8k4.row.col.f64.f64.f64.f64 {%0,%1},{%2},{%3},{%0,%1};"
                                 : "+d"(sum[i][k][0]), "+d"(sum[i][k][1]) : "d"(left[i]), "d"(right[k]));
        }
        #pragma unroll
        for (int i = 0; i < DOWN; ++i)
            #pragma unroll
            for (int k = 0; k < ACROSS; ++k) {
                const int r = first + 8 * i, c = begin + 8 * k + 2 * place;
                if (r < rows && c < columns) C[r * cs + c] += sum[i][k][0];
                if (r < rows && c + 1 < columns) C[r * cs + c + 1] += sum[i][k][1];
            }
    }
#elif defined(__CUDA_ARCH__)
    const int across = (columns + 3) / 4, down = (rows + 3) / 4;
    for (int tile = lane; tile < across * down; tile += lanes) {
        const int first = tile / across * 4, begin = tile % across;
        double sum[4][4];
        const double *a[4], *b[4];
        for (int t = 0; t < 4; ++t) {
            for (int s = 0; s < 4; ++s) sum[t][s] = 0.0;
            a[t] = A + (first + t < rows ? first + t : rows - 1) * as;
            b[t] = B + (begin + t * across < columns ? begin + t * across : columns - 1);
        }
        for (int k = 0; k < inner; ++k) {
            double left[4], right[4];
            for (int t = 0; t < 4; ++t) left[t] = a[t][k * ak];
            for (int t = 0; t < 4; ++t) right[t] = b[t][k * bs];
            for (int t = 0; t < 4; ++t)
                for (int s = 0; s < 4; ++s) sum[t][s] += left[t] * right[s];
        }
        for (int t = 0; t < 4 && first + t < rows; ++t)
            for (int s = 0; s < 4 && begin + s * across < columns; ++s)
                C[(first + t) * cs + begin + s * across] += sum[t][s];
    }
#else
    {
    #pragma clang fp contract(fast)
    typedef double v4 __attribute__((ext_vector_type(4), aligned(8)));
    for (int i = 0; i < rows; i += 4) {
        const double* a[4];
        double* to_row[4];
        for (int t = 0; t < 4; ++t) {
            a[t] = A + (i + t < rows ? i + t : rows - 1) * as;
            to_row[t] = C + (i + t) * cs;
        }
        const int some = rows - i < 4 ? rows - i : 4;
        int c = 0;
        for (; c + 8 <= columns; c += 8) {
            v4 sum[4][2];
            for (int t = 0; t < 4; ++t) sum[t][0] = sum[t][1] = 0.0;
            for (int k = 0; k < inner; ++k) {
                const v4 b0 = *(const v4*)(B + k * bs + c), b1 = *(const v4*)(B + k * bs + c + 4);
                for (int t = 0; t < 4; ++t) {
                    const double by = a[t][k * ak];
                    sum[t][0] += by * b0;
                    sum[t][1] += by * b1;
                }
            }
            for (int t = 0; t < some; ++t) {
                *(v4*)(to_row[t] + c) += sum[t][0];
                *(v4*)(to_row[t] + c + 4) += sum[t][1];
            }
        }
        for (; c < columns; ++c)
            for (int t = 0; t < some; ++t) {
                double sum = 0.0;
                for (int k = 0; k < inner; ++k) sum += a[t][k * ak] * B[k * bs + c];
                to_row[t][c] += sum;
            }
    }
    }
#endif
    WAIT;
""")
)
def gemm_add(
    to: wp.array2d[real],
    one: wp.array2d[real],
    other: wp.array2d[real],
    rows: int,
    columns: int,
    inner: int,
    transpose: int,
) -> None:
    """Add a matrix product to ``to`` (rows, columns): ``to`` += A ``other``, with ``other`` (inner, columns).

    A is ``one`` (rows, inner), or the transpose of ``one`` (inner, rows) if ``transpose`` is nonzero.
    """
    ...


@wp.func_native(
    by_block("""
    int total = 0;
#if defined(__CUDA_ARCH__)
    __shared__ int sums[32];
    for (int base = 0; base < count; base += lanes) {
        const bool marked = base + lane < count && marks.data[base + lane] != 0;
        const unsigned all = __ballot_sync(0xffffffffu, marked);
        if (own == 0) sums[warp] = __popc(all);
        WAIT;
        int place = total + __popc(all & ((1u << own) - 1u));
        for (int i = 0; i < warps; ++i) {
            place += i < warp ? sums[i] : 0;
            total += sums[i];
        }
        if (marked && place < capacity) indices.data[place] = base + lane;
        WAIT;
    }
#else
    for (int i = 0; i < count; ++i)
        if (marks.data[i] != 0) {
            if (total < capacity) indices.data[total] = i;
            ++total;
        }
#endif
    return total;
""")
)
def compact_indices(marks: wp.array[int], count: int, capacity: int, indices: wp.array[int]) -> int:
    """Write the indices of the nonzero entries of ``marks`` (count,) to ``indices``, in ascending order and up to
    ``capacity`` of them. Return the number of nonzero entries."""
    ...


@wp.func_native(
    by_block("""
#if defined(__CUDA_ARCH__)
    __shared__ double sizes[32];
    __shared__ int places[32];
    auto larger = [&]() {
        #pragma unroll
        for (int offset = 16; offset > 0; offset >>= 1) {
            const double theirs = __shfl_xor_sync(0xffffffffu, value, offset);
            const int other = __shfl_xor_sync(0xffffffffu, place, offset);
            if (theirs > value || (theirs == value && other < place)) { value = theirs; place = other; }
        }
    };
    larger();
    WAIT;
    if (own == 0) { sizes[warp] = value; places[warp] = place; }
    WAIT;
    value = sizes[own < warps ? own : 0];
    place = places[own < warps ? own : 0];
    larger();
#endif
    return wp::vec_t<2, double>(value, double(place));
""")
)
def argmax_of_block(value: real, place: int) -> wp.vec2d:
    """Return the largest ``value`` of all threads and its ``place``. If several values are equal, the lowest ``place``
    is returned."""
    ...


_ROWS_BY_VECTOR = """
#if defined(__CUDA_ARCH__)
    for (int i = 4 * warp; i < rows; i += 4 * warps) {
        const double* row[4];
        double value[4];
        for (int t = 0; t < 4; ++t) {
            row[t] = first + (long long)(i + t < rows ? i + t : rows - 1) * stride;
            value[t] = 0.0;
        }
        #pragma unroll 4
        for (int k = own; k < columns; k += WIDE) {
            const double by = vector.data[k];
            #pragma unroll
            for (int t = 0; t < 4; ++t) value[t] += row[t][k] * by;
        }
        for (int offset = 16; offset > 0; offset >>= 1)
            for (int t = 0; t < 4; ++t) value[t] += __shfl_xor_sync(0xffffffffu, value[t], offset);
        for (int t = 0; t < 4 && i + t < rows; ++t)
            if (own == 0) out.data[i + t] = value[t];
    }
#else
    {
    #pragma clang fp contract(fast)
    typedef double v4 __attribute__((ext_vector_type(4), aligned(8)));
    for (int i = 0; i < rows; ++i) {
        const double* const row = first + (long long)i * stride;
        v4 sum = 0.0;
        int k = 0;
        for (; k + 4 <= columns; k += 4) sum += *(const v4*)(row + k) * *(const v4*)(vector.data + k);
        double value = (sum[0] + sum[1]) + (sum[2] + sum[3]);
        for (; k < columns; ++k) value += row[k] * vector.data[k];
        out.data[i] = value;
    }
    }
#endif
    WAIT;
"""


@wp.func_native(
    by_block(f"""
    const double* const first = matrix.data;
    const int stride = matrix.strides[0] / 8;
{_ROWS_BY_VECTOR}""")
)
def multiply(matrix: wp.array2d[real], rows: int, columns: int, vector: wp.array[real], out: wp.array[real]) -> None:
    """Compute ``out`` (rows,) = ``matrix`` (rows, columns) ``vector`` (columns,)."""
    ...


@wp.func_native(
    by_block(f"""
    const double* const first = numbers.data + begin;
{_ROWS_BY_VECTOR}""")
)
def multiply_at(
    numbers: wp.array[real],
    begin: int,
    stride: int,
    rows: int,
    columns: int,
    vector: wp.array[real],
    out: wp.array[real],
) -> None:
    """Compute ``out`` (rows,) = A ``vector`` (columns,) for a matrix A (rows, columns) that is stored in ``numbers``
    from index ``begin`` on, with the row stride ``stride``."""
    ...


@wp.func_native(
    by_block("""
    const int stride = matrix.strides[0] / 8;
#if defined(__CUDA_ARCH__)
    const int chunks = (columns + 31) / 32, groups = warps / chunks;
    if (groups > 1) {
        // Several warps share the rows of each column.
        __shared__ double parts[1024];
        const int c = warp % chunks * 32 + own, group = warp / chunks;
        double sum = 0.0;
        if (group < groups && c < columns)
            #pragma unroll 8
            for (int k = group; k < rows; k += groups) sum += matrix.data[k * stride + c] * vector.data[k];
        parts[lane] = sum;
        WAIT;
        for (int k = lane; k < columns; k += lanes) {
            double value = parts[k];
            for (int other = 1; other < groups; ++other) value += parts[other * chunks * 32 + k];
            out.data[k] = value;
        }
        WAIT;
        return;
    }
    for (int c = lane; c < columns; c += lanes) {
        double some[4] = {0.0, 0.0, 0.0, 0.0};
        const double* at = matrix.data + c;
        int k = 0;
        for (; k + 4 <= rows; k += 4, at += 4 * stride)
            for (int t = 0; t < 4; ++t) some[t] += at[t * stride] * vector.data[k + t];
        for (; k < rows; ++k, at += stride) some[0] += *at * vector.data[k];
        out.data[c] = (some[0] + some[1]) + (some[2] + some[3]);
    }
#else
    {
    #pragma clang fp contract(fast)
    typedef double v4 __attribute__((ext_vector_type(4), aligned(8)));
    int c = 0;
    for (; c + 16 <= columns; c += 16) {
        v4 sum[4];
        for (int t = 0; t < 4; ++t) sum[t] = 0.0;
        for (int k = 0; k < rows; ++k)
            for (int t = 0; t < 4; ++t)
                sum[t] += vector.data[k] * *(const v4*)(matrix.data + k * stride + c + 4 * t);
        for (int t = 0; t < 4; ++t) *(v4*)(out.data + c + 4 * t) = sum[t];
    }
    for (; c < columns; ++c) {
        double sum = 0.0;
        for (int k = 0; k < rows; ++k) sum += matrix.data[k * stride + c] * vector.data[k];
        out.data[c] = sum;
    }
    }
#endif
    WAIT;
""")
)
def multiply_transposed(
    matrix: wp.array2d[real], rows: int, columns: int, vector: wp.array[real], out: wp.array[real]
) -> None:
    """Compute ``out`` (columns,) = A^T ``vector``, for the ``matrix`` A (rows, columns) and the ``vector`` (rows,)."""
    ...


@wp.func_native(
    by_block("""
    const int stride = matrix.strides[0] / 8;
    for (int i = 4 * warp; i < rows; i += 4 * warps) {
        double square[4];
        #pragma unroll
        for (int t = 0; t < 4; ++t) {
            const int r = 3 * (i + t < rows ? i + t : rows - 1);
            const double *row[3], *const share = shares.data + r;
            for (int s = 0; s < 3; ++s) row[s] = matrix.data + parts.data[r + s] * stride;
            square[t] = 0.0;
            for (int k = own; k < columns; k += WIDE) {
                const double value = share[0] * row[0][k] + share[1] * row[1][k] + share[2] * row[2][k];
                square[t] += value * value;
            }
        }
#if defined(__CUDA_ARCH__)
        for (int offset = 16; offset > 0; offset >>= 1)
            for (int t = 0; t < 4; ++t) square[t] += __shfl_xor_sync(0xffffffffu, square[t], offset);
#endif
        for (int t = 0; t < 4 && i + t < rows; ++t)
            if (own == 0) {
                const double length = square[t] > 0.0 ? wp::sqrt(square[t]) : 1.0;
                lengths.data[i + t] = length;
                for (int s = 0; s < 3; ++s) shares.data[3 * (i + t) + s] /= length;
            }
    }
    WAIT;
""")
)
def normalize_rows(
    matrix: wp.array2d[real],
    columns: int,
    parts: wp.array2d[int],
    shares: wp.array2d[real],
    rows: int,
    lengths: wp.array[real],
) -> None:
    """Scale rows to length 1. Each row is a linear combination of three rows of ``matrix`` (k, columns).

    Args:
        matrix: (k, columns) base rows.
        columns: length of a row.
        parts: (rows, 3) indices of the three base rows of each row.
        shares: (rows, 3) coefficients of these base rows; divided in place by the length of the row.
        rows: number of rows.
        lengths: (rows,) output: lengths before scaling, 1 for rows of zeros.
    """
    ...


@wp.func
def apply_factor(
    root: wp.array2d[real], count: int, vector: wp.array[real], between: wp.array[real], out: wp.array[real]
):
    """Compute ``out`` (count,) = U U^T ``vector`` for the upper triangular ``root`` U; ``between`` (count,) is
    overwritten with U^T ``vector``."""
    multiply_transposed(root, count, count, vector, between)
    multiply(root, count, count, between, out)
