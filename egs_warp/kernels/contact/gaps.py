"""Contact detection of embedded points against planes."""

import warp as wp

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
    """Signed distance of each embedded point to the nearest solid, and which of its planes faces the point.

    The planes of a solid, its intersection, follow each other; the largest distance to them bounds that to the solid
    from below.
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
