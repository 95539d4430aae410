"""Kernels that list the Gaussians of every tile from front to back.

A *slot* is the index of a (Gaussian, tile) pair when pairs are numbered by Gaussian, then by tile row; ``slot_end``
(n,) is the end of each Gaussian's slots. An *intersection* is the index of the same pair when pairs are numbered by
tile, nearest first. Gradients are written by slot, so that the gradients of one Gaussian are contiguous.
``projection.project_kernel`` describes ``ellipse``, ``falloff`` and ``colour_depth``. Host code:
``egs_warp/render/tiles.py``.
"""

import warp as wp

from egs_warp.kernels.render.ellipse import TILE, tile_columns, tile_rows

wp.set_module_options({"enable_backward": False})


EMPTY_KEY = wp.constant(wp.uint32(0xFFFFFFFF))
"""Sort key of unused capacity. It is larger than the keys of all tiles."""


@wp.func
def first_slot_of(slot_end: wp.array[wp.int64], g: wp.int32) -> wp.int32:
    """Return the first slot of Gaussian ``g``."""
    slot = wp.int32(0)
    if g > 0:
        slot = wp.int32(slot_end[g - 1])
    return slot


@wp.kernel
def emit_tiles_kernel(
    # In:
    width: wp.int32,
    height: wp.int32,
    capacity: wp.int32,
    nearest_bits: wp.int32,
    dropped_bits: wp.int32,
    depth_key_bits: wp.int32,
    slot_end: wp.array[wp.int64],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    # Out:
    key_out: wp.array[wp.uint32],
    slot_and_gaussian_out: wp.array[wp.int32],
):
    """Write, for every slot, the sort key (the tile, then the leading bits of the depth), the number of the slot, and
    its Gaussian.

    If the number of pairs exceeds the capacity, all keys are empty.

    Args:
        width, height: size of the image, pixels.
        capacity: maximum number of pairs.
        nearest_bits: bits of the near plane's depth as an integer, which the keys subtract.
        dropped_bits: number of trailing depth bits that the key omits.
        depth_key_bits: number of depth bits in a key.
        slot_end, ellipse, falloff, colour_depth: as in the module docstring.
        key_out: (capacity,) sort keys.
        slot_and_gaussian_out: slot numbers, and from index 2 ``capacity`` on the Gaussian of each slot.
    """
    g = wp.tid()
    pair_count = slot_end[slot_end.shape[0] - 1]
    fits = pair_count >= wp.int64(0) and pair_count <= wp.int64(capacity)
    # The slot numbers are written here and not in the loop below, because here the writes of neighbouring threads are
    # contiguous.
    for i in range(g, capacity, slot_end.shape[0]):
        slot_and_gaussian_out[i] = i
        if not fits or wp.int64(i) >= pair_count:
            key_out[i] = EMPTY_KEY
    if not fits:
        return
    slot = first_slot_of(slot_end, g)
    if slot == wp.int32(slot_end[g]):
        return
    columns = (width + TILE - 1) / TILE
    e = ellipse[g]
    f = falloff[g]
    # Positive floats sort like their bits; the difference to the near plane needs fewer bits.
    depth_key = wp.uint32((wp.cast(colour_depth[g][3], wp.int32) - nearest_bits) >> dropped_bits)
    rows = tile_rows(e, f, height)
    for row in range(rows[0], rows[1] + 1):
        span = tile_columns(e, f, row, width, height)
        for column in range(span[0], span[1] + 1):
            key_out[slot] = (wp.uint32(row * columns + column) << wp.uint32(depth_key_bits)) | depth_key
            slot_and_gaussian_out[2 * capacity + slot] = g
            slot += 1


@wp.func
def tile_of_key(key: wp.uint32, depth_key_bits: wp.int32, tiles: wp.int32) -> wp.int32:
    """Return the tile of a sort key; the number of ``tiles`` for unused capacity."""
    tile = tiles
    if key != EMPTY_KEY:
        tile = wp.int32(key >> wp.uint32(depth_key_bits))
    return tile


@wp.kernel
def finish_lists_kernel(
    # In:
    capacity: wp.int32,
    depth_key_bits: wp.int32,
    key: wp.array[wp.uint32],
    slot_and_gaussian: wp.array[wp.int32],
    colour_depth: wp.array[wp.vec4],
    # Out:
    tile_start_out: wp.array[wp.int32],
    gaussian_from_intersection_out: wp.array[wp.int32],
    slot_from_intersection_out: wp.array[wp.int32],
):
    """Write the start of each tile's range in the sorted pairs, and order the few pairs with equal keys by their full
    depth.

    Thread i writes the starts of all tiles after the tile of pair i - 1, up to the tile of pair i.

    Args:
        capacity, depth_key_bits: as in ``emit_tiles_kernel``.
        key: (capacity,) sorted keys.
        slot_and_gaussian: sorted slot numbers, and from index 2 ``capacity`` on the Gaussian of each slot.
        colour_depth: (n,) colour and z-depth.
        tile_start_out: (tiles + 1,) first intersection of each tile.
        gaussian_from_intersection_out, slot_from_intersection_out: (capacity,) Gaussian and slot of each intersection.
    """
    i = wp.tid()
    tiles = tile_start_out.shape[0] - 1
    before = wp.int32(-1)
    if i > 0:
        before = tile_of_key(key[i - 1], depth_key_bits, tiles)
    tile_here = tiles
    if i < capacity:
        tile_here = tile_of_key(key[i], depth_key_bits, tiles)
    if tile_here < tiles:
        own = key[i]
        slot = slot_and_gaussian[i]
        gaussians = 2 * capacity
        g = slot_and_gaussian[gaussians + slot]
        # The sort is stable: pairs with equal keys retain the order of their slots, so the order of Gaussians at equal
        # depths is defined, too.
        place = i
        j = i - 1
        while j >= 0 and key[j] == own:
            if colour_depth[slot_and_gaussian[gaussians + slot_and_gaussian[j]]][3] > colour_depth[g][3]:
                place -= 1
            j -= 1
        j = i + 1
        while j < capacity and key[j] == own:
            if colour_depth[slot_and_gaussian[gaussians + slot_and_gaussian[j]]][3] < colour_depth[g][3]:
                place += 1
            j += 1
        gaussian_from_intersection_out[place] = g
        slot_from_intersection_out[place] = slot
    for tile in range(before + 1, tile_here + 1):
        tile_start_out[tile] = i
