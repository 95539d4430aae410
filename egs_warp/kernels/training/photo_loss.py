"""Photo loss (L1 and SSIM) between a photo and a render at the photo's exposure, and the derivative of this loss: one
thread per run of pixels. The kernels of SSIM are in ``ssim.py``.

Host code: ``egs_warp/training/photo_loss.py``.
"""

import warp as wp

from egs_warp.kernels.training.ssim import PADDING, REACH

wp.set_module_options({"enable_backward": False})


@wp.func
def tone_of(tone: wp.array[wp.float32]) -> wp.mat33:
    """Return the linear part of the (3, 4) colour transform ``tone``, which is stored row by row."""
    return wp.mat33(tone[0], tone[1], tone[2], tone[4], tone[5], tone[6], tone[8], tone[9], tone[10])


@wp.func
def shift_of(tone: wp.array[wp.float32]) -> wp.vec3:
    """Return the constant part of the colour transform ``tone``."""
    return wp.vec3(tone[3], tone[7], tone[11])


@wp.func
def padded_index(pixel: wp.int32, width: wp.int32, pitch: wp.int32) -> wp.int32:
    """Return the index of the first float of a ``pixel`` in an image with padded rows of ``pitch`` floats each."""
    return PADDING + (REACH + pixel // width) * pitch + 3 * (pixel % width)


@wp.kernel
def tone_kernel(
    first_run: wp.int32,
    run: wp.int32,
    width: wp.int32,
    pitch: wp.int32,
    has_alpha: wp.int32,
    backdrop: wp.array[wp.vec3],
    tone: wp.array[wp.float32],
    colour: wp.array[wp.vec3],
    alpha: wp.array[wp.float32],
    image: wp.array[wp.vec3],
    image_alpha: wp.array[wp.float32],
    weight: wp.array[wp.float32],
    toned_out: wp.array[wp.float32],
    photo_out: wp.array[wp.float32],
    front_out: wp.array[wp.vec4],
    off_out: wp.array[wp.float32],
):
    """Compute the two images to compare, with padded rows, and the weighted L1 difference of each pixel.

    Args:
        run: number of pixels of a thread, all in one row.
        width: columns of the image.
        pitch: floats of a padded row.
        has_alpha: 1 if the photo has an alpha channel; both images are then compared over the ``backdrop``.
        backdrop: (1,) colour behind the object.
        tone: (12,) colour transform of the photo's exposure.
        colour, alpha: the render, over black if the photo has an alpha channel.
        image, image_alpha: the photo.
        weight: weight of each pixel; an array of length 1 stands for weights of 1.
        toned_out, photo_out: the transformed render and the photo, padded.
        front_out: what the colour transform multiplies: the render, and 1, or the render's alpha if the photo has
            alpha.
        off_out: weighted mean absolute difference of the channels.
    """
    first = (first_run + wp.tid()) * run
    start = padded_index(first, width, pitch)
    m = tone_of(tone)
    b = shift_of(tone)
    for i in range(run):
        p = first + i
        front = colour[p]
        photo = image[p]
        cover = wp.float32(1.0)
        toned = m * front + b
        if has_alpha == 1:
            behind = backdrop[0]
            cover = alpha[p]
            photo = photo * image_alpha[p] + (1.0 - image_alpha[p]) * behind
            toned = m * front + cover * b + (1.0 - cover) * behind
        counts = wp.float32(1.0)
        if weight.shape[0] > 1:
            counts = weight[p]
        # Pixels with zero weight must not affect the SSIM windows of other pixels.
        if counts <= 0.0:
            toned = photo
        off = toned - photo
        at = start + 3 * i
        toned_out[at] = toned[0]
        toned_out[at + 1] = toned[1]
        toned_out[at + 2] = toned[2]
        photo_out[at] = photo[0]
        photo_out[at + 1] = photo[1]
        photo_out[at + 2] = photo[2]
        front_out[p] = wp.vec4(front[0], front[1], front[2], cover)
        off_out[p] = counts * (wp.abs(off[0]) + wp.abs(off[1]) + wp.abs(off[2])) / 3.0


@wp.func
def l1_slope(off: wp.float32, weight: wp.float32) -> wp.float32:
    """Return the derivative of ``weight`` times the absolute value of ``off``, 0 at 0."""
    return wp.where(off > 0.0, weight, wp.where(off < 0.0, -weight, 0.0))


@wp.kernel
def gradient_kernel(
    first_run: wp.int32,
    run: wp.int32,
    width: wp.int32,
    height: wp.int32,
    pitch: wp.int32,
    ssim_weight: wp.float32,
    has_alpha: wp.int32,
    backdrop: wp.array[wp.vec3],
    tone: wp.array[wp.float32],
    weight: wp.array[wp.float32],
    toned: wp.array[wp.float32],
    photo: wp.array[wp.float32],
    by_similarity: wp.array[wp.float32],
    by_toned_out: wp.array[wp.vec3],
    by_colour_out: wp.array[wp.vec3],
    by_alpha_out: wp.array[wp.float32],
):
    """Compute the derivative of the mean loss with respect to the transformed render, to the render's colour, and to
    its alpha.

    Args:
        run, width, height, pitch, has_alpha, backdrop, tone, weight: as in ``tone_kernel``.
        ssim_weight: weight of SSIM in the loss; L1 has the rest.
        toned, photo: padded images of ``tone_kernel``.
        by_similarity: derivative of the sum of SSIM with respect to ``toned``, padded.
        by_toned_out, by_colour_out, by_alpha_out: the derivatives.
    """
    first = (first_run + wp.tid()) * run
    start = padded_index(first, width, pitch)
    each = 1.0 / (3.0 * wp.float32(width) * wp.float32(height))
    mixing = wp.transpose(tone_of(tone))
    for i in range(run):
        p = first + i
        at = start + 3 * i
        counts = wp.float32(1.0)
        if weight.shape[0] > 1:
            counts = weight[p]
        by_off = each * (1.0 - ssim_weight) * counts
        by_ssim = wp.where(counts > 0.0, each * ssim_weight, 0.0)
        red = toned[at] - photo[at]
        green = toned[at + 1] - photo[at + 1]
        blue = toned[at + 2] - photo[at + 2]
        by_toned = wp.vec3(
            l1_slope(red, by_off) - by_ssim * by_similarity[at],
            l1_slope(green, by_off) - by_ssim * by_similarity[at + 1],
            l1_slope(blue, by_off) - by_ssim * by_similarity[at + 2],
        )
        by_toned_out[p] = by_toned
        by_colour_out[p] = mixing * by_toned
    if has_alpha == 1:
        by_cover = shift_of(tone) - backdrop[0]
        for i in range(run):
            by_alpha_out[first + i] = wp.dot(by_toned_out[first + i], by_cover)
