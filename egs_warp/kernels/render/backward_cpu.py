"""Backward pass of the projection on a CPU, for sixteen Gaussians at a time, with the equations of ``backward``.

Host code: ``egs_warp/render/backward.py``.
"""

import warp as wp

from egs_warp.kernels.render.backward import clamp_gradient, offset_gradient
from egs_warp.kernels.render.covariance_cpu import SCREEN_COVARIANCES
from egs_warp.kernels.render.projection import View
from egs_warp.kernels.render.projection_cpu import BLOCK
from egs_warp.kernels.render.spherical_harmonics import sh_sum, write_sh_gradient
from egs_warp.kernels.render.tiles import first_slot_of
from egs_warp.kernels.render.vector_math import on_cpu

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    on_cpu(
        SCREEN_COVARIANCES
        + """
        // backward.splat_gradient: rows of the moments of each Gaussian, summed over its tiles.
        alignas(64) float sums[12][16];
        unsigned shown = 0;
        for (int i = 0; i < 16 && base + i < last; ++i) {
            const int g = base + i;
            const int start = g > 0 ? (int)slot_end.data[g - 1] : 0, end = (int)slot_end.data[g];
            f4 sum[3] = {};
            for (int slot = start; slot < end; ++slot)
                for (int k = 0; k < 3; ++k) {
                    f4 row;
                    __builtin_memcpy(&row, moments.data + 3 * (size_t)slot + k, sizeof(row));
                    sum[k] += row;
                }
            for (int k = 0; k < 12; ++k) sums[k][i] = sum[k / 4][k % 4];
            shown |= start < end ? 1u << i : 0u;
        }
        auto moment = [&](int k) -> const f16& { return *(const f16*)sums[k]; };
        const f16 inverse_yy = one / yy, inverse_determinant = one / determinant;
        const f16 a = 0.5f * yy * inverse_determinant, v = 0.5f * inverse_yy, shear = -xy * inverse_yy;
        const f16 by_log_opacity = moment(0), by_a = -moment(3), by_v = -moment(5), by_shear = -2.0f * a * moment(4);
        const f16 by_centre_x = 2.0f * a * moment(1), by_centre_y = by_centre_x * shear + 2.0f * v * moment(2);

        // backward.covariance_gradient
        const f16 p = yy * inverse_determinant, r = xy * inverse_determinant;
        f16 by_xx = -0.5f * by_a * p * p, by_xy = by_a * p * r - by_shear * inverse_yy;
        f16 by_yy = -0.5f * by_a * r * r + (by_shear * xy - 0.5f * by_v) * inverse_yy * inverse_yy;
        if (antialiased) {
            const i16 sharp = sharp_determinant > 1.0e-12f * determinant;
            const f16 inverse_sharp = one / sharp_determinant;
            by_xx += sharp ? 0.5f * by_log_opacity * (sharp_yy * inverse_sharp - p) : none;
            by_yy += sharp ? 0.5f * by_log_opacity * (sharp_xx * inverse_sharp - xx * inverse_determinant) : none;
            by_xy += sharp ? by_log_opacity * xy * (inverse_determinant - inverse_sharp) : none;
        }

        // backward.camera_space_gradient
        f16 by_axes[3][3], by_log_scale[3], along_x = none, along_y = none, forward_x = none, forward_y = none;
        for (int k = 0; k < 3; ++k) {
            const f16 by_row_x = 2.0f * by_xx * row_x[k] + by_xy * row_y[k];
            const f16 by_row_y = 2.0f * by_yy * row_y[k] + by_xy * row_x[k];
            const f16 by_axis_x = by_row_x * scale[k], by_axis_y = by_row_y * scale[k];
            by_log_scale[k] = by_row_x * row_x[k] + by_row_y * row_y[k];
            by_axes[0][k] = fx * by_axis_x;
            by_axes[1][k] = fy * by_axis_y;
            by_axes[2][k] = -tx * by_axes[0][k] - ty * by_axes[1][k];
            along_x += by_axis_x * axis_x[k];
            along_y += by_axis_y * axis_y[k];
            forward_x += by_axes[0][k] * forward[k];
            forward_y += by_axes[1][k] * forward[k];
        }
        f16 by_x = fx * by_centre_x, by_y = fy * by_centre_y;
        f16 by_z = moment(6) - inverse_z * (along_x + along_y + by_x * px + by_y * py);
        const f16 by_tx = tx == slope_x ? -forward_x * inverse_z : none;
        const f16 by_ty = ty == slope_y ? -forward_y * inverse_z : none;
        by_x += by_tx;
        by_y += by_ty;
        by_z -= by_tx * slope_x + by_ty * slope_y;

        // The rotation matrix, then backward.quaternion_gradient.
        f16 d[3][3];
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k)
                d[j][k] = R(0, j) * by_axes[0][k] + R(1, j) * by_axes[1][k] + R(2, j) * by_axes[2][k];
        const f16 by_unit[4] = {
            2.0f * (x * (d[2][1] - d[1][2]) + y * (d[0][2] - d[2][0]) + z * (d[1][0] - d[0][1])),
            2.0f * (y * (d[0][1] + d[1][0]) + z * (d[0][2] + d[2][0]) + w * (d[2][1] - d[1][2])
                - 2.0f * x * (d[1][1] + d[2][2])),
            2.0f * (x * (d[0][1] + d[1][0]) + z * (d[1][2] + d[2][1]) + w * (d[0][2] - d[2][0])
                - 2.0f * y * (d[0][0] + d[2][2])),
            2.0f * (x * (d[0][2] + d[2][0]) + y * (d[1][2] + d[2][1]) + w * (d[1][0] - d[0][1])
                - 2.0f * z * (d[0][0] + d[1][1]))};
        const f16 radial = w * by_unit[0] + x * by_unit[1] + y * by_unit[2] + z * by_unit[3], unit[4] = {w, x, y, z};

        alignas(64) float out[11][16];
        for (int k = 0; k < 3; ++k) {
            *(f16*)out[k] = R(0, k) * by_x + R(1, k) * by_y + R(2, k) * by_z;
            *(f16*)out[7 + k] = by_log_scale[k];
        }
        for (int k = 0; k < 4; ++k) *(f16*)out[3 + k] = (by_unit[k] - radial * unit[k]) * inverse_length;
        *(f16*)out[10] = by_log_opacity / (one + exp_of(lane(10)));
        for (int i = 0; i < 16 && base + i < last; ++i) {
            const int g = base + i;
            const bool visible = shown >> i & 1;
            auto value = [&](int k) -> float { return visible ? out[k][i] : 0.0f; };
            by_mean.data[g] = wp::vec3(value(0), value(1), value(2));
            by_rotation.data[g] = wp::vec4(value(3), value(4), value(5), value(6));
            by_log_scale_out.data[g] = wp::vec3(value(7), value(8), value(9));
            by_opacity_logit.data[g] = value(10);
            by_colour.data[(size_t)g * by_colour.shape[1]] = wp::vec3(sums[8][i], sums[9][i], sums[10][i]);
        }
    }
"""
    )
)
def project_backward_lanes(
    first: wp.int32,
    last: wp.int32,
    view: View,
    antialiased: wp.int32,
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    slot_end: wp.array[wp.int64],
    moments: wp.array2d[wp.vec4],
    by_mean: wp.array[wp.vec3],
    by_rotation: wp.array[wp.vec4],
    by_log_scale_out: wp.array[wp.vec3],
    by_opacity_logit: wp.array[wp.float32],
    by_colour: wp.array2d[wp.vec3],
):
    """Write the gradients of the Gaussians ``first`` to ``last`` - 1, without the contributions through the colour, and
    write the gradient with respect to the colour to the first column of ``by_colour``. Arguments are as in
    ``project_backward_kernel``.
    """
    ...


@wp.kernel
def project_backward_block_kernel(
    first_block: wp.int32,
    # In:
    view: View,
    antialiased: wp.int32,
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    sh: wp.array2d[wp.vec3],
    slot_end: wp.array[wp.int64],
    moments: wp.array2d[wp.vec4],
    # Out:
    by_mean_out: wp.array[wp.vec3],
    by_rotation_out: wp.array[wp.vec4],
    by_log_scale_out: wp.array[wp.vec3],
    by_opacity_logit_out: wp.array[wp.float32],
    by_sh_out: wp.array2d[wp.vec3],
):
    """Compute the gradients of ``project_backward_kernel`` for ``BLOCK`` Gaussians per thread."""
    first = (wp.tid() + first_block) * BLOCK
    last = wp.min(first + BLOCK, means.shape[0])
    project_backward_lanes(
        first,
        last,
        view,
        antialiased,
        means,
        rotations,
        log_scales,
        opacity_logits,
        slot_end,
        moments,
        by_mean_out,
        by_rotation_out,
        by_log_scale_out,
        by_opacity_logit_out,
        by_sh_out,
    )
    for g in range(first, last):
        if first_slot_of(slot_end, g) == wp.int32(slot_end[g]):
            for k in range(by_sh_out.shape[1]):
                by_sh_out[g, k] = wp.vec3()
        else:
            offset = means[g] - view.centre
            direction = wp.vec3()
            if sh.shape[1] > 1:
                direction = wp.normalize(offset)
            by_colour = clamp_gradient(sh_sum(sh, g, sh.shape[1], direction), by_sh_out[g, 0])
            write_sh_gradient(by_sh_out, g, direction, by_colour)
            if sh.shape[1] > 1:
                by_mean_out[g] = by_mean_out[g] + offset_gradient(sh, g, offset, by_colour)
