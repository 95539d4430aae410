"""C++ source code of vectors of single-precision numbers on a CPU, for the native functions of the renderer.

Clang maps the vector types to the SIMD instructions of the processor.
"""

VECTORS = """
    #pragma clang fp contract(fast)
    typedef float f4 __attribute__((ext_vector_type(4)));
    typedef int i4 __attribute__((ext_vector_type(4)));
    typedef float f8 __attribute__((ext_vector_type(8)));
    typedef float f16 __attribute__((ext_vector_type(16)));
    typedef int i16 __attribute__((ext_vector_type(16)));
    typedef bool b16 __attribute__((ext_vector_type(16)));
    constexpr float LOG2_E = 1.4426950408889634f;
    auto bits_of = [](i16 mask) -> unsigned {
        const b16 set = __builtin_convertvector(mask, b16);
        unsigned short bits;
        __builtin_memcpy(&bits, &set, sizeof(bits));
        return bits;
    };
    auto as_float = [](i16 x) -> f16 { f16 y; __builtin_memcpy(&y, &x, sizeof(y)); return y; };
    auto as_int = [](f16 x) -> i16 { i16 y; __builtin_memcpy(&y, &x, sizeof(y)); return y; };
    // The run-time compiler reloads literal constants at every use; reading them from memory once avoids that.
    volatile float power_pool[] = {1.32764720e-3f, 9.67554133e-3f, 5.55071327e-2f, 2.40221197e-1f, 6.93146967e-1f,
                                   1.0f};
    const f16 p5 = power_pool[0], p4 = power_pool[1], p3 = power_pool[2], p2 = power_pool[3], p1 = power_pool[4];
    const f16 p0 = power_pool[5];
    // 2^(whole + part) to 8e-8, for an integer -126 < whole < 127 and part in [-1/2, 1/2].
    auto power_of_two = [&](f16 whole, f16 part) -> f16 {
        #pragma clang fp contract(fast)
        const f16 p = ((((p5 * part + p4) * part + p3) * part + p2) * part + p1) * part + p0;
        return as_float(as_int(p) + (__builtin_convertvector(whole, i16) << 23));
    };
"""

EXP_AND_LOG = """
    // e^x to 2e-7, for x clamped to +-87.
    auto exp_of = [&](f16 x) -> f16 {
        #pragma clang fp contract(fast)
        const f16 t = x > -87.0f ? (x < 87.0f ? x : f16(87.0f)) : f16(-87.0f);
        const f16 whole = __builtin_elementwise_roundeven(t * LOG2_E);
        // The second constant is the rounding error of LOG2_E.
        return power_of_two(whole, (t * LOG2_E - whole) + t * 1.9259629e-8f);
    };
    // ln x to 1e-7, for a normal x > 0; the polynomial is that of the Cephes library.
    auto log_of = [&](f16 x) -> f16 {
        #pragma clang fp contract(fast)
        const i16 bits = as_int(x);
        const i16 exponent = (bits - 0x3f3504f3) >> 23;
        const f16 r = as_float(bits - (exponent << 23)) - 1.0f;
        const f16 p = (((((((7.0376836292e-2f * r - 1.1514610310e-1f) * r + 1.1676998740e-1f) * r - 1.2420140846e-1f)
            * r + 1.4249322787e-1f) * r - 1.6668057665e-1f) * r + 2.0000714765e-1f) * r - 2.4999993993e-1f) * r
            + 3.3333331174e-1f;
        return __builtin_convertvector(exponent, f16) * 0.6931471806f + (r + r * r * (p * r - 0.5f));
    };
"""

TILE_SPANS = """
    // First and last tile column of an ellipse in four tile rows from `row` on; first > last where there is none.
    // Contraction is off, so that every kernel computes the same bits.
    auto tile_spans = [&](const wp::vec4& e, const wp::vec2& f, int row, i4& first, i4& last) {
        #pragma clang fp contract(off)
        const float cut = f[1] + LOG_255, v = f[0], a = e[2], shear = e[3], end = (float)height;
        const float tip = -shear * __builtin_sqrtf(cut * a / (v * (v + a * shear * shear)));
        // Places 0 to 3 are the right ends, 4 to 7 the left ones.
        const f8 side = {1.0f, 1.0f, 1.0f, 1.0f, -1.0f, -1.0f, -1.0f, -1.0f};
        const f8 steps = {0.0f, 16.0f, 32.0f, 48.0f, 0.0f, 16.0f, 32.0f, 48.0f};
        const f8 start = steps + 16.0f * (float)row, stop = start + 16.0f;
        const f8 top = (start + 0.5f) - e[1], bottom = ((stop < end ? stop : f8(end)) - 0.5f) - e[1];
        const f8 extreme = side * tip, low = extreme < bottom ? extreme : bottom, dy = low > top ? low : top;
        const f8 margin = cut - v * dy * dy;
        const f8 edge = (e[0] - shear * dy)
            + side * __builtin_elementwise_sqrt((margin > 0.0f ? margin : f8(0.0f)) * (1.0f / a)) - 0.5f;
        const f4 image_side = (float)(width - 1), right = edge.lo, left = edge.hi;
        const i4 from = __builtin_convertvector(__builtin_elementwise_ceil(left > 0.0f ? left : f4(0.0f)), i4);
        const i4 to = __builtin_convertvector(
            __builtin_elementwise_floor(right < image_side ? right : image_side), i4);
        first = from <= to ? from >> 4 : i4(1);
        last = from <= to ? to >> 4 : i4(0);
    };
    // First and last tile row with a pixel centre inside the vertical extent of the ellipse; first > last if there is
    // none.
    auto tile_rows_of = [&](const wp::vec4& e, const wp::vec2& f, int& first, int& last) {
        #pragma clang fp contract(off)
        const float reach = __builtin_sqrtf((f[1] + LOG_255) / f[0]);
        const float high = e[1] - reach - 0.5f, low = e[1] + reach - 0.5f;
        const int from = (int)__builtin_ceilf(high > 0.0f ? high : 0.0f);
        const int to = (int)__builtin_floorf(low < (float)(height - 1) ? low : (float)(height - 1));
        first = from <= to ? from >> 4 : 1;
        last = from <= to ? to >> 4 : 0;
    };
"""
"""C++ code that computes the spans of the tiles that an ellipse reaches, as defined in ``ellipse.tile_rows`` and
``ellipse.tile_columns``. It needs ``CUTOFFS_IN_CPP`` and the variables width and height."""


def on_cpu(body: str, *, cuda: str = "") -> str:
    """Return the source of a native function.

    Args:
        body: source for a CPU; it may use ``VECTORS``.
        cuda: source for CUDA; empty for a function that runs on a CPU only.
    """
    return f"#if defined(__CUDA_ARCH__)\n{cuda}\n#else\n{VECTORS}{body}\n#endif\n"
