"""The C++ of compositing on a CPU: one thread for a tile, eight pixels of a row at a time.

Only rows and half rows inside the ellipse are visited, without branches in between, so that the compiler makes vector
code of them; it does not of the same loop written in Warp's Python, which took about four times as long.
"""

from egs_warp.kernels.render.ellipse import CUTOFFS_IN_CPP

_SHARED = f"""
    #pragma clang fp contract(fast){CUTOFFS_IN_CPP}"""
_SHARED += """
    const int tile_width = width - left < 16 ? width - left : 16;
    const int tile_height = height - top < 16 ? height - top : 16;
    // Pixels not yet full, by eights.
    int open_in_half[32];
    for (int i = 0; i < 32; ++i) {
        const int columns = tile_width - 8 * (i & 1);
        open_in_half[i] = (i >> 1) < tile_height && columns > 0 ? (columns < 8 ? columns : 8) : 0;
    }
    // e^x for x <= 0 to 2e-7: 2^whole times a polynomial for 2^part, part in (-1, 0].
    auto exponential = [](float x) -> float {
        #pragma clang fp contract(fast)
        float t = x * 1.4426950408889634f;
        t = t < -100.0f ? -100.0f : t;
        const int whole = (int)t;
        const float part = t - (float)whole;
        float p = 1.5403530e-4f;
        p = p * part + 1.3333558e-3f;
        p = p * part + 9.6181291e-3f;
        p = p * part + 5.5504109e-2f;
        p = p * part + 2.4022651e-1f;
        p = p * part + 6.9314718e-1f;
        p = p * part + 1.0f;
        const int bits = (whole + 127) << 23;
        float power;
        __builtin_memcpy(&power, &bits, 4);
        return p * power;
    };
"""

_EACH_PIXEL = """
        const wp::vec4 e = ellipse.data[id];
        const wp::vec2 f = falloff.data[id];
        const wp::vec4 c = colour_depth.data[id];
        const float x = e[0] - (float)left - 0.5f, y = e[1] - (float)top - 0.5f;
        const float a = e[2], cut = f[1] + LOG_255;
        const float reach = __builtin_sqrtf(cut / f[0]);
        const float highest = y - reach, lowest = y + reach;
        const int row_first = highest > 0.0f ? (int)__builtin_ceilf(highest < 16.0f ? highest : 16.0f) : 0;
        const int row_last = lowest < (float)(tile_height - 1) ? (int)__builtin_floorf(lowest < -1.0f ? -1.0f : lowest)
                                                               : tile_height - 1;
        for (int row = row_first; row <= row_last; ++row) {
            const float dy = (float)row - y;
            const float at_row = f[1] - f[0] * dy * dy;
            const float room = at_row + LOG_255;
            const float half_width = __builtin_sqrtf((room > 0.0f ? room : 0.0f) / a) + 1.0e-3f;
            const float middle = x - e[3] * dy;
            const float leftmost = middle - half_width, rightmost = middle + half_width;
            if (rightmost < 0.0f || leftmost > 15.0f) continue;
            const int half_first = leftmost <= 7.0f ? 0 : 1;
            const int half_last = rightmost >= 8.0f ? 1 : 0;
            for (int half = half_first; half <= half_last; ++half) {
                if (open_in_half[2 * row + half] == 0) continue;
                const int at = row * 16 + half * 8;
                const float origin = (float)(half * 8) - middle;
                int closed = 0;
                #pragma clang loop vectorize(enable)
                for (int k = 0; k < 8; ++k) {
                    const float u = origin + (float)k;
                    const float raw = exponential(at_row - a * u * u);
                    const float alpha = raw < LIMIT ? raw : LIMIT;
                    const float before = passing[at + k];
                    const float after = before * (1.0f - alpha);
                    const int hit = (alpha >= CUT) & (before > 0.0f);
                    const int stop = hit & (after <= STOP);
"""

_PIXELS_DONE = """
                }
                open_pixels -= closed;
                open_in_half[2 * row + half] -= closed;
            }
        }
"""

FORWARD = (
    _SHARED
    + """
    // Transmittance; zero outside of the image, negative once a pixel is full.
    alignas(64) float passing[256], red[256], green[256], blue[256], far[256];
    for (int i = 0; i < 256; ++i) {
        passing[i] = (i & 15) < tile_width && (i >> 4) < tile_height ? 1.0f : 0.0f;
        red[i] = green[i] = blue[i] = far[i] = 0.0f;
    }
    int open_pixels = tile_width * tile_height;
    for (int i = start; i < end && open_pixels > 0; ++i) {
        const int id = gaussians.data[i];
"""
    + _EACH_PIXEL
    + """
                    const float weight = (hit & !stop) ? before * alpha : 0.0f;
                    passing[at + k] = stop ? -before : (hit ? after : before);
                    closed += stop;
                    red[at + k] += weight * c[0];
                    green[at + k] += weight * c[1];
                    blue[at + k] += weight * c[2];
                    far[at + k] += weight * c[3];
"""
    + _PIXELS_DONE
    + """
    }
    for (int row = 0; row < tile_height; ++row)
        for (int column = 0; column < tile_width; ++column) {
            const int i = row * 16 + column, pixel = (top + row) * width + left + column;
            const float through = passing[i] < 0.0f ? -passing[i] : passing[i];
            const wp::vec3 behind = background.shape[0] > 0 ? background.data[pixel] : flat_background;
            colour.data[pixel] = wp::vec3(
                red[i] + through * behind[0], green[i] + through * behind[1], blue[i] + through * behind[2]
            );
            alpha_out.data[pixel] = 1.0f - through;
            depth.data[pixel] = through < 1.0f ? far[i] / (1.0f - through) : 0.0f;
        }
"""
)

BACKWARD = (
    _SHARED
    + """
    alignas(64) float passing[256], rest[256], by_red[256], by_green[256], by_blue[256], by_far[256];
    for (int i = 0; i < 256; ++i) {
        const bool inside = (i & 15) < tile_width && (i >> 4) < tile_height;
        const int pixel = inside ? (top + (i >> 4)) * width + left + (i & 15) : 0;
        const wp::vec4 g = sum_gradient.data[pixel];
        passing[i] = inside ? 1.0f : 0.0f;
        rest[i] = remaining.data[pixel];
        by_red[i] = g[0];
        by_green[i] = g[1];
        by_blue[i] = g[2];
        by_far[i] = g[3];
    }
    int open_pixels = tile_width * tile_height;
    for (int i = start; i < end; ++i) {
        float* out = (float*)moments.data + 12 * (size_t)slots.data[i];
        if (open_pixels == 0) {
            for (int q = 0; q < 12; ++q) out[q] = 0.0f;
            continue;
        }
        const int id = gaussians.data[i];
        alignas(64) float sums[10][8] = {};
"""
    + _EACH_PIXEL
    + """
                    const int drawn = hit & !stop;
                    const float weight = drawn ? before * alpha : 0.0f;
                    passing[at + k] = stop ? 0.0f : (hit ? after : before);
                    closed += stop;
                    const float value = c[0] * by_red[at + k] + c[1] * by_green[at + k] + c[2] * by_blue[at + k]
                                        + c[3] * by_far[at + k];
                    const float left_over = rest[at + k] - weight * value;
                    rest[at + k] = left_over;
                    const float free = alpha * (before * value - left_over / (1.0f - alpha));
                    const float slope = (drawn & (raw <= LIMIT)) ? free : 0.0f;
                    const float moment = slope * u;
                    sums[0][k] += slope;
                    sums[1][k] += moment;
                    sums[2][k] += slope * dy;
                    sums[3][k] += moment * u;
                    sums[4][k] += moment * dy;
                    sums[5][k] += slope * dy * dy;
                    sums[6][k] += weight * by_far[at + k];
                    sums[7][k] += weight * by_red[at + k];
                    sums[8][k] += weight * by_green[at + k];
                    sums[9][k] += weight * by_blue[at + k];
"""
    + _PIXELS_DONE
    + """
        for (int q = 0; q < 10; ++q) {
            float total = 0.0f;
            for (int k = 0; k < 8; ++k) total += sums[q][k];
            // Entry 7 is padding.
            out[q + (q >= 7 ? 1 : 0)] = total;
        }
    }
"""
)
