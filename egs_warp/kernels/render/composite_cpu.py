"""C++ code of compositing on a CPU: one thread per tile, which processes a block of 8 x 2 pixels at a time.

For each splat, the blocks of a tile that its ellipse reaches are computed for all rows of the tile at once. Blocks
whose pixels are all opaque are skipped. ``vector_math`` defines the vector types.
"""

from egs_warp.kernels.render.ellipse import CUTOFFS_IN_CPP

_SHARED = (
    CUTOFFS_IN_CPP
    + """
    // The run-time compiler reloads literal constants at every use; reading them from memory once avoids that.
    volatile float pool[] = {-LOG2_255, LIMIT, STOP, 0.0f, 1.0f, 2.0f, 3.0f, 4.0f, 5.0f, 6.0f, 7.0f};
    const f16 faintest = pool[0], limit = pool[1], stopped = pool[2], none = pool[3], one = pool[4];
    // Column and row of each pixel in its block. For the rows of a tile, even ones come first, so that the two rows of
    // block k are in places k and k + 8.
    const f16 columns = {pool[3], pool[4], pool[5], pool[6], pool[7], pool[8], pool[9], pool[10],
                         pool[3], pool[4], pool[5], pool[6], pool[7], pool[8], pool[9], pool[10]};
    f16 rows = one;
    rows.lo = none.lo;
    const f16 tile_rows = columns * pool[5] + rows;
    // Position of each block.
    alignas(64) float across[16], down[16];
    for (int block = 0; block < 16; ++block) {
        across[block] = (float)(block & 8);
        down[block] = (float)(2 * (block & 7));
    }
    // Blocks are numbered down the left half of the tile, then down the right one; pixels by blocks. A set bit of open:
    // the block is not yet opaque.
    const int tile_width = width - left < 16 ? width - left : 16;
    const int tile_height = height - top < 16 ? height - top : 16;
    const unsigned inside_rows = 0xFFu >> (8 - (tile_height + 1) / 2);
    unsigned open = tile_width > 0 ? inside_rows | (tile_width > 8 ? inside_rows << 8 : 0u) : 0u;
    auto refresh_open = [&](const float* passing, int stride) {
        for (unsigned to_do = open; to_do != 0; to_do &= to_do - 1) {
            const int block = __builtin_ctz(to_do);
            if (bits_of(*(const f16*)(passing + stride * block) > none) == 0) open &= ~(1u << block);
        }
    };
    auto column_of = [](int i) -> int { return (i >> 7) * 8 + (i & 7); };
    auto row_of = [](int i) -> int { return (i >> 3) & 15; };
    struct Splat {
        float x, y, shear, peak, steep_x, steep_y;
        unsigned blocks;
        wp::vec4 colour_depth;
    };
    constexpr int BATCH = 16;
    Splat batch[BATCH];
"""
)

_EACH_BLOCK = """
        for (int k = 0; k < count; ++k) {
            // The processor cannot predict the number of blocks of a splat, so it is computed well before its use.
            const int id = gaussians.data[begin + k];
            if (begin + k + BATCH < end) {
                const int next_id = gaussians.data[begin + k + BATCH];
                __builtin_prefetch(ellipse.data + next_id);
                __builtin_prefetch(falloff.data + next_id);
                __builtin_prefetch(colour_depth.data + next_id);
                ALSO_PREFETCH
            }
            const wp::vec4 e = ellipse.data[id];
            const wp::vec2 f = falloff.data[id];
            const float x = e[0] - (float)left - 0.5f, y = e[1] - (float)top - 0.5f;
            const f16 dy = tile_rows - y;
            const f16 margin = f[1] + LOG_255 - f[0] * dy * dy;
            const f16 reach = __builtin_elementwise_sqrt((margin > none ? margin : none) * (1.0f / e[2])) + 1.0e-3f;
            const f16 middle = x - e[3] * dy;
            const f16 first = middle - reach, last = middle + reach;
            const i16 inside = margin > -1.0e-3f;
            const unsigned left_rows = bits_of(inside & (first <= 7.0f) & (last >= none));
            const unsigned right_rows = bits_of(inside & (first <= 15.0f) & (last >= 8.0f));
            const unsigned blocks = ((left_rows | left_rows >> 8) & 0xFFu) | ((right_rows << 8 | right_rows) & 0xFF00u);
            // log2 of alpha is peak - steep_y dy^2 - steep_x u^2.
            batch[k] = {x, y, e[3], f[1] * LOG2_E, e[2] * LOG2_E, f[0] * LOG2_E, blocks & open, colour_depth.data[id]};
        }
        for (int k = 0; k < count; ++k) {
            const wp::vec4 c = batch[k].colour_depth;
            const float shear = batch[k].shear, peak = batch[k].peak;
            const float steep_x = batch[k].steep_x, steep_y = batch[k].steep_y;
            const f16 near_x = columns - batch[k].x, near_y = rows - batch[k].y;
            BEFORE_BLOCKS
            for (unsigned to_do = batch[k].blocks; to_do != 0; to_do &= to_do - 1) {
                const int block = __builtin_ctz(to_do);
                f16* const channels = (f16*)pixels + CHANNELS * block;
                const f16 dy = near_y + down[block];
                const f16 u = near_x + across[block] + shear * dy;
                const f16 level = peak - steep_y * dy * dy - steep_x * u * u;
                // Unused where the level is below the faintest; the power is undefined there.
                const f16 whole = __builtin_elementwise_roundeven(level);
                const f16 raw = power_of_two(whole, level - whole);
                const f16 before = channels[PASSING];
                const f16 alpha = ((level >= faintest)ALSO_NEAR) ? (raw < limit ? raw : limit) : none;
                const f16 after = before - before * alpha;
                const i16 stop = after <= stopped;
                const f16 weight = stop ? none : before * alpha;
"""

FORWARD = (
    _SHARED
    + """
    // Transmittance; zero outside the image, negative once a pixel is opaque.
    enum { PASSING, RED, GREEN, BLUE, FAR, BOUND, CHANNELS };
    alignas(64) float pixels[16 * CHANNELS * 16];
    for (int i = 0; i < 256; ++i) {
        const bool inside = column_of(i) < tile_width && row_of(i) < tile_height;
        float* const pixel = pixels + (i >> 4) * 16 * CHANNELS + (i & 15);
        pixel[16 * PASSING] = inside ? 1.0f : 0.0f;
        for (int channel = RED; channel <= FAR; ++channel) pixel[16 * channel] = 0.0f;
        const bool bounded = inside && max_depth.shape[0] > 0;
        const float floor = bounded ? max_depth.data[(top + row_of(i)) * width + left + column_of(i)] : 0.0f;
        pixel[16 * BOUND] = floor > 0.0f ? floor : 3.0e38f;
    }
    for (int begin = start; begin < end && open != 0; begin += BATCH, refresh_open(pixels, 16 * CHANNELS)) {
        const int count = end - begin < BATCH ? end - begin : BATCH;
"""
    + _EACH_BLOCK.replace("ALSO_NEAR", " & (c[3] <= channels[BOUND])")
    .replace("BEFORE_BLOCKS", "")
    .replace("ALSO_PREFETCH", "")
    + """
                channels[PASSING] = stop ? -__builtin_elementwise_abs(before) : after;
                channels[RED] += weight * c[0];
                channels[GREEN] += weight * c[1];
                channels[BLUE] += weight * c[2];
                channels[FAR] += weight * c[3];
            }
        }
    }
    for (int row = 0; row < tile_height; ++row)
        for (int column = 0; column < tile_width; ++column) {
            const int i = (column >> 3) * 128 + row * 8 + (column & 7), pixel = (top + row) * width + left + column;
            const float* const from = pixels + (i >> 4) * 16 * CHANNELS + (i & 15);
            const float signed_through = from[16 * PASSING];
            const float through = signed_through < 0.0f ? -signed_through : signed_through;
            const wp::vec3 behind = background.shape[0] > 0 ? background.data[pixel] : flat_background;
            colour.data[pixel] = wp::vec3(
                from[16 * RED] + through * behind[0],
                from[16 * GREEN] + through * behind[1],
                from[16 * BLUE] + through * behind[2]
            );
            alpha_out.data[pixel] = 1.0f - through;
            depth.data[pixel] = through < 1.0f ? from[16 * FAR] / (1.0f - through) : 0.0f;
        }
"""
)

BACKWARD = (
    _SHARED
    + """
    enum { PASSING, REST, RED, GREEN, BLUE, FAR, CHANNELS };
    alignas(64) float pixels[16 * CHANNELS * 16];
    for (int i = 0; i < 256; ++i) {
        const bool inside = column_of(i) < tile_width && row_of(i) < tile_height;
        const int pixel = inside ? (top + row_of(i)) * width + left + column_of(i) : 0;
        const wp::vec4 g = sum_gradient.data[pixel];
        float* const to = pixels + (i >> 4) * 16 * CHANNELS + (i & 15);
        to[16 * PASSING] = inside ? 1.0f : 0.0f;
        to[16 * REST] = remaining.data[pixel];
        for (int k = 0; k < 4; ++k) to[16 * (RED + k)] = g[k];
    }
    // Partial sums: places 0 and 1 sum to the sum of a, 2 and 3 to c, 4 and 5 to b, 6 and 7 to d.
    auto sums_of_four = [](f8 a, f8 b, f8 c, f8 d) -> f8 {
        const f8 p = __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11)
            + __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
        const f8 q = __builtin_shufflevector(c, d, 0, 1, 2, 3, 8, 9, 10, 11)
            + __builtin_shufflevector(c, d, 4, 5, 6, 7, 12, 13, 14, 15);
        return __builtin_shufflevector(p, q, 0, 1, 8, 9, 4, 5, 12, 13)
            + __builtin_shufflevector(p, q, 2, 3, 10, 11, 6, 7, 14, 15);
    };
    auto out_of = [&](int i) -> float* { return (float*)moments.data + 12 * (size_t)slots.data[i]; };
    int begin = start;
    for (; begin < end && open != 0; begin += BATCH, refresh_open(pixels, 16 * CHANNELS)) {
        const int count = end - begin < BATCH ? end - begin : BATCH;
"""
    + _EACH_BLOCK.replace("ALSO_NEAR", "")
    .replace("BEFORE_BLOCKS", "f16 sums[10] = {};")
    .replace(
        "ALSO_PREFETCH",
        """const float* const next_out = out_of(begin + k + BATCH);
                __builtin_prefetch(next_out, 1);
                __builtin_prefetch(next_out + 11, 1);""",
    )
    + """
                channels[PASSING] = stop ? none : after;
                const f16 red = channels[RED], green = channels[GREEN], blue = channels[BLUE];
                const f16 far = channels[FAR];
                const f16 value = c[0] * red + c[1] * green + c[2] * blue + c[3] * far;
                const f16 behind = channels[REST] - weight * value;
                channels[REST] = behind;
                const f16 free = alpha * (before * value - behind / (one - alpha));
                const f16 slope = ((weight > none) & (raw <= limit)) ? free : none;
                const f16 moment = slope * u, moment_y = slope * dy;
                sums[0] += slope;
                sums[1] += moment;
                sums[2] += moment_y;
                sums[3] += moment * u;
                sums[4] += moment * dy;
                sums[5] += moment_y * dy;
                sums[6] += weight * far;
                sums[7] += weight * red;
                sums[8] += weight * green;
                sums[9] += weight * blue;
            }
            float* out = out_of(begin + k);
            f8 eight[12] = {};
            for (int q = 0; q < 10; ++q) eight[q + (q >= 7 ? 1 : 0)] = sums[q].lo + sums[q].hi;
            const f8 low = sums_of_four(eight[0], eight[4], eight[1], eight[5]);
            const f8 high = sums_of_four(eight[2], eight[6], eight[3], eight[7]);
            const f8 third = sums_of_four(eight[8], eight[10], eight[9], eight[11]);
            // Transposed pairs are added last.
            const f8 first_rows = __builtin_shufflevector(low, high, 0, 2, 8, 10, 4, 6, 12, 14)
                + __builtin_shufflevector(low, high, 1, 3, 9, 11, 5, 7, 13, 15);
            const f4 third_row = __builtin_shufflevector(third, third, 0, 2, 4, 6)
                + __builtin_shufflevector(third, third, 1, 3, 5, 7);
            __builtin_memcpy(out, &first_rows, sizeof(first_rows));
            __builtin_memcpy(out + 8, &third_row, sizeof(third_row));
        }
    }
    for (; begin < end; ++begin) {
        if (begin + BATCH < end) __builtin_prefetch(out_of(begin + BATCH), 1);
        for (int q = 0; q < 12; ++q) out_of(begin)[q] = 0.0f;
    }
"""
)
