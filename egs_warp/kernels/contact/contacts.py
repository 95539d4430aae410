"""Kernels for the contacts of all worlds: their record, and the products W^T, W v and W^T f with the contact Jacobian W
(Eq. 8).

A contact with the ground has one side, the tetrahedron of its point. A contact between two bodies has two sides; the
weights of the second side are negative. Arrays of nodes and weights of K contacts with S sides have K S entries.
"""

import warp as wp

from egs_warp.kernels.contact.gaps import embedded_point
from egs_warp.kernels.contact.height_field import ground_frame, height_and_slopes
from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})


@wp.kernel
def contact_record_kernel(
    # Model:
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    frames: wp.array[Mat33],
    axes: Mat33,
    origin: Vec3,
    spacing: real,
    coefficients: wp.array2d[real],
    # In:
    points: wp.array2d[int],
    counts: wp.array[int],
    positions: wp.array2d[Vec3],
    gaps: wp.array2d[real],
    faces: wp.array2d[int],
    # Out:
    nodes_out: wp.array2d[wp.vec4i],
    weights_out: wp.array2d[Vec4],
    axes_out: wp.array2d[Mat33],
    gaps_out: wp.array2d[real],
    faces_out: wp.array2d[int],
):
    """Write nodes, weights, frame, gap and face of the first ``counts`` of the ``points`` (B, K), and zeros as padding.

    The frame is taken from ``frames``. If the face is 0 and there are ``coefficients``, it is the frame of the uneven
    ground below the point.
    """
    world, k = wp.tid()
    record_nodes = wp.vec4i()
    record_weights = Vec4()
    frame = Mat33()
    gap = real(0.0)
    face = int(0)
    if k < counts[world]:
        point = points[world, k]
        record_nodes = nodes[point]
        record_weights = weights[point]
        gap = gaps[world, point]
        face = faces[world, point]
        if face == 0 and coefficients.shape[0] > 0:
            x = embedded_point(record_nodes, record_weights, positions, world)
            ground = height_and_slopes(axes, origin, spacing, coefficients, x)
            frame = ground_frame(axes, ground[1], ground[2])
        else:
            frame = frames[face]
    nodes_out[world, k] = record_nodes
    weights_out[world, k] = record_weights
    axes_out[world, k] = frame
    gaps_out[world, k] = gap
    faces_out[world, k] = face


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
    """Write the transposed contact Jacobian W^T (c, 3N, 3K) into zeroed memory. Its columns are the nodal impulses of
    unit impulses along the contact axes.
    """
    world, k = wp.tid()
    if k < counts[world]:
        sides = nodes.shape[1] // axes.shape[1]
        for side in range(sides * k, sides * (k + 1)):
            for corner in range(4):
                node = nodes[world, side][corner]
                share = weights[world, side][corner]
                if share != real(0.0):
                    for axis in range(3):
                        for i in range(3):
                            rows_out[world, 3 * node + i, 3 * k + axis] = share * axes[world, k][axis, i]


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
    """Compute the contact velocities W v (c, 3K, m) for nodal velocities v (c, 3N, m). Padding entries are set to
    zero."""
    world, k, column = wp.tid()
    speeds = Vec3()
    if k < counts[world]:
        frame = axes[world, k]
        sides = nodes.shape[1] // axes.shape[1]
        for side in range(sides * k, sides * (k + 1)):
            corners = nodes[world, side]
            shares = weights[world, side]
            for corner in range(4):
                for i in range(3):
                    velocity = velocities[world, 3 * corners[corner] + i, column]
                    for axis in range(3):
                        speeds[axis] += (shares[corner] * frame[axis, i]) * velocity
    for axis in range(3):
        speeds_out[world, 3 * k + axis, column] = speeds[axis]


@wp.func
def nodal_force(
    counts: wp.array[int],
    nodes: wp.array2d[wp.vec4i],
    weights: wp.array2d[Vec4],
    axes: wp.array2d[Mat33],
    forces: wp.array2d[Vec3],
    world: int,
    node: int,
):
    """Return the nodal force W^T f at ``node``, summed over the contacts in their order."""
    total = Vec3()
    for k in range(counts[world]):
        sides = nodes.shape[1] // axes.shape[1]
        for side in range(sides * k, sides * (k + 1)):
            for corner in range(4):
                if nodes[world, side][corner] == node:
                    for axis in range(3):
                        for i in range(3):
                            entry = weights[world, side][corner] * axes[world, k][axis, i]
                            total[i] += entry * forces[world, k][axis]
    return total


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
    """Compute the nodal forces W^T f (c, N) in newtons."""
    world, node = wp.tid()
    pushes_out[world, node] = nodal_force(counts, nodes, weights, axes, forces, world, node)
