"""What is seldom asked of a picture: median depth and normals."""

import warp as wp

from egs_warp.kernels.render_ellipse import ALPHA_CUT, ALPHA_LIMIT, TILE, TILE_PIXELS, TRANSMITTANCE_STOP
from egs_warp.kernels.render_projection import View, rotation_matrix

wp.set_module_options({"enable_backward": False, "fast_math": True})


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
