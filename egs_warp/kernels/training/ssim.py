"""SSIM (Wang et al. 2004) of two images and its derivative, with a Gaussian window of 11 x 11 pixels.

An image is stored by rows, with three floats per pixel. A thread computes several consecutive floats of a row:
``ssim_cpu.py`` has the kernels for a vector register, ``ssim_cuda.py`` those for a single float. Each row ends with at
least ``PADDING`` zeros, and there are ``REACH`` rows of zeros above and below the image, so the window needs no bounds
check. The window is separable: it is applied along the rows first, then along the columns. ``pitch`` is the number of
floats of a padded row, and ``window`` (2 REACH + 1,) the weights.
"""

from typing import Any, NamedTuple

import warp as wp

C1 = wp.constant(wp.float32(0.01 * 0.01))
C2 = wp.constant(wp.float32(0.03 * 0.03))
REACH = wp.constant(5)
"""Radius of the window, pixels."""
PADDING = wp.constant(16)
"""Number of zeros before the first row, and minimum number of zeros at the end of each row."""


class SsimKernels(NamedTuple):
    """Kernels of SSIM. For a row of w pixels they use ceil(3 w / lanes) threads; this number is the argument
    ``blocks``.
    """

    lanes: int
    """Number of floats that a thread computes."""
    blur_products: Any
    similarity: Any
    blur_derivatives: Any
    gradient: Any


def ssim_kernels(module: str, lanes: int) -> SsimKernels:
    """Create the kernels for threads of ``lanes`` floats in the Warp module ``module``."""
    options: dict[str, Any] = {"module": wp.get_module(module), "enable_backward": False}
    numbers = wp.types.vector(length=lanes, dtype=wp.float32)

    @wp.func_native(f"return *(const wp::vec_t<{lanes}, float>*)(values.data + at);")
    def load(values: wp.array[wp.float32], at: wp.int32) -> numbers: ...

    @wp.func_native(f"*(wp::vec_t<{lanes}, float>*)(values.data + at) = value;")
    def store(values: wp.array[wp.float32], at: wp.int32, value: numbers): ...

    @wp.func_native(f"""
        if (count >= {lanes}) *(wp::vec_t<{lanes}, float>*)(values.data + at) = value;
        else for (int i = 0; i < count; ++i) values.data[at + i] = value[i];
    """)
    def store_first(values: wp.array[wp.float32], at: wp.int32, count: wp.int32, value: numbers): ...

    @wp.func
    def blurred(values: wp.array[wp.float32], window: wp.array[wp.float32], at: wp.int32, pitch: wp.int32) -> numbers:
        """Return the weighted mean of floats ``pitch`` apart around index ``at``; the window gives the weights."""
        total = numbers()
        # Static bounds unroll the loop, which keeps the total in a register.
        for k in range(wp.static(-REACH), wp.static(REACH + 1)):
            total += window[k + REACH] * load(values, at + k * pitch)
        return total

    @wp.kernel(**options)
    def blur_products(
        first_row: wp.int32,
        blocks: wp.int32,
        pitch: wp.int32,
        window: wp.array[wp.float32],
        a: wp.array[wp.float32],
        b: wp.array[wp.float32],
        mean_a_out: wp.array[wp.float32],
        mean_b_out: wp.array[wp.float32],
        aa_out: wp.array[wp.float32],
        bb_out: wp.array[wp.float32],
        ab_out: wp.array[wp.float32],
    ):
        """Blur both images and their products along the rows only."""
        thread = first_row + wp.tid()
        at = PADDING + (REACH + thread // blocks) * pitch + (thread % blocks) * wp.static(lanes)
        mean_a = numbers()
        mean_b = numbers()
        aa = numbers()
        bb = numbers()
        ab = numbers()
        for k in range(wp.static(-REACH), wp.static(REACH + 1)):
            x = load(a, at + 3 * k)
            y = load(b, at + 3 * k)
            share_x = window[k + REACH] * x
            share_y = window[k + REACH] * y
            mean_a += share_x
            mean_b += share_y
            aa += wp.cw_mul(share_x, x)
            bb += wp.cw_mul(share_y, y)
            ab += wp.cw_mul(share_x, y)
        store(mean_a_out, at, mean_a)
        store(mean_b_out, at, mean_b)
        store(aa_out, at, aa)
        store(bb_out, at, bb)
        store(ab_out, at, ab)

    @wp.kernel(**options)
    def similarity(
        first_row: wp.int32,
        blocks: wp.int32,
        pitch: wp.int32,
        width: wp.int32,
        window: wp.array[wp.float32],
        mean_a_in: wp.array[wp.float32],
        mean_b_in: wp.array[wp.float32],
        aa_in: wp.array[wp.float32],
        bb_in: wp.array[wp.float32],
        ab_in: wp.array[wp.float32],
        similarity_out: wp.array[wp.float32],
        by_mean_out: wp.array[wp.float32],
        by_square_out: wp.array[wp.float32],
        by_product_out: wp.array[wp.float32],
    ):
        """Compute SSIM, and its derivatives with respect to the blurred means, squares and products."""
        thread = first_row + wp.tid()
        lane = (thread % blocks) * wp.static(lanes)
        at = PADDING + (REACH + thread // blocks) * pitch + lane
        ma = blurred(mean_a_in, window, at, pitch)
        mb = blurred(mean_b_in, window, at, pitch)
        aa = blurred(aa_in, window, at, pitch)
        bb = blurred(bb_in, window, at, pitch)
        ab = blurred(ab_in, window, at, pitch)
        c1 = numbers(C1)
        c2 = numbers(C2)
        both = wp.cw_mul(ma, mb)
        squares = wp.cw_mul(ma, ma) + wp.cw_mul(mb, mb)
        n1 = 2.0 * both + c1
        n2 = 2.0 * (ab - both) + c2
        d1 = squares + c1
        d2 = aa + bb - squares + c2
        over = wp.cw_div(numbers(1.0), wp.cw_mul(d1, d2))
        s = wp.cw_mul(wp.cw_mul(n1, n2), over)
        by_square = -wp.cw_mul(wp.cw_mul(s, d1), over)
        by_product = 2.0 * wp.cw_mul(n1, over)
        by_mean = 2.0 * (
            wp.cw_mul(wp.cw_mul(mb, n2 - n1), over) + wp.cw_mul(wp.cw_mul(ma, s), wp.cw_mul(d1 - d2, over))
        )
        left = 3 * width - lane  # The padding must remain zero.
        store_first(similarity_out, at, left, s)
        store_first(by_mean_out, at, left, by_mean)
        store_first(by_square_out, at, left, by_square)
        store_first(by_product_out, at, left, by_product)

    @wp.kernel(**options)
    def blur_derivatives(
        first_row: wp.int32,
        blocks: wp.int32,
        pitch: wp.int32,
        window: wp.array[wp.float32],
        by_mean: wp.array[wp.float32],
        by_square: wp.array[wp.float32],
        by_product: wp.array[wp.float32],
        by_mean_out: wp.array[wp.float32],
        by_square_out: wp.array[wp.float32],
        by_product_out: wp.array[wp.float32],
    ):
        """Blur the derivatives along the rows. The window is symmetric, so the blur is its own transpose."""
        thread = first_row + wp.tid()
        at = PADDING + (REACH + thread // blocks) * pitch + (thread % blocks) * wp.static(lanes)
        mean = numbers()
        square = numbers()
        product = numbers()
        # A loop for each image, as in ``blurred``, takes three times as long on a CPU.
        for k in range(wp.static(-REACH), wp.static(REACH + 1)):
            weight = window[k + REACH]
            mean += weight * load(by_mean, at + 3 * k)
            square += weight * load(by_square, at + 3 * k)
            product += weight * load(by_product, at + 3 * k)
        store(by_mean_out, at, mean)
        store(by_square_out, at, square)
        store(by_product_out, at, product)

    @wp.kernel(**options)
    def gradient(
        first_row: wp.int32,
        blocks: wp.int32,
        pitch: wp.int32,
        window: wp.array[wp.float32],
        toned: wp.array[wp.float32],
        photo: wp.array[wp.float32],
        by_mean_in: wp.array[wp.float32],
        by_square_in: wp.array[wp.float32],
        by_product_in: wp.array[wp.float32],
        by_similarity_out: wp.array[wp.float32],
    ):
        """Compute the derivative of the sum of SSIM with respect to the transformed render."""
        thread = first_row + wp.tid()
        at = PADDING + (REACH + thread // blocks) * pitch + (thread % blocks) * wp.static(lanes)
        mean = blurred(by_mean_in, window, at, pitch)
        square = blurred(by_square_in, window, at, pitch)
        product = blurred(by_product_in, window, at, pitch)
        x = load(toned, at)
        y = load(photo, at)
        store(by_similarity_out, at, mean + 2.0 * wp.cw_mul(x, square) + wp.cw_mul(y, product))

    return SsimKernels(lanes, blur_products, similarity, blur_derivatives, gradient)
