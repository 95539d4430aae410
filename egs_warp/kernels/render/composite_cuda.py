"""CUDA C++ code of compositing: one block of 256 threads per tile, and one warp for each of the eight 8 x 4 pixel parts
of the tile.

Splats pass through shared memory in batches. The thread that loads a splat also computes which of the eight parts its
ellipse reaches, and each warp then visits only the splats that reach its part. The code is CUDA C++ because Warp's tile
functions offer neither ballots nor per-warp control flow. Warp compiles it at run time like every other kernel.
"""

from egs_warp.kernels.render.ellipse import CUTOFFS_IN_CPP, SEGMENT

# With a and v in units of log2 e, alpha = exp2(log2 opacity - a u^2 - v dy^2).
_SHARED = CUTOFFS_IN_CPP + f"    constexpr int SEGMENT = {int(SEGMENT)};\n"
_SHARED += """
    constexpr float LOG2_E = 1.4426950408889634f;
    // Bit mask of the eight parts (two columns by four rows of 8 x 4 pixels) that an ellipse reaches.
    auto parts_of = [](float mx, float my, float a, float shear, float v, float cut) -> unsigned {
        // mx, my relative to the first pixel centre of the tile.
        unsigned mask = 0;
        float tip = shear * sqrtf(cut * a / (v * (v + a * shear * shear)));
        float inv_a = 1.0f / a;
        #pragma unroll
        for (int row = 0; row < 4; ++row) {
            float top = 4.0f * row - my, bottom = top + 3.0f;
            float nearest = fminf(fmaxf(0.0f, top), bottom);
            if (v * nearest * nearest <= cut) {
                float dr = fminf(fmaxf(-tip, top), bottom), dl = fminf(fmaxf(tip, top), bottom);
                float right = mx - shear * dr + sqrtf(fmaxf(cut - v * dr * dr, 0.0f) * inv_a) + 1.0e-3f;
                float left = mx - shear * dl - sqrtf(fmaxf(cut - v * dl * dl, 0.0f) * inv_a) - 1.0e-3f;
                if (left <= 7.0f && right >= 0.0f) mask |= 1u << (2 * row);
                if (left <= 15.0f && right >= 8.0f) mask |= 2u << (2 * row);
            }
        }
        return mask;
    };
"""

# All splats of the tile pass through shared memory in batches of 256; ``group`` iterates over a batch in steps of 32.
_BATCHES = """
    __shared__ float4 s_shape[256];
    __shared__ float4 s_colour[256];
    __shared__ float2 s_falloff[256];
    __shared__ unsigned char s_parts[256];
    const int thread = threadIdx.x, lane = thread & 31, part = thread >> 5;
    const int part_x = (part & 1) * 8, part_y = (part >> 1) * 4;
    const float px = (float)(part_x + (lane & 7)), py = (float)(part_y + (lane >> 3));
    const bool inside = left + (int)px < width && top + (int)py < height;
    const float4* shapes = (const float4*)ellipse.data;
    const float2* falloffs = (const float2*)falloff.data;
    const float4* colours = (const float4*)colour_depth.data;
    auto log2_alpha = [&](int k) -> float {
        const float4 shape = s_shape[k];
        const float2 f = s_falloff[k];
        const float dy = py - shape.y;
        const float u = fmaf(shape.w, dy, px - shape.x);
        return f.y - f.x * dy * dy - shape.z * u * u;
    };
    bool open = inside;
    ALSO_START
    // The loads of the next batch are in flight while this one is blended.
    float4 next_shape, next_colour;
    float2 next_falloff;
    auto fetch = [&](int i) {
        if (i < end) {
            const int id = gaussians.data[i];
            next_shape = __ldg(shapes + id);
            next_falloff = __ldg(falloffs + id);
            next_colour = __ldg(colours + id);
            ALSO_FETCH
        }
    };
    fetch(start + thread);
    int base = start;
    for (; base < end; base += 256) {
        if (__syncthreads_count(open) == 0) break;
        ALSO_BATCH
        unsigned parts = 0;
        if (base + thread < end) {
            float4 shape = next_shape;
            shape.x -= (float)left + 0.5f;
            shape.y -= (float)top + 0.5f;
            shape.z *= LOG2_E;
            const float v = next_falloff.x * LOG2_E, log_opacity = next_falloff.y * LOG2_E;
            parts = parts_of(shape.x, shape.y, shape.z, shape.w, v, log_opacity + LOG2_255);
            s_shape[thread] = shape;
            s_colour[thread] = next_colour;
            ALSO_STORE
            s_falloff[thread] = make_float2(v, log_opacity);
        }
        s_parts[thread] = (unsigned char)parts;
        __syncthreads();
        fetch(base + 256 + thread);
        const int batch = min(256, end - base);
        for (int group = 0; group < batch; group += 32) {
"""


def _batches(*, also_start: str, also_batch: str = "", also_fetch: str = "", also_store: str = "") -> str:
    code = _BATCHES.replace("ALSO_START", also_start).replace("ALSO_BATCH", also_batch)
    return code.replace("ALSO_FETCH", also_fetch).replace("ALSO_STORE", also_store)


_BOUND = """float bound = 3.0e38f;
    if (inside && max_depth.shape[0] > 0) {
        const float floor = max_depth.data[(top + (int)py) * width + left + (int)px];
        if (floor > 0.0f) bound = floor;
    }"""

# The state before each later segment of the tile's splats, from which a block of the backward pass starts.
_SAVE = """
    auto save_before = [&](int at) {
        if (checkpoint_passing.shape[0] == 0 || at == start || (at - start) % SEGMENT != 0) return;
        const size_t i = (size_t)(start / SEGMENT + (at - start) / SEGMENT) * 256 + thread;
        ((float4*)checkpoint_sums.data)[i] = make_float4(r, g, b, d);
        checkpoint_passing.data[i] = open ? passing : 0.0f;
    };"""


FORWARD = (
    _SHARED
    + """
    float passing = 1.0f, r = 0.0f, g = 0.0f, b = 0.0f, d = 0.0f;
"""
    + _batches(also_start=_BOUND + _SAVE, also_batch="save_before(base);")
    + """
            if (!__any_sync(0xffffffffu, open)) break;
            unsigned mine_here = __ballot_sync(0xffffffffu, (s_parts[group + lane] >> part) & 1u);
            while (mine_here) {
                // The alphas of four splats are computed together, which hides the latency of each step.
                int chosen[4];
                float alphas[4];
                #pragma unroll
                for (int i = 0; i < 4; ++i) {
                    const bool real = mine_here != 0;
                    const int k = real ? group + __ffs(mine_here) - 1 : group;
                    mine_here &= mine_here - 1;
                    chosen[i] = k;
                    alphas[i] = real ? fminf(exp2f(log2_alpha(k)), LIMIT) : 0.0f;
                }
                #pragma unroll
                for (int i = 0; i < 4; ++i) {
                    const float alpha = alphas[i];
                    const float after = passing * (1.0f - alpha);
                    const float4 c = s_colour[chosen[i]];
                    if (open && alpha >= CUT && c.w <= bound) {
                        if (after <= STOP) {
                            open = false;
                        } else {
                            const float weight = passing * alpha;
                            r = fmaf(weight, c.x, r);
                            g = fmaf(weight, c.y, g);
                            b = fmaf(weight, c.z, b);
                            d = fmaf(weight, c.w, d);
                            passing = after;
                        }
                    }
                }
            }
        }
    }
    for (; base < end; base += 256) save_before(base);
    if (inside) {
        const int pixel = (top + (int)py) * width + left + (int)px;
        const wp::vec3 behind = background.shape[0] > 0 ? background.data[pixel] : flat_background;
        const float opaque = 1.0f - passing;
        colour.data[pixel] =
            wp::vec3(fmaf(passing, behind[0], r), fmaf(passing, behind[1], g), fmaf(passing, behind[2], b));
        alpha_out.data[pixel] = opaque;
        depth.data[pixel] = opaque > 0.0f ? d / opaque : 0.0f;
    }
"""
)

BACKWARD = (
    _SHARED
    + """
    __shared__ int s_slot[256];
    __shared__ float4 s_gradient[256];
    __shared__ float s_k[8][8][33];       // warp, splat of eight, pixel: alpha dL/dalpha
    __shared__ float s_weight[8][8][33];  // and blending weight
    __shared__ int s_chosen[8][8];
    __shared__ float s_sum[8][32][11];    // warp, splat of 32, quantity
    __shared__ unsigned s_visited[8];
    float* out = (float*)moments.data;
    float passing = passing_before, rest = remaining;
    const float4 gradient = make_float4(sum_gradient[0], sum_gradient[1], sum_gradient[2], sum_gradient[3]);
    s_gradient[threadIdx.x] = gradient;
    int next_slot;
"""
    + _batches(
        also_start="open = open && passing > 0.0f;",
        also_fetch="next_slot = slots.data[i];",
        also_store="s_slot[thread] = next_slot;",
    )
    + """
            unsigned todo = __ballot_sync(0xffffffffu, (s_parts[group + lane] >> part) & 1u);
            unsigned visited = 0;
            while (todo && __any_sync(0xffffffffu, open)) {
                int chosen = 0;
                // The alphas of two splats are computed together, as in the forward pass.
                while (todo && chosen < 7) {
                    int pair[2];
                    float raw[2];
                    #pragma unroll
                    for (int i = 0; i < 2; ++i) {
                        const bool real = todo != 0;
                        const int k = real ? __ffs(todo) - 1 : 0;
                        todo &= todo - 1;
                        pair[i] = k;
                        raw[i] = real ? exp2f(log2_alpha(group + k)) : 0.0f;
                    }
                    #pragma unroll
                    for (int i = 0; i < 2; ++i) {
                        const int k = pair[i];
                        const float unbounded = raw[i];
                        const float alpha = fminf(unbounded, LIMIT);
                        const float after = passing * (1.0f - alpha);
                        float slope = 0.0f, weight = 0.0f;
                        if (open && alpha >= CUT) {
                            if (after <= STOP) {
                                open = false;
                            } else {
                                const float4 c = s_colour[group + k];
                                const float value =
                                    c.x * gradient.x + c.y * gradient.y + c.z * gradient.z + c.w * gradient.w;
                                weight = passing * alpha;
                                rest -= weight * value;
                                if (unbounded <= LIMIT) slope = alpha * (passing * value - rest / (1.0f - alpha));
                                passing = after;
                            }
                        }
                        if (__any_sync(0xffffffffu, weight > 0.0f)) {
                            s_k[part][chosen][lane] = slope;
                            s_weight[part][chosen][lane] = weight;
                            if (lane == 0) s_chosen[part][chosen] = k;
                            visited |= 1u << k;
                            ++chosen;
                        }
                    }
                }
                __syncwarp();
                // Four lanes process a splat, one for each row of eight pixels.
                const int splat = lane >> 2, row = lane & 3;
                float q[10];
                #pragma unroll
                for (int i = 0; i < 10; ++i) q[i] = 0.0f;
                if (splat < chosen) {
                    const float4 shape = s_shape[group + s_chosen[part][splat]];
                    const float dy = (float)(part_y + row) - shape.y;
                    const float u = fmaf(shape.w, dy, (float)part_x - shape.x);
                    float by_column = 0.0f, by_square = 0.0f;
                    #pragma unroll
                    for (int i = 0; i < 8; ++i) {
                        const float k = s_k[part][splat][row * 8 + i];
                        const float w = s_weight[part][splat][row * 8 + i];
                        const float4 by = s_gradient[part * 32 + row * 8 + i];
                        q[0] += k;
                        by_column = fmaf(k, (float)i, by_column);
                        by_square = fmaf(k, (float)(i * i), by_square);
                        q[6] = fmaf(w, by.w, q[6]);
                        q[7] = fmaf(w, by.x, q[7]);
                        q[8] = fmaf(w, by.y, q[8]);
                        q[9] = fmaf(w, by.z, q[9]);
                    }
                    // The pixels of a row are at u, u + 1, ...
                    q[1] = fmaf(u, q[0], by_column);
                    q[3] = fmaf(u, q[1] + by_column, by_square);
                    q[2] = q[0] * dy;
                    q[4] = q[1] * dy;
                    q[5] = q[2] * dy;
                }
                // Each of the four lanes ends with the sums of the quantities row, row + 4 and row + 8.
                const bool odd = row & 1, high = row & 2;
                float half[5], whole[3];
                #pragma unroll
                for (int i = 0; i < 5; ++i) {
                    const float other = __shfl_xor_sync(0xffffffffu, odd ? q[2 * i] : q[2 * i + 1], 1);
                    half[i] = (odd ? q[2 * i + 1] : q[2 * i]) + other;
                }
                #pragma unroll
                for (int i = 0; i < 3; ++i) {
                    const float last = i < 2 ? half[2 * i + 1] : 0.0f;
                    const float other = __shfl_xor_sync(0xffffffffu, high ? half[2 * i] : last, 2);
                    whole[i] = (high ? last : half[2 * i]) + other;
                }
                if (splat < chosen) {
                    float* sum = s_sum[part][s_chosen[part][splat]];
                    sum[row] = whole[0];
                    sum[row + 4] = whole[1];
                    if (!high) sum[row + 8] = whole[2];
                }
                __syncwarp();
            }
            if (lane == 0) s_visited[part] = visited;
            __syncthreads();
            const int splats = min(32, batch - group);
            for (int i = thread; i < splats * 10; i += 256) {
                const int k = i / 10, quantity = i - 10 * k;
                float total = 0.0f;
                #pragma unroll
                for (int p = 0; p < 8; ++p)
                    if ((s_visited[p] >> k) & 1u) total += s_sum[p][k][quantity];
                // (k, k u, k dy, k u^2), (k u dy, k dy^2, by depth, -), (by colour, -): entry 7 is skipped.
                out[12 * (size_t)s_slot[group + k] + quantity + (quantity >= 7 ? 1 : 0)] = total;
            }
            __syncthreads();
        }
    }
    // Clear the moments of the splats behind the last open pixel.
    for (int i = base + thread; i < end; i += 256) {
        float4* unseen = (float4*)moments.data + 3 * (size_t)slots.data[i];
        unseen[0] = unseen[1] = unseen[2] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    }
"""
)
