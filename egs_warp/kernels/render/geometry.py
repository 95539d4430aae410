"""Kernels of the optional outputs of an image: median depth and normals."""

import warp as wp

from egs_warp.kernels.render.ellipse import (
    ALPHA_CUT,
    TILE_PIXELS,
    TRANSMITTANCE_STOP,
    is_tile_enabled,
    pixel_of_thread,
    splat_alpha,
)
from egs_warp.kernels.render.projection import View, rotation_matrix

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
    """Compute the unit vector along the thinnest axis of every Gaussian, in camera axes and pointing towards the
    camera.

    Args:
        view: camera.
        means, rotations, log_scales: (n,) as in ``projection``.
        normal_out: (n,) unit vectors.
    """
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
    tile_mask: wp.array[wp.int32],
    gaussian_from_intersection: wp.array[wp.int32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    normal: wp.array[wp.vec3],
    # Out:
    median_depth_out: wp.array[wp.float32],
    median_gaussian_out: wp.array[wp.int32],
    normal_out: wp.array[wp.vec3],
):
    """Compute, for one pixel per thread, the median depth, the Gaussian at this depth, and the blended normal.

    The median depth is the depth of the splat at which the transmittance falls to one half, 0 if it does not; the
    Gaussian is -1 then. ``compositing`` describes the other arguments.
    """
    thread = wp.tid() + first
    pixel = pixel_of_thread(thread, width)
    if pixel[0] >= width or pixel[1] >= height:
        return
    tile = thread / TILE_PIXELS
    median = wp.int32(-1)
    normal_sum = wp.vec3()
    passing = wp.float32(1.0)
    intersection = tile_start[tile]
    end = intersection
    if is_tile_enabled(tile_mask, tile):
        end = tile_start[tile + 1]
    while intersection < end:
        g = gaussian_from_intersection[intersection]
        intersection += 1
        alpha = splat_alpha(ellipse[g], falloff[g], pixel)
        if alpha >= ALPHA_CUT:
            after = passing * (1.0 - alpha)
            if after <= TRANSMITTANCE_STOP:
                intersection = end
            else:
                normal_sum += passing * alpha * normal[g]
                if passing > 0.5 and after <= 0.5:
                    median = g
                passing = after
    i = pixel[1] * width + pixel[0]
    depth = wp.float32(0.0)
    if median >= 0:
        depth = colour_depth[median][3]
    median_depth_out[i] = depth
    median_gaussian_out[i] = median
    normal_out[i] = normal_sum
