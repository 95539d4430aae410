"""C++ code of compositing on a CPU: one thread per tile, eight pixels of a row at a time.

It uses vectors of eight floats, which Clang maps to the SIMD instructions of the processor. The half rows of a tile
that an ellipse reaches are computed for eight rows at once. Half rows whose pixels are all opaque are skipped.
"""

from egs_warp.kernels.render.ellipse import CUTOFFS_IN_CPP

_SHARED = f"""
    #pragma clang fp contract(fast){CUTOFFS_IN_CPP}"""
_SHARED += """
    typedef float f8 __attribute__((ext_vector_type(8)));
    typedef int i8 __attribute__((ext_vector_type(8)));
    typedef bool b8 __attribute__((ext_vector_type(8)));
    constexpr float LOG2_E = 1.4426950408889634f;
    // The run-time compiler reloads literal constants at every use; reading them from memory once avoids that.
    volatile float pool[] = {-100.0f, 1.32764720e-3f, 9.67554133e-3f, 5.55071327e-2f, 2.40221197e-1f, 6.93146967e-1f,
                             LIMIT, CUT, STOP, 0.0f, 1.0f, 2.0f, 3.0f, 4.0f, 5.0f, 6.0f, 7.0f};
    const f8 least = pool[0], p5 = pool[1], p4 = pool[2], p3 = pool[3], p2 = pool[4], p1 = pool[5];
    const f8 limit = pool[6], cut = pool[7], stopped = pool[8], none = pool[9], one = pool[10];
    const f8 steps = {pool[9], pool[10], pool[11], pool[12], pool[13], pool[14], pool[15], pool[16]};
    // 2^x for x <= 0 to 8e-8: 2^whole times the polynomial nearest to 2^part, part in [-1/2, 1/2].
    auto power_of_two = [&](f8 x) -> f8 {
        #pragma clang fp contract(fast)
        const f8 t = x > least ? x : least;
        const f8 whole = __builtin_elementwise_roundeven(t);
        const f8 part = t - whole;
        const f8 p = ((((p5 * part + p4) * part + p3) * part + p2) * part + p1) * part + one;
        i8 bits;
        __builtin_memcpy(&bits, &p, 32);
        bits += __builtin_convertvector(whole, i8) << 23;
        f8 power;
        __builtin_memcpy(&power, &bits, 32);
        return power;
    };
    auto bits_of = [](i8 mask) -> unsigned {
        const b8 set = __builtin_convertvector(mask, b8);
        unsigned char bits;
        __builtin_memcpy(&bits, &set, 1);
        return bits;
    };
    // Half rows are numbered down the left half, then down the right one; pixels by half rows. A set bit of open: the
    // half row is not yet opaque.
    const int tile_width = width - left < 16 ? width - left : 16;
    const int tile_height = height - top < 16 ? height - top : 16;
    const unsigned inside_rows = 0xFFFFu >> (16 - tile_height);
    unsigned open = inside_rows | (tile_width > 8 ? inside_rows << 16 : 0u);
    auto column_of = [](int i) -> int { return (i >> 7) * 8 + (i & 7); };
    auto row_of = [](int i) -> int { return (i >> 3) & 15; };
"""

_EACH_HALF = """
        if (i + 8 < end) {
            const int next_id = gaussians.data[i + 8];
            __builtin_prefetch(ellipse.data + next_id);
            __builtin_prefetch(falloff.data + next_id);
            __builtin_prefetch(colour_depth.data + next_id);
        }
        const wp::vec4 e = ellipse.data[id];
        const wp::vec2 f = falloff.data[id];
        const wp::vec4 c = colour_depth.data[id];
        const float x = e[0] - (float)left - 0.5f, y = e[1] - (float)top - 0.5f;
        const float steep = e[2] * LOG2_E, over_a = 1.0f / e[2];
        // begins: start of each half row relative to the ellipse's centre there. tops: log2 of alpha there, per row.
        alignas(32) float begins[32], tops[16], down[16];
        unsigned reached = 0;
        for (int rows = 0; rows < 16; rows += 8) {
            const f8 dy = steps + ((float)rows - y);
            const f8 at_row = f[1] - f[0] * dy * dy;
            const f8 margin = at_row + LOG_255;
            const f8 reach = __builtin_elementwise_sqrt((margin > none ? margin : none) * over_a) + 1.0e-3f;
            const f8 middle = x - e[3] * dy;
            const f8 first = middle - reach, last = middle + reach;
            const i8 level = margin > -1.0e-3f;
            reached |= bits_of(level & (first <= 7.0f) & (last >= none)) << rows;
            reached |= bits_of(level & (first <= 15.0f) & (last >= 8.0f)) << (16 + rows);
            *(f8*)(begins + rows) = -middle;
            *(f8*)(begins + 16 + rows) = 8.0f - middle;
            *(f8*)(tops + rows) = at_row * LOG2_E;
            *(f8*)(down + rows) = dy;
        }
        for (unsigned to_do = reached & open; to_do != 0; to_do &= to_do - 1) {
            const int half = __builtin_ctz(to_do), at = 8 * half;
            const f8 u = steps + begins[half];
            const f8 raw = power_of_two(tops[half & 15] - steep * u * u);
            const f8 alpha = raw < limit ? raw : limit;
            const f8 before = *(f8*)(passing + at);
            const f8 after = before * (one - alpha);
            const i8 hit = (alpha >= cut) & (before > none)ALSO_NEAR;
            const i8 stop = hit & (after <= stopped);
"""

FORWARD = (
    _SHARED
    + """
    // Transmittance; zero outside the image, negative once a pixel is opaque.
    alignas(64) float passing[256], red[256], green[256], blue[256], far[256], bound[256];
    for (int i = 0; i < 256; ++i) {
        const bool inside = column_of(i) < tile_width && row_of(i) < tile_height;
        passing[i] = inside ? 1.0f : 0.0f;
        red[i] = green[i] = blue[i] = far[i] = 0.0f;
        const bool bounded = inside && max_depth.shape[0] > 0;
        const float floor = bounded ? max_depth.data[(top + row_of(i)) * width + left + column_of(i)] : 0.0f;
        bound[i] = floor > 0.0f ? floor : 3.0e38f;
    }
    for (int i = start; i < end && open != 0; ++i) {
        const int id = gaussians.data[i];
"""
    + _EACH_HALF.replace("ALSO_NEAR", " & (c[3] <= *(f8*)(bound + at))")
    + """
            const f8 weight = (hit & ~stop) ? before * alpha : none;
            const f8 left_over = stop ? -before : (hit ? after : before);
            *(f8*)(passing + at) = left_over;
            *(f8*)(red + at) += weight * c[0];
            *(f8*)(green + at) += weight * c[1];
            *(f8*)(blue + at) += weight * c[2];
            *(f8*)(far + at) += weight * c[3];
            if (__builtin_reduce_or(stop) && !__builtin_reduce_or(left_over > none)) open &= ~(1u << half);
        }
    }
    for (int row = 0; row < tile_height; ++row)
        for (int column = 0; column < tile_width; ++column) {
            const int i = (column >> 3) * 128 + row * 8 + (column & 7), pixel = (top + row) * width + left + column;
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
        const bool inside = column_of(i) < tile_width && row_of(i) < tile_height;
        const int pixel = inside ? (top + row_of(i)) * width + left + column_of(i) : 0;
        const wp::vec4 g = sum_gradient.data[pixel];
        passing[i] = inside ? 1.0f : 0.0f;
        rest[i] = remaining.data[pixel];
        by_red[i] = g[0];
        by_green[i] = g[1];
        by_blue[i] = g[2];
        by_far[i] = g[3];
    }
    for (int i = start; i < end; ++i) {
        float* out = (float*)moments.data + 12 * (size_t)slots.data[i];
        if (open == 0) {
            for (int q = 0; q < 12; ++q) out[q] = 0.0f;
            continue;
        }
        const int id = gaussians.data[i];
        f8 sums[10] = {};
"""
    + _EACH_HALF.replace("ALSO_NEAR", "")
    + """
            const i8 blended = hit & ~stop;
            const f8 weight = blended ? before * alpha : none;
            const f8 left_over = stop ? none : (hit ? after : before);
            *(f8*)(passing + at) = left_over;
            const f8 red = *(f8*)(by_red + at), green = *(f8*)(by_green + at), blue = *(f8*)(by_blue + at);
            const f8 far = *(f8*)(by_far + at);
            const f8 value = c[0] * red + c[1] * green + c[2] * blue + c[3] * far;
            const f8 behind = *(f8*)(rest + at) - weight * value;
            *(f8*)(rest + at) = behind;
            const f8 free = alpha * (before * value - behind / (one - alpha));
            const f8 slope = (blended & (raw <= limit)) ? free : none;
            const f8 moment = slope * u;
            const float dy = down[half & 15];
            sums[0] += slope;
            sums[1] += moment;
            sums[2] += slope * dy;
            sums[3] += moment * u;
            sums[4] += moment * dy;
            sums[5] += slope * dy * dy;
            sums[6] += weight * far;
            sums[7] += weight * red;
            sums[8] += weight * green;
            sums[9] += weight * blue;
            if (__builtin_reduce_or(stop) && !__builtin_reduce_or(left_over > none)) open &= ~(1u << half);
        }
        for (int q = 0; q < 10; ++q) {
            const auto four = sums[q].lo + sums[q].hi;
            const auto two = four.lo + four.hi;
            // Entry 7 is padding.
            out[q + (q >= 7 ? 1 : 0)] = two[0] + two[1];
        }
    }
"""
)
