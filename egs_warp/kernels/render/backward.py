"""Backward pass of the projection, written by hand: gradients from (Gaussian, tile) pairs to Gaussians and to the
camera pose.

Each sum is computed in a fixed order. There are no atomics, so every run gives the same bits. The
equations are the derivatives of those in ``projection``, in reverse order; ``by_x`` is the gradient of the loss with
respect to x. ``projection`` describes the arrays of Gaussians, ``tiles`` the slots, of which those of Gaussian g end at
``slot_end[g]``. Host code: ``egs_warp/render/backward.py``.
"""

from typing import Any

import warp as wp

from egs_warp.kernels.render.moments import end_of_sum
from egs_warp.kernels.render.projection import (
    ScreenCovariance,
    View,
    rotation_matrix,
    scale_of,
    screen_axes,
    screen_covariance,
    view_of,
)
from egs_warp.kernels.render.spherical_harmonics import sh_direction_gradient, sh_sum, write_sh_gradient
from egs_warp.kernels.render.tiles import first_slot_of

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class SplatGradient:
    """Gradient with respect to the parameters of a splat on the screen, where -ln(alpha / opacity) = a u^2 + v dy^2
    with u = dx + shear dy.
    """

    log_opacity: wp.float32
    a: wp.float32
    v: wp.float32
    shear: wp.float32
    centre: wp.vec2
    colour: wp.vec3
    depth: wp.float32


@wp.struct
class CameraSpaceGradient:
    """Gradient with respect to the parameters of a Gaussian in camera space."""

    screen: wp.vec2
    log_opacity: wp.float32
    log_scale: wp.vec3
    axes: wp.mat33
    point: wp.vec3
    colour: wp.vec3


@wp.func
def splat_gradient(
    moments: wp.array2d[wp.vec4],
    first_slot: wp.int32,
    end_slot: wp.int32,
    a: wp.float32,
    v: wp.float32,
    shear: wp.float32,
) -> SplatGradient:
    """Return the gradient of a splat: the sum, over the tiles of a Gaussian, of the moments that
    ``composite_backward_tile_kernel`` wrote.

    With k = alpha dL/dalpha, ``moments[slot]`` holds (sum k, k u, k dy, k u^2), (k u dy, k dy^2, dL/d depth, 0) and
    (dL/d colour, 0). The slots are ``first_slot`` to ``end_slot`` - 1.
    """
    first_row = wp.vec4()
    second_row = wp.vec4()
    third_row = wp.vec4()
    for slot in range(first_slot, end_of_sum(first_slot, end_slot)):
        first_row += moments[slot, 0]
        second_row += moments[slot, 1]
        third_row += moments[slot, 2]
    sum_k = first_row[0]
    sum_ku = first_row[1]
    sum_kdy = first_row[2]
    sum_kuu = first_row[3]
    sum_kudy = second_row[0]
    sum_kdydy = second_row[1]
    by = SplatGradient()
    by.log_opacity = sum_k
    by.a = -sum_kuu
    by.v = -sum_kdydy
    by.shear = -2.0 * a * sum_kudy
    by.centre = wp.vec2(2.0 * a * sum_ku, 2.0 * a * shear * sum_ku + 2.0 * v * sum_kdy)
    by.colour = wp.vec3(third_row[0], third_row[1], third_row[2])
    by.depth = second_row[2]
    return by


@wp.func
def covariance_gradient(covariance: ScreenCovariance, by: SplatGradient, antialiased: wp.int32) -> wp.vec3:
    """Return the gradient with respect to the entries xx, yy and xy of the screen covariance, through a = yy / (2 det),
    shear = -xy / yy, v = 1 / (2 yy) and the opacity factor of the low-pass."""
    inv_det = 1.0 / covariance.determinant
    by_xx = -0.5 * by.a * (covariance.yy * inv_det) * (covariance.yy * inv_det)
    by_yy = (
        -0.5 * by.a * (covariance.xy * inv_det) * (covariance.xy * inv_det)
        + by.shear * covariance.xy / (covariance.yy * covariance.yy)
        - 0.5 * by.v / (covariance.yy * covariance.yy)
    )
    by_xy = by.a * (covariance.yy * inv_det) * (covariance.xy * inv_det) - by.shear / covariance.yy
    if antialiased != 0 and covariance.sharp_determinant > 1.0e-12 * covariance.determinant:
        inv_sharp = 1.0 / covariance.sharp_determinant
        by_xx += 0.5 * by.log_opacity * (covariance.sharp_yy * inv_sharp - covariance.yy * inv_det)
        by_yy += 0.5 * by.log_opacity * (covariance.sharp_xx * inv_sharp - covariance.xx * inv_det)
        by_xy += by.log_opacity * covariance.xy * (inv_det - inv_sharp)
    return wp.vec3(by_xx, by_yy, by_xy)


@wp.func
def camera_space_gradient(
    view: View,
    antialiased: wp.int32,
    p: wp.vec3,
    q: wp.vec4,
    log_scale: wp.vec3,
    moments: wp.array2d[wp.vec4],
    first_slot: wp.int32,
    end_slot: wp.int32,
) -> CameraSpaceGradient:
    """Propagate the gradient of a splat through the screen covariance and ``screen_axes`` to camera space, for a
    Gaussian at the camera-space point ``p``.
    """
    # The scale is computed once, because a call of the exponential function is expensive on a CPU.
    scale = scale_of(log_scale)
    row_x, row_y = screen_axes(view, p, q, scale)
    covariance = screen_covariance(row_x, row_y)
    a = 0.5 * covariance.yy / covariance.determinant
    by_splat = splat_gradient(moments, first_slot, end_slot, a, 0.5 / covariance.yy, -covariance.xy / covariance.yy)
    by_covariance = covariance_gradient(covariance, by_splat, antialiased)
    by_row_x = 2.0 * by_covariance[0] * row_x + by_covariance[2] * row_y
    by_row_y = 2.0 * by_covariance[1] * row_y + by_covariance[2] * row_x

    # row_x = fx / z (right - tx forward) scale, and row_y likewise.
    axes = view.rotation * rotation_matrix(q)
    right = wp.vec3(axes[0, 0], axes[0, 1], axes[0, 2])
    down = wp.vec3(axes[1, 0], axes[1, 1], axes[1, 2])
    forward = wp.vec3(axes[2, 0], axes[2, 1], axes[2, 2])
    inv_z = 1.0 / p[2]
    slope_x = p[0] * inv_z
    slope_y = p[1] * inv_z
    tx = wp.clamp(slope_x, view.slope_low[0], view.slope_high[0])
    ty = wp.clamp(slope_y, view.slope_low[1], view.slope_high[1])
    fx = view.fx * inv_z
    fy = view.fy * inv_z
    by_axis_x = wp.cw_mul(by_row_x, scale)
    by_axis_y = wp.cw_mul(by_row_y, scale)
    by_forward = -fx * tx * by_axis_x - fy * ty * by_axis_y
    axis_x = fx * (right - tx * forward)
    axis_y = fy * (down - ty * forward)

    by_x = fx * by_splat.centre[0]
    by_y = fy * by_splat.centre[1]
    by_z = by_splat.depth - inv_z * (wp.dot(by_axis_x, axis_x) + wp.dot(by_axis_y, axis_y))
    by_z -= inv_z * (by_x * p[0] + by_y * p[1])
    # A slope clamped at the image's edge does not depend on the point.
    if tx == slope_x:
        by_tx = -fx * wp.dot(by_axis_x, forward) * inv_z
        by_x += by_tx
        by_z -= by_tx * slope_x
    if ty == slope_y:
        by_ty = -fy * wp.dot(by_axis_y, forward) * inv_z
        by_y += by_ty
        by_z -= by_ty * slope_y

    by = CameraSpaceGradient()
    by.screen = by_splat.centre
    by.log_opacity = by_splat.log_opacity
    by.log_scale = wp.cw_mul(by_row_x, row_x) + wp.cw_mul(by_row_y, row_y)
    by.axes = wp.matrix_from_rows(fx * by_axis_x, fy * by_axis_y, by_forward)
    by.point = wp.vec3(by_x, by_y, by_z)
    by.colour = by_splat.colour
    return by


@wp.func
def quaternion_gradient(q: wp.vec4, by_rotation: wp.mat33) -> wp.vec4:
    """Return the gradient with respect to an unnormalised quaternion w, x, y, z, given the gradient ``by_rotation``
    with respect to its rotation matrix.
    """
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
def clamp_gradient(raw: wp.vec3, by_colour: wp.vec3) -> wp.vec3:
    """Return the gradient with respect to the SH sum ``raw``, where the colour is max(raw + 0.5, 0)."""
    return wp.vec3(
        wp.where(raw[0] > -0.5, by_colour[0], 0.0),
        wp.where(raw[1] > -0.5, by_colour[1], 0.0),
        wp.where(raw[2] > -0.5, by_colour[2], 0.0),
    )


@wp.func
def offset_gradient(sh: wp.array2d[wp.vec3], g: wp.int32, offset: wp.vec3, by_colour: wp.vec3) -> wp.vec3:
    """Return the gradient with respect to ``offset``, the vector from the camera's centre to the mean, through the
    colour, which depends on the direction of this vector.
    """
    distance = wp.length(offset)
    direction = offset / distance
    by_direction = sh_direction_gradient(sh, g, direction, by_colour)
    return (by_direction - wp.dot(direction, by_direction) * direction) / distance


@wp.kernel
def project_backward_any_view_kernel(
    first: wp.int32,
    # In:
    view: Any,
    antialiased: wp.int32,
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    sh: wp.array2d[wp.vec3],
    slot_end: wp.array[wp.int64],
    moments: wp.array2d[wp.vec4],
    is_blocked: wp.array[wp.int32],
    # Out:
    by_mean_out: wp.array[wp.vec3],
    by_rotation_out: wp.array[wp.vec4],
    by_log_scale_out: wp.array[wp.vec3],
    by_opacity_logit_out: wp.array[wp.float32],
    by_sh_out: wp.array2d[wp.vec3],
):
    """Compute the gradient with respect to the attributes of one Gaussian per thread; zero if the Gaussian reaches no
    tile.

    Args:
        view: camera, or an array (1,) with it.
        antialiased, means, rotations, log_scales, opacity_logits, sh: as in ``projection``.
        slot_end: (n,) end of each Gaussian's slots.
        moments: (slots, 3) moments of ``composite_backward_tile_kernel``.
        is_blocked: (1,) nonzero if the tile lists are incomplete, so that nothing may be read; or an empty array.
        by_mean_out, by_rotation_out, by_log_scale_out, by_opacity_logit_out: (n,) gradients.
        by_sh_out: (n, coefficients) gradients.
    """
    blocked = wp.int32(0)
    if is_blocked.shape[0] > 0:
        blocked = is_blocked[0]
    if blocked != 0:
        return
    g = wp.tid() + first
    camera = view_of(view)
    slot = first_slot_of(slot_end, g)
    end = wp.int32(slot_end[g])
    if slot == end:
        by_mean_out[g] = wp.vec3()
        by_rotation_out[g] = wp.vec4()
        by_log_scale_out[g] = wp.vec3()
        by_opacity_logit_out[g] = wp.float32(0.0)
        for k in range(by_sh_out.shape[1]):
            by_sh_out[g, k] = wp.vec3()
        return
    mean = means[g]
    q = rotations[g]
    p = camera.rotation * mean + camera.translation
    by = camera_space_gradient(camera, antialiased, p, q, log_scales[g], moments, slot, end)
    camera_axes = wp.transpose(camera.rotation)
    by_rotation_out[g] = quaternion_gradient(q, camera_axes * by.axes)
    by_log_scale_out[g] = by.log_scale
    by_opacity_logit_out[g] = by.log_opacity / (1.0 + wp.exp(opacity_logits[g]))

    offset = mean - camera.centre
    direction = wp.normalize(offset)
    by_colour = clamp_gradient(sh_sum(sh, g, sh.shape[1], direction), by.colour)
    write_sh_gradient(by_sh_out, g, direction, by_colour)
    by_mean_out[g] = camera_axes * by.point + offset_gradient(sh, g, offset, by_colour)


project_backward_kernel = wp.overload(project_backward_any_view_kernel, {"view": View})
"""``project_backward_any_view_kernel`` for a ``View``."""
project_backward_into_view_kernel = wp.overload(project_backward_any_view_kernel, {"view": wp.array[View]})
"""``project_backward_any_view_kernel`` for an array (1,) of ``View``."""


@wp.kernel
def pose_backward_kernel(
    first: wp.int32,
    # In:
    view: View,
    antialiased: wp.int32,
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    sh: wp.array2d[wp.vec3],
    slot_end: wp.array[wp.int64],
    moments: wp.array2d[wp.vec4],
    # Out:
    by_screen_out: wp.array[wp.vec2],
    by_pose_rotation_out: wp.array[wp.mat33],
    by_pose_translation_out: wp.array[wp.vec3],
):
    """Compute the gradient with respect to the screen position of one Gaussian per thread, and the Gaussian's
    contribution to the gradient with respect to the camera pose.

    Outputs that are not requested are empty arrays.

    Args:
        view: camera.
        antialiased, means, rotations, log_scales, sh, slot_end, moments: as in ``project_backward_kernel``.
        by_screen_out: (n,) gradients with respect to the screen position in pixels.
        by_pose_rotation_out: (n,) contributions to the gradient with respect to the rotation matrix of the camera.
        by_pose_translation_out: (n,) contributions to the gradient with respect to the translation of the camera.
    """
    g = wp.tid() + first
    slot = first_slot_of(slot_end, g)
    end = wp.int32(slot_end[g])
    by_screen = wp.vec2()
    by_rotation = wp.mat33()
    by_translation = wp.vec3()
    if slot < end:
        mean = means[g]
        q = rotations[g]
        p = view.rotation * mean + view.translation
        by = camera_space_gradient(view, antialiased, p, q, log_scales[g], moments, slot, end)
        by_screen = by.screen
        offset = mean - view.centre
        by_colour = clamp_gradient(sh_sum(sh, g, sh.shape[1], wp.normalize(offset)), by.colour)
        by_offset = offset_gradient(sh, g, offset, by_colour)
        # The colour also depends on the pose, through the camera's centre -R^T t.
        by_rotation = (
            by.axes * wp.transpose(rotation_matrix(q))
            + wp.outer(by.point, mean)
            + wp.outer(view.translation, by_offset)
        )
        by_translation = by.point + view.rotation * by_offset
    if by_screen_out.shape[0] > 0:
        by_screen_out[g] = by_screen
    if by_pose_rotation_out.shape[0] > 0:
        by_pose_rotation_out[g] = by_rotation
        by_pose_translation_out[g] = by_translation
