"""Inverses of Cholesky factors by many blocks of threads at once, each of which takes task after task, on a GPU.

Tasks are taken in their order, and none waits for a later one: it does not matter how many blocks there are, nor when
each of them begins. All sums have an order of their own, whoever finds them.
"""

from enum import IntEnum

import warp as wp

from egs_warp.kernels.fem.tiled_inverse_code import FACTOR, TOOLS
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

TILE_SIDE = 64
"""Rows and columns of a tile."""
BLOCK = 256
"""Threads of a block."""
TASK_SIZE = 16
"""Numbers that tell a task: its kind, the first of its rows and how many, the same of its columns, the inverse of which
columns it is multiplied by, where its pairs begin and end, and the tile it makes. Then, each or -1: of which columns it
makes the inverse, the tile that has this turned, and the sums with which its tile and that on the diagonal begin."""


class Kind(IntEnum):
    """Of a task: how a tile comes about."""

    ROWS = 0
    """In rows of the matrix, from its entries."""
    UNIT = 1
    """In rows of the unit matrix, columns of the inverse."""
    FIRST = 2
    """On the diagonal, with nothing to the left of it in its group: the factor's inverse there."""
    CHAINED = 3
    """As in rows of the matrix, and then that to the right of it, on the diagonal."""
    SUM = 4
    """Part of the sum of one of the others."""
    ZEROS = 5
    """None: whole rows of the inverse, outside of some of the columns."""


_BEGIN = f"""
    enum {{ {", ".join(f"{kind.name} = {kind.value}" for kind in Kind)} }};
    constexpr int TILE = {TILE_SIDE * TILE_SIDE}, CHUNK = TILE / 8, SLOTS = 5, LANES = {BLOCK}, TASK = {TASK_SIZE};
"""

_ROOM = """
    double *const S = matrix.data, *const R = inverse.data;
    const int stride = matrix.strides[0] / 8, apart = inverse.strides[0] / 8;
    const int2* const both = (const int2*)pairs.data;
    // Columns of tiles whose products are summed; a tile that is multiplied, or factored.
    __shared__ __align__(16) double room[2 * SLOTS * CHUNK];
    int* const told = (int*)room;
    const int lane = threadIdx.x, warp = lane >> 5, own = lane & 31, r = own >> 2, q = own & 3;
    const int turn = *(volatile const int*)(state.data + 1) + 1;
    int* const there = flags.data + columns;
    // Warps have sixteen rows of a tile and half of its columns, which ones so that all have about
    // as much of a triangle.
    const int half = warp >> 2, band = half ? 7 - warp : warp;
    auto piece = [&](int s) { return 2 * s + ((s & 1) ^ half); };

"""

_SUM = """
    for (;;) {
        __syncthreads();
        if (lane == 0) *told = atomicAdd(state.data, 1);
        __syncthreads();
        const int number = *told;
        if (number >= tasks.shape[0]) break;
        const int* const task = tasks.data + TASK * number;
        const int kind = task[0], row = task[1], rows = task[2], column = task[3], width = task[4], by = task[5];
        const int first = task[6], total = 8 * (task[7] - first), slot = task[8], mine = task[9], turned = task[10];
        const int begun = task[11];
        if (kind == ZEROS) {
            for (int j = lane; j < place.shape[0]; j += LANES) {
                const int at = place.data[j];
                if (at < column || at >= width)
                    for (int i = 0; i < rows; ++i) R[(size_t)(row + i) * apart + j] = 0.0;
            }
            continue;
        }
        double sum[4][4], square[4][4];
        const bool chained = kind == CHAINED;
        if (kind == UNIT) {
            #pragma unroll
            for (int s = 0; s < 4; ++s)
                #pragma unroll
                for (int k = 0; k < 4; ++k) sum[s][k] = 0.0;
        } else
            begin(sum, begun, row, rows, column, width);
        if (chained) begin(square, task[12], row, rows, row, rows);

        int2 next = make_int2(0, 0), after = next;
        int seen = 0;
        if (total > 0) {
            next = __ldg(both + first);
            if (total > 8) after = __ldg(both + first + 1);
            seen = flag_of(there + (lane ? next.y : next.x));
        }
        // Less the products of pairs, eight columns of both after the other: four are on their way while one is summed.
        const double *one = tiles.data + (size_t)next.x * TILE, *other = tiles.data + (size_t)next.y * TILE;
        double *to = room, *from = room;
        for (int issued = 0, way = 0; issued < total || way;) {
#if __CUDA_ARCH__ >= 800
            asm volatile("cp.async.wait_group 3;" ::: "memory");
#endif
            const bool fresh = issued < total && (issued & 7) == 0;
            const bool go = __syncthreads_and(lane > 1 || !fresh || seen == turn) && issued < total;
            way *= 2;
            if (go) {
                fetch(to, one);
                fetch(to + CHUNK, other);
                to = to == room + 2 * (SLOTS - 1) * CHUNK ? room : to + 2 * CHUNK;
                one += CHUNK, other += CHUNK;
                ++way;
                if ((++issued & 7) == 0 && issued < total) {
                    next = after;
                    one = tiles.data + (size_t)next.x * TILE, other = tiles.data + (size_t)next.y * TILE;
                    if (lane < 2) seen = flag_of(there + (lane ? next.y : next.x));
                    if (issued + 8 < total) after = __ldg(both + first + issued / 8 + 1);
                }
            } else if (fresh && lane < 2)
                seen = flag_of(there + (lane ? next.y : next.x));
            fetched();
            if (way & 16) {
                way &= 15;
                const double* const left = from;
                from = from == room + 2 * (SLOTS - 1) * CHUNK ? room : from + 2 * CHUNK;
                const double2 upper = less(load(left + 2 * band * 64)), lower = less(load(left + (2 * band + 1) * 64));
                #pragma unroll
                for (int s = 0; s < 4; ++s) add(sum[s], upper, lower, load(left + CHUNK + piece(s) * 64));
                if (chained) {
                    #pragma unroll
                    for (int s = 0; s < 4; ++s)
                        if (s <= band) add(square[s], upper, lower, load(left + piece(s) * 64));
                }
            }
        }

"""

_SCALE = """
        if (kind == SUM) {
            put(tiles.data + (size_t)slot * TILE, sum);
            publish(there + slot, 0);
        } else if (kind != FIRST) {
            // By the inverse of the factor in its columns, of which a warp takes all of its rows.
            double whole[8][4];
            __syncthreads();
            put(room, sum);
            __syncthreads();
            #pragma unroll
            for (int k = 0; k < 8; ++k) {
                const double* const from = room + (8 * k + 2 * band) * 64;
                const double2 upper = load(from), lower = load(from + 64);
                whole[k][0] = upper.x, whole[k][1] = upper.y, whole[k][2] = lower.x, whole[k][3] = lower.y;
            }
            await(flags.data + by);
            #pragma unroll
            for (int k = 0; k < TILE; k += CHUNK) fetch(room + k, triangles.data + (size_t)by * TILE + k);
            fetched();
#if __CUDA_ARCH__ >= 800
            asm volatile("cp.async.wait_group 0;" ::: "memory");
#endif
            __syncthreads();
            #pragma unroll
            for (int s = 0; s < 4; ++s) sum[s][0] = sum[s][1] = sum[s][2] = sum[s][3] = 0.0;
            #pragma unroll
            for (int k = 0; k < 8; ++k) {
                const double2 upper = make_double2(whole[k][0], whole[k][1]);
                const double2 lower = make_double2(whole[k][2], whole[k][3]);
                #pragma unroll
                for (int s = k / 2; s < 4; ++s) add(sum[s], upper, lower, load(room + (8 * k + piece(s)) * 64));
            }
            put(tiles.data + (size_t)slot * TILE, sum);
            if (chained) {
                __syncthreads();
                put(room, sum);
                __syncthreads();
                #pragma unroll
                for (int k = 0; k < 8; ++k) {
                    const double2 upper = less(load(room + (8 * k + 2 * band) * 64));
                    const double2 lower = less(load(room + (8 * k + 2 * band + 1) * 64));
                    #pragma unroll
                    for (int s = 0; s < 4; ++s)
                        if (s <= band) add(square[s], upper, lower, load(room + (8 * k + piece(s)) * 64));
                }
            }
            publish(there + slot, chained ? LANES - 1 : 0);
            if (kind == UNIT) {
                #pragma unroll
                for (int k = 0; k < 4; k += 2) {
                    const int i = 16 * band + r + 4 * k;
                    if (i < rows) {
                        double* const to = R + (size_t)column * apart + order.data[row + i];
                        #pragma unroll
                        for (int s = 0; s < 4; ++s) {
                            const int j = 8 * piece(s) + 2 * q;
                            if (j < width) to[(size_t)j * apart] = sum[s][k];
                            if (j + 1 < width) to[(size_t)(j + 1) * apart] = sum[s][k + 1];
                        }
                    }
                }
            }
        }
"""

_END = """
    // Who comes last leaves all as it was for the next time.
    if (lane == 0) {
        __threadfence();
        if (atomicAdd(state.data + 2, 1) == static_cast<int>(gridDim.x) - 1) {
            __threadfence();
            *definite.data = *(volatile int*)(state.data + 3) == 0;
            state.data[0] = state.data[2] = state.data[3] = 0;
            __threadfence();
            *(volatile int*)(state.data + 1) = turn;
        }
    }
"""


@wp.func_native(
    f"""
#if defined(__CUDA_ARCH__)
{_BEGIN}{_ROOM}{TOOLS}{_SUM}{_SCALE}{FACTOR}{_END}
#endif
"""
)
def tiled_inverse_native(
    matrix: wp.array2d[real],
    tasks: wp.array2d[int],
    pairs: wp.array2d[int],
    order: wp.array[int],
    place: wp.array[int],
    columns: int,
    tiles: wp.array[real],
    triangles: wp.array[real],
    flags: wp.array[int],
    state: wp.array[int],
    inverse: wp.array2d[real],
    definite: wp.array[wp.bool],
) -> None:
    """See ``inverse_root_kernel``."""
    ...


@wp.kernel
def tiled_inverse_kernel(
    # In:
    matrix: wp.array2d[real],
    tasks: wp.array2d[int],
    pairs: wp.array2d[int],
    order: wp.array[int],
    place: wp.array[int],
    columns: int,
    # Scratch, zeros before the first time:
    tiles: wp.array[real],
    triangles: wp.array[real],
    flags: wp.array[int],
    state: wp.array[int],
    # Out:
    inverse_out: wp.array2d[real],
    definite_out: wp.array[wp.bool],
):
    """Into ``inverse_out`` the inverse of the factor of a ``matrix`` whose lower triangle is given, by ``tasks`` and
    ``pairs`` of tiles as of ``RootTasks``, column j in the place ``order[j]``, which has j as its ``place``; whether
    that is ``definite_out``. Two of these must not run at once with the same scratch memory."""
    tiled_inverse_native(
        matrix,
        tasks,
        pairs,
        order,
        place,
        columns,
        tiles,
        triangles,
        flags,
        state,
        inverse_out,
        definite_out,
    )
