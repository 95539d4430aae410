"""Kernels for the contacts of all worlds: the contact record, the transposed contact Jacobian W^T, and the products W v
and W^T f (Eq. 8).

A contact with the ground has one side, the tetrahedron of its point. A contact between two bodies has two sides; the
weights of the second side are negative. Arrays of nodes and weights of K contacts with S sides have K S entries per
world. Entries from ``counts`` on are padding. B or c is the number of worlds, N the number of nodes of a world.
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
    """Write the contact record of each world: nodes, weights, contact frame, gap and face of its points.

    The contacts of a world are the first ``counts`` of its ``points``; the other entries of the outputs become zero.
    The frame is that of the face, except on face 0 of uneven ground, where it follows the ground below the point.

    Args:
        nodes: (P,) nodes of the tetrahedron of each point.
        weights: (P,) barycentric weights of each point.
        frames: (planes,) frame of each face.
        axes, origin, spacing, coefficients: height field (``height_and_slopes``); ``coefficients`` is empty without
            one.
        points: (B, K) indices of the contact points.
        counts: (B,) number of contacts of each world.
        positions: (B, N) m, nodes at the start of the step.
        gaps, faces: (B, P) gaps in metres and faces of all points at ``positions``.
        nodes_out, weights_out, axes_out, gaps_out, faces_out: (B, K) the record, as in ``ContactSet``.
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
    """Write the transposed contact Jacobian W^T of each world into zeroed memory.

    Column 3k + a contains the nodal impulses of a unit impulse along axis a of contact k.

    Args:
        counts: (c,) number of contacts of each world.
        nodes: (c, K S) nodes of each side.
        weights: (c, K S) weights of these nodes.
        axes: (c, K) contact frames.
        rows_out: (c, 3N, 3K) W^T, zero on entry.
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
                            # In self contact, both sides may share nodes.
                            before = rows_out[world, 3 * node + i, 3 * k + axis]
                            rows_out[world, 3 * node + i, 3 * k + axis] = before + share * axes[world, k][axis, i]


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
    """Compute the contact velocities W v of each world; padding entries become zero.

    Args:
        counts, nodes, weights, axes: the contacts, as in ``contact_jacobian_kernel``.
        velocities: (c, 3N, m) m/s, m columns of nodal velocities v.
        speeds_out: (c, 3K, m) m/s, W v.
    """
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
    """Return the force W^T f on ``node`` in newtons, summed over the contacts of ``world`` in ascending order.

    Args:
        counts, nodes, weights, axes: the contacts, as in ``contact_jacobian_kernel``.
        forces: (c, K) newtons, contact forces f in the contact frames.
        world: index of the world.
        node: index of the node.
    """
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
    """Compute the nodal forces W^T f of each world.

    Args:
        counts, nodes, weights, axes: the contacts, as in ``contact_jacobian_kernel``.
        forces: (c, K) newtons, contact forces f in the contact frames.
        pushes_out: (c, N) newtons, W^T f.
    """
    world, node = wp.tid()
    pushes_out[world, node] = nodal_force(counts, nodes, weights, axes, forces, world, node)
