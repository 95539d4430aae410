"""Photo loss (L1 and SSIM) between a photo and a render at the photo's exposure, and its derivative: one thread per
pixel.

Host code: ``egs_warp/training/photo_loss.py``.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

C1 = wp.constant(wp.float32(0.01 * 0.01))
C2 = wp.constant(wp.float32(0.03 * 0.03))
REACH = wp.constant(5)
"""Radius of the SSIM window of 11 pixels."""


@wp.func
def tone_of(tone: wp.array[wp.float32]) -> wp.mat33:
    """Return the linear part of the (3, 4) colour transform, stored row by row."""
    return wp.mat33(tone[0], tone[1], tone[2], tone[4], tone[5], tone[6], tone[8], tone[9], tone[10])


@wp.func
def shift_of(tone: wp.array[wp.float32]) -> wp.vec3:
    """Return the constant part of the colour transform."""
    return wp.vec3(tone[3], tone[7], tone[11])


@wp.kernel
def tone_kernel(
    first_row: wp.int32,
    has_alpha: wp.int32,
    backdrop: wp.array[wp.vec3],
    tone: wp.array[wp.float32],
    colour: wp.array[wp.vec3],
    alpha: wp.array[wp.float32],
    image: wp.array[wp.vec3],
    image_alpha: wp.array[wp.float32],
    weight: wp.array[wp.float32],
    toned_out: wp.array[wp.vec3],
    photo_out: wp.array[wp.vec3],
    front_out: wp.array[wp.vec3],
    off_out: wp.array[wp.float32],
):
    """Compute the two images to compare. ``front`` is the render before the colour transform, without the backdrop."""
    p = first_row + wp.tid()
    m = tone_of(tone)
    b = shift_of(tone)
    front = colour[p]
    photo = image[p]
    toned = m * front + b
    if has_alpha == 1:
        behind = backdrop[0]
        front = colour[p] - (1.0 - alpha[p]) * behind
        photo = photo * image_alpha[p] + (1.0 - image_alpha[p]) * behind
        toned = m * front + alpha[p] * b + (1.0 - alpha[p]) * behind
    counts = wp.float32(1.0)
    if weight.shape[0] > 1:
        counts = weight[p]
    # Pixels of weight zero must not affect the SSIM windows of other pixels.
    if counts <= 0.0:
        toned = photo
    off = toned - photo
    toned_out[p] = toned
    photo_out[p] = photo
    front_out[p] = front
    off_out[p] = counts * (wp.abs(off[0]) + wp.abs(off[1]) + wp.abs(off[2])) / 3.0


@wp.kernel
def blur_products_kernel(
    first_row: wp.int32,
    width: wp.int32,
    window: wp.array[wp.float32],
    a: wp.array[wp.vec3],
    b: wp.array[wp.vec3],
    mean_a_out: wp.array[wp.vec3],
    mean_b_out: wp.array[wp.vec3],
    aa_out: wp.array[wp.vec3],
    bb_out: wp.array[wp.vec3],
    ab_out: wp.array[wp.vec3],
):
    """Blur both images and their products along the rows."""
    p = first_row + wp.tid()
    column = p % width
    mean_a = wp.vec3(0.0)
    mean_b = wp.vec3(0.0)
    aa = wp.vec3(0.0)
    bb = wp.vec3(0.0)
    ab = wp.vec3(0.0)
    for k in range(-REACH, REACH + 1):
        if column + k >= 0 and column + k < width:
            share = window[k + REACH]
            x = a[p + k]
            y = b[p + k]
            mean_a += share * x
            mean_b += share * y
            aa += share * wp.cw_mul(x, x)
            bb += share * wp.cw_mul(y, y)
            ab += share * wp.cw_mul(x, y)
    mean_a_out[p] = mean_a
    mean_b_out[p] = mean_b
    aa_out[p] = aa
    bb_out[p] = bb
    ab_out[p] = ab


@wp.kernel
def similarity_kernel(
    first_row: wp.int32,
    width: wp.int32,
    height: wp.int32,
    ssim_weight: wp.float32,
    window: wp.array[wp.float32],
    mean_a_in: wp.array[wp.vec3],
    mean_b_in: wp.array[wp.vec3],
    aa_in: wp.array[wp.vec3],
    bb_in: wp.array[wp.vec3],
    ab_in: wp.array[wp.vec3],
    off: wp.array[wp.float32],
    loss_out: wp.array[wp.float32],
    by_mean_out: wp.array[wp.vec3],
    by_square_out: wp.array[wp.vec3],
    by_product_out: wp.array[wp.vec3],
):
    """Compute the loss (1 - w) L1 + w (1 - SSIM) of a pixel, and the derivatives of its SSIM with respect to the
    blurred means, squares and products."""
    p = first_row + wp.tid()
    row = p // width
    mean_a = wp.vec3(0.0)
    mean_b = wp.vec3(0.0)
    aa = wp.vec3(0.0)
    bb = wp.vec3(0.0)
    ab = wp.vec3(0.0)
    for k in range(-REACH, REACH + 1):
        if row + k >= 0 and row + k < height:
            share = window[k + REACH]
            q = p + k * width
            mean_a += share * mean_a_in[q]
            mean_b += share * mean_b_in[q]
            aa += share * aa_in[q]
            bb += share * bb_in[q]
            ab += share * ab_in[q]
    total = wp.float32(0.0)
    by_mean = wp.vec3(0.0)
    by_square = wp.vec3(0.0)
    by_product = wp.vec3(0.0)
    for c in range(3):
        ma = mean_a[c]
        mb = mean_b[c]
        n1 = 2.0 * ma * mb + C1
        n2 = 2.0 * (ab[c] - ma * mb) + C2
        d1 = ma * ma + mb * mb + C1
        d2 = aa[c] - ma * ma + bb[c] - mb * mb + C2
        s = n1 * n2 / (d1 * d2)
        total += s
        by_mean[c] = 2.0 * mb * (n2 - n1) / (d1 * d2) - 2.0 * ma * s / d1 + 2.0 * ma * s / d2
        by_square[c] = -s / d2
        by_product[c] = 2.0 * n1 / (d1 * d2)
    loss_out[p] = (1.0 - ssim_weight) * off[p] + ssim_weight * (1.0 - total / 3.0)
    by_mean_out[p] = by_mean
    by_square_out[p] = by_square
    by_product_out[p] = by_product


@wp.kernel
def blur_derivatives_kernel(
    first_row: wp.int32,
    width: wp.int32,
    window: wp.array[wp.float32],
    by_mean: wp.array[wp.vec3],
    by_square: wp.array[wp.vec3],
    by_product: wp.array[wp.vec3],
    by_mean_out: wp.array[wp.vec3],
    by_square_out: wp.array[wp.vec3],
    by_product_out: wp.array[wp.vec3],
):
    """Blur the derivatives along the rows. The window is symmetric, so the blur is its own transpose."""
    p = first_row + wp.tid()
    column = p % width
    mean = wp.vec3(0.0)
    square = wp.vec3(0.0)
    product = wp.vec3(0.0)
    for k in range(-REACH, REACH + 1):
        if column + k >= 0 and column + k < width:
            share = window[k + REACH]
            mean += share * by_mean[p + k]
            square += share * by_square[p + k]
            product += share * by_product[p + k]
    by_mean_out[p] = mean
    by_square_out[p] = square
    by_product_out[p] = product


@wp.kernel
def gradient_kernel(
    first_row: wp.int32,
    width: wp.int32,
    height: wp.int32,
    ssim_weight: wp.float32,
    has_alpha: wp.int32,
    window: wp.array[wp.float32],
    backdrop: wp.array[wp.vec3],
    tone: wp.array[wp.float32],
    weight: wp.array[wp.float32],
    toned: wp.array[wp.vec3],
    photo: wp.array[wp.vec3],
    by_mean_in: wp.array[wp.vec3],
    by_square_in: wp.array[wp.vec3],
    by_product_in: wp.array[wp.vec3],
    by_toned_out: wp.array[wp.vec3],
    by_colour_out: wp.array[wp.vec3],
    by_alpha_out: wp.array[wp.float32],
):
    """Compute the derivative of the mean loss with respect to the transformed render, the render's colour, and its
    alpha."""
    p = first_row + wp.tid()
    row = p // width
    mean = wp.vec3(0.0)
    square = wp.vec3(0.0)
    product = wp.vec3(0.0)
    for k in range(-REACH, REACH + 1):
        if row + k >= 0 and row + k < height:
            share = window[k + REACH]
            q = p + k * width
            mean += share * by_mean_in[q]
            square += share * by_square_in[q]
            product += share * by_product_in[q]
    counts = wp.float32(1.0)
    if weight.shape[0] > 1:
        counts = weight[p]
    each = 1.0 / (3.0 * wp.float32(width) * wp.float32(height))
    x = toned[p]
    y = photo[p]
    by_toned = wp.vec3(0.0)
    if counts > 0.0:
        for c in range(3):
            similarity = mean[c] + 2.0 * x[c] * square[c] + y[c] * product[c]
            side = wp.float32(0.0)
            if x[c] > y[c]:
                side = wp.float32(1.0)
            if x[c] < y[c]:
                side = wp.float32(-1.0)
            by_toned[c] = each * ((1.0 - ssim_weight) * counts * side - ssim_weight * similarity)
    m = tone_of(tone)
    by_toned_out[p] = by_toned
    by_colour_out[p] = wp.transpose(m) * by_toned
    if has_alpha == 1:
        by_alpha_out[p] = wp.dot(by_toned, m * backdrop[0] + shift_of(tone) - backdrop[0])
