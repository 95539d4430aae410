"""C++ source code of the screen covariances of sixteen Gaussians at a time on a CPU, with the equations of
``projection``.

The projection and its backward pass use this code.
"""

from egs_warp.kernels.render.ellipse import LOW_PASS
from egs_warp.kernels.render.vector_math import EXP_AND_LOG

SCREEN_COVARIANCES = (
    f"    constexpr float LOW_PASS = {float(LOW_PASS)}f;"
    + EXP_AND_LOG
    + """
    auto R = [&](int i, int j) -> float { return view.rotation.data[i][j]; };
    auto clamp = [](f16 x, float low, float high) -> f16 { return x < low ? f16(low) : (x > high ? f16(high) : x); };
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
        const f16 inverse_z = one / pz, fx = view.fx * inverse_z, fy = view.fy * inverse_z;
        const f16 slope_x = px * inverse_z, slope_y = py * inverse_z;
        const f16 tx = clamp(slope_x, view.slope_low[0], view.slope_high[0]);
        const f16 ty = clamp(slope_y, view.slope_low[1], view.slope_high[1]);
        f16 scale[3], forward[3], axis_x[3], axis_y[3], row_x[3], row_y[3];
        for (int k = 0; k < 3; ++k) {
            const f16 right = R(0, 0) * turn[0][k] + R(0, 1) * turn[1][k] + R(0, 2) * turn[2][k];
            const f16 down = R(1, 0) * turn[0][k] + R(1, 1) * turn[1][k] + R(1, 2) * turn[2][k];
            forward[k] = R(2, 0) * turn[0][k] + R(2, 1) * turn[1][k] + R(2, 2) * turn[2][k];
            scale[k] = exp_of(lane(7 + k));
            axis_x[k] = fx * (right - tx * forward[k]);
            axis_y[k] = fy * (down - ty * forward[k]);
            row_x[k] = axis_x[k] * scale[k];
            row_y[k] = axis_y[k] * scale[k];
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
"""
)
"""Head of a loop over the Gaussians ``first`` to ``last`` - 1, sixteen at a time from ``base`` on.

The function that uses the head closes the loop. The code needs ``view`` and the arrays of the cloud."""
