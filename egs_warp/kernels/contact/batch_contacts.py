"""Kernels for the contacts of many worlds with one mesh: the products W^T, W v and W^T f with the contact Jacobian W
(Eq. 8).
"""

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
    """Write the transposed contact Jacobian W^T (c, 3N, 3K) into zeroed memory: the nodal impulses of a unit impulse
    along each contact axis.
    """
    world, k = wp.tid()
    if k < counts[world]:
        for corner in range(4):
            node = nodes[world, k][corner]
            for axis in range(3):
                for i in range(3):
                    rows_out[world, 3 * node + i, 3 * k + axis] = weights[world, k][corner] * axes[world, k][axis, i]


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
    """Compute the contact velocities W v (c, 3K, m) for nodal velocities v (c, 3N, m). The velocities of padding are
    set to zero."""
    world, k, column = wp.tid()
    at_point = Vec3()
    if k < counts[world]:
        for corner in range(4):
            n = 3 * nodes[world, k][corner]
            weight = weights[world, k][corner]
            for i in range(3):
                at_point[i] += weight * velocities[world, n + i, column]
    speeds = axes[world, k] * at_point
    for axis in range(3):
        speeds_out[world, 3 * k + axis, column] = speeds[axis]


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
    """Compute the nodal forces W^T f (c, N) in newtons. Each node sums over the contacts in their order."""
    world, node = wp.tid()
    total = Vec3()
    for k in range(counts[world]):
        for corner in range(4):
            if nodes[world, k][corner] == node:
                total += weights[world, k][corner] * (wp.transpose(axes[world, k]) * forces[world, k])
    pushes_out[world, node] = total
