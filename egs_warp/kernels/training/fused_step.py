"""Kernels of a training step without PyTorch: everything besides the renderer and the photo loss.

The host uploads one ``StepPlan`` for each of the next steps. Each step reads the plan at the index ``cursor`` (1,),
which the last kernel of the step increases. If the tile lists of a step are too small, ``is_blocked`` (1,) is set: this
step and all that follow then change nothing but temporary arrays, until the host has enlarged the lists. Host code:
``egs_warp/training/fused_steps.py``.
"""

import warp as wp

from egs_warp.kernels.render.projection import View
from egs_warp.kernels.training.population import displacement, opacity_penalty_gradient, scale_penalty_gradient

wp.set_module_options({"enable_backward": False})

FIRST_DECAY = wp.constant(wp.float32(0.9))
"""Decay of Adam's first moment, also for the colour maps."""
SECOND_DECAY = wp.constant(wp.float32(0.999))
"""Decay of Adam's second moment."""
TONE_SECOND_DECAY = wp.constant(wp.float32(0.99))
"""Decay of the second moment of the colour maps."""
TONE_ENTRIES = wp.constant(12)
SUMS = wp.constant(14)
"""Number of sums over the pixels: the gradient of the colour map (12), the L1 difference, and SSIM."""
PARTS = wp.constant(64)
"""Number of partial sums of each sum, which are added in a fixed order."""


@wp.struct
class StepPlan:
    """Parameters that differ between steps whose arrays have equal shapes."""

    view: wp.int32
    """Index of the view, for its colour map."""
    picture: wp.int32
    """Index of the view's photo among the photos of equal size."""
    backdrop: wp.vec3
    """Colour behind photos with alpha."""
    means: wp.float32
    """Learning rate of the means; the next fields have those of the other attributes."""
    rotations: wp.float32
    log_scales: wp.float32
    opacity_logits: wp.float32
    sh_band_0: wp.float32
    sh_rest: wp.float32
    first_bias: wp.float32
    """Bias correction of Adam's first moment, 1 - 0.9^t."""
    second_bias: wp.float32
    """Square root of the bias correction of the second moment, sqrt(1 - 0.999^t)."""
    tone_rate: wp.float32
    """Learning rate of the colour map divided by its bias correction."""
    tone_bias: wp.float32
    """Bias correction of the second moment of the colour map."""
    noise: wp.float32
    """Factor of the displacements of the means."""
    seed: wp.int32
    """Seed of the random displacements."""


@wp.kernel
def begin_step_kernel(
    first_row: wp.int32,
    # In:
    plans: wp.array[StepPlan],
    cursor: wp.array[wp.int32],
    views: wp.array[View],
    tone_offsets: wp.array2d[wp.float32],
    photos: wp.array2d[wp.vec3],
    alphas: wp.array2d[wp.float32],
    weights: wp.array2d[wp.float32],
    # Out:
    view_out: wp.array[View],
    tone_out: wp.array[wp.float32],
    backdrop_out: wp.array[wp.vec3],
    photo_out: wp.array[wp.vec3],
    alpha_out: wp.array[wp.float32],
    weight_out: wp.array[wp.float32],
):
    """Copy the camera, the colour map and the photo of the next step to arrays at fixed addresses, by one thread for
    each pixel.

    Args:
        plans, cursor: as in the module docstring.
        views: (photos,) cameras.
        tone_offsets: (views, 12) colour maps minus the identity.
        photos, alphas, weights: (photos, H * W) photos; alpha and weights may be empty.
        view_out: (1,) camera.
        tone_out: (12,) colour map.
        backdrop_out: (1,) colour behind the photo.
        photo_out, alpha_out, weight_out: (H * W,) photo.
    """
    p = first_row + wp.tid()
    plan = plans[cursor[0]]
    # The cursor remains at a blocked step, so that later steps with photos of another size read the plan of this step.
    picture = wp.min(plan.picture, photos.shape[0] - 1)
    if p == 0:
        view_out[0] = views[picture]
        backdrop_out[0] = plan.backdrop
        for entry in range(TONE_ENTRIES):
            # The diagonal of the linear part has the entries 0, 5 and 10.
            tone_out[entry] = tone_offsets[plan.view, entry] + wp.where(entry % 5 == 0, 1.0, 0.0)
    photo_out[p] = photos[picture, p]
    if alphas.shape[0] > 0:
        alpha_out[p] = alphas[picture, p]
    if weights.shape[0] > 0:
        weight_out[p] = weights[picture, p]


@wp.kernel
def check_capacity_kernel(
    # In:
    capacity: wp.int64,
    slot_end: wp.array[wp.int64],
    # Out:
    is_blocked_out: wp.array[wp.int32],
    max_pairs_out: wp.array[wp.int64],
):
    """Set ``is_blocked_out`` if the pairs exceed the ``capacity``, and update the largest number of pairs so far. The
    steps after a blocked step do not count, because they may not render their own photo.

    A Gaussian that is not finite counts as more pairs than any capacity.
    """
    if is_blocked_out[0] != 0:
        return
    pairs = slot_end[slot_end.shape[0] - 1]
    if pairs < wp.int64(0) or pairs > capacity:
        is_blocked_out[0] = 1
    max_pairs_out[0] = wp.max(max_pairs_out[0], pairs)


@wp.kernel
def sum_pixels_kernel(
    first_row: wp.int32,
    threads: wp.int32,
    # In:
    by_toned: wp.array[wp.vec3],
    front: wp.array[wp.vec4],
    off: wp.array[wp.float32],
    similarity: wp.array[wp.float32],
    # Out:
    sums_out: wp.array2d[wp.float32],
):
    """Sum the gradient of the colour map, the L1 difference and SSIM over every ``threads``-th pixel, one column of
    ``sums_out`` (14, threads) for each thread.

    Args:
        threads: number of threads.
        by_toned: (pixels,) gradient with respect to the colour after the colour map.
        front: (pixels,) factors of the colour map.
        off: (pixels,) L1 difference.
        similarity: SSIM, padded.
        sums_out: the sums.
    """
    thread = first_row + wp.tid()
    red = wp.vec4()
    green = wp.vec4()
    blue = wp.vec4()
    total_off = wp.float32(0.0)
    total_similarity = wp.float32(0.0)
    for p in range(thread, by_toned.shape[0], threads):
        by = by_toned[p]
        f = front[p]
        red += by[0] * f
        green += by[1] * f
        blue += by[2] * f
        total_off += off[p]
    # The padding of the similarity is zero.
    for i in range(thread, similarity.shape[0], threads):
        total_similarity += similarity[i]
    for k in range(4):
        sums_out[k, thread] = red[k]
        sums_out[4 + k, thread] = green[k]
        sums_out[8 + k, thread] = blue[k]
    sums_out[12, thread] = total_off
    sums_out[13, thread] = total_similarity


@wp.kernel
def sum_parts_kernel(
    first_row: wp.int32,
    # In:
    sums: wp.array2d[wp.float32],
    # Out:
    parts_out: wp.array2d[wp.float32],
):
    """Add the columns of ``sums`` (14, threads) to ``PARTS`` columns, one entry of ``parts_out`` for each thread."""
    i = first_row + wp.tid()
    part = i % PARTS
    total = wp.float32(0.0)
    for column in range(part, sums.shape[1], PARTS):
        total += sums[i // PARTS, column]
    parts_out[i // PARTS, part] = total


@wp.func
def total_of(parts: wp.array2d[wp.float32], row: wp.int32) -> wp.float32:
    """Return the sum of one ``row`` of the partial sums."""
    total = wp.float32(0.0)
    for part in range(PARTS):
        total += parts[row, part]
    return total


@wp.kernel
def tone_step_kernel(
    first_row: wp.int32,
    # In:
    plans: wp.array[StepPlan],
    cursor: wp.array[wp.int32],
    is_blocked: wp.array[wp.int32],
    parts: wp.array2d[wp.float32],
    pixels: wp.int32,
    ssim_weight: wp.float32,
    regularization: wp.float32,
    typical_offset: wp.float32,
    offsets: wp.array2d[wp.float32],
    # Out:
    first_moment: wp.array2d[wp.float32],
    second_moment: wp.array2d[wp.float32],
    change_out: wp.array[wp.float32],
    losses_out: wp.array[wp.float32],
):
    """Compute the loss, and the change of the view's colour map by a step of Adam, by 13 threads.

    Args:
        plans, cursor, is_blocked: as in the module docstring.
        parts: (14, PARTS) partial sums over the pixels.
        pixels: number of pixels.
        ssim_weight: weight of SSIM in the loss.
        regularization, typical_offset: weight and scale of the penalty on offsets (``exposure``).
        offsets: (views, 12) colour maps minus the identity.
        first_moment, second_moment: (views, 12) moments, updated.
        change_out: (12,) change of the view's colour map.
        losses_out: (steps,) losses, updated at the index ``cursor``.
    """
    if is_blocked[0] != 0:
        return
    entry = first_row + wp.tid()
    plan = plans[cursor[0]]
    if entry == TONE_ENTRIES:
        count = wp.float32(pixels)
        by_off = total_of(parts, 12) / count
        similarity = total_of(parts, 13) / (3.0 * count)
        losses_out[cursor[0]] = (1.0 - ssim_weight) * by_off + ssim_weight * (1.0 - similarity)
        return
    square = wp.float32(0.0)
    for i in range(TONE_ENTRIES):
        square += offsets[plan.view, i] * offsets[plan.view, i]
    pull = 2.0 * regularization / (1.0 + square / (typical_offset * typical_offset))
    by = total_of(parts, entry) + pull * offsets[plan.view, entry]
    first = FIRST_DECAY * first_moment[plan.view, entry] + (1.0 - FIRST_DECAY) * by
    second = TONE_SECOND_DECAY * second_moment[plan.view, entry] + (1.0 - TONE_SECOND_DECAY) * by * by
    first_moment[plan.view, entry] = first
    second_moment[plan.view, entry] = second
    change_out[entry] = -plan.tone_rate * first / (wp.sqrt(second / plan.tone_bias) + 1.0e-12)


@wp.kernel
def shift_tones_kernel(
    first_row: wp.int32,
    # In:
    plans: wp.array[StepPlan],
    cursor: wp.array[wp.int32],
    is_blocked: wp.array[wp.int32],
    change: wp.array[wp.float32],
    # Out:
    offsets: wp.array2d[wp.float32],
):
    """Add the ``change`` (12,) to the colour map of the view, and shift all maps such that their mean, which is zero
    before, remains zero. There is one thread for each entry of ``offsets`` (views, 12).
    """
    if is_blocked[0] != 0:
        return
    i = first_row + wp.tid()
    view = i // TONE_ENTRIES
    entry = i % TONE_ENTRIES
    share = wp.where(view == plans[cursor[0]].view, 1.0, 0.0) - 1.0 / wp.float32(offsets.shape[0])
    offsets[view, entry] = offsets[view, entry] + share * change[entry]


@wp.func
def adam_step(plan: StepPlan, rate: wp.float32, by: wp.float32, first: wp.float32, second: wp.float32) -> wp.vec3:
    """Return the change of a parameter with the gradient ``by``, and the new moments (Kingma and Ba 2015)."""
    new_first = first + (1.0 - FIRST_DECAY) * (by - first)
    new_second = SECOND_DECAY * second + (1.0 - SECOND_DECAY) * by * by
    change = -(rate / plan.first_bias) * new_first / (wp.sqrt(new_second) / plan.second_bias + 1.0e-15)
    return wp.vec3(change, new_first, new_second)


@wp.kernel
def update_shapes_kernel(
    first_row: wp.int32,
    # In:
    plans: wp.array[StepPlan],
    cursor: wp.array[wp.int32],
    is_blocked: wp.array[wp.int32],
    by_opacity: wp.float32,
    by_scale: wp.float32,
    min_log_scale: wp.float32,
    faint: wp.float32,
    by_means: wp.array[wp.vec3],
    by_rotations: wp.array[wp.vec4],
    by_log_scales: wp.array[wp.vec3],
    by_opacity_logits: wp.array[wp.float32],
    # Out:
    means: wp.array[wp.vec3],
    means_first: wp.array[wp.vec3],
    means_second: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    rotations_first: wp.array[wp.vec4],
    rotations_second: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    log_scales_first: wp.array[wp.vec3],
    log_scales_second: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    opacity_logits_first: wp.array[wp.float32],
    opacity_logits_second: wp.array[wp.float32],
):
    """Update everything except the SH coefficients of one Gaussian per thread: regularisation, Adam, the minimum of the
    scales, and the noise of MCMC.

    Args:
        plans, cursor, is_blocked: as in the module docstring.
        by_opacity, by_scale: weights of the sums of the opacities and of the scales.
        min_log_scale: minimum of the logarithms of the scales.
        faint: opacity around which the noise decreases.
        by_means, by_rotations, by_log_scales, by_opacity_logits: (n,) gradients.
        means, rotations, log_scales, opacity_logits: (n,) attributes, updated, each with its two moments.
    """
    if is_blocked[0] != 0:
        return
    n = first_row + wp.tid()
    plan = plans[cursor[0]]

    logit = opacity_logits[n]
    by_logit = by_opacity_logits[n] + opacity_penalty_gradient(by_opacity, logit)
    step = adam_step(plan, plan.opacity_logits, by_logit, opacity_logits_first[n], opacity_logits_second[n])
    logit += step[0]
    opacity_logits[n] = logit
    opacity_logits_first[n] = step[1]
    opacity_logits_second[n] = step[2]

    s = log_scales[n]
    by = by_log_scales[n] + scale_penalty_gradient(by_scale, s)
    first = log_scales_first[n]
    second = log_scales_second[n]
    for k in range(3):
        step = adam_step(plan, plan.log_scales, by[k], first[k], second[k])
        s[k] = wp.max(s[k] + step[0], min_log_scale)
        first[k] = step[1]
        second[k] = step[2]
    log_scales[n] = s
    log_scales_first[n] = first
    log_scales_second[n] = second

    q = rotations[n]
    by_q = by_rotations[n]
    first_q = rotations_first[n]
    second_q = rotations_second[n]
    for k in range(4):
        step = adam_step(plan, plan.rotations, by_q[k], first_q[k], second_q[k])
        q[k] = q[k] + step[0]
        first_q[k] = step[1]
        second_q[k] = step[2]
    rotations[n] = q
    rotations_first[n] = first_q
    rotations_second[n] = second_q

    mean = means[n]
    by = by_means[n]
    first = means_first[n]
    second = means_second[n]
    for k in range(3):
        step = adam_step(plan, plan.means, by[k], first[k], second[k])
        mean[k] = mean[k] + step[0]
        first[k] = step[1]
        second[k] = step[2]
    means_first[n] = first
    means_second[n] = second
    if plan.noise > 0.0:
        random = wp.rand_init(plan.seed, n)
        noise = wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
        mean += displacement(plan.noise, faint, noise, q, s, logit)
    means[n] = mean


@wp.kernel
def update_sh_kernel(
    first_row: wp.int32,
    # In:
    plans: wp.array[StepPlan],
    cursor: wp.array[wp.int32],
    is_blocked: wp.array[wp.int32],
    trained: wp.int32,
    stored: wp.int32,
    by_sh: wp.array[wp.float32],
    # Out:
    sh: wp.array[wp.float32],
    sh_first: wp.array[wp.float32],
    sh_second: wp.array[wp.float32],
):
    """Update one SH coefficient of one channel per thread by a step of Adam.

    Args:
        plans, cursor, is_blocked: as in the module docstring.
        trained, stored: number of floats for each Gaussian in the gradients, and in the other arrays, whose remaining
            coefficients are not trained yet.
        by_sh: (n * trained,) gradients.
        sh, sh_first, sh_second: (n * stored,) coefficients and their moments, updated.
    """
    if is_blocked[0] != 0:
        return
    i = first_row + wp.tid()
    plan = plans[cursor[0]]
    channel = i % trained
    at = (i // trained) * stored + channel
    rate = wp.where(channel < 3, plan.sh_band_0, plan.sh_rest)
    step = adam_step(plan, rate, by_sh[i], sh_first[at], sh_second[at])
    sh[at] = sh[at] + step[0]
    sh_first[at] = step[1]
    sh_second[at] = step[2]


@wp.kernel
def end_step_kernel(
    # In:
    is_blocked: wp.array[wp.int32],
    # Out:
    cursor_out: wp.array[wp.int32],
):
    """Advance the ``cursor_out`` (1,) to the next step, unless this step could not be taken."""
    if is_blocked[0] == 0:
        cursor_out[0] = cursor_out[0] + 1
