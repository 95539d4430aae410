"""Gaussian elimination, and Cholesky factors of inverses, for all threads of a block on a GPU or one thread on a CPU.

Both algorithms proceed in blocks of eight unknowns. One warp processes the diagonal block in registers; all threads
apply the result to the rest of the matrix.
"""

import warp as wp

from egs_warp.kernels.locomotion.block_algebra import by_block
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

_TAKE_OFF = """
    // to[rows][columns] -= left[rows][some] top[some][columns] with some <= 8, in tiles of 4 x 4; if half, only the
    // part right of the diagonal.
    auto take_off = [&](double* to, int stride, int rows, int columns, const double* left, int by_row, int by_part,
                        const double* top, int top_stride, int some, bool half) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
        // A warp computes 8 x 16 entries at a time, the fastest shape for an inner dimension of eight.
        const int across = (columns + 15) / 16, down = (rows + 7) / 8, quad = own >> 2, place = own & 3;
        for (int tile = warp; tile < across * down; tile += warps) {
            const int r = tile / across * 8 + quad, begin = tile % across * 16;
            if (half && begin + 15 < r - quad) continue;
            const double* const from = left + (r < rows ? r : rows - 1) * by_row;
            double one[2], other[2][2], out[2][2];
            #pragma unroll
            for (int s = 0; s < 2; ++s) {
                const int p = place + 4 * s;
                one[s] = p < some ? -from[p * by_part] : 0.0;
                #pragma unroll
                for (int k = 0; k < 2; ++k) {
                    const int c = begin + 8 * k + quad;
                    other[s][k] = p < some ? top[p * top_stride + (c < columns ? c : columns - 1)] : 0.0;
                }
            }
            #pragma unroll
            for (int k = 0; k < 2; ++k)
                #pragma unroll
                for (int t = 0; t < 2; ++t) {
                    const int c = begin + 8 * k + 2 * place + t;
                    out[k][t] = r < rows && c < columns ? to[r * stride + c] : 0.0;
                }
            #pragma unroll
            for (int s = 0; s < 2; ++s)
                #pragma unroll
                for (int k = 0; k < 2; ++k)
                    asm volatile("mma.sync.aligned.m8n8k4.row.col.f64.f64.f64.f64 {%0,%1},{%2},{%3},{%0,%1};"
                                 : "+d"(out[k][0]), "+d"(out[k][1]) : "d"(one[s]), "d"(other[s][k]));
            #pragma unroll
            for (int k = 0; k < 2; ++k)
                #pragma unroll
                for (int t = 0; t < 2; ++t) {
                    const int c = begin + 8 * k + 2 * place + t;
                    if (r < rows && c < columns) to[r * stride + c] = out[k][t];
                }
        }
#else
        const int across = (columns + 3) / 4, down = (rows + 3) / 4;
        for (int tile = lane; tile < across * down; tile += lanes) {
            const int first = tile / across * 4, begin = tile % across;
            if (half && begin + 3 * across < first) continue;
            double sum[4][4];
            int r[4], c[4];
            #pragma unroll
            for (int t = 0; t < 4; ++t) {
                r[t] = first + t < rows ? first + t : rows - 1;
                c[t] = begin + t * across < columns ? begin + t * across : columns - 1;
                #pragma unroll
                for (int s = 0; s < 4; ++s) sum[t][s] = 0.0;
            }
            #pragma unroll 4
            for (int p = 0; p < some; ++p) {
                double one[4], other[4];
                #pragma unroll
                for (int t = 0; t < 4; ++t) one[t] = left[r[t] * by_row + p * by_part];
                #pragma unroll
                for (int t = 0; t < 4; ++t) other[t] = top[p * top_stride + c[t]];
                #pragma unroll
                for (int t = 0; t < 4; ++t)
                    #pragma unroll
                    for (int s = 0; s < 4; ++s) sum[t][s] += one[t] * other[s];
            }
            #pragma unroll
            for (int t = 0; t < 4; ++t)
                #pragma unroll
                for (int s = 0; s < 4; ++s)
                    if (first + t < rows && begin + s * across < columns) to[r[t] * stride + c[s]] -= sum[t][s];
        }
#endif
    };
"""


@wp.func_native(
    by_block(
        _TAKE_OFF
        + """
    constexpr int B = 8;
    double* const M = matrix.data;
    const int stride = matrix.strides[0] / 8;
    double min_pivot = 0.0;
    for (int a = 0; a < unknowns; ++a) min_pivot += M[a * stride + a];
    min_pivot *= singular / unknowns;
#if defined(__CUDA_ARCH__)
    __shared__ double inverse[B][B];
    __shared__ int is_regular;
#else
    double inverse[B][B];
    int is_regular = 1;
#endif
    for (int begin = 0; begin < unknowns; begin += B) {
        const int end = begin + B < unknowns ? begin + B : unknowns, some = end - begin;
        if (warp == 0) {
            // All threads of the warp compute the same, in registers.
            double D[B][B];
            #pragma unroll
            for (int p = 0; p < B; ++p)
                #pragma unroll
                for (int q = 0; q < B; ++q) {
                    const bool there = begin + p < end && begin + q < end;
                    D[p][q] = there ? M[(begin + p) * stride + begin + q] : (p == q ? 1.0 : 0.0);
                }
            bool there = true;
            #pragma unroll
            for (int p = 0; p < B; ++p) {
                there = there && (wp::abs(D[p][p]) > min_pivot || begin + p >= end);
                const double by = 1.0 / D[p][p];
                D[p][p] = 1.0;
                #pragma unroll
                for (int q = 0; q < B; ++q) D[p][q] *= by;
                #pragma unroll
                for (int o = 0; o < B; ++o)
                    if (o != p) {
                        const double factor = D[o][p];
                        D[o][p] = 0.0;
                        #pragma unroll
                        for (int q = 0; q < B; ++q) D[o][q] -= factor * D[p][q];
                    }
            }
            if (own == 0) {
                is_regular = there;
                #pragma unroll
                for (int p = 0; p < B; ++p)
                    #pragma unroll
                    for (int q = 0; q < B; ++q) inverse[p][q] = D[p][q];
            }
        }
        WAIT;
        if (!is_regular) return 0;
        for (int c = end + lane; c < columns; c += lanes) {
            double right[B];
            #pragma unroll
            for (int p = 0; p < B; ++p) right[p] = begin + p < end ? M[(begin + p) * stride + c] : 0.0;
            #pragma unroll
            for (int p = 0; p < B; ++p) {
                double value = 0.0;
                #pragma unroll
                for (int q = 0; q < B; ++q) value += inverse[p][q] * right[q];
                if (begin + p < end) M[(begin + p) * stride + c] = value;
            }
        }
        WAIT;
        const double* const top = M + begin * stride + end;
        take_off(M + end, stride, begin, columns - end, M + begin, stride, 1, top, stride, some, false);
        double* const below = M + end * stride;
        const int down = unknowns - end, right = columns - end;
        take_off(below + end, stride, down, right, below + begin, stride, 1, top, stride, some, false);
        WAIT;
    }
    return 1;
"""
    )
)
def eliminate(matrix: wp.array2d[real], unknowns: int, columns: int, singular: real) -> int:
    """Solve a linear system in place, without row exchanges.

    Args:
        matrix: (unknowns, columns): in each row the coefficients, then the right-hand sides. On return, the right-hand
            sides are replaced by the solutions, and the coefficients are overwritten.
        unknowns: number of unknowns.
        columns: number of unknowns and right-hand sides.
        singular: minimum magnitude of a pivot, as a fraction of the mean of the diagonal.

    Returns: 1, or 0 if a pivot is too small.
    """
    ...


@wp.func_native(
    by_block(
        _TAKE_OFF
        + """
    constexpr int B = 8;
    double *const A = matrix.data, *const U = root.data;
    const int as = matrix.strides[0] / 8, us = root.strides[0] / 8;
#if defined(__CUDA_ARCH__)
    __shared__ double R[B][B], by[B];
    __shared__ int is_regular;
#else
    double R[B][B], by[B];
    int is_regular = 1;
#endif
#if defined(__CUDA_ARCH__)
    if (count <= 32) {
        // Each warp takes rows, each of its threads a column; one unknown at a time costs no more than the barriers.
        __shared__ double rows[32][33], out[32][33];
        const int side = own < count ? own : count - 1;
        for (int r = warp; r < count; r += warps) {
            rows[r][own] = A[r * as + side];
            out[r][own] = 0.0;
        }
        WAIT;
        for (int j = 0; j < count; ++j) {
            const double pivot = rows[j][j];
            if (!(pivot > 0.0)) {
                WAIT;
                return 0;
            }
            const double ahead = own > j ? rows[j][own] / pivot : 0.0;
            for (int r = warp; r < count; r += warps) {
                if (r < j) out[r][own] -= out[r][j] * ahead;
                else if (r == j) out[r][own] = own == j ? 1.0 : -ahead;
                else rows[r][own] -= rows[j][r] * ahead;
            }
            WAIT;
        }
        for (int r = warp; r < count; r += warps)
            if (own < count) U[r * us + own] = out[r][own] * rsqrt(rows[own][own]);
        WAIT;
        return 1;
    }
#endif
    for (int r = warp; r < count; r += warps)
        for (int c = own; c < count; c += WIDE) U[r * us + c] = r == c ? 1.0 : 0.0;
    for (int begin = 0; begin < count; begin += B) {
        const int end = begin + B < count ? begin + B : count, left = count - end;
        if (warp == 0) {
            // R^T R of the diagonal block; all threads of the warp compute the same, in registers.
            double S[B][B];
            #pragma unroll
            for (int p = 0; p < B; ++p)
                #pragma unroll
                for (int q = p; q < B; ++q)
                    S[p][q] = begin + q < end ? A[(begin + p) * as + begin + q] : (p == q ? 1.0 : 0.0);
            bool definite = true;
            #pragma unroll
            for (int p = 0; p < B; ++p) {
                definite = definite && S[p][p] > 0.0;
#if defined(__CUDA_ARCH__)
                const double over = rsqrt(S[p][p]);
#else
                const double over = 1.0 / wp::sqrt(S[p][p]);
#endif
                #pragma unroll
                for (int q = p; q < B; ++q) S[p][q] *= over;
                #pragma unroll
                for (int q = p + 1; q < B; ++q)
                    #pragma unroll
                    for (int o = q; o < B; ++o) S[q][o] -= S[p][q] * S[p][o];
                if (own == 0) {
                    by[p] = over;
                    #pragma unroll
                    for (int q = p; q < B; ++q) R[p][q] = S[p][q];
                }
            }
            if (own == 0) is_regular = definite;
        }
        WAIT;
        if (!is_regular) return 0;
        for (int item = lane; item < count; item += lanes) {
            double* const from = item < end ? U + item * us + begin : A + begin * as + item;
            const int step = item < end ? 1 : as;
            double value[B];
            #pragma unroll
            for (int p = 0; p < B; ++p) value[p] = begin + p < end ? from[p * step] : 0.0;
            #pragma unroll
            for (int p = 0; p < B; ++p) {
                #pragma unroll
                for (int q = 0; q < p; ++q) value[p] -= R[q][p] * value[q];
                value[p] *= by[p];
            }
            #pragma unroll
            for (int p = 0; p < B; ++p)
                if (begin + p < end) from[p * step] = value[p];
        }
        WAIT;
        if (left == 0) break;
        const double* const top = A + begin * as + end;
        take_off(U + end, us, end, left, U + begin, us, 1, top, as, end - begin, false);
        take_off(A + end * as + end, as, left, left, top, 1, as, top, as, end - begin, true);
        WAIT;
    }
    return 1;
"""
    )
)
def inverse_cholesky(matrix: wp.array2d[real], count: int, root: wp.array2d[real]) -> int:
    """Compute the upper triangular ``root`` U (count, count) with A^-1 = U U^T, for a symmetric ``matrix`` A (count,
    count).

    Only the upper triangle of A is read; it is overwritten.

    Returns: 1, or 0 if A is not positive definite.
    """
    ...
