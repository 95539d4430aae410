"""Nodal impulses of groups of muscle segments over a step (Eq. 7); host code: ``egs_warp.muscles.tension``."""

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
    weights: wp.array[real],
    max_forces: wp.array[real],
    rest_lengths: wp.array[real],
    length_zero_force: real,
    length_full_force: real,
    # In:
    positions: wp.array[Vec3],
    dt: real,
    # Out:
    impulses_out: wp.array2d[Vec3],
):
    """Compute the nodal impulses of each group of muscle segments at its activation bound over a step; one thread per
    group.

    Args:
        member_offsets: (groups + 1,) offset of each group in ``members``.
        members: segments of each group.
        node_offsets: (M + 1,) offset of each segment in ``nodes`` and ``weights``.
        nodes: nodes of each segment.
        weights: weights of these nodes; the segment vector is the weighted sum of their positions.
        max_forces: (M,) newtons, forces of the segments at their bounds.
        rest_lengths: (M,) m.
        length_zero_force: relative length at and below which a segment exerts no force.
        length_full_force: relative length at and above which a segment exerts its full force.
        positions: (N,) m.
        dt: step size, s.
        impulses_out: (groups, N) N s.
    """
    group = wp.tid()
    for node in range(positions.shape[0]):
        impulses_out[group, node] = Vec3(real(0.0))
    for member in range(member_offsets[group], member_offsets[group + 1]):
        segment = members[member]
        vector = Vec3(real(0.0))
        for slot in range(node_offsets[segment], node_offsets[segment + 1]):
            vector += weights[slot] * positions[nodes[slot]]
        length = wp.max(wp.length(vector), real(1e-300))
        along = wp.clamp(
            (length / rest_lengths[segment] - length_zero_force) / (length_full_force - length_zero_force),
            real(0.0),
            real(1.0),
        )
        length_factor = along * along * (real(3.0) - real(2.0) * along)
        pull = (-dt * max_forces[segment] * length_factor / length) * vector
        for slot in range(node_offsets[segment], node_offsets[segment + 1]):
            node = nodes[slot]
            impulses_out[group, node] = impulses_out[group, node] + weights[slot] * pull
