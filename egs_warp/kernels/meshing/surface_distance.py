"""Distance of points from a closed triangle mesh, with and without sign."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def surface_distance_kernel(
    first_row: wp.int32,
    # Model:
    mesh: wp.uint64,
    # In:
    points: wp.array[wp.vec3],
    max_distance: float,
    # Out:
    distances_out: wp.array[float],
):
    """Compute the signed distance of each point from a closed mesh: negative where the winding number is above one
    half.

    Args:
        mesh: the triangle mesh.
        points: (n,) points.
        max_distance: result for points to which no triangle is nearer than this.
        distances_out: (n,) signed distances, in the unit of the points.
    """
    i = first_row + wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], max_distance)
    distance = max_distance
    if query.result:
        nearest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        distance = query.sign * wp.length(points[i] - nearest)
    distances_out[i] = distance


@wp.kernel
def unsigned_distance_kernel(
    first_row: wp.int32,
    # Model:
    mesh: wp.uint64,
    # In:
    points: wp.array[wp.vec3],
    max_distance: float,
    # Out:
    distances_out: wp.array[float],
):
    """Compute the distance of each point from a mesh.

    Args:
        mesh: the triangle mesh.
        points: (n,) points.
        max_distance: upper limit of the distances.
        distances_out: (n,) distances, in the unit of the points.
    """
    i = first_row + wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], max_distance)
    distance = max_distance
    if query.result:
        nearest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        distance = wp.length(points[i] - nearest)
    distances_out[i] = distance
