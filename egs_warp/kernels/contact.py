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
    # In:
    positions: wp.array[Vec3],
    # Out:
    gaps_out: wp.array[real],
    planes_out: wp.array[int],
):
    """Signed distance of each embedded point to the nearest plane, and which plane that is."""
    point = wp.tid()
    tet = tets[tet_from_point[point]]
    w = weights[point]
    x = w[0] * positions[tet[0]] + w[1] * positions[tet[1]] + w[2] * positions[tet[2]] + w[3] * positions[tet[3]]
    best = real(wp.inf)
    nearest = int(0)
    for i in range(planes.shape[0]):
        plane = planes[i]
        gap = plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] + plane[3]
        if gap < best:
            best = gap
            nearest = i
    gaps_out[point] = best
    planes_out[point] = nearest
