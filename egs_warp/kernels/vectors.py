"""C++ of dense products on a CPU, for native functions: four rows by eight columns are what the registers hold.

Clang maps vectors and contracted products to what the processor has.
"""

_PRODUCTS = """
    #pragma clang fp contract(fast)
    typedef double v4 __attribute__((ext_vector_type(4), aligned(8)));
    // y[4][8] -= l[4][k] x[k][8]
    auto take_off = [](double* y0, double* y1, double* y2, double* y3, const double* l0, const double* l1,
                       const double* l2, const double* l3, const double* x, int stride, int k) {
        #pragma clang fp contract(fast)
        v4 a0 = *(v4*)y0, a1 = *(v4*)(y0 + 4), b0 = *(v4*)y1, b1 = *(v4*)(y1 + 4);
        v4 c0 = *(v4*)y2, c1 = *(v4*)(y2 + 4), d0 = *(v4*)y3, d1 = *(v4*)(y3 + 4);
        for (int j = 0; j < k; ++j, x += stride) {
            const v4 x0 = *(const v4*)x, x1 = *(const v4*)(x + 4);
            a0 -= l0[j] * x0; a1 -= l0[j] * x1; b0 -= l1[j] * x0; b1 -= l1[j] * x1;
            c0 -= l2[j] * x0; c1 -= l2[j] * x1; d0 -= l3[j] * x0; d1 -= l3[j] * x1;
        }
        *(v4*)y0 = a0; *(v4*)(y0 + 4) = a1; *(v4*)y1 = b0; *(v4*)(y1 + 4) = b1;
        *(v4*)y2 = c0; *(v4*)(y2 + 4) = c1; *(v4*)y3 = d0; *(v4*)(y3 + 4) = d1;
    };
    // The same of one row.
    auto take_off_one = [](double* y, const double* l, const double* x, int stride, int k) {
        #pragma clang fp contract(fast)
        v4 a0 = *(v4*)y, a1 = *(v4*)(y + 4);
        for (int j = 0; j < k; ++j, x += stride) {
            a0 -= l[j] * *(const v4*)x;
            a1 -= l[j] * *(const v4*)(x + 4);
        }
        *(v4*)y = a0; *(v4*)(y + 4) = a1;
    };
"""


def on_cpu(body: str, *, elsewhere: str = "") -> str:
    """``body``, which may use ``v4``, ``take_off`` and ``take_off_one``, on a CPU; on a GPU, which never comes there,
    ``elsewhere``."""
    return f"#if !defined(__CUDA_ARCH__)\n{_PRODUCTS}{body}\n#else\n{elsewhere}\n#endif\n"
