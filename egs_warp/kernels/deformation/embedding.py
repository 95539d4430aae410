"""Kernels that locate points in a rest cage (Eq. 2), and that embed the seven points of every Gaussian (Eq. 3).

The kernels share these arguments: ``origin`` is subtracted from all points, and ``nodes`` and the boxes are relative to
it; ``extent`` is the size of the cage, m; ``tets`` (T,) are the nodes of the tetrahedra; ``inverse_edges`` (T,) 1/m
their inverse edge matrices; ``box_lowers`` and ``box_uppers`` (T,) the corners of their boxes; ``boxes`` the bounding
volume hierarchy of these boxes; ``surface`` the mesh of the cage's surface.
"""

import warp as wp

from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})

# A point on a shared face belongs to both tetrahedra; the tolerance makes the choice independent of rounding.
INSIDE_TOLERANCE = wp.constant(wp.float64(1.0e-10))
DISTANCE_TOLERANCE = wp.constant(wp.float64(1.0e-9))

ARM_SHORTENING = wp.constant(wp.float64(0.6))
MAX_ARM_LENGTHS = wp.constant(10)


@wp.func
def barycentric_weights(corner: Vec3, inverse_edges: Mat33, point: Vec3) -> Vec4:
    """Return the barycentric weights of ``point`` in a tetrahedron (Eq. 2), whose sum is 1.

    ``corner`` is the first corner x0 of the tetrahedron, and ``inverse_edges`` the inverse of [x1-x0, x2-x0, x3-x0].
    """
    w = inverse_edges * (point - corner)
    return Vec4(real(1.0) - w[0] - w[1] - w[2], w[0], w[1], w[2])


@wp.func
def least_weight(weights: Vec4) -> real:
    return wp.min(wp.min(weights[0], weights[1]), wp.min(weights[2], weights[3]))


@wp.func
def closest_on_triangle(a: Vec3, b: Vec3, c: Vec3, point: Vec3) -> Vec3:
    """Return the point of a triangle that is closest to ``point`` (Ericson, Real-Time Collision Detection, 5.1.5: by
    Voronoi regions).
    """
    ab = b - a
    ac = c - a
    ap = point - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    if d1 <= real(0.0) and d2 <= real(0.0):
        return a
    bp = point - b
    d3 = wp.dot(ab, bp)
    d4 = wp.dot(ac, bp)
    if d3 >= real(0.0) and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= real(0.0) and d1 >= real(0.0) and d3 <= real(0.0):
        return a + ab * (d1 / (d1 - d3))
    cp = point - c
    d5 = wp.dot(ab, cp)
    d6 = wp.dot(ac, cp)
    if d6 >= real(0.0) and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= real(0.0) and d2 >= real(0.0) and d6 <= real(0.0):
        return a + ac * (d2 / (d2 - d6))
    va = d3 * d6 - d5 * d4
    if va <= real(0.0) and d4 - d3 >= real(0.0) and d5 - d6 >= real(0.0):
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
    total = va + vb + vc
    return a + ab * (vb / total) + ac * (vc / total)


@wp.func
def distance_to_tet(x0: Vec3, x1: Vec3, x2: Vec3, x3: Vec3, weights: Vec4, point: Vec3) -> real:
    """Return the distance in metres between a tetrahedron and a ``point`` outside it, which has these barycentric
    ``weights``. Only faces whose outer side faces the point can be nearest.
    """
    nearest = real(1.0e300)
    if weights[0] < real(0.0):
        nearest = wp.min(nearest, wp.length(point - closest_on_triangle(x1, x2, x3, point)))
    if weights[1] < real(0.0):
        nearest = wp.min(nearest, wp.length(point - closest_on_triangle(x0, x2, x3, point)))
    if weights[2] < real(0.0):
        nearest = wp.min(nearest, wp.length(point - closest_on_triangle(x0, x1, x3, point)))
    if weights[3] < real(0.0):
        nearest = wp.min(nearest, wp.length(point - closest_on_triangle(x0, x1, x2, point)))
    return nearest


@wp.func
def single(v: Vec3) -> wp.vec3:
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
def distance_to_box(lower: wp.vec3, upper: wp.vec3, point: wp.vec3) -> wp.float32:
    outside = wp.max(wp.max(lower - point, point - upper), wp.vec3(0.0))
    return wp.length(outside)


@wp.func
def locate(
    point: Vec3,
    extent: real,
    tets: wp.array[wp.vec4i],
    nodes: wp.array[Vec3],
    inverse_edges: wp.array[Mat33],
    box_lowers: wp.array[wp.vec3],
    box_uppers: wp.array[wp.vec3],
    boxes: wp.uint64,
    surface: wp.uint64,
) -> wp.vec2i:
    """Return the index of the tetrahedron that contains the point, or of the nearest one; and 1 if the point is inside,
    else 0.

    Among several tetrahedra that contain the point, the lowest index is returned. Among several at equal distance (the
    nearest point is on a shared edge or node), the one whose weights extrapolate least is returned, then the lowest
    index.
    """
    coarse = single(point)

    best = wp.int32(-1)
    candidate = wp.int32(0)
    query = wp.bvh_query_aabb(boxes, coarse, coarse)
    while wp.bvh_query_next(query, candidate):
        if best < 0 or candidate < best:
            weights = barycentric_weights(nodes[tets[candidate][0]], inverse_edges[candidate], point)
            if least_weight(weights) >= -INSIDE_TOLERANCE:
                best = candidate
    if best >= 0:
        return wp.vec2i(best, 1)

    # The float32 distance to the surface bounds the search; ``slack`` covers the rounding error of this distance.
    slack = 1.0e-5 * (wp.length(coarse) + wp.float32(extent))
    radius = wp.length(coarse) + 2.0 * wp.float32(extent)
    on_surface = wp.mesh_query_point_no_sign(surface, coarse, radius)
    if on_surface.result:
        nearest_surface = wp.mesh_eval_position(surface, on_surface.face, on_surface.u, on_surface.v)
        radius = wp.length(nearest_surface - coarse)
    radius = radius + slack
    reach = wp.vec3(radius)

    nearest = real(1.0e300)
    query = wp.bvh_query_aabb(boxes, coarse - reach, coarse + reach)
    while wp.bvh_query_next(query, candidate):
        if distance_to_box(box_lowers[candidate], box_uppers[candidate], coarse) <= radius:
            corners = tets[candidate]
            x0 = nodes[corners[0]]
            weights = barycentric_weights(x0, inverse_edges[candidate], point)
            distance = distance_to_tet(x0, nodes[corners[1]], nodes[corners[2]], nodes[corners[3]], weights, point)
            if distance < nearest:
                nearest = distance
                radius = wp.min(radius, wp.float32(distance) + slack)

    limit = nearest * (real(1.0) + DISTANCE_TOLERANCE) + DISTANCE_TOLERANCE * extent
    reach = wp.vec3(radius)
    least = real(-1.0e300)
    query = wp.bvh_query_aabb(boxes, coarse - reach, coarse + reach)
    while wp.bvh_query_next(query, candidate):
        if distance_to_box(box_lowers[candidate], box_uppers[candidate], coarse) <= radius:
            corners = tets[candidate]
            x0 = nodes[corners[0]]
            weights = barycentric_weights(x0, inverse_edges[candidate], point)
            distance = distance_to_tet(x0, nodes[corners[1]], nodes[corners[2]], nodes[corners[3]], weights, point)
            low = least_weight(weights)
            if distance <= limit and (low > least or (low == least and candidate < best)):
                least = low
                best = candidate
    return wp.vec2i(best, 0)


@wp.kernel
def locate_points_kernel(
    first_row: wp.int32,
    # In:
    points: wp.array[Vec3],
    origin: Vec3,
    extent: real,
    tets: wp.array[wp.vec4i],
    nodes: wp.array[Vec3],
    inverse_edges: wp.array[Mat33],
    box_lowers: wp.array[wp.vec3],
    box_uppers: wp.array[wp.vec3],
    boxes: wp.uint64,
    surface: wp.uint64,
    # Out:
    tets_out: wp.array[wp.int32],
    nodes_out: wp.array[wp.vec4i],
    weights_out: wp.array[Vec4],
    inside_out: wp.array[wp.bool],
):
    """Compute the tetrahedron and the barycentric weights of each point (Eq. 2).

    Args:
        points: (n,) m.
        origin, extent, tets, nodes, inverse_edges, box_lowers, box_uppers, boxes, surface: the cage (module docstring).
        tets_out: (n,) tetrahedron that contains the point, or the nearest one.
        nodes_out: (n,) nodes of this tetrahedron.
        weights_out: (n,) barycentric weights in it.
        inside_out: (n,) True if the point is inside the cage.
    """
    row = first_row + wp.tid()
    point = points[row] - origin
    location = locate(point, extent, tets, nodes, inverse_edges, box_lowers, box_uppers, boxes, surface)
    tet = location[0]
    tets_out[row] = tet
    nodes_out[row] = tets[tet]
    weights_out[row] = barycentric_weights(nodes[tets[tet][0]], inverse_edges[tet], point)
    inside_out[row] = location[1] == 1


@wp.func
def axes_from_quaternion(q: wp.vec4) -> Mat33:
    """Return the rotation matrix [r1 r2 r3] of a quaternion w, x, y, z. The quaternion is normalised in float64,
    because its float32 components are rounded.
    """
    d = Vec4(real(q[0]), real(q[1]), real(q[2]), real(q[3]))
    d = d / wp.length(d)
    w = d[0]
    x = d[1]
    y = d[2]
    z = d[3]
    one = real(1.0)
    two = real(2.0)
    return Mat33(
        one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
        two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
        two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
    )  # fmt: skip


@wp.kernel
def embed_gaussians_kernel(
    first_row: wp.int32,
    # In:
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    gamma: real,
    min_arm: real,
    origin: Vec3,
    extent: real,
    tets: wp.array[wp.vec4i],
    nodes: wp.array[Vec3],
    inverse_edges: wp.array[Mat33],
    box_lowers: wp.array[wp.vec3],
    box_uppers: wp.array[wp.vec3],
    boxes: wp.uint64,
    surface: wp.uint64,
    # Out:
    tets_out: wp.array[wp.int32],
    nodes_out: wp.array[wp.vec4i],
    weights_out: wp.array[Vec4],
    inside_out: wp.array[wp.bool],
    arms_out: wp.array2d[wp.float32],
):
    """Embed the seven points of each Gaussian: the mean, three ends m + arm r_j, three ends m - arm r_j (Eq. 3).

    Point k of Gaussian i is row 7 i + k. An arm whose end would have weights outside [-1, 2] is shortened until they
    are inside. If no length suffices (the mean itself lies far outside), the arm uses the tetrahedron of the mean.

    Args:
        means, rotations, log_scales: the n Gaussians at rest.
        gamma: length of the arms in standard deviations.
        min_arm: m, minimum length of an arm.
        origin, extent, tets, nodes, inverse_edges, box_lowers, box_uppers, boxes, surface: the cage (module docstring).
        tets_out, nodes_out, weights_out, inside_out: (7 n,) as in ``locate_points_kernel``.
        arms_out: (n, 6) m, lengths of the arms.
    """
    row = first_row + wp.tid()
    gaussian = row // 7
    k = row - 7 * gaussian
    m = means[gaussian]
    mean = Vec3(real(m[0]), real(m[1]), real(m[2])) - origin
    point = mean
    location = wp.vec2i(0, 0)
    if k == 0:
        location = locate(point, extent, tets, nodes, inverse_edges, box_lowers, box_uppers, boxes, surface)
    else:
        axis = (k - 1) % 3
        axes = axes_from_quaternion(rotations[gaussian])
        direction = Vec3(axes[0, axis], axes[1, axis], axes[2, axis])
        if k > 3:
            direction = -direction
        arm = wp.float32(wp.max(gamma * wp.exp(real(log_scales[gaussian][axis])), min_arm))
        attempt = wp.int32(0)
        searching = wp.bool(True)
        while searching:
            point = mean + real(arm) * direction
            location = locate(point, extent, tets, nodes, inverse_edges, box_lowers, box_uppers, boxes, surface)
            weights = barycentric_weights(nodes[tets[location[0]][0]], inverse_edges[location[0]], point)
            greatest = wp.max(wp.max(weights[0], weights[1]), wp.max(weights[2], weights[3]))
            searching = least_weight(weights) < real(-1.0) or greatest > real(2.0)
            attempt += 1
            if searching:
                if attempt == MAX_ARM_LENGTHS or real(arm) * ARM_SHORTENING < min_arm:
                    location = locate(mean, extent, tets, nodes, inverse_edges, box_lowers, box_uppers, boxes, surface)
                    location[1] = 0
                    searching = wp.bool(False)
                else:
                    arm = arm * wp.float32(ARM_SHORTENING)
        arms_out[gaussian, k - 1] = arm
    tet = location[0]
    tets_out[row] = tet
    nodes_out[row] = tets[tet]
    weights_out[row] = barycentric_weights(nodes[tets[tet][0]], inverse_edges[tet], point)
    inside_out[row] = location[1] == 1


@wp.kernel
def interpolate_points_kernel(
    first_row: wp.int32,
    # In:
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    positions: wp.array[Vec3],
    # Out:
    points_out: wp.array[Vec3],
):
    """Compute the position of each embedded point (Eq. 2).

    Args:
        nodes: (n,) nodes of the tetrahedron of each point.
        weights: (n,) barycentric weights.
        positions: (N,) m, nodes of the cage.
        points_out: (n,) m.
    """
    row = first_row + wp.tid()
    n = nodes[row]
    w = weights[row]
    points_out[row] = w[0] * positions[n[0]] + w[1] * positions[n[1]] + w[2] * positions[n[2]] + w[3] * positions[n[3]]


@wp.kernel
def nearest_face_kernel(
    first_row: wp.int32,
    # In:
    points: wp.array[wp.vec3],
    origin: Vec3,
    extent: real,
    surface: wp.uint64,
    # Out:
    faces_out: wp.array[wp.int32],
):
    """Find the triangle of the cage's surface that is nearest to each point.

    Args:
        points: (n,) m.
        origin, extent, surface: the cage (module docstring).
        faces_out: (n,) index of the triangle.
    """
    row = first_row + wp.tid()
    point = points[row] - single(origin)
    location = wp.mesh_query_point_no_sign(surface, point, wp.length(point) + 2.0 * wp.float32(extent))
    faces_out[row] = wp.where(location.result, location.face, 0)
