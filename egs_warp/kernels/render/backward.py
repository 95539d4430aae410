"""Backward pass of the renderer, written by hand: pixels to (Gaussian, tile) pairs, pairs to Gaussians.

Every sum has one owner and a fixed order: no atomics, the same bits on every run.
"""

import warp as wp

from egs_warp.kernels.render.ellipse import LOW_PASS
from egs_warp.kernels.render.projection import View, rotation_matrix, screen_axes, sh_sum

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
    """The gradient by a pixel's weighted sums, and the whole that splats from front to back use up.

    With s_i = (colour_i, depth_i) . gradient, the loss is linear in the weights w_i and the final transmittance T:
    dL/dalpha_i = T_i s_i - (sum of w_j s_j over j > i + T dL/dT) / (1 - alpha_i). The bracket for i = 0 is what is
    returned; walking from front to back then needs no second pass and no stored state. Empty arrays are zero gradients.
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
    # colour holds T times the background already; depth times alpha is the weighted sum of depths.
    remaining = wp.dot(by_colour, colour[row, column]) + by_depth_sum * depth_sum - (1.0 - opaque) * by_alpha
    return wp.vec4(by_colour[0], by_colour[1], by_colour[2], by_depth_sum), remaining


@wp.kernel
def pixel_gradients_kernel(
    first: wp.int32,
    # In:
    colour: wp.array2d[wp.vec3],
    alpha: wp.array2d[wp.float32],
    depth: wp.array2d[wp.float32],
    colour_gradient: wp.array2d[wp.vec3],
    alpha_gradient: wp.array2d[wp.float32],
    depth_gradient: wp.array2d[wp.float32],
    # Out:
    sum_gradient_out: wp.array[wp.vec4],
    remaining_out: wp.array[wp.float32],
):
    """``pixel_gradient`` of every pixel (CPU; a GPU's compositor works it out itself)."""
    i = wp.tid() + first
    by_sums, remaining = pixel_gradient(
        i / colour.shape[1],
        i % colour.shape[1],
        colour,
        alpha,
        depth,
        colour_gradient,
        alpha_gradient,
        depth_gradient,
    )
    sum_gradient_out[i] = by_sums
    remaining_out[i] = remaining


@wp.func
def quaternion_gradient(q: wp.vec4, by_rotation: wp.mat33) -> wp.vec4:
    """Gradient by an unnormalised quaternion w, x, y, z, from the gradient by its rotation matrix."""
    length = wp.length(q)
    if length == 0.0:
        return wp.vec4()
    unit = q / length
    w = unit[0]
    x = unit[1]
    y = unit[2]
    z = unit[3]
    d = by_rotation
    by_unit = 2.0 * wp.vec4(
        x * (d[2, 1] - d[1, 2]) + y * (d[0, 2] - d[2, 0]) + z * (d[1, 0] - d[0, 1]),
        y * (d[0, 1] + d[1, 0]) + z * (d[0, 2] + d[2, 0]) + w * (d[2, 1] - d[1, 2]) - 2.0 * x * (d[1, 1] + d[2, 2]),
        x * (d[0, 1] + d[1, 0]) + z * (d[1, 2] + d[2, 1]) + w * (d[0, 2] - d[2, 0]) - 2.0 * y * (d[0, 0] + d[2, 2]),
        x * (d[0, 2] + d[2, 0]) + y * (d[1, 2] + d[2, 1]) + w * (d[1, 0] - d[0, 1]) - 2.0 * z * (d[0, 0] + d[1, 1]),
    )
    return (by_unit - wp.dot(unit, by_unit) * unit) / length


@wp.func
def sh_gradients(
    sh: wp.array2d[wp.vec3],
    g: wp.int32,
    d: wp.vec3,
    by_colour: wp.vec3,
    by_sh: wp.array2d[wp.vec3],
) -> wp.vec3:
    """Write the gradient by the coefficients of Gaussian ``g``; return the gradient by the direction, as if free."""
    x = d[0]
    y = d[1]
    z = d[2]
    coefficients = sh.shape[1]
    by_sh[g, 0] = 0.28209479177387814 * by_colour
    by_d = wp.vec3()
    if coefficients > 1:
        c1 = 0.4886025119029199
        by_sh[g, 1] = -c1 * y * by_colour
        by_sh[g, 2] = c1 * z * by_colour
        by_sh[g, 3] = -c1 * x * by_colour
        by_d = c1 * wp.vec3(-wp.dot(sh[g, 3], by_colour), -wp.dot(sh[g, 1], by_colour), wp.dot(sh[g, 2], by_colour))
    if coefficients > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        c2 = 1.0925484305920792
        c20 = 0.31539156525252005
        c22 = 0.5462742152960396
        by_sh[g, 4] = c2 * (x * y) * by_colour
        by_sh[g, 5] = -c2 * (y * z) * by_colour
        by_sh[g, 6] = c20 * (2.0 * zz - xx - yy) * by_colour
        by_sh[g, 7] = -c2 * (x * z) * by_colour
        by_sh[g, 8] = c22 * (xx - yy) * by_colour
        by_d += c2 * wp.dot(sh[g, 4], by_colour) * wp.vec3(y, x, 0.0)
        by_d -= c2 * wp.dot(sh[g, 5], by_colour) * wp.vec3(0.0, z, y)
        by_d += 2.0 * c20 * wp.dot(sh[g, 6], by_colour) * wp.vec3(-x, -y, 2.0 * z)
        by_d -= c2 * wp.dot(sh[g, 7], by_colour) * wp.vec3(z, 0.0, x)
        by_d += 2.0 * c22 * wp.dot(sh[g, 8], by_colour) * wp.vec3(x, -y, 0.0)
    if coefficients > 9:
        xx = x * x
        yy = y * y
        zz = z * z
        c33 = 0.5900435899266435
        c32 = 2.890611442640554
        c31 = 0.4570457994644658
        c30 = 0.3731763325901154
        c3b = 1.445305721320277
        by_sh[g, 9] = -c33 * y * (3.0 * xx - yy) * by_colour
        by_sh[g, 10] = c32 * (x * y) * z * by_colour
        by_sh[g, 11] = -c31 * y * (4.0 * zz - xx - yy) * by_colour
        by_sh[g, 12] = c30 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * by_colour
        by_sh[g, 13] = -c31 * x * (4.0 * zz - xx - yy) * by_colour
        by_sh[g, 14] = c3b * z * (xx - yy) * by_colour
        by_sh[g, 15] = -c33 * x * (xx - 3.0 * yy) * by_colour
        by_d -= c33 * wp.dot(sh[g, 9], by_colour) * wp.vec3(6.0 * x * y, 3.0 * xx - 3.0 * yy, 0.0)
        by_d += c32 * wp.dot(sh[g, 10], by_colour) * wp.vec3(y * z, x * z, x * y)
        by_d -= c31 * wp.dot(sh[g, 11], by_colour) * wp.vec3(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z)
        by_d += c30 * wp.dot(sh[g, 12], by_colour) * wp.vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy)
        by_d -= c31 * wp.dot(sh[g, 13], by_colour) * wp.vec3(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z)
        by_d += c3b * wp.dot(sh[g, 14], by_colour) * wp.vec3(2.0 * x * z, -2.0 * y * z, xx - yy)
        by_d -= c33 * wp.dot(sh[g, 15], by_colour) * wp.vec3(3.0 * xx - 3.0 * yy, -6.0 * x * y, 0.0)
    return by_d


@wp.kernel
def project_backward_kernel(
    first: wp.int32,
    # In:
    view: View,
    antialiased: wp.int32,
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    sh: wp.array2d[wp.vec3],
    ellipse: wp.array[wp.vec4],
    slot_end: wp.array[wp.int64],
    moments: wp.array2d[wp.vec4],
    # Out:
    by_mean_out: wp.array[wp.vec3],
    by_rotation_out: wp.array[wp.vec4],
    by_log_scale_out: wp.array[wp.vec3],
    by_opacity_logit_out: wp.array[wp.float32],
    by_sh_out: wp.array2d[wp.vec3],
    by_screen_out: wp.array[wp.vec2],
    by_pose_rotation_out: wp.array[wp.mat33],
    by_pose_translation_out: wp.array[wp.vec3],
):
    """Sum a Gaussian's tiles and carry the gradient through the projection; outputs not wanted are empty arrays."""
    g = wp.tid() + first
    slot = wp.int32(0)
    if g > 0:
        slot = wp.int32(slot_end[g - 1])
    end = wp.int32(slot_end[g])
    want_pose = by_pose_rotation_out.shape[0] > 0
    want_screen = by_screen_out.shape[0] > 0
    if slot == end:
        by_mean_out[g] = wp.vec3()
        by_rotation_out[g] = wp.vec4()
        by_log_scale_out[g] = wp.vec3()
        by_opacity_logit_out[g] = wp.float32(0.0)
        if want_screen:
            by_screen_out[g] = wp.vec2()
        for k in range(sh.shape[1]):
            by_sh_out[g, k] = wp.vec3()
        if want_pose:
            by_pose_rotation_out[g] = wp.mat33()
            by_pose_translation_out[g] = wp.vec3()
        return
    m0 = wp.vec4()
    m1 = wp.vec4()
    m2 = wp.vec4()
    while slot < end:
        m0 += moments[slot, 0]
        m1 += moments[slot, 1]
        m2 += moments[slot, 2]
        slot += 1

    mean = means[g]
    q = rotations[g]
    log_scale = log_scales[g]
    logit = opacity_logits[g]
    p = view.rotation * mean + view.translation
    inv_z = 1.0 / p[2]
    row_x, row_y = screen_axes(view, p, q, log_scale)
    sharp_xx = wp.dot(row_x, row_x)
    sharp_yy = wp.dot(row_y, row_y)
    var_xy = wp.dot(row_x, row_y)
    var_xx = sharp_xx + LOW_PASS
    var_yy = sharp_yy + LOW_PASS
    sharp_determinant = wp.length_sq(wp.cross(row_x, row_y))
    determinant = sharp_determinant + LOW_PASS * (sharp_xx + sharp_yy) + LOW_PASS * LOW_PASS

    # ln alpha = ln opacity - a u^2 - v dy^2, u = dx + shear dy, dx = pixel - centre.
    a = ellipse[g][2]
    shear = ellipse[g][3]
    v = 0.5 / var_yy
    by_log_opacity = m0[0]
    by_a = -m0[3]
    by_v = -m1[1]
    by_shear = -2.0 * a * m1[0]
    by_screen = wp.vec2(2.0 * a * m0[1], 2.0 * a * shear * m0[1] + 2.0 * v * m0[2])
    if want_screen:
        by_screen_out[g] = by_screen
    by_opacity_logit_out[g] = by_log_opacity / (1.0 + wp.exp(logit))

    # a = var_yy / (2 det), shear = -var_xy / var_yy, v = 1 / (2 var_yy).
    inv_det = 1.0 / determinant
    by_xx = -0.5 * by_a * (var_yy * inv_det) * (var_yy * inv_det)
    by_yy = (
        -0.5 * by_a * (var_xy * inv_det) * (var_xy * inv_det)
        + by_shear * var_xy / (var_yy * var_yy)
        - 0.5 * by_v / (var_yy * var_yy)
    )
    by_xy = by_a * (var_yy * inv_det) * (var_xy * inv_det) - by_shear / var_yy
    if antialiased != 0 and sharp_determinant > 1.0e-12 * determinant:
        inv_sharp = 1.0 / sharp_determinant
        by_xx += 0.5 * by_log_opacity * (sharp_yy * inv_sharp - var_yy * inv_det)
        by_yy += 0.5 * by_log_opacity * (sharp_xx * inv_sharp - var_xx * inv_det)
        by_xy += by_log_opacity * var_xy * (inv_det - inv_sharp)
    by_row_x = 2.0 * by_xx * row_x + by_xy * row_y
    by_row_y = 2.0 * by_yy * row_y + by_xy * row_x
    by_log_scale_out[g] = wp.cw_mul(by_row_x, row_x) + wp.cw_mul(by_row_y, row_y)

    scale = wp.vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))
    by_axis_x = wp.cw_mul(by_row_x, scale)
    by_axis_y = wp.cw_mul(by_row_y, scale)
    rotation = rotation_matrix(q)
    axes = view.rotation * rotation
    right = wp.vec3(axes[0, 0], axes[0, 1], axes[0, 2])
    down = wp.vec3(axes[1, 0], axes[1, 1], axes[1, 2])
    forward = wp.vec3(axes[2, 0], axes[2, 1], axes[2, 2])
    slope_x = p[0] * inv_z
    slope_y = p[1] * inv_z
    tx = wp.clamp(slope_x, view.slope_low[0], view.slope_high[0])
    ty = wp.clamp(slope_y, view.slope_low[1], view.slope_high[1])
    fx = view.fx * inv_z
    fy = view.fy * inv_z
    by_forward = -fx * tx * by_axis_x - fy * ty * by_axis_y
    by_axes = wp.matrix_from_rows(fx * by_axis_x, fy * by_axis_y, by_forward)
    axis_x = fx * (right - tx * forward)
    axis_y = fy * (down - ty * forward)
    by_z = m1[2] - inv_z * (wp.dot(by_axis_x, axis_x) + wp.dot(by_axis_y, axis_y))
    by_px = fx * by_screen[0]
    by_py = fy * by_screen[1]
    by_z -= inv_z * (by_px * p[0] + by_py * p[1])
    if tx == slope_x:
        by_tx = -fx * wp.dot(by_axis_x, forward) * inv_z
        by_px += by_tx
        by_z -= by_tx * slope_x
    if ty == slope_y:
        by_ty = -fy * wp.dot(by_axis_y, forward) * inv_z
        by_py += by_ty
        by_z -= by_ty * slope_y
    by_p = wp.vec3(by_px, by_py, by_z)
    turn = wp.transpose(view.rotation)
    by_rotation_out[g] = quaternion_gradient(q, turn * by_axes)

    offset = mean - view.centre
    distance = wp.length(offset)
    direction = offset / distance
    raw = sh_sum(sh, g, sh.shape[1], direction)
    by_colour = wp.vec3(
        wp.where(raw[0] > -0.5, m2[0], 0.0), wp.where(raw[1] > -0.5, m2[1], 0.0), wp.where(raw[2] > -0.5, m2[2], 0.0)
    )
    by_direction = sh_gradients(sh, g, direction, by_colour, by_sh_out)
    by_offset = (by_direction - wp.dot(direction, by_direction) * direction) / distance
    by_mean_out[g] = turn * by_p + by_offset
    if want_pose:
        # The camera's centre -R^T t carries the colour's share.
        by_pose_rotation_out[g] = (
            by_axes * wp.transpose(rotation) + wp.outer(by_p, mean) + wp.outer(view.translation, by_offset)
        )
        by_pose_translation_out[g] = by_p + view.rotation * by_offset
