"""Columns of the muscle matrix A(p) (Eq. 7)."""

import warp as wp

from egs_warp.precision import Vec3, real

wp.set_module_options({"enable_backward": False})


@wp.func
def segment_direction(
    segment: wp.int32,
    positions: wp.array[Vec3],
    row_starts: wp.array[wp.int32],
    row_nodes: wp.array[wp.int32],
    row_weights: wp.array[real],
) -> Vec3:
    """Unit vector from the weighted centroid of end i to that of end k; zero where the two coincide."""
    difference = Vec3()
    for entry in range(row_starts[segment], row_starts[segment + 1]):
        difference += row_weights[entry] * positions[row_nodes[entry]]
    # Warp's normalize returns zero for a zero vector: a collapsed segment has no direction and pulls nothing.
    return wp.normalize(difference)


@wp.kernel
def muscle_entries_kernel(
    # In:
    positions: wp.array[Vec3],
    row_starts: wp.array[wp.int32],
    row_nodes: wp.array[wp.int32],
    row_weights: wp.array[real],
    stiffness: wp.array[real],
    # Out:
    entries_out: wp.array[Vec3],
):
    """One thread a segment: the force on each node the segment touches, for unit activation.

    Row j of (row_starts, row_nodes, row_weights) is B_k - B_i, so the force on node n is -k_j (B_k - B_i)_n u.
    """
    segment = wp.tid()
    force = -stiffness[segment] * segment_direction(segment, positions, row_starts, row_nodes, row_weights)
    for entry in range(row_starts[segment], row_starts[segment + 1]):
        entries_out[entry] = row_weights[entry] * force


@wp.kernel
def muscle_columns_kernel(
    # In:
    positions: wp.array[Vec3],
    row_starts: wp.array[wp.int32],
    row_nodes: wp.array[wp.int32],
    row_weights: wp.array[real],
    stiffness: wp.array[real],
    # Out:
    columns_out: wp.array2d[real],
):
    """One thread a segment: its dense column; entries of nodes it does not touch are left as they are (zero)."""
    segment = wp.tid()
    force = -stiffness[segment] * segment_direction(segment, positions, row_starts, row_nodes, row_weights)
    for entry in range(row_starts[segment], row_starts[segment + 1]):
        node = row_nodes[entry]
        for axis in range(3):
            columns_out[3 * node + axis, segment] = row_weights[entry] * force[axis]
