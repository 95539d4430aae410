"""Islands of bodies: sets of bodies that are connected by contacts."""

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
    """Write, for each body of each world, the lowest index of a body in its island (union-find).

    A negative index in a pair is an obstacle, which connects nothing. The root of a tree is its lowest body, so the
    result does not depend on the order of the contacts.

    Args:
        counts: (B,) number of contacts of each world.
        pairs: (B, K) the two bodies of each contact.
        islands_out: (B, bodies) lowest body of the island.
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
    # A parent has a lower index than its child, so the island of the parent is already final.
    for body in range(islands_out.shape[1]):
        islands_out[world, body] = islands_out[world, islands_out[world, body]]
