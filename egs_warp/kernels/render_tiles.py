"""The Gaussians of every tile from front to back.

A *slot* numbers the (Gaussian, tile) pairs Gaussian by Gaussian, row by row of tiles; an *intersection* numbers the same pairs
tile by tile, nearest first. Gradients are written by slot, so that each Gaussian finds its own side by side.
"""

import warp as wp

from egs_warp.kernels.render_ellipse import TILE, tile_columns, tile_rows

wp.set_module_options({"enable_backward": False})


@wp.kernel
def gather_ranks_kernel(
    first: wp.int32,
    # In:
    height: wp.int32,
    gaussian_from_rank: wp.array[wp.int32],
    slot_end: wp.array[wp.int64],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    # Out:
    rows_out: wp.array[wp.vec2i],
    slot_out: wp.array[wp.int32],
    ellipse_out: wp.array[wp.vec4],
    falloff_out: wp.array[wp.vec2],
):
    """What the walk from front to back needs of each Gaussian, in the order in which it needs it (CPU)."""
    rank = wp.tid() + first
    g = gaussian_from_rank[rank]
    slot = wp.int32(0)
    if g > 0:
        slot = wp.int32(slot_end[g - 1])
    rows_out[rank] = tile_rows(ellipse[g], falloff[g], height)
    slot_out[rank] = slot
    ellipse_out[rank] = ellipse[g]
    falloff_out[rank] = falloff[g]


@wp.kernel
def band_lists_kernel(
    first: wp.int32,
    # In:
    band_rows: wp.int32,
    width: wp.int32,
    height: wp.int32,
    visible_count: wp.int32,
    fill: wp.int32,
    gaussian_from_rank: wp.array[wp.int32],
    rows: wp.array[wp.vec2i],
    slot: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    # Out:
    cursor_out: wp.array[wp.int32],
    gaussian_from_intersection_out: wp.array[wp.int32],
    slot_from_intersection_out: wp.array[wp.int32],
):
    """One thread walks all Gaussians from front to back and counts, or appends, those of its tile rows (CPU)."""
    band = wp.tid() + first
    columns = (width + TILE - 1) / TILE
    top = band * band_rows
    bottom = wp.min(top + band_rows, (height + TILE - 1) / TILE) - 1
    for rank in range(visible_count):
        reach = rows[rank]
        if reach[0] <= bottom and reach[1] >= top:
            e = ellipse[rank]
            f = falloff[rank]
            g = gaussian_from_rank[rank]
            pair = slot[rank]
            start = reach[0]
            if fill == 0:
                # Counting needs no slots, so rows above the band are of no interest.
                start = wp.max(start, top)
            for row in range(start, wp.min(reach[1], bottom) + 1):
                span = tile_columns(e, f, row, width, height)
                if row >= top:
                    for column in range(span[0], span[1] + 1):
                        tile = row * columns + column
                        i = cursor_out[tile]
                        cursor_out[tile] = i + 1
                        if fill != 0:
                            gaussian_from_intersection_out[i] = g
                            slot_from_intersection_out[i] = pair + column - span[0]
                pair += span[1] - span[0] + 1


@wp.kernel
def emit_tiles_kernel(
    # In:
    width: wp.int32,
    height: wp.int32,
    nearest_bits: wp.int32,
    depth_bits: wp.int64,
    slot_end: wp.array[wp.int64],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    # Out:
    key_out: wp.array[wp.int64],
    gaussian_from_slot_out: wp.array[wp.int32],
    slot_out: wp.array[wp.int32],
):
    """Sort key (tile, then depth) and Gaussian of every slot."""
    g = wp.tid()
    slot = wp.int32(0)
    if g > 0:
        slot = wp.int32(slot_end[g - 1])
    if slot == wp.int32(slot_end[g]):
        return
    columns = (width + TILE - 1) / TILE
    e = ellipse[g]
    f = falloff[g]
    # Positive floats order as their bits do; counted from those of the near plane they need fewer.
    depth_key = wp.int64(wp.cast(colour_depth[g][3], wp.int32) - nearest_bits)
    rows = tile_rows(e, f, height)
    for row in range(rows[0], rows[1] + 1):
        span = tile_columns(e, f, row, width, height)
        for column in range(span[0], span[1] + 1):
            key_out[slot] = (wp.int64(row * columns + column) << depth_bits) | depth_key
            gaussian_from_slot_out[slot] = g
            slot_out[slot] = slot
            slot += 1


@wp.kernel
def tile_starts_kernel(
    # In:
    intersection_count: wp.int32,
    depth_bits: wp.int64,
    key: wp.array[wp.int64],
    gaussian_from_slot: wp.array[wp.int32],
    slot_from_intersection: wp.array[wp.int32],
    # Out:
    tile_start_out: wp.array[wp.int32],
    gaussian_from_intersection_out: wp.array[wp.int32],
):
    """Start of each tile's run in the sorted intersections: thread i fills the tiles after tile i-1 up to tile i."""
    i = wp.tid()
    before = wp.int32(-1)
    if i > 0:
        before = wp.int32(key[i - 1] >> depth_bits)
    here = tile_start_out.shape[0] - 1
    if i < intersection_count:
        here = wp.int32(key[i] >> depth_bits)
        gaussian_from_intersection_out[i] = gaussian_from_slot[slot_from_intersection[i]]
    for tile in range(before + 1, here + 1):
        tile_start_out[tile] = i
