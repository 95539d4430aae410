"""Tiled computation of the inverse Cholesky factor on a GPU: thread blocks take tasks from a shared counter.

Tasks are taken in order and no task depends on a later one, so any number of blocks makes progress, regardless of when
each block starts. Every sum has a fixed order, so results do not depend on the number of blocks. The host code is in
``egs_warp.fem.tiled_cholesky``; ``egs_warp.fem.tile_tasks`` builds the task lists.
"""

from enum import IntEnum

import warp as wp

from egs_warp.kernels.fem.tiled_inverse_code import FACTOR_CODE, TOOLS_CODE
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

TILE_SIDE = 64
"""Number of rows and of columns of a tile."""
BLOCK = 256
"""Number of threads of a block."""
TASK_SIZE = 16
"""Length of a task record, in int32 values.

The fields are: kind, first row, number of rows, first column, number of columns, tile column whose inverse diagonal
factor multiplies the tile, begin and end in ``pairs``, and slot of the tile. Four optional fields follow, -1 if unused:
tile column of the inverse diagonal factor that the task computes, slot of the transpose of this inverse, slot of the
partial sum from which the tile starts, and slot of the partial sum from which the diagonal tile starts."""


class Kind(IntEnum):
    """Kind of a task, by its result."""

    ROWS = 0
    """A tile of L, starting from entries of the matrix."""
    UNIT = 1
    """A tile of L^-T, starting from the identity."""
    FIRST = 2
    """The inverse of the first diagonal factor of a group, which has no tiles to its left."""
    CHAINED = 3
    """A tile of L, and then the inverse of the diagonal factor to its right."""
    SUM = 4
    """A partial sum, from which a tile of another task starts."""
    ZEROS = 5
    """Zeros in the rows of the inverse, outside a range of columns."""


_CONSTANTS_CODE = f"""
    enum {{ {", ".join(f"{kind.name} = {kind.value}" for kind in Kind)} }};
    constexpr int TILE = {TILE_SIDE * TILE_SIDE}, CHUNK = TILE / 8, SLOTS = 5, LANES = {BLOCK}, TASK = {TASK_SIZE};
"""

_SETUP_CODE = """
    double *const S = matrix.data, *const R = inverse.data;
    const int stride = matrix.strides[0] / 8, out_stride = inverse.strides[0] / 8;
    const int2* const pair_list = (const int2*)pairs.data;
    // Memory for the columns of tiles whose products are summed, or for a tile that is multiplied or factored.
    __shared__ __align__(16) double scratch[2 * SLOTS * CHUNK];
    int* const next_task = (int*)scratch;
    const int lane = threadIdx.x, warp = lane >> 5, own = lane & 31, r = own >> 2, q = own & 3;
    const int launch = *(volatile const int*)(state.data + 1) + 1;
    int* const tile_flags = flags.data + columns;
    // A warp has sixteen rows of a tile and half of its columns, interleaved so that all warps have about the same part
    // of a triangle.
    const int half = warp >> 2, band = half ? 7 - warp : warp;
    auto column_block = [&](int s) { return 2 * s + ((s & 1) ^ half); };

"""

_SUM_CODE = """
    for (;;) {
        __syncthreads();
        if (lane == 0) *next_task = atomicAdd(state.data, 1);
        __syncthreads();
        const int number = *next_task;
        if (number >= tasks.shape[0]) break;
        const int* const task = tasks.data + TASK * number;
        const int kind = task[0], row = task[1], rows = task[2], column = task[3], width = task[4], by = task[5];
        const int first = task[6], total = 8 * (task[7] - first), slot = task[8], diagonal = task[9],
                  transposed = task[10];
        const int initial = task[11];
        if (kind == ZEROS) {
            for (int j = lane; j < permutation.shape[0]; j += LANES) {
                const int at = permutation.data[j];
                if (at < column || at >= width)
                    for (int i = 0; i < rows; ++i) R[(size_t)(row + i) * out_stride + j] = 0.0;
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
            begin(sum, initial, row, rows, column, width);
        if (chained) begin(square, task[12], row, rows, row, rows);

        int2 next = make_int2(0, 0), after = next;
        int flag_value = 0;
        if (total > 0) {
            next = __ldg(pair_list + first);
            if (total > 8) after = __ldg(pair_list + first + 1);
            flag_value = flag_of(tile_flags + (lane ? next.y : next.x));
        }
        // Subtract the products of pairs, eight columns of both at a time: four copies are in flight while one is
        // summed.
        const double *one = tiles.data + (size_t)next.x * TILE, *other = tiles.data + (size_t)next.y * TILE;
        double *to = scratch, *from = scratch;
        for (int issued = 0, in_flight = 0; issued < total || in_flight;) {
#if __CUDA_ARCH__ >= 800
            asm volatile("cp.async.wait_group 3;" ::: "memory");
#endif
            const bool is_new_tile = issued < total && (issued & 7) == 0;
            const bool is_ready = __syncthreads_and(lane > 1 || !is_new_tile || flag_value == launch) && issued < total;
            in_flight *= 2;
            if (is_ready) {
                fetch(to, one);
                fetch(to + CHUNK, other);
                to = to == scratch + 2 * (SLOTS - 1) * CHUNK ? scratch : to + 2 * CHUNK;
                one += CHUNK, other += CHUNK;
                ++in_flight;
                if ((++issued & 7) == 0 && issued < total) {
                    next = after;
                    one = tiles.data + (size_t)next.x * TILE, other = tiles.data + (size_t)next.y * TILE;
                    if (lane < 2) flag_value = flag_of(tile_flags + (lane ? next.y : next.x));
                    if (issued + 8 < total) after = __ldg(pair_list + first + issued / 8 + 1);
                }
            } else if (is_new_tile && lane < 2)
                flag_value = flag_of(tile_flags + (lane ? next.y : next.x));
            fetched();
            if (in_flight & 16) {
                in_flight &= 15;
                const double* const left = from;
                from = from == scratch + 2 * (SLOTS - 1) * CHUNK ? scratch : from + 2 * CHUNK;
                const double2 upper = less(load(left + 2 * band * 64)), lower = less(load(left + (2 * band + 1) * 64));
                #pragma unroll
                for (int s = 0; s < 4; ++s) add(sum[s], upper, lower, load(left + CHUNK + column_block(s) * 64));
                if (chained) {
                    #pragma unroll
                    for (int s = 0; s < 4; ++s)
                        if (s <= band) add(square[s], upper, lower, load(left + column_block(s) * 64));
                }
            }
        }

"""

_SCALE_CODE = """
        if (kind == SUM) {
            put(tiles.data + (size_t)slot * TILE, sum);
            publish(tile_flags + slot, 0);
        } else if (kind != FIRST) {
            // Multiply by the inverse of the diagonal factor; a warp reads all columns of its rows.
            double products[8][4];
            __syncthreads();
            put(scratch, sum);
            __syncthreads();
            #pragma unroll
            for (int k = 0; k < 8; ++k) {
                const double* const from = scratch + (8 * k + 2 * band) * 64;
                const double2 upper = load(from), lower = load(from + 64);
                products[k][0] = upper.x, products[k][1] = upper.y, products[k][2] = lower.x, products[k][3] = lower.y;
            }
            await(flags.data + by);
            #pragma unroll
            for (int k = 0; k < TILE; k += CHUNK) fetch(scratch + k, triangles.data + (size_t)by * TILE + k);
            fetched();
#if __CUDA_ARCH__ >= 800
            asm volatile("cp.async.wait_group 0;" ::: "memory");
#endif
            __syncthreads();
            #pragma unroll
            for (int s = 0; s < 4; ++s) sum[s][0] = sum[s][1] = sum[s][2] = sum[s][3] = 0.0;
            #pragma unroll
            for (int k = 0; k < 8; ++k) {
                const double2 upper = make_double2(products[k][0], products[k][1]);
                const double2 lower = make_double2(products[k][2], products[k][3]);
                #pragma unroll
                for (int s = k / 2; s < 4; ++s)
                    add(sum[s], upper, lower, load(scratch + (8 * k + column_block(s)) * 64));
            }
            put(tiles.data + (size_t)slot * TILE, sum);
            if (chained) {
                __syncthreads();
                put(scratch, sum);
                __syncthreads();
                #pragma unroll
                for (int k = 0; k < 8; ++k) {
                    const double2 upper = less(load(scratch + (8 * k + 2 * band) * 64));
                    const double2 lower = less(load(scratch + (8 * k + 2 * band + 1) * 64));
                    #pragma unroll
                    for (int s = 0; s < 4; ++s)
                        if (s <= band) add(square[s], upper, lower, load(scratch + (8 * k + column_block(s)) * 64));
                }
            }
            publish(tile_flags + slot, chained ? LANES - 1 : 0);
            if (kind == UNIT) {
                #pragma unroll
                for (int k = 0; k < 4; k += 2) {
                    const int i = 16 * band + r + 4 * k;
                    if (i < rows) {
                        double* const to = R + (size_t)column * out_stride + order.data[row + i];
                        #pragma unroll
                        for (int s = 0; s < 4; ++s) {
                            const int j = 8 * column_block(s) + 2 * q;
                            if (j < width) to[(size_t)j * out_stride] = sum[s][k];
                            if (j + 1 < width) to[(size_t)(j + 1) * out_stride] = sum[s][k + 1];
                        }
                    }
                }
            }
        }
"""

_END_CODE = """
    // The last block resets the state for the next launch.
    if (lane == 0) {
        __threadfence();
        if (atomicAdd(state.data + 2, 1) == static_cast<int>(gridDim.x) - 1) {
            __threadfence();
            *definite.data = *(volatile int*)(state.data + 3) == 0;
            state.data[0] = state.data[2] = state.data[3] = 0;
            __threadfence();
            *(volatile int*)(state.data + 1) = launch;
        }
    }
"""


@wp.func_native(
    f"""
#if defined(__CUDA_ARCH__)
{_CONSTANTS_CODE}{_SETUP_CODE}{TOOLS_CODE}{_SUM_CODE}{_SCALE_CODE}{FACTOR_CODE}{_END_CODE}
#endif
"""
)
def tiled_inverse_native(
    matrix: wp.array2d[real],
    tasks: wp.array2d[int],
    pairs: wp.array2d[int],
    order: wp.array[int],
    permutation: wp.array[int],
    columns: int,
    tiles: wp.array[real],
    triangles: wp.array[real],
    flags: wp.array[int],
    state: wp.array[int],
    inverse: wp.array2d[real],
    definite: wp.array[wp.bool],
) -> None:
    """Execute tasks until none is left (native code of ``tiled_inverse_kernel``)."""
    ...


@wp.kernel
def tiled_inverse_kernel(
    # In:
    matrix: wp.array2d[real],
    tasks: wp.array2d[int],
    pairs: wp.array2d[int],
    order: wp.array[int],
    permutation: wp.array[int],
    columns: int,
    # Scratch, zeros before the first launch:
    tiles: wp.array[real],
    triangles: wp.array[real],
    flags: wp.array[int],
    state: wp.array[int],
    # Out:
    inverse_out: wp.array2d[real],
    definite_out: wp.array[wp.bool],
):
    """Compute the inverse Cholesky factor of a symmetric matrix.

    Two launches with the same scratch memory must not run concurrently.

    Args:
        matrix: (n, n), of which the lower triangle is read, in the order of the dissection.
        tasks: (t, ``TASK_SIZE``) records of ``TileTaskGraph``.
        pairs: (p, 2) pairs of ``TileTaskGraph``.
        order: (n,) column of ``inverse_out`` that corresponds to each column of ``matrix``.
        permutation: (n,) inverse of ``order``.
        columns: number of tile columns.
        tiles: tiles of L and L^-T.
        triangles: inverses of the diagonal factors.
        flags: one per inverse diagonal factor and per tile; equal to the launch number once it is complete.
        state: (4,) next task, number of launches, number of finished blocks, and 1 if the matrix is not positive
            definite.
        inverse_out: (n, n) inverse factor.
        definite_out: (1,) True if the matrix is positive definite.
    """
    tiled_inverse_native(
        matrix, tasks, pairs, order, permutation, columns, tiles, triangles, flags, state, inverse_out, definite_out
    )
