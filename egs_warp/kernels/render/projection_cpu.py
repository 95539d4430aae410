"""Projection on a CPU: sixteen Gaussians at a time, as ``projection.project_kernel`` projects one.

Host code: ``egs_warp/render/projection.py``.
"""

import warp as wp

from egs_warp.kernels.render.ellipse import CUTOFFS_IN_CPP, LOW_PASS
from egs_warp.kernels.render.projection import NOT_FINITE, View, colour_and_depth
from egs_warp.kernels.render.spherical_harmonics import sh_sum
from egs_warp.kernels.render.vector_math import EXP_AND_LOG, TILE_SPANS, on_cpu

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(64)
"""Number of Gaussians that a thread projects per row of a launch."""

_SETTINGS = f"""
    constexpr float LOW_PASS = {float(LOW_PASS)}f;
    constexpr long long NOT_FINITE = {int(NOT_FINITE)};
"""


@wp.func_native(
    on_cpu(
        CUTOFFS_IN_CPP
        + _SETTINGS
        + EXP_AND_LOG
        + "    const int width = view.width, height = view.height;"
        + TILE_SPANS
        + """
    auto R = [&](int i, int j) -> float { return view.rotation.data[i][j]; };
    const f16 none = 0.0f, one = 1.0f;
    for (int base = first; base < last; base += 16) {
        alignas(64) float lanes[11][16];
        for (int i = 0; i < 16; ++i) {
            const int g = base + i < last ? base + i : last - 1;
            const float *mean = &(*wp::address(means, g))[0], *q = &(*wp::address(rotations, g))[0];
            const float* log_scale = &(*wp::address(log_scales, g))[0];
            for (int k = 0; k < 3; ++k) lanes[k][i] = mean[k];
            for (int k = 0; k < 4; ++k) lanes[3 + k][i] = q[k];
            for (int k = 0; k < 3; ++k) lanes[7 + k][i] = log_scale[k];
            lanes[10][i] = *wp::address(opacity_logits, g);
        }
        auto lane = [&](int k) -> const f16& { return *(const f16*)lanes[k]; };
        f16 zero = none;
        for (int k = 0; k < 11; ++k) zero += lane(k) * 0.0f;
        const i16 finite = zero == none;

        const f16 mx = lane(0), my = lane(1), mz = lane(2);
        const f16 px = R(0, 0) * mx + R(0, 1) * my + R(0, 2) * mz + view.translation[0];
        const f16 py = R(1, 0) * mx + R(1, 1) * my + R(1, 2) * mz + view.translation[1];
        const f16 pz = R(2, 0) * mx + R(2, 1) * my + R(2, 2) * mz + view.translation[2];
        const i16 in_front = finite & (pz >= view.near) & (pz <= view.far);

        // projection.rotation_matrix
        const f16 length = __builtin_elementwise_sqrt(
            lane(3) * lane(3) + lane(4) * lane(4) + lane(5) * lane(5) + lane(6) * lane(6));
        const f16 inverse_length = length > none ? one / length : none;
        const f16 w = length > none ? lane(3) * inverse_length : one;
        const f16 x = lane(4) * inverse_length, y = lane(5) * inverse_length, z = lane(6) * inverse_length;
        const f16 turn[3][3] = {
            {1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y - w * z), 2.0f * (x * z + w * y)},
            {2.0f * (x * y + w * z), 1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z - w * x)},
            {2.0f * (x * z - w * y), 2.0f * (y * z + w * x), 1.0f - 2.0f * (x * x + y * y)}};

        // projection.screen_axes and screen_covariance
        const f16 inverse_z = one / pz;
        f16 tx = px * inverse_z, ty = py * inverse_z;
        tx = tx < view.slope_low[0] ? f16(view.slope_low[0]) : (tx > view.slope_high[0] ? f16(view.slope_high[0]) : tx);
        ty = ty < view.slope_low[1] ? f16(view.slope_low[1]) : (ty > view.slope_high[1] ? f16(view.slope_high[1]) : ty);
        f16 row_x[3], row_y[3];
        for (int k = 0; k < 3; ++k) {
            const f16 right = R(0, 0) * turn[0][k] + R(0, 1) * turn[1][k] + R(0, 2) * turn[2][k];
            const f16 down = R(1, 0) * turn[0][k] + R(1, 1) * turn[1][k] + R(1, 2) * turn[2][k];
            const f16 forward = R(2, 0) * turn[0][k] + R(2, 1) * turn[1][k] + R(2, 2) * turn[2][k];
            const f16 scale = exp_of(lane(7 + k)) * inverse_z;
            row_x[k] = view.fx * scale * (right - tx * forward);
            row_y[k] = view.fy * scale * (down - ty * forward);
        }
        const f16 sharp_xx = row_x[0] * row_x[0] + row_x[1] * row_x[1] + row_x[2] * row_x[2];
        const f16 sharp_yy = row_y[0] * row_y[0] + row_y[1] * row_y[1] + row_y[2] * row_y[2];
        const f16 xy = row_x[0] * row_y[0] + row_x[1] * row_y[1] + row_x[2] * row_y[2];
        const f16 xx = sharp_xx + LOW_PASS, yy = sharp_yy + LOW_PASS;
        f16 sharp_determinant = none;
        for (int k = 0; k < 3; ++k) {
            const int i = (k + 1) % 3, j = (k + 2) % 3;
            const f16 minor = row_x[i] * row_y[j] - row_x[j] * row_y[i];
            sharp_determinant += minor * minor;
        }
        const f16 determinant = sharp_determinant + LOW_PASS * (sharp_xx + sharp_yy) + LOW_PASS * LOW_PASS;

        const f16 logit = lane(10);
        f16 log_opacity = logit < -15.0f ? logit : -log_of(one + exp_of(-logit));
        if (antialiased) {
            const f16 ratio = sharp_determinant / determinant;
            log_opacity += 0.5f * log_of(ratio > 1.0e-12f ? ratio : f16(1.0e-12f));
        }
        const f16 cut = log_opacity + LOG_255;
        const f16 screen_x = view.fx * px * inverse_z + view.cx, screen_y = view.fy * py * inverse_z + view.cy;
        const f16 reach_x = __builtin_elementwise_sqrt(2.0f * cut * xx);
        const f16 reach_y = __builtin_elementwise_sqrt(2.0f * cut * yy);
        const i16 visible = in_front & (cut > none) & (determinant < 3.4e38f)
            & (screen_x + reach_x >= 0.5f) & (screen_x - reach_x <= (float)width - 0.5f)
            & (screen_y + reach_y >= 0.5f) & (screen_y - reach_y <= (float)height - 0.5f);

        alignas(64) float out[6][16];
        *(f16*)out[0] = screen_x;
        *(f16*)out[1] = screen_y;
        *(f16*)out[2] = 0.5f * yy / determinant;
        *(f16*)out[3] = -xy / yy;
        *(f16*)out[4] = 0.5f / yy;
        *(f16*)out[5] = log_opacity;
        *(f16*)lanes[2] = pz;
        const unsigned shown = bits_of(visible), usable = bits_of(finite);
        for (int i = 0; i < 16 && base + i < last; ++i) {
            const int g = base + i;
            tile_count.data[g] = usable >> i & 1 ? 0 : NOT_FINITE;
            if (!(shown >> i & 1)) continue;
            const wp::vec4 e(out[0][i], out[1][i], out[2][i], out[3][i]);
            const wp::vec2 f(out[4][i], out[5][i]);
            int row, last_row, tiles = 0;
            tile_rows_of(e, f, row, last_row);
            for (; row <= last_row; row += 4) {
                i4 from, to;
                tile_spans(e, f, row, from, to);
                const i4 steps = {0, 1, 2, 3};
                tiles += __builtin_reduce_add(row + steps <= last_row ? to - from + 1 : i4(0));
            }
            tile_count.data[g] = tiles;
            ellipse.data[g] = e;
            falloff.data[g] = f;
            colour_depth.data[g][3] = lanes[2][i];
        }
    }
"""
    )
)
def project_lanes(
    first: wp.int32,
    last: wp.int32,
    view: View,
    antialiased: wp.int32,
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    ellipse: wp.array[wp.vec4],
    falloff: wp.array[wp.vec2],
    colour_depth: wp.array[wp.vec4],
    tile_count: wp.array[wp.int64],
):
    """Write everything but the colour of Gaussians ``first`` to ``last`` - 1; see ``project_kernel``."""
    ...


@wp.kernel
def project_block_kernel(
    first_block: wp.int32,
    # In:
    view: View,
    antialiased: wp.int32,
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    sh: wp.array2d[wp.vec3],
    # Out:
    ellipse_out: wp.array[wp.vec4],
    falloff_out: wp.array[wp.vec2],
    colour_depth_out: wp.array[wp.vec4],
    tile_count_out: wp.array[wp.int64],
):
    """Do the work of ``project_kernel`` for ``BLOCK`` Gaussians."""
    first = (wp.tid() + first_block) * BLOCK
    last = wp.min(first + BLOCK, means.shape[0])
    project_lanes(
        first,
        last,
        view,
        antialiased,
        means,
        rotations,
        log_scales,
        opacity_logits,
        ellipse_out,
        falloff_out,
        colour_depth_out,
        tile_count_out,
    )
    for g in range(first, last):
        tiles = tile_count_out[g]
        if tiles > wp.int64(0) and tiles < NOT_FINITE:
            direction = wp.vec3()
            if sh.shape[1] > 1:
                direction = wp.normalize(means[g] - view.centre)
            colour = sh_sum(sh, g, sh.shape[1], direction)
            if not wp.isfinite(colour):
                tile_count_out[g] = NOT_FINITE
            colour_depth_out[g] = colour_and_depth(colour, colour_depth_out[g][3])
