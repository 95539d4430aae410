"""Gradients of the loss with respect to the weighted sums of each pixel of an image."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.func
def pixel_gradient(
    row: wp.int32,
    column: wp.int32,
    colour: wp.array2d[wp.vec3],
    alpha: wp.array2d[wp.float32],
    depth: wp.array2d[wp.float32],
    colour_gradient: wp.array2d[wp.vec3],
    alpha_gradient: wp.array2d[wp.float32],
    depth_gradient: wp.array2d[wp.float32],
) -> tuple[wp.vec4, wp.float32]:
    """Return the gradient with respect to the weighted sums of pixel (``row``, ``column``), and the initial remaining
    sum of a front-to-back traversal.

    With s_i = (colour_i, depth_i) . gradient, the loss is linear in the weights w_i and in the final transmittance T:
    dL/dalpha_i = T_i s_i - (sum of w_j s_j over j > i + T dL/dT) / (1 - alpha_i). The initial remaining sum is the
    expression in brackets with the sum over all splats. The front-to-back traversal subtracts each w_j s_j from it, so
    no second pass and no stored state are needed. An empty array represents a zero gradient.
    """
    opaque = alpha[row, column]
    by_colour = wp.vec3()
    if colour_gradient.shape[0] > 0:
        by_colour = colour_gradient[row, column]
    by_alpha = wp.float32(0.0)
    if alpha_gradient.shape[0] > 0:
        by_alpha = alpha_gradient[row, column]
    by_depth_sum = wp.float32(0.0)
    if depth_gradient.shape[0] > 0 and opaque > 0.0:
        by_depth_sum = depth_gradient[row, column] / opaque
    depth_sum = depth[row, column] * opaque
    by_alpha = by_alpha - by_depth_sum * depth[row, column]
    # ``colour`` already contains T times the background; depth times alpha is the weighted sum of depths.
    remaining = wp.dot(by_colour, colour[row, column]) + by_depth_sum * depth_sum - (1.0 - opaque) * by_alpha
    return wp.vec4(by_colour[0], by_colour[1], by_colour[2], by_depth_sum), remaining


@wp.kernel
def pixel_gradients_kernel(
    first_row: wp.int32,
    # In:
    colour: wp.array2d[wp.vec3],
    alpha: wp.array2d[wp.float32],
    depth: wp.array2d[wp.float32],
    colour_gradient: wp.array2d[wp.vec3],
    alpha_gradient: wp.array2d[wp.float32],
    depth_gradient: wp.array2d[wp.float32],
    # Out:
    sum_gradient_out: wp.array2d[wp.vec4],
    remaining_out: wp.array2d[wp.float32],
):
    """Compute ``pixel_gradient`` for every pixel of one row. This kernel is used on a CPU only; the backward kernel on
    a GPU calls ``pixel_gradient`` itself.
    """
    row = wp.tid() + first_row
    for column in range(colour.shape[1]):
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
        sum_gradient_out[row, column] = by_sums
        remaining_out[row, column] = remaining
