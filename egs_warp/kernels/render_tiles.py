"""Which tiles each screen ellipse reaches, and the Gaussians of every tile from front to back."""

import warp as wp

from egs_warp.kernels.render_projection import LOG_255

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(16)
"""Side of a square tile in pixels."""


@wp.func
def tile_rows(ellipse: wp.vec4, falloff: wp.vec2, height: wp.int32) -> wp.vec2i:
    """First and last tile row with a pixel centre inside the ellipse's height; first > last if none."""
    reach = wp.sqrt((falloff[1] + LOG_255) / falloff[0])
    first = wp.max(wp.int32(wp.ceil(ellipse[1] - reach - 0.5)), 0)
    last = wp.min(wp.int32(wp.floor(ellipse[1] + reach - 0.5)), height - 1)
    if first > last:
        return wp.vec2i(0, -1)
    return wp.vec2i(first / TILE, last / TILE)


@wp.func
def tile_columns(ellipse: wp.vec4, falloff: wp.vec2, row: wp.int32, width: wp.int32, height: wp.int32) -> wp.vec2i:
    """First and last tile column that the ellipse reaches within a tile row; exact, because the ellipse is convex."""
    cut = falloff[1] + LOG_255
    top = wp.float32(row * TILE) + 0.5 - ellipse[1]
    bottom = wp.float32(wp.min(row * TILE + TILE, height)) - 0.5 - ellipse[1]
    # The ellipse a (dx + shear dy)^2 + v dy^2 = cut has its leftmost and rightmost points at dy = -+ tip.
    v = falloff[0]
    shear = ellipse[3]
    tip = -shear * wp.sqrt(cut * ellipse[2] / (v * (v + ellipse[2] * shear * shear)))
    dy_right = wp.clamp(tip, top, bottom)
    dy_left = wp.clamp(-tip, top, bottom)
    right = ellipse[0] - shear * dy_right + wp.sqrt(wp.max(cut - v * dy_right * dy_right, 0.0) / ellipse[2])
    left = ellipse[0] - shear * dy_left - wp.sqrt(wp.max(cut - v * dy_left * dy_left, 0.0) / ellipse[2])
    first = wp.max(wp.int32(wp.ceil(wp.max(left, -1.0e6) - 0.5)), 0)
    last = wp.min(wp.int32(wp.floor(wp.min(right, 1.0e6) - 0.5)), width - 1)
    if first > last:
        return wp.vec2i(0, -1)
    return wp.vec2i(first / TILE, last / TILE)


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
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    # Out:
    cursor_out: wp.array[wp.int32],
    gaussian_from_intersection_out: wp.array[wp.int32],
):
    """One thread walks all Gaussians from front to back and counts, or appends, those of its band of tile rows
    (CPU).
    """
    band = wp.tid() + first
    columns = (width + TILE - 1) / TILE
    top = band * band_rows
    bottom = wp.min(top + band_rows, (height + TILE - 1) / TILE) - 1
    for rank in range(visible_count):
        g = gaussian_from_rank[rank]
        e = ellipse[g]
        f = falloff[g]
        rows = tile_rows(e, f, height)
        for row in range(wp.max(rows[0], top), wp.min(rows[1], bottom) + 1):
            span = tile_columns(e, f, row, width, height)
            for column in range(span[0], span[1] + 1):
                tile = row * columns + column
                slot = cursor_out[tile]
                cursor_out[tile] = slot + 1
                if fill != 0:
                    gaussian_from_intersection_out[slot] = g


@wp.kernel
def count_tiles_kernel(
    # In:
    width: wp.int32,
    height: wp.int32,
    gaussian_from_rank: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    # Out:
    tile_count_out: wp.array[wp.int32],
):
    """Number of tiles reached by the Gaussian of each depth rank."""
    rank = wp.tid()
    g = gaussian_from_rank[rank]
    e = ellipse[g]
    f = falloff[g]
    rows = tile_rows(e, f, height)
    count = wp.int32(0)
    for row in range(rows[0], rows[1] + 1):
        span = tile_columns(e, f, row, width, height)
        count += span[1] - span[0] + 1
    tile_count_out[rank] = count


@wp.kernel
def emit_tiles_kernel(
    # In:
    width: wp.int32,
    height: wp.int32,
    gaussian_from_rank: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    intersections_end: wp.array[wp.int32],
    # Out:
    tile_out: wp.array[wp.int32],
    gaussian_out: wp.array[wp.int32],
):
    """(tile, Gaussian) for every pair that meets, in depth order; ``intersections_end`` is the inclusive scan of the
    counts.
    """
    rank = wp.tid()
    g = gaussian_from_rank[rank]
    slot = wp.int32(0)
    if rank > 0:
        slot = intersections_end[rank - 1]
    if slot == intersections_end[rank]:
        return
    columns = (width + TILE - 1) / TILE
    e = ellipse[g]
    f = falloff[g]
    rows = tile_rows(e, f, height)
    for row in range(rows[0], rows[1] + 1):
        span = tile_columns(e, f, row, width, height)
        for column in range(span[0], span[1] + 1):
            tile_out[slot] = row * columns + column
            gaussian_out[slot] = g
            slot += 1


@wp.kernel
def tile_ends_kernel(
    # In:
    intersection_count: wp.int32,
    tile_from_intersection: wp.array[wp.int32],
    # Out:
    tile_start_out: wp.array[wp.int32],
):
    """Start of each tile's run in the sorted intersections: thread i fills the tiles after tile i-1 up to tile i."""
    i = wp.tid()
    before = wp.int32(-1)
    if i > 0:
        before = tile_from_intersection[i - 1]
    here = tile_start_out.shape[0] - 1
    if i < intersection_count:
        here = tile_from_intersection[i]
    for tile in range(before + 1, here + 1):
        tile_start_out[tile] = i


@wp.kernel
def visible_kernel(
    # In:
    depth_key: wp.array[wp.float32],
    # Out:
    visible_out: wp.array[wp.int32],
):
    """1 for a Gaussian that can show, else 0."""
    g = wp.tid()
    visible_out[g] = wp.where(depth_key[g] < wp.inf, 1, 0)


@wp.kernel
def compact_visible_kernel(
    # In:
    depth_key: wp.array[wp.float32],
    visible_end: wp.array[wp.int32],
    # Out:
    key_out: wp.array[wp.float32],
    gaussian_out: wp.array[wp.int32],
):
    """Depth keys and indices of the visible Gaussians, closed up in index order."""
    g = wp.tid()
    key = depth_key[g]
    if key < wp.inf:
        slot = visible_end[g] - 1
        key_out[slot] = key
        gaussian_out[slot] = g
