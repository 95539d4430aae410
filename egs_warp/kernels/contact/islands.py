"""Islands: sets of bodies that are connected by contacts."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def islands_kernel(
    # In:
    counts: wp.array[int],
    pairs: wp.array2d[wp.vec2i],
    # Out:
    islands_out: wp.array2d[int],
):
    """Write the lowest body index in the island of each body, for each world (union-find).

    The first ``counts`` of the ``pairs`` (B, K) are the two bodies of each contact. A negative index is an obstacle,
    which connects nothing. The root of a tree is its lowest body, so the result does not depend on the order of the
    contacts.
    """
    world = wp.tid()
    for body in range(islands_out.shape[1]):
        islands_out[world, body] = body
    for k in range(counts[world]):
        first = pairs[world, k][0]
        second = pairs[world, k][1]
        if first >= 0 and second >= 0:
            while islands_out[world, first] != first:
                # Path halving.
                islands_out[world, first] = islands_out[world, islands_out[world, first]]
                first = islands_out[world, first]
            while islands_out[world, second] != second:
                islands_out[world, second] = islands_out[world, islands_out[world, second]]
                second = islands_out[world, second]
            islands_out[world, wp.max(first, second)] = wp.min(first, second)
    # The parent of a body is lower than the body, so its island is already final.
    for body in range(islands_out.shape[1]):
        islands_out[world, body] = islands_out[world, islands_out[world, body]]
