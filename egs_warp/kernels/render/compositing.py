"""Kernels of compositing and of its backward pass.

The blending code is in ``composite_cpu`` and ``composite_cuda``. ``width`` and ``height`` are those of the image in
pixels. ``tile_start`` (tiles + 1,) is the first intersection of each tile; ``tile_mask`` (tiles,) is nonzero for
enabled tiles, or empty. ``projection.project_kernel`` describes ``ellipse``, ``falloff`` and ``colour_depth``,
``tiles`` the slots and intersections. Host code: ``egs_warp/render/compositing.py``.
"""

import warp as wp

from egs_warp.kernels.render import composite_cpu, composite_cuda
from egs_warp.kernels.render.ellipse import SEGMENT, TILE, TILE_PIXELS, is_tile_enabled
from egs_warp.kernels.render.pixel_gradients import pixel_gradient
from egs_warp.kernels.render.vector_math import on_cpu

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.func_native(on_cpu(composite_cpu.FORWARD, cuda=composite_cuda.FORWARD))
def composite_tile(
    width: wp.int32,
    height: wp.int32,
    left: wp.int32,
    top: wp.int32,
    start: wp.int32,
    end: wp.int32,
    gaussians: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    flat_background: wp.vec3,
    background: wp.array[wp.vec3],
    max_depth: wp.array[wp.float32],
    colour: wp.array2d[wp.vec3],
    alpha_out: wp.array2d[wp.float32],
    depth: wp.array2d[wp.float32],
    checkpoint_sums: wp.array[wp.vec4],
    checkpoint_passing: wp.array[wp.float32],
):
    """Blend the splats of one tile from front to back, by one thread (CPU) or one block (CUDA).

    A splat whose mean is deeper than the ``max_depth`` of a pixel is skipped at this pixel; 0 or an empty array means
    no limit.

    Args:
        width, height: size of the image, pixels.
        left, top: first pixel of the tile.
        start, end: range of the tile's splats in ``gaussians``.
        gaussians: Gaussian of each intersection.
        ellipse, falloff, colour_depth: splats (``projection.project_kernel``).
        flat_background: background colour if ``background`` is empty.
        background: background colour of each pixel, or empty.
        max_depth: z-depth of each pixel, or empty.
        colour, alpha_out, depth: (height, width) outputs.
        checkpoint_sums, checkpoint_passing: state of the pixels before each later segment, or empty; CUDA only
            (``Checkpoints``).
    """
    ...


@wp.func_native(on_cpu(composite_cpu.BACKWARD))
def composite_backward_tile(
    width: wp.int32,
    height: wp.int32,
    left: wp.int32,
    top: wp.int32,
    start: wp.int32,
    end: wp.int32,
    gaussians: wp.array[wp.int32],
    slots: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    sum_gradient: wp.array[wp.vec4],
    remaining: wp.array[wp.float32],
    moments: wp.array2d[wp.vec4],
):
    """Sum the gradients of one tile's splats over its pixels by one thread (CPU), in the order and with the rounding of
    ``composite_tile``.
    """
    ...


@wp.func_native(on_cpu("", cuda=composite_cuda.BACKWARD))
def composite_backward_block(
    width: wp.int32,
    height: wp.int32,
    left: wp.int32,
    top: wp.int32,
    start: wp.int32,
    end: wp.int32,
    gaussians: wp.array[wp.int32],
    slots: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    sum_gradient: wp.vec4,
    remaining: wp.float32,
    passing_before: wp.float32,
    moments: wp.array2d[wp.vec4],
):
    """Sum the gradients of one segment of a tile's splats over its pixels by one block (CUDA), in the order and with
    the rounding of ``composite_tile``.

    ``sum_gradient`` and ``remaining`` are the results of ``pixel_gradient`` for the thread's own pixel, the latter
    without the splats before ``start``. ``passing_before`` is the transmittance before ``start``, 0 if the compositing
    of the pixel has ended.
    """
    ...


@wp.kernel
def composite_tile_kernel(
    first: wp.int32,
    # In:
    width: wp.int32,
    height: wp.int32,
    tile_start: wp.array[wp.int32],
    tile_mask: wp.array[wp.int32],
    gaussian_from_intersection: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    flat_background: wp.vec3,
    background: wp.array[wp.vec3],
    max_depth: wp.array[wp.float32],
    # Out:
    colour_out: wp.array2d[wp.vec3],
    alpha_out: wp.array2d[wp.float32],
    depth_out: wp.array2d[wp.float32],
    checkpoint_sums_out: wp.array[wp.vec4],
    checkpoint_passing_out: wp.array[wp.float32],
):
    """Composite one tile by one thread (CPU), or by one block of ``TILE_PIXELS`` threads (CUDA).

    Args:
        width, height, tile_start, tile_mask, ellipse, falloff, colour_depth: as in the module docstring.
        gaussian_from_intersection: Gaussian of each intersection.
        flat_background, background, max_depth: as in ``composite_tile``.
        colour_out, alpha_out, depth_out: (height, width) outputs; the depth is the alpha-weighted mean.
        checkpoint_sums_out, checkpoint_passing_out: as in ``composite_tile``.
    """
    tile = (wp.tid() + first) / wp.block_dim()
    columns = (width + TILE - 1) / TILE
    start = tile_start[tile]
    end = start
    if is_tile_enabled(tile_mask, tile):
        end = tile_start[tile + 1]
    composite_tile(
        width,
        height,
        (tile % columns) * TILE,
        (tile / columns) * TILE,
        start,
        end,
        gaussian_from_intersection,
        ellipse,
        falloff,
        colour_depth,
        flat_background,
        background,
        max_depth,
        colour_out,
        alpha_out,
        depth_out,
        checkpoint_sums_out,
        checkpoint_passing_out,
    )


@wp.kernel
def composite_backward_tile_kernel(
    first: wp.int32,
    # In:
    width: wp.int32,
    height: wp.int32,
    tile_start: wp.array[wp.int32],
    tile_mask: wp.array[wp.int32],
    gaussian_from_intersection: wp.array[wp.int32],
    slot_from_intersection: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    sum_gradient: wp.array[wp.vec4],
    remaining: wp.array[wp.float32],
    # Out:
    moments_out: wp.array2d[wp.vec4],
):
    """Sum each splat's gradient over the pixels of one tile, by one thread.

    With k = alpha dL/dalpha at a pixel, ``moments_out[slot]`` holds (sum k, k u, k dy, k u^2), (k u dy, k dy^2, dL/d
    depth, 0) and (dL/d colour, 0).
    """
    tile = wp.tid() + first
    columns = (width + TILE - 1) / TILE
    right = width
    if not is_tile_enabled(tile_mask, tile):
        right = (tile % columns) * TILE
    composite_backward_tile(
        right,
        height,
        (tile % columns) * TILE,
        (tile / columns) * TILE,
        tile_start[tile],
        tile_start[tile + 1],
        gaussian_from_intersection,
        slot_from_intersection,
        ellipse,
        falloff,
        colour_depth,
        sum_gradient,
        remaining,
        moments_out,
    )


@wp.kernel(grid_stride=False)
def composite_backward_block_kernel(
    # In:
    tiles: wp.int32,
    width: wp.int32,
    height: wp.int32,
    tile_start: wp.array[wp.int32],
    tile_mask: wp.array[wp.int32],
    gaussian_from_intersection: wp.array[wp.int32],
    slot_from_intersection: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    checkpoint_sums: wp.array[wp.vec4],
    checkpoint_passing: wp.array[wp.float32],
    colour: wp.array2d[wp.vec3],
    alpha: wp.array2d[wp.float32],
    depth: wp.array2d[wp.float32],
    colour_gradient: wp.array2d[wp.vec3],
    alpha_gradient: wp.array2d[wp.float32],
    depth_gradient: wp.array2d[wp.float32],
    # Out:
    moments_out: wp.array2d[wp.vec4],
):
    """Sum each splat's gradient over the pixels of one tile, as ``composite_backward_tile_kernel`` does, by blocks of
    256 threads.

    The first ``tiles`` blocks process the first segment of each tile. Each further block processes the segment of one
    checkpoint, if there is one, so that long lists are distributed over many blocks.
    """
    block = wp.tid() / TILE_PIXELS
    # A warp has 8 x 4 pixels; two such parts have the width of a tile.
    i = wp.tid() % TILE_PIXELS
    tile = block
    checkpoint = wp.int32(0)
    if block >= tiles:
        # A tile with a later segment of this number contains this intersection.
        checkpoint = block - tiles + 1
        tile = wp.lower_bound(tile_start, checkpoint * SEGMENT + 1) - 1
        if tile >= tiles:
            return
    first = tile_start[tile]
    start = first
    last = tile_start[tile + 1]
    if checkpoint > 0:
        segment = checkpoint - first / SEGMENT
        start = first + segment * SEGMENT
        if segment < 1 or start >= last:
            return
    end = last
    if checkpoint_passing.shape[0] > 0:
        end = wp.min(start + SEGMENT, last)
    columns = (width + TILE - 1) / TILE
    left = (tile % columns) * TILE
    top = (tile / columns) * TILE
    part = i / 32
    column = left + (part % 2) * 8 + i % 8
    row = top + (part / 2) * 4 + (i % 32) / 8
    by_sums = wp.vec4()
    remaining = wp.float32(0.0)
    passing = wp.float32(1.0)
    right = width
    if not is_tile_enabled(tile_mask, tile):
        right = left
    if column < right and row < height:
        by_sums, remaining = pixel_gradient(
            row,
            column,
            colour,
            alpha,
            depth,
            colour_gradient,
            alpha_gradient,
            depth_gradient,
        )
        if checkpoint > 0:
            remaining -= wp.dot(by_sums, checkpoint_sums[checkpoint * TILE_PIXELS + i])
            passing = checkpoint_passing[checkpoint * TILE_PIXELS + i]
    composite_backward_block(
        right,
        height,
        left,
        top,
        start,
        end,
        gaussian_from_intersection,
        slot_from_intersection,
        ellipse,
        falloff,
        colour_depth,
        by_sums,
        remaining,
        passing,
        moments_out,
    )
