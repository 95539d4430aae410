"""Newton step of the Coulomb solve by a block of threads on a GPU, for 121 to 256 unknowns.

The method is that of ``coulomb_step``, in passes of 64 columns.
"""

import warp as wp

from egs_warp.kernels.contact.coulomb_block import gpu_or_cpu
from egs_warp.kernels.contact.coulomb_step import LIST, PRODUCTS
from egs_warp.kernels.contact.coulomb_step import TILES as FEWER
from egs_warp.precision import Vec4, real

wp.set_module_options({"enable_backward": False})

_TILES = f"""
    constexpr int TILES = 4 * WARPS, FEWEST = {FEWER} + 1, WIDTH = 8, SLOTS = 8, PITCH = 8 * WIDTH + 8, EACH = 9;
    // As in coulomb_step, but tops holds the tiles of all columns of a pass in the rows of the next unknowns, and
    // rights their right-hand sides. The strip has 64 rows.
    double* const shared = (double*)__cvta_shared_to_generic(shared_address);
    double (*const lefts)[TILES][64] = (double (*)[TILES][64])shared;
    double (*const inverses)[64] = (double (*)[64])(lefts + 2);
    double (*const tops)[WIDTH][64] = (double (*)[WIDTH][64])(inverses + 2);
    double (*const rights)[8] = (double (*)[8])(tops + 2);
    double (*const strip)[PITCH] = (double (*)[PITCH])shared;
    double (*const line)[EACH] = (double (*)[EACH])matrix.data;
    static_assert((2 * TILES + 2 + 2 * WIDTH) * 64 + 16 <= SHARED_DOUBLES && 64 * PITCH <= SHARED_DOUBLES, "");
"""

_PREPARE = """
    // A warp has two columns of tiles with every second pair of rows, and the right sides of every eighth tile. The
    // multipliers of earlier passes' unknowns are stored behind the lines in matrix, which has space for all equations.
    const int r = own >> 2, q = own & 3, group = warp & 3, half = warp >> 2, slots = (pairs + 1 - half) / 2;
    double* const factors = (double*)matrix.data + (EACH * unknowns + 7) / 8 * 8;
    double part[2][SLOTS][4], right[TILES / WARPS];
    #pragma unroll
    for (int i = 0; i < TILES / WARPS; ++i) {
        const int a = 8 * (warp + WARPS * i) + r;
        right[i] = a < unknowns ? line[a][6] : 0.0;
    }
    auto fetch = [&](int k) {
        for (int e = lane; e < 32 * tiles; e += 8 * 32) {
            const int a = e >> 2, there = a < unknowns ? 16 : 0;
            const double* const from = factors + (k * unknowns + (there ? a : 0)) * 8 + 2 * (e & 3);
            const unsigned to = __cvta_generic_to_shared(lefts[k & 1][0] + 2 * e);
            asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" : : "r"(to), "l"(from), "r"(there) : "memory");
        }
    };
"""

_WRITE = """
        // Expand 64 rows at a time into strip, from which each warp loads its tiles.
        #pragma unroll 1
        for (int chunk = 0; 4 * chunk < pairs; ++chunk) {
            #pragma unroll 1
            for (int some = 0; some < 64; some += 4 * WARPS) {
                const double *from[4], *g[4];
                int base[4];
                #pragma unroll
                for (int h = 0; h < 4; ++h) {
                    const int a = 64 * chunk + some + warp + WARPS * h, row = a < unknowns ? a : 0, c = column[row];
                    from[h] = line[row];
                    base[h] = c - c % 3;
                    g[h] = G + base[h] * stride;
                }
                #pragma unroll
                for (int t = 0; t < WIDTH / 4; ++t) {
                    const int b = 8 * first + own + 32 * t, c = b >= 0 ? column[b] : -1, at = c < 0 ? 0 : c;
                    #pragma unroll
                    for (int h = 0; h < 4; ++h) {
                        const int a = 64 * chunk + some + warp + WARPS * h;
                        const unsigned place = c - base[h];
                        const double entry = from[h][0] * g[h][at] + from[h][1] * g[h][stride + at]
                            + from[h][2] * g[h][2 * stride + at] + from[h][place < 3u ? 3 + place : 7];
                        strip[some + warp + WARPS * h][own + 32 * t] =
                            a >= unknowns ? (a == b ? 1.0 : 0.0) : c < 0 ? 0.0 : entry;
                    }
                }
            }
            WAIT;
            #pragma unroll
            for (int slot = 0; slot < SLOTS; ++slot)
                if (slot / 2 == chunk) {
                    #pragma unroll
                    for (int jj = 0; jj < 2; ++jj) {
                        const int row = 16 * (2 * (slot & 1) + half) + r;
                        const double* const upper = strip[row] + 8 * (group + 4 * jj) + 2 * q;
                        const double* const lower = upper + 8 * PITCH;
                        part[jj][slot][0] = upper[0];
                        part[jj][slot][1] = upper[1];
                        part[jj][slot][2] = lower[0];
                        part[jj][slot][3] = lower[1];
                    }
                }
            WAIT;
        }
"""

_PASSES = """
    for (int first = tiles - (tiles + WIDTH - 1) / WIDTH * WIDTH; first < tiles; first += WIDTH) {
        const int begin = first > 0 ? first : 0, end = first + WIDTH;
        WRITE
        // Apply the multipliers of earlier passes, then eliminate eight more unknowns at a time.
        for (int k = -1; k < end; ++k) {
            const int next = k + 1, now = k & 1, then = next & 1;
            if (k >= begin && !regular[now]) return 0;
            if (next < begin) fetch(next);
            const bool one = first + group > k && first + group >= 0;
            const bool two = first + group + 4 > k && first + group + 4 >= 0;
            if (k >= 0 && (one || two)) {
                double less[2][2];
                #pragma unroll
                for (int jj = 0; jj < 2; ++jj) {
                    const double2 top = load(tops[now][group + 4 * jj]);
                    if (k < begin) {
                        less[jj][0] = -top.x;
                        less[jj][1] = -top.y;
                    } else {
                        less[jj][0] = less[jj][1] = 0.0;
                        product(less[jj], make_double2(-top.x, -top.y), load(inverses[now]));
                    }
                }
                constexpr int SOME = 2;
                #pragma unroll
                for (int from = 0; from < SLOTS; from += SOME)
                    if (from < slots) {
                        double2 upper[SOME], lower[SOME];
                        #pragma unroll
                        for (int t = 0; t < SOME; ++t) {
                            upper[t] = load(lefts[now][4 * (from + t) + 2 * half]);
                            lower[t] = load(lefts[now][4 * (from + t) + 2 * half + 1]);
                        }
                        if (one) {
                            #pragma unroll
                            for (int t = 0; t < SOME; ++t) add(part[0][from + t], upper[t], lower[t], less[0]);
                        }
                        if (two) {
                            #pragma unroll
                            for (int t = 0; t < SOME; ++t) add(part[1][from + t], upper[t], lower[t], less[1]);
                        }
                    }
            }
            const int ahead = next - first;
            if (next < end && next / 2 % 2 == half) {
                double* const to = tops[then][group] + 16 * q + r;
                #pragma unroll
                for (int ii = 0; ii < SLOTS; ++ii)
                    if (ii == next / 4) {
                        #pragma unroll
                        for (int jj = 0; jj < 2; ++jj) {
                            to[256 * jj] = then ? part[jj][ii][2] : part[jj][ii][0];
                            to[256 * jj + 8] = then ? part[jj][ii][3] : part[jj][ii][1];
                        }
                    }
            }
            if (next >= begin && next < end && group == ahead % 4) {
                #pragma unroll
                for (int jj = 0; jj < 2; ++jj)
                    if (ahead / 4 == jj) {
                        #pragma unroll
                        for (int ii = 0; ii < SLOTS; ++ii)
                            if (ii < slots) {
                                double (*const to)[64] = lefts[then] + 4 * ii + 2 * half;
                                store(to[0], part[jj][ii][0], part[jj][ii][1]);
                                store(to[1], part[jj][ii][2], part[jj][ii][3]);
                            }
                    }
                if (next / 2 % 2 == half) {
                    __syncwarp();
                    if (!invert(lefts[then][next], inverses[then])) regular[then] = 0;
                }
            }
            // Multipliers of these eight unknowns, for the right-hand sides and for later passes.
            if (k >= begin) {
                const double2 inverse = make_double2(inverses[now][16 * q + r], inverses[now][16 * q + 8 + r]);
                const double2 solved = *(const double2*)(rights[now] + 2 * q);
                #pragma unroll
                for (int i = 0; i < TILES / WARPS; ++i) {
                    const int tile = warp + WARPS * i, a = 8 * tile + r;
                    if (tile < tiles) {
                        double share[2] = {0.0, 0.0};
                        product(share, load(lefts[now][tile]), inverse);
                        if (end < tiles && a < unknowns)
                            *(double2*)(factors + (k * unknowns + a) * 8 + 2 * q) = make_double2(share[0], share[1]);
                        double sum = share[0] * solved.x + share[1] * solved.y;
                        sum += __shfl_xor_sync(0xffffffffu, sum, 1);
                        sum += __shfl_xor_sync(0xffffffffu, sum, 2);
                        right[i] -= sum;
                    }
                }
            }
            if (next >= begin && next < end && next % WARPS == warp && q == 0) {
                #pragma unroll
                for (int i = 0; i < TILES / WARPS; ++i)
                    if (next / WARPS == i) rights[then][r] = right[i];
            }
            asm volatile("cp.async.wait_all;" : : : "memory");
            WAIT;
        }
    }
    #pragma unroll
    for (int i = 0; i < TILES / WARPS; ++i) {
        const int a = 8 * (warp + WARPS * i) + r;
        if (q == 0 && a < unknowns) s[column[a]] = right[i];
    }
    WAIT;
    return 1;
""".replace("        WRITE\n", _WRITE)


@wp.func_native(
    gpu_or_cpu(
        f"#if __CUDA_ARCH__ < 800\n    return 0;\n#else\n{_TILES}{LIST}{_PREPARE}{PRODUCTS}{_PASSES}#endif\n",
        otherwise="    return 0;",
    )
)
def wide_step_by_block(
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
    matrix: wp.array2d[Vec4],
) -> int:
    """Compute the Newton step like ``step_by_block``, but for 121 to 256 unknowns.

    The arguments are those of ``step_by_block``, and ``matrix``, which is scratch memory with space for all equations.

    Returns:
        1 on success; 0, with an invalid step, if a pivot is too small or the number of unknowns is outside this range.
    """
    ...
