"""Patch search and voting on one image: the inner loops of texture synthesis.

Host code: ``egs_warp/inpainting/patch_synthesis.py``.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

RADIUS = 3
"""Radius of a patch, pixels: patches are 7 x 7."""


@wp.struct
class Match:
    """Similarity of one patch to another."""

    cost: wp.float32
    """Weighted mean of the squared colour difference after the shift."""
    shift: wp.vec3
    """Colour shift that is added to the source."""


@wp.func
def compare(
    image: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    row: wp.int32,
    column: wp.int32,
    source: wp.vec2i,
    shift_limit: wp.float32,
) -> Match:
    """Return the match of the patch around ``source`` to the patch around (``row``, ``column``).

    Args:
        image: (rows, columns) colours.
        confidence: (rows, columns) weights of the pixels.
        row, column: centre of the target patch, which may extend beyond the image.
        source: centre of the source patch.
        shift_limit: maximum magnitude of each component of the colour shift.
    """
    weight = wp.float32(0.0)
    sum = wp.vec3()
    squares = wp.float32(0.0)
    for i in range(-RADIUS, RADIUS + 1):
        for j in range(-RADIUS, RADIUS + 1):
            r = row + i
            c = column + j
            if r >= 0 and r < image.shape[0] and c >= 0 and c < image.shape[1]:
                w = confidence[r, c]
                off = image[r, c] - image[source[0] + i, source[1] + j]
                weight += w
                sum += w * off
                squares += w * wp.dot(off, off)
    match = Match()
    weight = wp.max(weight, 1.0e-6)
    mean = sum / weight
    for k in range(3):
        match.shift[k] = wp.clamp(mean[k], -shift_limit, shift_limit)
    match.cost = squares / weight - 2.0 * wp.dot(match.shift, mean) + wp.dot(match.shift, match.shift)
    return match


@wp.func
def is_set(flags: wp.array2d[wp.int32], place: wp.vec2i) -> wp.bool:
    """Return True if ``place`` is inside the image and has a flag."""
    if place[0] < 0 or place[0] >= flags.shape[0] or place[1] < 0 or place[1] >= flags.shape[1]:
        return False
    return flags[place[0], place[1]] == 1


@wp.kernel
def search_kernel(
    first_row: wp.int32,
    # In:
    image: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    is_source: wp.array2d[wp.int32],
    targets: wp.array[wp.vec2i],
    is_target: wp.array2d[wp.int32],
    source_from_target: wp.array2d[wp.vec2i],
    stride: wp.int32,
    random_reach: wp.int32,
    shift_limit: wp.float32,
    seed: wp.int32,
    # Out:
    source_from_target_out: wp.array2d[wp.vec2i],
    cost_out: wp.array2d[wp.float32],
    shift_out: wp.array2d[wp.vec3],
):
    """Run one round of PatchMatch (Barnes et al. 2009).

    Each target tests the matches of its neighbours at ``stride``, then random positions in windows of halving size. All
    targets read the results of the previous round, so the output does not depend on their order.

    Args:
        image, confidence, shift_limit: as in ``compare``.
        is_source: (rows, columns) nonzero for centres of source patches.
        targets: (n,) rows and columns of the targets.
        is_target: (rows, columns) nonzero for targets.
        source_from_target: (rows, columns) source of each target in the previous round.
        stride: distance of the neighbours, pixels.
        random_reach: half width of the first window, pixels.
        seed: seed of the random positions.
        source_from_target_out, cost_out, shift_out: (rows, columns) best match of each target.
    """
    i = first_row + wp.tid()
    row = targets[i][0]
    column = targets[i][1]
    best_source = source_from_target[row, column]
    best = compare(image, confidence, row, column, best_source, shift_limit)
    for k in range(8):
        # The eight neighbours, clockwise.
        dr = wp.where(k < 3, -1, wp.where(k > 4, 1, 0)) * stride
        dc = wp.where(k == 0 or k == 3 or k == 5, -1, wp.where(k == 1 or k == 6, 0, 1)) * stride
        r = row + dr
        c = column + dc
        if is_set(is_target, wp.vec2i(r, c)):
            neighbour_source = source_from_target[r, c]
            candidate = wp.vec2i(neighbour_source[0] - dr, neighbour_source[1] - dc)
            if is_set(is_source, candidate):
                candidate_match = compare(image, confidence, row, column, candidate, shift_limit)
                if candidate_match.cost < best.cost:
                    best = candidate_match
                    best_source = candidate
    state = wp.rand_init(seed, i)
    reach = wp.int32(random_reach)
    while reach >= 1:
        candidate = wp.vec2i(
            best_source[0] + wp.randi(state, -reach, reach + 1), best_source[1] + wp.randi(state, -reach, reach + 1)
        )
        if is_set(is_source, candidate):
            candidate_match = compare(image, confidence, row, column, candidate, shift_limit)
            if candidate_match.cost < best.cost:
                best = candidate_match
                best_source = candidate
        reach = reach // 2
    source_from_target_out[row, column] = best_source
    cost_out[row, column] = best.cost
    shift_out[row, column] = best.shift


@wp.kernel
def vote_kernel(
    first_row: wp.int32,
    # In:
    image: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    holes: wp.array[wp.vec2i],
    is_target: wp.array2d[wp.int32],
    source_from_target: wp.array2d[wp.vec2i],
    cost: wp.array2d[wp.float32],
    shift: wp.array2d[wp.vec3],
    tolerance: wp.float32,
    # Out:
    colour_out: wp.array[wp.vec3],
):
    """Compute the colour of each pixel of the hole as the weighted mean of the patches that cover it. Better matches
    have larger weights (Wexler et al. 2007).

    Args:
        image, confidence: as in ``compare``.
        holes: (n,) rows and columns of the pixels of the hole.
        is_target, source_from_target, cost, shift: matches of ``search_kernel``.
        tolerance: cost at which the weight of a match has decreased to 1/e.
        colour_out: (n,) colours.
    """
    i = first_row + wp.tid()
    row = holes[i][0]
    column = holes[i][1]
    weight = wp.float32(0.0)
    sum = wp.vec3()
    for dr in range(-RADIUS, RADIUS + 1):
        for dc in range(-RADIUS, RADIUS + 1):
            r = row + dr
            c = column + dc
            if is_set(is_target, wp.vec2i(r, c)):
                source = source_from_target[r, c]
                w = confidence[r, c] * wp.exp(-cost[r, c] / tolerance) + 1.0e-12
                weight += w
                sum += w * (image[source[0] - dr, source[1] - dc] + shift[r, c])
    colour_out[i] = sum / weight
