"""What activations of groups of segments push nodes with over a step (Eq. 7), a row for each."""

import warp as wp

from egs_warp.precision import Vec3, real

wp.set_module_options({"enable_backward": False})


@wp.kernel
def impulses_kernel(
    # Model:
    member_offsets: wp.array[int],
    members: wp.array[int],
    node_offsets: wp.array[int],
    nodes: wp.array[int],
    shares: wp.array[real],
    strengths: wp.array[real],
    rest_lengths: wp.array[real],
    slack: real,
    full: real,
    # In:
    positions: wp.array[Vec3],
    dt: real,
    # Out:
    impulses_out: wp.array2d[Vec3],
):
    """N s on each node for an activation of a group at its bound, over ``dt`` seconds: of its ``members``, which pull
    with ``strengths`` newtons at their bounds where they are not ``slack``, with the shares of tension of
    ``muscles.tension``. One thread a group."""
    group = wp.tid()
    for node in range(positions.shape[0]):
        impulses_out[group, node] = Vec3(real(0.0))
    for place in range(member_offsets[group], member_offsets[group + 1]):
        segment = members[place]
        line = Vec3(real(0.0))
        for slot in range(node_offsets[segment], node_offsets[segment + 1]):
            line += shares[slot] * positions[nodes[slot]]
        length = wp.max(wp.length(line), real(1e-300))
        along = wp.clamp((length / rest_lengths[segment] - slack) / (full - slack), real(0.0), real(1.0))
        share = along * along * (real(3.0) - real(2.0) * along)
        pull = (-dt * strengths[segment] * share / length) * line
        for slot in range(node_offsets[segment], node_offsets[segment + 1]):
            node = nodes[slot]
            impulses_out[group, node] = impulses_out[group, node] + shares[slot] * pull
