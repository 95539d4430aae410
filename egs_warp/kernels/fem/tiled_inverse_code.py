"""CUDA source of ``tiled_inverse``: operations of a thread block on tiles of 64 rows and columns.

A tile consists of 8 x 8 subtiles of eight rows and columns each. The subtiles are stored in column-major order, the
entries of a subtile row by row. Each thread of a warp loads two entries of a subtile, as the tensor cores require.
"""

TOOLS_CODE = """
    auto product = [](double (&to)[2], const double2& one, const double2& other) {
#if __CUDA_ARCH__ >= 800
        asm("mma.sync.aligned.m8n8k4.row.col.f64.f64.f64.f64 {%0,%1},{%2},{%3},{%0,%1};"
            : "+d"(to[0]), "+d"(to[1]) : "d"(one.x), "d"(other.x));
        asm("mma.sync.aligned.m8n8k4.row.col.f64.f64.f64.f64 {%0,%1},{%2},{%3},{%0,%1};"
            : "+d"(to[0]), "+d"(to[1]) : "d"(one.y), "d"(other.y));
#else
        const int own = threadIdx.x & 31, r = own >> 2, q = own & 3;
        #pragma unroll
        for (int k = 0; k < 8; ++k) {
            const int from = k / 2;
            const double a = __shfl_sync(0xffffffffu, k & 1 ? one.y : one.x, 4 * r + from);
            const double b = k & 1 ? other.y : other.x;
            to[0] = fma(a, __shfl_sync(0xffffffffu, b, 8 * q + from), to[0]);
            to[1] = fma(a, __shfl_sync(0xffffffffu, b, 8 * q + 4 + from), to[1]);
        }
#endif
    };
    // Inverse of the Cholesky factor of an 8 x 8 matrix. All threads of a warp factor; eight compute a column each.
    auto invert = [](const double* from, double* to) {
        const int c = threadIdx.x & 7;
        double a[8][8], y[8], roots[8];
        #pragma unroll
        for (int i = 0; i < 8; ++i) {
            #pragma unroll
            for (int k = 0; k <= i; k += 2) {
                const double2 x = *(const double2*)(from + 8 * i + k);
                a[i][k] = x.x;
                if (k < i) a[i][k + 1] = x.y;
            }
            y[i] = i == c ? 1.0 : 0.0;
        }
        bool sound = true;
        #pragma unroll
        for (int k = 0; k < 8; ++k) {
            const double pivot = a[k][k];
            sound = sound && pivot > 1e-300;
            double about;
            asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(about) : "d"(pivot));
            const double off = fma(-pivot, about, 1.0), more = fma(off, off, off), over = fma(about, more, about);
            if (k < 7) {
                // The next pivot is on the critical path: compute it first, from the approximate reciprocal.
                const double some = a[k + 1][k] * a[k + 1][k] * about;
                a[k + 1][k + 1] = fma(-some, more, a[k + 1][k + 1] - some);
            }
            double near;
            asm("rsqrt.approx.ftz.f64 %0, %1;" : "=d"(near) : "d"(pivot));
            const double rest = fma(-pivot * near, near, 1.0);
            roots[k] = fma(fma(0.375, rest, 0.5), near * rest, near);
            #pragma unroll
            for (int i = k + 1; i < 8; ++i) {
                const double share = a[i][k] * over;
                #pragma unroll
                for (int j = k + 1; j <= i; ++j)
                    if (j > k + 1 || i > k + 1) a[i][j] = fma(-share, a[j][k], a[i][j]);
                y[i] = fma(-share, y[k], y[i]);
            }
        }
        if ((threadIdx.x & 31) < 8) {
            #pragma unroll
            for (int i = 0; i < 8; ++i) to[8 * i + c] = y[i] * roots[i];
        }
        return sound;
    };
    // Add the product of sixteen rows and the transpose of eight other rows, over eight columns.
    auto add = [&](double (&to)[4], const double2& upper, const double2& lower, const double2& by) {
#if __CUDA_ARCH__ >= 900
        asm("mma.sync.aligned.m16n8k8.row.col.f64.f64.f64.f64 {%0,%1,%2,%3},{%4,%5,%6,%7},{%8,%9},{%0,%1,%2,%3};"
            : "+d"(to[0]), "+d"(to[1]), "+d"(to[2]), "+d"(to[3])
            : "d"(upper.x), "d"(lower.x), "d"(upper.y), "d"(lower.y), "d"(by.x), "d"(by.y));
#else
        double above[2] = {to[0], to[1]}, under[2] = {to[2], to[3]};
        product(above, upper, by);
        product(under, lower, by);
        to[0] = above[0], to[1] = above[1], to[2] = under[0], to[3] = under[1];
#endif
    };
    auto load = [&](const double* from) { return *(const double2*)(from + 2 * own); };
    auto store = [&](double* to, double one, double two) { *(double2*)(to + 2 * own) = make_double2(one, two); };
    auto less = [](const double2& x) { return make_double2(-x.x, -x.y); };
    // Copy eight columns of a tile, bypassing the L1 cache, which may hold old values.
    auto fetch = [&](double* to, const double* from) {
#if __CUDA_ARCH__ >= 800
        const unsigned at = static_cast<unsigned>(__cvta_generic_to_shared(to + 2 * lane));
        asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(at), "l"(from + 2 * lane) : "memory");
#else
        *(double2*)(to + 2 * lane) = __ldcg((const double2*)(from + 2 * lane));
#endif
    };
    auto fetched = [] {
#if __CUDA_ARCH__ >= 800
        asm volatile("cp.async.commit_group;" ::: "memory");
#endif
    };
    auto flag_of = [](const int* flag) { return *(volatile const int*)flag; };
    // Everything that this block has written is visible to a thread that reads the flag.
    auto publish = [&](int* flag, int writer) {
        __syncthreads();
        if (lane == writer) {
            __threadfence();
            *(volatile int*)flag = launch;
        }
    };
    auto await = [&](const int* flag) {
        while (!__syncthreads_and(lane != 0 || flag_of(flag) == launch)) {
        }
    };
    // Initial value of a sum: a partial sum, or entries of the matrix, padded with the identity.
    auto begin = [&](double (&to)[4][4], int initial, int row, int rows, int column, int width) {
        if (initial >= 0) {
            await(tile_flags + initial);
            const double* const from = tiles.data + (size_t)initial * TILE + 2 * own;
            #pragma unroll
            for (int s = 0; s < 4; ++s)
                #pragma unroll
                for (int k = 0; k < 2; ++k) {
                    const double2 x = __ldcg((const double2*)(from + (8 * column_block(s) + 2 * band + k) * 64));
                    to[s][2 * k] = x.x, to[s][2 * k + 1] = x.y;
                }
            return;
        }
        #pragma unroll
        for (int s = 0; s < 4; ++s)
            #pragma unroll
            for (int k = 0; k < 4; ++k) {
                const int i = 16 * band + r + 8 * (k / 2), j = 8 * column_block(s) + 2 * q + k % 2;
                const double none = row == column && i == j ? 1.0 : 0.0;
                to[s][k] = i < rows && j < width ? S[(size_t)(row + i) * stride + column + j] : none;
            }
    };
    auto put = [&](double* to, const double (&from)[4][4]) {
        #pragma unroll
        for (int s = 0; s < 4; ++s) {
            store(to + (8 * column_block(s) + 2 * band) * 64, from[s][0], from[s][1]);
            store(to + (8 * column_block(s) + 2 * band + 1) * 64, from[s][2], from[s][3]);
        }
    };

"""

FACTOR_CODE = """
        if (kind == FIRST || chained) {
            if (!chained) __syncthreads();
            #pragma unroll
            for (int s = 0; s < 4; ++s)
                #pragma unroll
                for (int k = 0; k < 2; ++k) {
                    const int i = 2 * band + k, n = column_block(s);
                    const double one = chained ? square[s][2 * k] : sum[s][2 * k];
                    const double two = chained ? square[s][2 * k + 1] : sum[s][2 * k + 1];
                    store(scratch + (8 * i + n) * 64, n <= i ? one : 0.0, n <= i ? two : 0.0);
                }
            // Eight columns at a time: below the diagonal is the remaining matrix, above it the computed part of the
            // factor's inverse, transposed. One warp runs ahead along the diagonal, each other one has one of the rows.
            double *const line = scratch + TILE, *const roots = line + 512, *const corner = roots + 128;
            __syncthreads();
            bool sound = true;
            if (warp == 0) sound = invert(scratch, roots);
            #pragma unroll 1
            for (int j = 0; j < 8; ++j) {
                const double* const root = roots + (j & 1) * 64;
                const int i = warp == 0 ? min(j + 1, 7) : warp - 1 <= j ? warp - 1 : warp;
                double v[2] = {0.0, 0.0};
                __syncthreads();
                if (i == j)
                    v[0] = root[16 * q + r], v[1] = root[16 * q + 8 + r];
                else
                    product(v, load(scratch + (8 * i + j) * 64), load(root));
                const double2 w = make_double2(v[0], v[1]), minus = less(w);
                store(line + i * 64, v[0], v[1]);
                if (i <= j) store(scratch + (8 * i + j) * 64, v[0], v[1]);
                if (j == 7) break;
                if (warp == 0) {
                    asm volatile("bar.arrive 1, 256;" ::: "memory");
                    const double2 d = load(scratch + (8 * i + i) * 64);
                    double left[2] = {d.x, d.y};
                    product(left, minus, w);
                    store(corner, left[0], left[1]);
                    __syncwarp();
                    sound = invert(corner, roots + (~j & 1) * 64) && sound;
                } else {
                    asm volatile("bar.sync 1, 256;" ::: "memory");
                    const int end = i <= j ? 7 : i;
                    #pragma unroll
                    for (int s = 1; s < 8; ++s) {
                        const int c = min(j + s, end);
                        double* const at = scratch + (8 * i + c) * 64;
                        const double2 x = load(at);
                        double to[2] = {x.x, x.y};
                        product(to, minus, load(line + c * 64));
                        if (j + s <= end) store(at, to[0], to[1]);
                    }
                }
            }
            if (!sound) *(volatile int*)(state.data + 3) = 1;
            __syncthreads();
            for (int s = warp; s < 64; s += LANES / 32) {
                const int k = s / 8, n = s % 8;
                const double* const from = scratch + s * 64 + 16 * q + r;
                if (k <= n) store(triangles.data + (size_t)diagonal * TILE + s * 64, from[0], from[8]);
            }
            publish(flags.data + diagonal, 0);
            for (int s = warp; s < 64; s += LANES / 32) {
                const int i = s % 8, n = s / 8;
                const double2 x = load(scratch + (8 * i + n) * 64);
                if (i <= n) store(tiles.data + (size_t)transposed * TILE + s * 64, x.x, x.y);
            }
            publish(tile_flags + transposed, 0);
            for (int s = lane; s < TILE; s += LANES) {
                const int i = s / 64, j = s % 64, n = i / 8, k = j / 8;
                if (i < rows && j < rows)
                    R[(size_t)(row + i) * out_stride + order.data[row + j]] =
                        k <= n ? scratch[(8 * k + n) * 64 + j % 8 * 8 + i % 8] : 0.0;
            }
        }
    }
"""
