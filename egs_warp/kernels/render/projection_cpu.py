"""Projection on a CPU, for sixteen Gaussians at a time, with the equations of ``projection.project_kernel``.

Host code: ``egs_warp/render/projection.py``.
"""

import warp as wp

from egs_warp.kernels.render.covariance_cpu import SCREEN_COVARIANCES
from egs_warp.kernels.render.ellipse import CUTOFFS_IN_CPP
from egs_warp.kernels.render.projection import NOT_FINITE, View, colour_and_depth
from egs_warp.kernels.render.spherical_harmonics import sh_sum
from egs_warp.kernels.render.vector_math import TILE_SPANS, on_cpu

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(64)
"""Number of Gaussians that one thread of a launch processes."""


@wp.func_native(
    on_cpu(
        f"    constexpr long long NOT_FINITE = {int(NOT_FINITE)};"
        + CUTOFFS_IN_CPP
        + "    const int width = view.width, height = view.height;"
        + TILE_SPANS
        + SCREEN_COVARIANCES
        + """
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
    """Write all outputs of ``project_kernel`` except the colour for the Gaussians ``first`` to ``last`` - 1."""
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
    """Compute the outputs of ``project_kernel`` for ``BLOCK`` Gaussians per thread."""
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
