"""Kernels of contact detection between embedded points and planes (Eq. 8)."""

import warp as wp

from egs_warp.kernels.vectors import on_cpu
from egs_warp.precision import Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})


@wp.func
def embedded_point(tet: wp.vec4i, w: Vec4, positions: wp.array2d[Vec3], world: int):
    """Return the position in metres of the point with barycentric weights ``w`` in the tetrahedron with the nodes
    ``tet``, for the nodes ``positions`` (B, N) m of ``world``."""
    return (
        w[0] * positions[world, tet[0]]
        + w[1] * positions[world, tet[1]]
        + w[2] * positions[world, tet[2]]
        + w[3] * positions[world, tet[3]]
    )


@wp.kernel
def point_gaps_kernel(
    # Model:
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    planes: wp.array[Vec4],
    solid_from_plane: wp.array[int],
    # In:
    positions: wp.array2d[Vec3],
    # Out:
    gaps_out: wp.array2d[real],
    planes_out: wp.array2d[int],
):
    """Compute the gap of each embedded point in each world: its signed distance to the nearest solid, in metres.

    A solid is the intersection of the half spaces behind its planes, which are consecutive. The largest signed distance
    to its planes is used as the distance to the solid; it is a lower bound of the true distance.

    Args:
        nodes: (P,) nodes of the tetrahedron of each point.
        weights: (P,) barycentric weights of each point.
        planes: (planes,) unit outward normal and offset of each plane.
        solid_from_plane: (planes,) index of the solid of each plane, ascending.
        positions: (B, N) m, nodes.
        gaps_out: (B, P) m, gaps.
        planes_out: (B, P) index of the plane of the nearest solid with the largest signed distance.
    """
    world, point = wp.tid()
    x = embedded_point(nodes[point], weights[point], positions, world)
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
    gaps_out[world, point] = nearest_gap
    planes_out[world, point] = nearest


@wp.func_native(
    on_cpu(
        """
    const int planes_count = planes.shape[0], nodes_count = positions.shape[1], points = nodes.shape[0];
    const double* const x = (const double*)positions.data + 3 * (size_t)world * nodes_count;
    const double* const w = (const double*)weights.data;
    double* const gaps = gaps_out.data + (size_t)world * points;
    int* const nearest_planes = planes_out.data + (size_t)world * points;
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
        gaps[i] = nearest_gap;
        nearest_planes[i] = nearest;
    }
"""
    )
)
def write_gaps(
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    planes: wp.array[Vec4],
    solid_from_plane: wp.array[int],
    positions: wp.array2d[Vec3],
    world: int,
    heights: wp.array[real],
    gaps_out: wp.array2d[real],
    planes_out: wp.array2d[int],
) -> None:
    """Compute the gaps of all points of ``world`` (native code of ``all_gaps_kernel``)."""
    ...


@wp.kernel
def all_gaps_kernel(
    # Model:
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    planes: wp.array[Vec4],
    solid_from_plane: wp.array[int],
    # In:
    positions: wp.array2d[Vec3],
    # Out:
    heights: wp.array[real],
    gaps_out: wp.array2d[real],
    planes_out: wp.array2d[int],
):
    """Compute the gaps like ``point_gaps_kernel``, with one CPU thread for all points of a world.

    Arrays must be contiguous. The worlds of a launch on a CPU run one after the other and share the workspace.

    Args:
        nodes, weights, planes, solid_from_plane, positions: as in ``point_gaps_kernel``.
        heights: (planes x nodes,) m, workspace for the signed distances of the nodes, from which those of the points
            are interpolated linearly.
        gaps_out, planes_out: as in ``point_gaps_kernel``.
    """
    write_gaps(nodes, weights, planes, solid_from_plane, positions, wp.tid(), heights, gaps_out, planes_out)
