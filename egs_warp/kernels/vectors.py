"""C++ source code of dense linear algebra on a CPU, for native functions.

The inner kernel updates blocks of four rows by eight columns, which fit into the vector registers. Clang maps the
vector types and the fused multiply-adds to instructions of the processor.
"""

BLOCK = 16
"""Number of columns that are eliminated at once. The factorisation stores the inverse of each diagonal block of this
size."""

_PRODUCTS = """
    #pragma clang fp contract(fast)
    typedef double v4 __attribute__((ext_vector_type(4), aligned(8)));
    // y[4][8] -= l[4][k] x[k][8]
    auto take_off = [](double* y0, double* y1, double* y2, double* y3, const double* l0, const double* l1,
                       const double* l2, const double* l3, const double* x, int stride, int k) {
        #pragma clang fp contract(fast)
        v4 a0 = *(v4*)y0, a1 = *(v4*)(y0 + 4), b0 = *(v4*)y1, b1 = *(v4*)(y1 + 4);
        v4 c0 = *(v4*)y2, c1 = *(v4*)(y2 + 4), d0 = *(v4*)y3, d1 = *(v4*)(y3 + 4);
        for (int j = 0; j < k; ++j, x += stride) {
            const v4 x0 = *(const v4*)x, x1 = *(const v4*)(x + 4);
            a0 -= l0[j] * x0; a1 -= l0[j] * x1; b0 -= l1[j] * x0; b1 -= l1[j] * x1;
            c0 -= l2[j] * x0; c1 -= l2[j] * x1; d0 -= l3[j] * x0; d1 -= l3[j] * x1;
        }
        *(v4*)y0 = a0; *(v4*)(y0 + 4) = a1; *(v4*)y1 = b0; *(v4*)(y1 + 4) = b1;
        *(v4*)y2 = c0; *(v4*)(y2 + 4) = c1; *(v4*)y3 = d0; *(v4*)(y3 + 4) = d1;
    };
    // The same for one row.
    auto take_off_one = [](double* y, const double* l, const double* x, int stride, int k) {
        #pragma clang fp contract(fast)
        v4 a0 = *(v4*)y, a1 = *(v4*)(y + 4);
        for (int j = 0; j < k; ++j, x += stride) {
            a0 -= l[j] * *(const v4*)x;
            a1 -= l[j] * *(const v4*)(x + 4);
        }
        *(v4*)y = a0; *(v4*)(y + 4) = a1;
    };
    // y[rows][columns] -= l[rows][k] x[k][columns], columns by eights, each matrix with its own stride.
    auto take_off_all = [&](double* y, int y_stride, int rows, const double* l, int l_stride, const double* x,
                            int x_stride, int columns, int k) {
        int i = 0;
        for (; i + 4 <= rows; i += 4, y += 4 * y_stride, l += 4 * l_stride)
            for (int c = 0; c < columns; c += 8)
                take_off(y + c, y + y_stride + c, y + 2 * y_stride + c, y + 3 * y_stride + c, l, l + l_stride,
                         l + 2 * l_stride, l + 3 * l_stride, x + c, x_stride, k);
        for (; i < rows; ++i, y += y_stride, l += l_stride)
            for (int c = 0; c < columns; c += 8) take_off_one(y + c, l, x + c, x_stride, k);
    };
"""

_SIZES = f"""
    constexpr int BLOCK = {BLOCK};
"""
ROW_ELIMINATION = """
    // Gaussian elimination with row exchanges of a matrix of `unknowns` rows and columns, followed by right-hand sides,
    // in all a multiple of four columns. Returns the rank, and the column of each pivot in `pivots`. A candidate of at
    // most `singular` times the largest pivot so far is not a pivot. Rows whose multipliers are zero, and columns in
    // which the pivot rows are zero, are skipped: contacts of different bodies of an island are mostly not coupled.
    auto eliminate_rows = [&](double* M, int stride, int unknowns, int columns, double singular, int* pivots) {
        #pragma clang fp contract(fast)
        int rank = 0, chosen[BLOCK];
        double largest = 0.0, shares[4 * BLOCK];
        // Chunks of eight columns; later ones are not skipped. An array of variable size would need the compiler's
        // runtime on Windows.
        constexpr int CHUNKS = 512;
        bool is_coupled[CHUNKS];
        for (int begin = 0; begin < unknowns; begin += BLOCK) {
            const int end = unknowns - begin < BLOCK ? unknowns : begin + BLOCK, next = (end + 3) & ~3, first = rank;
            int block_rank = 0;
            for (int j = begin; j < end; ++j) {
                int pivot = rank;
                double size = 0.0;
                for (int a = rank; a < unknowns; ++a) {
                    const double candidate = __builtin_fabs(M[a * stride + j]);
                    if (candidate > size) { size = candidate; pivot = a; }
                }
                if (!(size > singular * largest)) continue;
                largest = size > largest ? size : largest;
                double *const top = M + rank * stride, *const other = M + pivot * stride;
                for (int c = begin; pivot != rank && c < columns; ++c) {
                    const double swapped = top[c];
                    top[c] = other[c];
                    other[c] = swapped;
                }
                for (int a = rank + 1; a < unknowns; ++a) {
                    double* const row = M + a * stride;
                    if (row[j] == 0.0) continue;
                    const double factor = row[j] / top[j];
                    row[j] = factor;
                    for (int c = j + 1; c < next; ++c) row[c] -= factor * top[c];
                }
                pivots[rank++] = j;
                chosen[block_rank++] = j;
            }
            for (int t = 1; t < block_rank; ++t)
                for (int s = 0; s < t; ++s) {
                    double *const row = M + (first + t) * stride, *const by = M + (first + s) * stride;
                    const double share = row[chosen[s]];
                    for (int c = next; c < columns; c += 4) *(v4*)(row + c) -= share * *(const v4*)(by + c);
                }
            const double* const by = M + first * stride;
            for (int c = next; c + 8 <= columns && c < next + 8 * CHUNKS; c += 8) {
                bool found = false;
                for (int s = 0; s < block_rank; ++s)
                    for (int d = c; d < c + 8; ++d) found |= by[s * stride + d] != 0.0;
                is_coupled[(c - next) / 8] = found;
            }
            for (int a = rank; a < unknowns; a += 4) {
                const int rows = unknowns - a < 4 ? unknowns - a : 4;
                bool has_multipliers = false;
                for (int q = 0; q < rows; ++q)
                    for (int s = 0; s < block_rank; ++s) {
                        shares[q * BLOCK + s] = M[(a + q) * stride + chosen[s]];
                        has_multipliers |= shares[q * BLOCK + s] != 0.0;
                    }
                if (!has_multipliers) continue;
                double* const row = M + a * stride;
                int c = next;
                if (rows == 4)
                    for (; c + 8 <= columns; c += 8) {
                        if (c < next + 8 * CHUNKS && !is_coupled[(c - next) / 8]) continue;
                        take_off(row + c, row + stride + c, row + 2 * stride + c, row + 3 * stride + c, shares,
                                 shares + BLOCK, shares + 2 * BLOCK, shares + 3 * BLOCK, by + c, stride, block_rank);
                    }
                for (int q = 0; q < rows; ++q)
                    for (int d = c; d < columns; d += 4) {
                        v4 left = *(v4*)(row + q * stride + d);
                        for (int s = 0; s < block_rank; ++s)
                            left -= shares[q * BLOCK + s] * *(const v4*)(by + s * stride + d);
                        *(v4*)(row + q * stride + d) = left;
                    }
            }
        }
        return rank;
    };
"""

FRONT_ELIMINATION = """
    // Eliminates the first w of the f columns of a symmetric front F, of which only the lower triangle is read. F then
    // holds unit columns of L with the pivots on the diagonal, and behind them the Schur complement. Also writes the
    // inverses of the diagonal blocks of L and the reciprocals of the pivots. T is scratch memory for BLOCK rows.
    // Returns the number of negative pivots, or -1 if the size of one is at most min_pivot.
    auto eliminate_front = [&](double* F, int f, int w, int ld, double* T, double min_pivot, double* inverse,
                               double* reciprocals) {
        #pragma clang fp contract(fast)
        double u[BLOCK], reciprocal[BLOCK], X[BLOCK * BLOCK], P[4 * BLOCK];
        int negative = 0;
        for (int b = 0; b < w; b += BLOCK, inverse += BLOCK * BLOCK) {
            const int nb = w - b < BLOCK ? w - b : BLOCK, next = b + nb;
            for (int j = 0; j < nb; ++j) {
                double* const pivot_row = F + (b + j) * ld + b;
                const double d = pivot_row[j];
                if (!(d > min_pivot || d < -min_pivot)) return -1;
                negative += d < 0.0;
                reciprocal[j] = 1.0 / d;
                reciprocals[b + j] = reciprocal[j];
                for (int i = j + 1; i < nb; ++i) u[i] = F[(b + i) * ld + b + j];
                for (int i = j + 1; i < nb; ++i) {
                    double* const row = F + (b + i) * ld + b;
                    const double l = u[i] * reciprocal[j];
                    for (int k = j + 1; k <= i; ++k) row[k] -= l * u[k];
                    row[j] = l;
                }
            }
            for (int i = 0; i < BLOCK * BLOCK; ++i) inverse[i] = X[i] = 0.0;
            for (int i = 0; i < nb; ++i) {
                double* const row = inverse + i * BLOCK;
                const double* l = F + (b + i) * ld + b;
                for (int m = 0; m < i; ++m)
                    for (int k = 0; k <= m; ++k) row[k] -= l[m] * inverse[m * BLOCK + k];
                row[i] = 1.0;
                for (int k = 0; k <= i; ++k) X[k * BLOCK + i] = -row[k];
            }
            // The rows below times the inverse are L D: stored by rows divided by D, and by columns in T unchanged.
            const int aligned = next & ~7;
            for (int c = 0; c < nb; ++c) {
                for (int i = aligned; i < next; ++i) T[c * ld + i] = 0.0;
                for (int i = f; i < ld; ++i) T[c * ld + i] = 0.0;
            }
            for (int i = next; i < f; i += 4) {
                const int rows = f - i < 4 ? f - i : 4;
                double* const l = F + i * ld + b;
                for (int k = 0; k < 4 * BLOCK; ++k) P[k] = 0.0;
                if (rows == 4) {
                    for (int c = 0; c < nb; c += 8)
                        take_off(P + c, P + BLOCK + c, P + 2 * BLOCK + c, P + 3 * BLOCK + c, l, l + ld, l + 2 * ld,
                                 l + 3 * ld, X + c, BLOCK, nb);
                } else {
                    for (int q = 0; q < rows; ++q)
                        for (int c = 0; c < nb; c += 8) take_off_one(P + q * BLOCK + c, l + q * ld, X + c, BLOCK, nb);
                }
                for (int q = 0; q < rows; ++q)
                    for (int c = 0; c < nb; ++c) {
                        T[c * ld + i + q] = P[q * BLOCK + c];
                        l[q * ld + c] = P[q * BLOCK + c] * reciprocal[c];
                    }
            }
            for (int i = next; i < f; i += 4) {
                double* const l = F + i * ld + b;
                if (f - i >= 4) {
                    for (int c = aligned; c < i + 4; c += 8) {
                        double* const y = F + i * ld + c;
                        take_off(y, y + ld, y + 2 * ld, y + 3 * ld, l, l + ld, l + 2 * ld, l + 3 * ld, T + c, ld, nb);
                    }
                } else {
                    for (int q = 0; q < f - i; ++q)
                        for (int c = aligned; c <= i + q; c += 8)
                            take_off_one(F + (i + q) * ld + c, l + q * ld, T + c, ld, nb);
                }
            }
        }
        return negative;
    };
"""


def on_cpu(body: str, *, elsewhere: str = "") -> str:
    """Return the source of a native function that runs on a CPU only.

    Args:
        body: source for a CPU; it may use ``BLOCK``, ``v4`` and the ``take_off`` functions.
        elsewhere: source for the GPU compilation, which is never executed.
    """
    return f"#if !defined(__CUDA_ARCH__)\n{_PRODUCTS}{_SIZES}{body}\n#else\n{elsewhere}\n#endif\n"
