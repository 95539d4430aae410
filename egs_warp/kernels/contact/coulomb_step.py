"""Newton step of the Coulomb solve by a block of threads on a GPU, for up to 120 unknowns (see ``coulomb_block``).

The equations are written as tiles of 8 x 8, which the threads hold in registers, and eliminated eight unknowns at a
time on the tensor cores. The C++ source has four parts: ``_TILES`` lays out the shared memory, ``LIST`` finds the
unknowns and writes a compact form of their rows (*lines*), ``_WRITE`` expands the lines to tiles, and ``_ELIMINATE``
solves the equations.
"""

import warp as wp

from egs_warp.kernels.contact.coulomb_block import gpu_or_cpu
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

TILES = 15
"""Maximum number of tiles of eight unknowns."""

_TILES = f"""
    constexpr int TILES = {TILES}, FEWEST = 0, PAIRS = WARPS, PITCH = 8 * TILES + 10, EACH = 9;
    // Tiles of eight rows and columns, in the order of the threads of a warp. lefts are the columns of the unknowns
    // that are eliminated now and next, inverses the inverses of their diagonal tiles, tops the two tiles of each warp
    // in the rows of the next unknowns. Before the elimination, the memory holds the lines of the equations and, in
    // strip, sixteen expanded rows.
    double* const shared = (double*)__cvta_shared_to_generic(shared_address);
    double (*const line)[EACH] = (double (*)[EACH])shared;
    double (*const strip)[PITCH] = (double (*)[PITCH])(line + 8 * TILES);
    double (*const lefts)[64] = (double (*)[64])shared, (*const inverses)[64] = lefts + 2 * (TILES + 1);
    double (*const tops)[64] = inverses + 2 + 2 * warp;
    static_assert(8 * EACH * TILES + 16 * PITCH <= SHARED_DOUBLES
        && (2 * (TILES + 1) + 2 + 2 * WARPS) * 64 <= SHARED_DOUBLES, "");
"""

LIST = """
    // A line has EACH numbers: three weights, three own entries, the right-hand side, a zero, padding.
    __shared__ int column[8 * TILES], ahead[WARPS], regular[2];
    const double *const G = delassus.data, *const f = forces.data, *const u = velocities.data;
    const int stride = delassus.strides[0] / 8;
    double* const s = step.data;
    if (count > lanes) return 0;
    // Each thread processes a contact: it finds the unknown components of its step and the effect of the known ones.
    const int n = 3 * lane, size = 3 * count;
    const bool mine = lane < count;
    bool presses = false, has_tangents = false;
    double rate = 0.0, first = 0.0, second = 0.0, known[3] = {0.0, 0.0, 0.0};
    if (mine) {
        const double* const d = G + n * stride + n;
        rate = 3.0 * scale * over(d[0] + d[stride + 1] + d[2 * stride + 2]);
        first = f[n + 1] - rate * u[n + 1];
        second = f[n + 2] - rate * u[n + 2];
        presses = f[n] - rate * u[n] > 0.0;
        has_tangents = !(f[n] <= 0.0 && first * first + second * second > 0.0);
        if (!presses) known[0] = -values.data[n];
        if (!has_tangents) {
            known[1] = -values.data[n + 1];
            known[2] = -values.data[n + 2];
        }
        for (int t = 0; t < 3; ++t) s[n + t] = known[t];
    }
    const unsigned pressing = __ballot_sync(0xffffffffu, presses), tangents = __ballot_sync(0xffffffffu, has_tangents);
    const unsigned below = (1u << own) - 1u;
    if (own == 0) ahead[warp] = __popc(pressing) + 2 * __popc(tangents);
    if (lane < 2) regular[lane] = 1;
    const int moves = __syncthreads_or(!(known[0] == 0.0 && known[1] == 0.0 && known[2] == 0.0));
    int place = __popc(pressing & below) + 2 * __popc(tangents & below), unknowns = 0;
    #pragma unroll 1
    for (int i = 0; i < WARPS; ++i) {
        if (i < warp) place += ahead[i];
        unknowns += ahead[i];
    }
    const int tiles = (unknowns + 7) / 8, pairs = (tiles + 1) / 2;
    if (tiles < FEWEST || tiles > TILES) return 0;
    if (moves) {
        for (int row = warp; row < size; row += WARPS) {
            double sum = 0.0;
            for (int c = own; c < size; c += 32) sum += G[row * stride + c] * s[c];
            for (int away = 16; away > 0; away >>= 1) sum += __shfl_xor_sync(0xffffffffu, sum, away);
            if (own == 0) change.data[row] = sum;
        }
        WAIT;
    }
    // Write the lines of the contact's unknowns.
    if (mine) {
        double moved[3] = {0.0, 0.0, 0.0};
        if (moves)
            for (int t = 0; t < 3; ++t) moved[t] = change.data[n + t];
        if (presses) {
            double* const to = line[place];
            column[place++] = n;
            to[0] = rate;
            to[3] = regularization;
            to[1] = to[2] = to[4] = to[5] = to[7] = 0.0;
            to[6] = -values.data[n] - rate * moved[0];
        }
        if (has_tangents) {
            const double square = first * first + second * second, radius = friction * fmax(f[n], 0.0);
            const bool slides = square > radius * radius;
            const double by = over_root(square), share = radius * by, d[2] = {first * by, second * by};
            #pragma unroll
            for (int t = 0; t < 2; ++t) {
                double w[2], o[3] = {0.0, 0.0, 0.0};
                #pragma unroll
                for (int k = 0; k < 2; ++k) {
                    // Sliding: I - share (I - d d^T) (I - rate G); -friction d in the column of the normal force.
                    const double same = t == k ? 1.0 : 0.0, along = share * (same - d[t] * d[k]);
                    w[k] = rate * (slides ? along : same);
                    o[1 + k] = same * regularization + (slides ? same - along : 0.0);
                }
                if (slides) o[0] = -friction * d[t];
                double* const to = line[place];
                column[place++] = n + 1 + t;
                to[0] = to[7] = 0.0;
                to[1] = w[0];
                to[2] = w[1];
                for (int k = 0; k < 3; ++k) to[3 + k] = o[k];
                to[6] = -values.data[n + 1 + t] - w[0] * moved[1] - w[1] * moved[2] - o[0] * known[0];
            }
        }
    }
    for (int b = unknowns + lane; b < 8 * tiles; b += lanes) column[b] = -1;
    WAIT;
"""

_WRITE = """
    // Expand sixteen rows at a time into strip, from which each warp loads its columns of tiles, at most two.
    const int r = own >> 2, q = own & 3;
    double part[2][PAIRS][4];
    #pragma unroll 1
    for (int ii = 0; ii < pairs; ++ii) {
        const double *from[2], *g[2];
        int base[2];
        #pragma unroll
        for (int h = 0; h < 2; ++h) {
            const int a = 16 * ii + warp + WARPS * h, row = a < unknowns ? a : 0, c = unknowns > 0 ? column[row] : 0;
            from[h] = line[row];
            base[h] = c - c % 3;
            g[h] = G + base[h] * stride;
        }
        #pragma unroll
        for (int t = 0; t < (8 * TILES + 31) / 32; ++t) {
            const int b = own + 32 * t;
            if (32 * t >= 8 * tiles) break;
            const int c = b < 8 * tiles ? column[b] : -1, at = c < 0 ? 0 : c;
            #pragma unroll
            for (int h = 0; h < 2; ++h) {
                const int a = 16 * ii + warp + WARPS * h;
                const unsigned place = c - base[h];
                const double entry = from[h][0] * g[h][at] + from[h][1] * g[h][stride + at]
                    + from[h][2] * g[h][2 * stride + at] + from[h][place < 3u ? 3 + place : 7];
                if (b < 8 * tiles)
                    strip[warp + WARPS * h][b] = a >= unknowns ? (a == b ? 1.0 : 0.0) : c < 0 ? 0.0 : entry;
                if (b == 0) strip[warp + WARPS * h][8 * tiles] = a < unknowns ? from[h][6] : 0.0;
            }
        }
        WAIT;
        #pragma unroll
        for (int slot = 0; slot < PAIRS; ++slot)
            if (slot == ii) {
                #pragma unroll
                for (int jj = 0; jj < 2; ++jj) {
                    const int j = warp + WARPS * jj < tiles ? warp + WARPS * jj : tiles;
                    const double *const upper = strip[r] + 8 * j + 2 * q, *const lower = upper + 8 * PITCH;
                    part[jj][slot][0] = upper[0];
                    part[jj][slot][1] = upper[1];
                    part[jj][slot][2] = lower[0];
                    part[jj][slot][3] = lower[1];
                }
            }
        WAIT;
    }
"""

PRODUCTS = """
    // Products of tiles: a thread holds row r of one factor and column r of the other, at the summation indices 2q and
    // 2q + 1.
    auto product = [](double (&to)[2], const double2& one, const double2& other) {
        asm volatile("mma.sync.aligned.m8n8k4.row.col.f64.f64.f64.f64 {%0,%1},{%2},{%3},{%0,%1};"
                     : "+d"(to[0]), "+d"(to[1]) : "d"(one.x), "d"(other.x));
        asm volatile("mma.sync.aligned.m8n8k4.row.col.f64.f64.f64.f64 {%0,%1},{%2},{%3},{%0,%1};"
                     : "+d"(to[0]), "+d"(to[1]) : "d"(one.y), "d"(other.y));
    };
    auto add = [&](double (&to)[4], const double2& upper, const double2& lower, const double (&by)[2]) {
#if __CUDA_ARCH__ >= 900
        asm volatile("mma.sync.aligned.m16n8k8.row.col.f64.f64.f64.f64 "
                     "{%0,%1,%2,%3},{%4,%5,%6,%7},{%8,%9},{%0,%1,%2,%3};"
                     : "+d"(to[0]), "+d"(to[1]), "+d"(to[2]), "+d"(to[3])
                     : "d"(upper.x), "d"(lower.x), "d"(upper.y), "d"(lower.y), "d"(by[0]), "d"(by[1]));
#else
        const double2 other = make_double2(by[0], by[1]);
        double above[2] = {to[0], to[1]}, under[2] = {to[2], to[3]};
        product(above, upper, other);
        product(under, lower, other);
        to[0] = above[0], to[1] = above[1], to[2] = under[0], to[3] = under[1];
#endif
    };
    auto store = [&](double* to, double one, double two) { *(double2*)(to + 2 * own) = make_double2(one, two); };
    auto load = [&](const double* from) { return *(const double2*)(from + 2 * own); };
    // A warp inverts a diagonal tile, and returns whether its pivots are large enough.
    auto invert = [&](double* to, double* inverse) {
        const double2 tile = load(to);
        double d0 = tile.x, d1 = tile.y;
        bool is_regular = true;
        #pragma unroll
        for (int p = 0; p < 8; ++p) {
            const double some = p & 1 ? d1 : d0, pivot = __shfl_sync(0xffffffffu, some, 4 * p + p / 2);
            const double factor = __shfl_sync(0xffffffffu, some, (own & 28) | (p / 2));
            const double t0 = __shfl_sync(0xffffffffu, d0, 4 * p + q);
            const double t1 = __shfl_sync(0xffffffffu, d1, 4 * p + q);
            is_regular = is_regular && fabs(pivot) > min_pivot;
            const double by = over(pivot), share = (r == p ? 1.0 : -factor) * by;
            if (r == p) d0 = d1 = 0.0;
            d0 = fma(share, t0, d0);
            d1 = fma(share, t1, d1);
            if (q == p / 2) (p & 1 ? d1 : d0) = share;
        }
        store(inverse, d0, d1);
        // Subtract the identity: eliminating the tile from its own rows then leaves the product with the inverse.
        store(to, tile.x - (r == 2 * q ? 1.0 : 0.0), tile.y - (r == 2 * q + 1 ? 1.0 : 0.0));
        return is_regular;
    };
"""

_ELIMINATE = """
    // Eliminate eight unknowns at a time.
    for (int k = -1; k < tiles; ++k) {
        if (k >= 0) {
            if (!regular[k & 1]) return 0;
            const bool one = warp > k && warp <= tiles, two = warp + WARPS > k && warp + WARPS <= tiles;
            const double (*const left)[64] = lefts + (k & 1) * (TILES + 1);
            const double2 inverse = load(inverses[k & 1]);
            double less[2][2];
            #pragma unroll
            for (int jj = 0; jj < 2; ++jj) {
                const double2 top = load(tops[jj]);
                less[jj][0] = less[jj][1] = 0.0;
                product(less[jj], make_double2(-top.x, -top.y), inverse);
            }
            constexpr int SOME = 3;
            #pragma unroll
            for (int begin = 0; begin < PAIRS; begin += SOME)
                if (begin < pairs && (one || two)) {
                    double2 upper[SOME], lower[SOME];
                    #pragma unroll
                    for (int t = 0; t < SOME; ++t)
                        if (begin + t < PAIRS) {
                            upper[t] = load(left[2 * (begin + t)]);
                            lower[t] = load(left[2 * (begin + t) + 1]);
                        }
                    if (one) {
                        #pragma unroll
                        for (int t = 0; t < SOME; ++t)
                            if (begin + t < PAIRS) add(part[0][begin + t], upper[t], lower[t], less[0]);
                    }
                    if (two) {
                        #pragma unroll
                        for (int t = 0; t < SOME; ++t)
                            if (begin + t < PAIRS) add(part[1][begin + t], upper[t], lower[t], less[1]);
                    }
                }
        }
        const int next = k + 1;
        if (next < tiles) {
            double (*const left)[64] = lefts + (next & 1) * (TILES + 1);
            auto publish = [&](int ii) {
                double* const to = tops[0] + 16 * q + r;
                if (next & 1) {
                    to[0] = part[0][ii][2], to[8] = part[0][ii][3];
                    to[64] = part[1][ii][2], to[72] = part[1][ii][3];
                } else {
                    to[0] = part[0][ii][0], to[8] = part[0][ii][1];
                    to[64] = part[1][ii][0], to[72] = part[1][ii][1];
                }
            };
            #pragma unroll
            for (int ii = 0; ii < PAIRS; ++ii)
                if (ii == next / 2) publish(ii);
            #pragma unroll
            for (int jj = 0; jj < 2; ++jj)
                if (warp + WARPS * jj == next) {
                    #pragma unroll
                    for (int ii = 0; ii < PAIRS; ++ii)
                        if (ii < pairs) {
                            store(left[2 * ii], part[jj][ii][0], part[jj][ii][1]);
                            store(left[2 * ii + 1], part[jj][ii][2], part[jj][ii][3]);
                        }
                }
            if (warp == next % WARPS) {
                __syncwarp();
                if (!invert(left[next], inverses[next & 1])) regular[next & 1] = 0;
            }
        }
        WAIT;
    }
    #pragma unroll
    for (int jj = 0; jj < 2; ++jj)
        if (warp + WARPS * jj == tiles && q == 0) {
            #pragma unroll
            for (int ii = 0; ii < PAIRS; ++ii) {
                const int a = 16 * ii + r;
                if (a < unknowns) s[column[a]] = part[jj][ii][0];
                if (a + 8 < unknowns) s[column[a + 8]] = part[jj][ii][2];
            }
        }
    WAIT;
    return 1;
"""


@wp.func_native(
    gpu_or_cpu(
        f"#if __CUDA_ARCH__ < 800\n    return 0;\n#else\n{_TILES}{LIST}{_WRITE}{PRODUCTS}{_ELIMINATE}#endif\n",
        otherwise="    return 0;",
    )
)
def step_by_block(
    shared_address: wp.uint32,
    delassus: wp.array2d[real],
    friction: real,
    count: int,
    forces: wp.array[real],
    velocities: wp.array[real],
    values: wp.array[real],
    scale: real,
    regularization: real,
    min_pivot: real,
    step: wp.array[real],
    change: wp.array[real],
) -> int:
    """Compute the Newton step of ``write_equations`` and ``solve_equations``, without row exchanges.

    Args:
        shared_address: result of ``shared_memory``.
        delassus: (3n, 3n) m/(N s), Delassus operator.
        friction: Coulomb coefficient.
        count: number n of contacts.
        forces: (3n,) newtons, forces at the start of the step.
        velocities: (3n,) m/s, contact velocities under these forces, including the normal bias.
        values: (3n,) newtons, residual of the projection equations.
        scale: scale of the projection rates (``rate_of``).
        regularization: added to the diagonal of normal and sticking components.
        min_pivot: pivots must be larger than this.
        step: (3n,) newtons, output.
        change: (3n,) scratch memory.

    Returns:
        1 on success; 0, with an invalid step, if a pivot is too small or there are more than 120 unknowns.
    """
    ...
