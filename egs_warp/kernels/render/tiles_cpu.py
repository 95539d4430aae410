"""Kernels that list the Gaussians of every tile on a CPU, by a counting sort over chunks of the depth order.

The *rank* of a Gaussian is its position in the depth order of the visible Gaussians. Gaussians in this order are
scattered in memory, so their data are prefetched. ``tiles`` defines slots and intersections; host code:
``egs_warp/render/tiles.py``.
"""

import warp as wp

from egs_warp.kernels.render.ellipse import CUTOFFS_IN_CPP
from egs_warp.kernels.render.tiles import first_slot_of
from egs_warp.kernels.render.vector_math import TILE_SPANS, on_cpu

wp.set_module_options({"enable_backward": False})


@wp.kernel
def compact_visible_kernel(
    # In:
    slot_end: wp.array[wp.int64],
    colour_depth: wp.array[wp.vec4],
    # Out:
    depth_out: wp.array[wp.float32],
    gaussian_out: wp.array[wp.int32],
    count_out: wp.array[wp.int32],
):
    """List the Gaussians that reach a tile, by one thread.

    Args:
        slot_end: (n,) end of each Gaussian's slots.
        colour_depth: (n,) colour and z-depth.
        depth_out: z-depths of the Gaussians in the list.
        gaussian_out: indices of these Gaussians.
        count_out: (1,) length of the list.
    """
    count = wp.int32(0)
    before = wp.int64(0)
    for g in range(slot_end.shape[0]):
        # The outputs are written for invisible Gaussians, too, because a branch would often be mispredicted.
        depth_out[count] = colour_depth[g][3]
        gaussian_out[count] = g
        end = slot_end[g]
        count += wp.where(end > before, 1, 0)
        before = end
    count_out[0] = count


@wp.kernel
def split_ranks_kernel(
    # In:
    visible_count: wp.int32,
    pair_count: wp.int64,
    gaussian_from_rank: wp.array[wp.int32],
    slot_end: wp.array[wp.int64],
    # Out:
    chunk_start_out: wp.array[wp.int32],
    pair_start_out: wp.array[wp.int32],
):
    """Split the depth order into chunks with about equal numbers of pairs, by one thread.

    Near Gaussians reach more tiles than far ones, so the chunks have different numbers of Gaussians.

    Args:
        visible_count: number of visible Gaussians.
        pair_count: number of pairs.
        gaussian_from_rank: (visible_count,) Gaussians in depth order.
        slot_end: (n,) end of each Gaussian's slots.
        chunk_start_out: (chunks + 1,) first rank of each chunk.
        pair_start_out: (chunks + 1,) first pair of each chunk.
    """
    chunks = chunk_start_out.shape[0] - 1
    chunk = wp.int32(0)
    pairs = wp.int64(0)
    rank = wp.int32(0)
    while rank < visible_count and chunk < chunks:
        if pairs * wp.int64(chunks) >= pair_count * wp.int64(chunk):
            chunk_start_out[chunk] = rank
            pair_start_out[chunk] = wp.int32(pairs)
            chunk += 1
        g = gaussian_from_rank[rank]
        pairs += slot_end[g] - wp.int64(first_slot_of(slot_end, g))
        rank += 1
    for rest in range(chunk, chunks + 1):
        chunk_start_out[rest] = visible_count
        pair_start_out[rest] = wp.int32(pair_count)


_TILES_OF_CHUNK = """
    constexpr int AHEAD = 12;
    // Up to four spare entries after those of a chunk are written.
    auto tiles_of = [&](int chunk) -> int* { return &tile_from_pair.data[pair_start.data[chunk] + 4 * chunk]; };
"""


@wp.func_native(
    on_cpu(
        CUTOFFS_IN_CPP
        + TILE_SPANS
        + _TILES_OF_CHUNK
        + """
    const int columns = (width + 15) / 16, end = chunk_start.data[chunk + 1];
    const i4 steps = {0, 1, 2, 3};
    int* const tiles = tiles_of(chunk);
    int* tile_out = tiles;
    // Spans are computed for several Gaussians before any of them is used, and tiles are written four at a time,
    // because branches on the numbers of rows and columns would often be mispredicted.
    constexpr int CAPACITY = 64;
    i4 first_tile[CAPACITY], counts_of_row[CAPACITY];
    int rank = chunk_start.data[chunk], row = 1, last_row = 0;
    wp::vec4 e;
    wp::vec2 f;
    while (rank < end || row <= last_row) {
        int groups = 0;
        for (; groups < CAPACITY; ++groups, row += 4) {
            if (row > last_row) {
                if (rank == end) break;
                const int next = gaussian_from_rank.data[rank + AHEAD < end ? rank + AHEAD : end - 1];
                __builtin_prefetch(ellipse.data + next);
                __builtin_prefetch(falloff.data + next);
                const int g = gaussian_from_rank.data[rank++];
                e = ellipse.data[g];
                f = falloff.data[g];
                tile_rows_of(e, f, row, last_row);
            }
            i4 from, to;
            tile_spans(e, f, row, from, to);
            first_tile[groups] = (row + steps) * columns + from;
            counts_of_row[groups] = row + steps <= last_row ? to - from + 1 : i4(0);
        }
        for (int i = 0; i < groups; ++i)
            for (int k = 0; k < 4; ++k) {
                for (int done = 0; done == 0 || done < counts_of_row[i][k]; done += 4) {
                    const i4 four = first_tile[i][k] + done + steps;
                    __builtin_memcpy(tile_out + done, &four, sizeof(four));
                }
                tile_out += counts_of_row[i][k];
            }
    }
    int* const counts = &count.data[(size_t)chunk * count.shape[1]];
    for (const int* tile = tiles; tile < tile_out; ++tile) ++counts[*tile];
"""
    )
)
def count_tiles(
    chunk: wp.int32,
    width: wp.int32,
    height: wp.int32,
    chunk_start: wp.array[wp.int32],
    pair_start: wp.array[wp.int32],
    gaussian_from_rank: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    tile_from_pair: wp.array[wp.int32],
    count: wp.array2d[wp.int32],
):
    """Write the tiles of the Gaussians of one ``chunk`` of the depth order, and count the Gaussians in each tile
    (native code of ``count_tiles_kernel``).
    """
    ...


@wp.kernel
def count_tiles_kernel(
    first_chunk: wp.int32,
    # In:
    width: wp.int32,
    height: wp.int32,
    chunk_start: wp.array[wp.int32],
    pair_start: wp.array[wp.int32],
    gaussian_from_rank: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    # Out:
    tile_from_pair_out: wp.array[wp.int32],
    count_out: wp.array2d[wp.int32],
):
    """Write the tiles of the Gaussians of one chunk per thread, and count the Gaussians in each tile. Pairs are
    numbered in depth order here.

    Args:
        width, height: size of the image, pixels.
        chunk_start, pair_start, gaussian_from_rank: the chunks (``split_ranks_kernel``).
        ellipse, falloff: splats (``projection.project_kernel``).
        tile_from_pair_out: tile of each pair, with four spare entries after the pairs of each chunk.
        count_out: (chunks, tiles) numbers of Gaussians.
    """
    count_tiles(
        wp.tid() + first_chunk,
        width,
        height,
        chunk_start,
        pair_start,
        gaussian_from_rank,
        ellipse,
        falloff,
        tile_from_pair_out,
        count_out,
    )


@wp.func_native(
    on_cpu(
        _TILES_OF_CHUNK
        + """
    int* const cursors = &cursor.data[(size_t)chunk * cursor.shape[1]];
    const int* tile = tiles_of(chunk);
    const int start = chunk_start.data[chunk], end = chunk_start.data[chunk + 1];
    for (int rank = start; rank < end; ++rank) {
        __builtin_prefetch(slot_end.data + gaussian_from_rank.data[rank + AHEAD < end ? rank + AHEAD : end - 1]);
        const int g = gaussian_from_rank.data[rank];
        const int last_slot = (int)slot_end.data[g];
        for (int slot = g > 0 ? (int)slot_end.data[g - 1] : 0; slot < last_slot; ++slot) {
            const int i = cursors[*tile++]++;
            gaussians.data[i] = g;
            slots.data[i] = slot;
        }
    }
"""
    )
)
def fill_tiles(
    chunk: wp.int32,
    chunk_start: wp.array[wp.int32],
    pair_start: wp.array[wp.int32],
    gaussian_from_rank: wp.array[wp.int32],
    slot_end: wp.array[wp.int64],
    tile_from_pair: wp.array[wp.int32],
    cursor: wp.array2d[wp.int32],
    gaussians: wp.array[wp.int32],
    slots: wp.array[wp.int32],
):
    """Append the Gaussians of one ``chunk`` of the depth order to their tiles (native code of
    ``fill_tiles_kernel``).
    """
    ...


@wp.kernel
def fill_tiles_kernel(
    first_chunk: wp.int32,
    # In:
    chunk_start: wp.array[wp.int32],
    pair_start: wp.array[wp.int32],
    gaussian_from_rank: wp.array[wp.int32],
    slot_end: wp.array[wp.int64],
    tile_from_pair: wp.array[wp.int32],
    # Out:
    cursor_out: wp.array2d[wp.int32],
    gaussian_from_intersection_out: wp.array[wp.int32],
    slot_from_intersection_out: wp.array[wp.int32],
):
    """Append the Gaussians of one chunk per thread to their tiles.

    Args:
        chunk_start, pair_start, gaussian_from_rank, slot_end: the chunks (``split_ranks_kernel``).
        tile_from_pair: tile of each pair (``count_tiles_kernel``).
        cursor_out: (chunks, tiles) intersection at which the chunk's next entry of each tile is written, updated.
        gaussian_from_intersection_out, slot_from_intersection_out: Gaussian and slot of each intersection.
    """
    fill_tiles(
        wp.tid() + first_chunk,
        chunk_start,
        pair_start,
        gaussian_from_rank,
        slot_end,
        tile_from_pair,
        cursor_out,
        gaussian_from_intersection_out,
        slot_from_intersection_out,
    )
