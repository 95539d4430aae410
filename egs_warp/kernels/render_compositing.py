"""Front-to-back compositing of each tile's splats."""

import warp as wp

from egs_warp.kernels.render_ellipse import ALPHA_CUT, ALPHA_LIMIT, LOG_255, TILE, TILE_PIXELS, TRANSMITTANCE_STOP
from egs_warp.kernels.render_projection import View, rotation_matrix

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.func
def store_pixel(
    pixel: wp.int32,
    sums: wp.vec4,
    transmittance: wp.float32,
    flat_background: wp.vec3,
    background: wp.array[wp.vec3],
    colour: wp.array[wp.vec3],
    alpha: wp.array[wp.float32],
    depth: wp.array[wp.float32],
):
    """Lay the sums over the background (an image, or one colour where there is none) and divide the depth by alpha."""
    behind = flat_background
    if background.shape[0] > 0:
        behind = background[pixel]
    opaque = 1.0 - transmittance
    colour[pixel] = wp.vec3(sums[0], sums[1], sums[2]) + transmittance * behind
    alpha[pixel] = opaque
    weighted = wp.float32(0.0)
    if opaque > 0.0:
        weighted = sums[3] / opaque
    depth[pixel] = weighted


@wp.kernel
def composite_tile_kernel(
    first: wp.int32,
    # In:
    width: wp.int32,
    height: wp.int32,
    tile_start: wp.array[wp.int32],
    gaussian_from_intersection: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    flat_background: wp.vec3,
    background: wp.array[wp.vec3],
    # Out:
    colour_out: wp.array[wp.vec3],
    alpha_out: wp.array[wp.float32],
    depth_out: wp.array[wp.float32],
):
    """One thread composites one tile, row span by row span of each splat: only pixels inside the ellipse are visited
    (CPU).
    """
    tile = wp.tid() + first
    columns = (width + TILE - 1) / TILE
    left = (tile % columns) * TILE
    top = (tile / columns) * TILE
    tile_width = wp.min(TILE, width - left)
    tile_height = wp.min(TILE, height - top)
    # Transmittance of each pixel; negative once the pixel is full.
    passing = wp.zeros(shape=TILE_PIXELS, dtype=wp.float32)
    sums = wp.zeros(shape=TILE_PIXELS, dtype=wp.vec4)
    for i in range(TILE_PIXELS):
        passing[i] = 1.0
    open_pixels = tile_width * tile_height
    intersection = tile_start[tile]
    end = tile_start[tile + 1]
    while intersection < end and open_pixels > 0:
        g = gaussian_from_intersection[intersection]
        intersection += 1
        e = ellipse[g]
        f = falloff[g]
        colour = colour_depth[g]
        x = e[0] - wp.float32(left) - 0.5
        y = e[1] - wp.float32(top) - 0.5
        a = e[2]
        cut = f[1] + LOG_255
        reach = wp.sqrt(cut / f[0])
        row_first = wp.max(wp.int32(wp.ceil(wp.max(y - reach, -1.0))), 0)
        row_last = wp.min(wp.int32(wp.floor(wp.min(y + reach, 16.0))), tile_height - 1)
        for row in range(row_first, row_last + 1):
            dy = wp.float32(row) - y
            in_row = f[0] * dy * dy
            half_width = wp.sqrt(wp.max(cut - in_row, 0.0) / a)
            middle = x - e[3] * dy
            column_first = wp.max(wp.int32(wp.ceil(wp.max(middle - half_width, -1.0))), 0)
            column_last = wp.min(wp.int32(wp.floor(wp.min(middle + half_width, 16.0))), tile_width - 1)
            for column in range(column_first, column_last + 1):
                pixel = row * TILE + column
                before = passing[pixel]
                if before > 0.0:
                    u = wp.float32(column) - middle
                    alpha = wp.min(wp.exp(f[1] - in_row - a * u * u), ALPHA_LIMIT)
                    after = before * (1.0 - alpha)
                    if alpha >= ALPHA_CUT:
                        if after <= TRANSMITTANCE_STOP:
                            passing[pixel] = -before
                            open_pixels -= 1
                        else:
                            passing[pixel] = after
                            sums[pixel] = sums[pixel] + before * alpha * colour
    for row in range(tile_height):
        for column in range(tile_width):
            i = row * TILE + column
            pixel = (top + row) * width + left + column
            store_pixel(
                pixel, sums[i], wp.abs(passing[i]), flat_background, background, colour_out, alpha_out, depth_out
            )


@wp.kernel
def splat_normals_kernel(
    first: wp.int32,
    # In:
    view: View,
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    # Out:
    normal_out: wp.array[wp.vec3],
):
    """Thinnest axis of every Gaussian in camera axes, on the camera's side."""
    g = wp.tid() + first
    s = log_scales[g]
    axis = wp.vec3(1.0, 0.0, 0.0)
    if s[1] < s[0] and s[1] <= s[2]:
        axis = wp.vec3(0.0, 1.0, 0.0)
    elif s[2] < s[0] and s[2] < s[1]:
        axis = wp.vec3(0.0, 0.0, 1.0)
    normal = view.rotation * (rotation_matrix(rotations[g]) * axis)
    towards = wp.dot(normal, view.rotation * means[g] + view.translation)
    normal_out[g] = wp.where(towards > 0.0, -normal, normal)


@wp.kernel
def composite_geometry_kernel(
    first: wp.int32,
    # In:
    width: wp.int32,
    height: wp.int32,
    tile_start: wp.array[wp.int32],
    gaussian_from_intersection: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    normal: wp.array[wp.vec3],
    # Out:
    median_depth_out: wp.array[wp.float32],
    normal_out: wp.array[wp.vec3],
):
    """One thread walks one pixel for what is seldom asked: where half of the light is stopped, and the mean normal."""
    thread = wp.tid() + first
    tile = thread / TILE_PIXELS
    i = thread % TILE_PIXELS
    columns = (width + TILE - 1) / TILE
    column = (tile % columns) * TILE + i % TILE
    row = (tile / columns) * TILE + i / TILE
    if column >= width or row >= height:
        return
    x = wp.float32(column) + 0.5
    y = wp.float32(row) + 0.5
    median = wp.float32(0.0)
    normal_sum = wp.vec3()
    passing = wp.float32(1.0)
    intersection = tile_start[tile]
    end = tile_start[tile + 1]
    while intersection < end:
        g = gaussian_from_intersection[intersection]
        intersection += 1
        e = ellipse[g]
        f = falloff[g]
        dy = y - e[1]
        u = x - e[0] + e[3] * dy
        alpha = wp.min(wp.exp(f[1] - f[0] * dy * dy - e[2] * u * u), ALPHA_LIMIT)
        if alpha >= ALPHA_CUT:
            after = passing * (1.0 - alpha)
            if after <= TRANSMITTANCE_STOP:
                intersection = end
            else:
                normal_sum += passing * alpha * normal[g]
                if passing > 0.5 and after <= 0.5:
                    median = colour_depth[g][3]
                passing = after
    median_depth_out[row * width + column] = median
    normal_out[row * width + column] = normal_sum
