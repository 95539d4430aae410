"""Kernels of contact detection between embedded points and planes (Eq. 8)."""

import warp as wp

from egs_warp.kernels.vectors import on_cpu
from egs_warp.precision import Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})


@wp.kernel
def point_gaps_kernel(
    # Model:
    tets: wp.array[wp.vec4i],
    tet_from_point: wp.array[int],
    weights: wp.array[Vec4],
    planes: wp.array[Vec4],
    solid_from_plane: wp.array[int],
    # In:
    positions: wp.array[Vec3],
    # Out:
    gaps_out: wp.array[real],
    planes_out: wp.array[int],
):
    """Compute the signed distance of each embedded point to the nearest solid, and the plane of that solid with the
    largest signed distance.

    The planes of a solid, which is their intersection, are consecutive. The largest signed distance to them is taken as
    the distance to the solid, of which it is a lower bound.
    """
    point = wp.tid()
    tet = tets[tet_from_point[point]]
    w = weights[point]
    x = w[0] * positions[tet[0]] + w[1] * positions[tet[1]] + w[2] * positions[tet[2]] + w[3] * positions[tet[3]]
    nearest_gap = real(wp.inf)
    nearest = int(0)
    solid_gap = real(-wp.inf)
    facing = int(0)
    for i in range(planes.shape[0]):
        plane = planes[i]
        gap = plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] + plane[3]
        if gap > solid_gap:
            solid_gap = gap
            facing = i
        last_face = i + 1 == planes.shape[0]
        if not last_face:
            last_face = solid_from_plane[i + 1] != solid_from_plane[i]
        if last_face:
            if solid_gap < nearest_gap:
                nearest_gap = solid_gap
                nearest = facing
            solid_gap = real(-wp.inf)
    gaps_out[point] = nearest_gap
    planes_out[point] = nearest


@wp.func_native(
    on_cpu(
        """
    const int planes_count = planes.shape[0], nodes_count = positions.shape[0], points = nodes.shape[0];
    const double *const x = (const double*)positions.data, *const w = (const double*)weights.data;
    double* const height = heights.data;
    const int* const corners = (const int*)nodes.data;
    for (int p = 0; p < planes_count; ++p) {
        const double* const plane = (const double*)planes.data + 4 * p;
        double* const row = height + p * nodes_count;
        for (int i = 0; i < nodes_count; ++i)
            row[i] = plane[0] * x[3 * i] + plane[1] * x[3 * i + 1] + plane[2] * x[3 * i + 2] + plane[3];
    }
    for (int i = 0; i < points; ++i) {
        const int* const corner = corners + 4 * i;
        const double* const share = w + 4 * i;
        double nearest_gap = __builtin_inf(), solid_gap = -__builtin_inf();
        int nearest = 0, facing = 0;
        for (int p = 0; p < planes_count; ++p) {
            const double* const row = height + p * nodes_count;
            const double gap = (share[0] * row[corner[0]] + share[1] * row[corner[1]])
                + (share[2] * row[corner[2]] + share[3] * row[corner[3]]);
            if (gap > solid_gap) {
                solid_gap = gap;
                facing = p;
            }
            if (p + 1 == planes_count || solid_from_plane.data[p + 1] != solid_from_plane.data[p]) {
                if (solid_gap < nearest_gap) {
                    nearest_gap = solid_gap;
                    nearest = facing;
                }
                solid_gap = -__builtin_inf();
            }
        }
        gaps_out.data[i] = nearest_gap;
        planes_out.data[i] = nearest;
    }
"""
    )
)
def write_gaps(
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    planes: wp.array[Vec4],
    solid_from_plane: wp.array[int],
    positions: wp.array[Vec3],
    heights: wp.array[real],
    gaps_out: wp.array[real],
    planes_out: wp.array[int],
) -> None:
    """Compute the gaps of all points (native code of ``all_gaps_kernel``)."""
    ...


@wp.kernel
def all_gaps_kernel(
    # Model:
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    planes: wp.array[Vec4],
    solid_from_plane: wp.array[int],
    # In:
    positions: wp.array[Vec3],
    # Out:
    heights: wp.array[real],
    gaps_out: wp.array[real],
    planes_out: wp.array[int],
):
    """Do the same as ``point_gaps_kernel`` for all points in one CPU thread, each point on four ``nodes``.
    ``heights`` is a workspace of planes times nodes for the signed distances of the nodes, which are interpolated
    linearly.
    """
    write_gaps(nodes, weights, planes, solid_from_plane, positions, heights, gaps_out, planes_out)
