"""Quantisation of images to eight bits."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def quantise_kernel(
    first_row: wp.int32,
    # In:
    colour: wp.array[wp.vec3],
    # Out:
    level_out: wp.array2d[wp.uint8],
):
    """Map colours from 0..1 to 0..255, clip values outside this range, and round half to even."""
    tid = wp.tid() + first_row
    for channel in range(3):
        level_out[tid, channel] = wp.uint8(wp.rint(255.0 * wp.clamp(colour[tid][channel], 0.0, 1.0)))
