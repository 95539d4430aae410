"""Contacts of many bodies with one mesh: their rows in the velocities, and what forces on them push."""

import warp as wp

from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})


@wp.kernel
def contact_jacobian_kernel(
    # In:
    counts: wp.array[int],
    nodes: wp.array2d[wp.vec4i],
    weights: wp.array2d[Vec4],
    axes: wp.array2d[Mat33],
    # Out:
    rows_out: wp.array3d[real],
):
    """(c, 3N, 3K), zero before: of each contact the impulses on each node's axes that one along each of its own is."""
    world, k = wp.tid()
    if k < counts[world]:
        for corner in range(4):
            node = nodes[world, k][corner]
            for own in range(3):
                for i in range(3):
                    rows_out[world, 3 * node + i, 3 * k + own] = weights[world, k][corner] * axes[world, k][own, i]


@wp.kernel
def contact_velocities_kernel(
    # In:
    counts: wp.array[int],
    nodes: wp.array2d[wp.vec4i],
    weights: wp.array2d[Vec4],
    axes: wp.array2d[Mat33],
    velocities: wp.array3d[real],
    # Out:
    speeds_out: wp.array3d[real],
):
    """(c, 3K, m) along the axes of each contact, for nodal velocities (c, 3N, m); zero for those beyond the count."""
    world, k, column = wp.tid()
    at_point = Vec3()
    if k < counts[world]:
        for corner in range(4):
            n = 3 * nodes[world, k][corner]
            share = weights[world, k][corner]
            for i in range(3):
                at_point[i] += share * velocities[world, n + i, column]
    speeds = axes[world, k] * at_point
    for own in range(3):
        speeds_out[world, 3 * k + own, column] = speeds[own]


@wp.kernel
def nodal_forces_kernel(
    # In:
    counts: wp.array[int],
    nodes: wp.array2d[wp.vec4i],
    weights: wp.array2d[Vec4],
    axes: wp.array2d[Mat33],
    forces: wp.array2d[Vec3],
    # Out:
    pushes_out: wp.array2d[Vec3],
):
    """(c, N) newtons on each node, gathered in the order of the contacts."""
    world, node = wp.tid()
    total = Vec3()
    for k in range(counts[world]):
        for corner in range(4):
            if nodes[world, k][corner] == node:
                total += weights[world, k][corner] * (wp.transpose(axes[world, k]) * forces[world, k])
    pushes_out[world, node] = total
