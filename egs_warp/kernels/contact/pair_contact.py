"""Contact between the embedded points of one body and the level set of another body through its deformed tetrahedra.
Both may be the same body (self contact).

A point of body a at x lies in a tetrahedron of body b with barycentric weights w. At rest the same weights give X =
sum w_i X_i, where the level set phi of b is evaluated. With the deformation gradient F of the tetrahedron and g = F^-T
grad phi(X), the normal is n = g / |g| and the gap phi / |g|, the distance to first order. The derivative of phi is g
with respect to x and -w_i g with respect to node i of b.

In self contact, a point is in its own tetrahedron, too, where X is its own rest position X_p, and extrapolation from
adjacent tetrahedra gives an X close to X_p. At rest, and after a rigid motion, all tetrahedra give X_p. So tetrahedra
with an X close to X_p are skipped.
"""

import warp as wp

from egs_warp.kernels.contact.gaps import embedded_point
from egs_warp.kernels.contact.level_set import LevelSetLattice, level_set_value_and_gradient
from egs_warp.kernels.deformation.embedding import least_weight, single
from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})

MIN_SLOPE = wp.constant(wp.float64(0.5))
"""Lower bound of |grad phi| in the gap, because the slope of a level set vanishes near the middle of the body."""

SELF_SHIFT = wp.constant(wp.float64(2.5))
"""Minimum distance between X and X_p in self contact, as a multiple of the distance d up to which points outside of a
tetrahedron are tested. If the point is in a neighbour with the deformation gradient F_2, at most d outside their common
face, then |X - X_p| <= |F_1^-1 - F_2^-1| d, because both gradients agree along the face."""


@wp.func
def edges_of(corners: wp.vec4i, positions: wp.array2d[Vec3], world: int) -> Mat33:
    """Return the matrix whose columns are the edges from the first corner of a tetrahedron to the others, m."""
    first = positions[world, corners[0]]
    return wp.matrix_from_cols(
        positions[world, corners[1]] - first, positions[world, corners[2]] - first, positions[world, corners[3]] - first
    )


@wp.func
def weights_in_tet(corners: wp.vec4i, positions: wp.array2d[Vec3], world: int, x: Vec3) -> Vec4:
    """Return the barycentric weights of ``x`` in a deformed tetrahedron; all are -inf if the tetrahedron is
    inverted."""
    edges = edges_of(corners, positions, world)
    if wp.determinant(edges) <= real(0.0):
        return Vec4(real(-wp.inf))
    w = wp.inverse(edges) * (x - positions[world, corners[0]])
    return Vec4(real(1.0) - w[0] - w[1] - w[2], w[0], w[1], w[2])


@wp.func
def is_in_reach(weights: Vec4, inverse: Mat33, reach: real) -> bool:
    """Return True if a point is at most ``reach`` metres outside each face of a tetrahedron.

    Args:
        weights: barycentric weights of the point.
        inverse: inverse of the tetrahedron's edges. Its rows are the gradients of the last three weights.
        reach: m.
    """
    first = Vec3()
    for i in range(3):
        gradient = Vec3(inverse[i, 0], inverse[i, 1], inverse[i, 2])
        if weights[i + 1] < -reach * wp.length(gradient):
            return False
        first += gradient
    return weights[0] >= -reach * wp.length(first)


@wp.func
def is_another_part(
    weights: Vec4,
    corners: wp.vec4i,
    own: Vec3,
    reach: real,
    rest: wp.array2d[Vec3],
    positions: wp.array2d[Vec3],
    world: int,
) -> bool:
    """Return True if a point of a body may touch the body at one of its own tetrahedra: it is at most ``reach`` metres
    outside, and the tetrahedron maps it to a place away from its own rest position ``own``.

    Args:
        weights: barycentric weights of the point in the tetrahedron.
        corners: nodes of the tetrahedron.
        own: m, rest position of the point.
        reach: m.
        rest: (1, N) m, nodes at rest.
        positions: (B, N) m, nodes.
        world: index of the world.
    """
    if wp.length(embedded_point(corners, weights, rest, 0) - own) < SELF_SHIFT * reach:
        return False
    return is_in_reach(weights, wp.inverse(edges_of(corners, positions, world)), reach)


@wp.func
def tet_at_point(
    x: Vec3,
    own: Vec3,
    reach: real,
    world: int,
    tets: wp.array[wp.vec4i],
    rest: wp.array2d[Vec3],
    positions: wp.array2d[Vec3],
    boxes: wp.uint64,
) -> int:
    """Return the index of the deformed tetrahedron in which the minimum barycentric weight of ``x`` is largest.

    If several are equal, the lowest index is returned. Only tetrahedra whose boxes contain ``x`` are tested; the result
    is -1 if there are none.

    Args:
        x: m, the point.
        own: m, rest position of a point of the same body, for ``is_another_part``; not used if ``reach`` is 0.
        reach: m, maximum distance outside of the tetrahedra in self contact; 0 for a point of another body.
        world: index of the world.
        tets: (T,) nodes of the tetrahedra.
        rest: (1, N) m, nodes at rest.
        positions: (B, N) m, nodes.
        boxes: bounding volume hierarchy of the boxes, with a group for each world.
    """
    coarse = single(x)
    query = wp.bvh_query_aabb(boxes, coarse, coarse, wp.bvh_get_group_root(boxes, world))
    candidate = int(0)
    best = int(-1)
    max_weight = real(-wp.inf)
    while wp.bvh_query_next(query, candidate):
        tet = candidate - world * tets.shape[0]
        weights = weights_in_tet(tets[tet], positions, world, x)
        weight = least_weight(weights)
        is_better = weight > max_weight or (weight == max_weight and weight > real(-wp.inf) and tet < best)
        if is_better and reach > real(0.0):
            is_better = is_another_part(weights, tets[tet], own, reach, rest, positions, world)
        if is_better:
            max_weight = weight
            best = tet
    return best


@wp.func
def normal_and_gap(
    weights: Vec4,
    corners: wp.vec4i,
    rest: wp.array2d[Vec3],
    positions: wp.array2d[Vec3],
    world: int,
    lattice: LevelSetLattice,
    coefficients: wp.array[float],
) -> Vec4:
    """Return the contact normal at a point and, as the last component, the gap in metres.

    If the gradient of the level set vanishes at the point, the normal is zero and the gap infinite.

    Args:
        weights: barycentric weights of the point in a tetrahedron of the other body.
        corners: nodes of this tetrahedron.
        rest: (1, N) m, nodes at rest in the frame of the level set.
        positions: (B, N) m, nodes.
        world: index of the world.
        lattice, coefficients: level set of the other body.
    """
    level = level_set_value_and_gradient(lattice, coefficients, embedded_point(corners, weights, rest, 0))
    gradient = Vec3(level[0], level[1], level[2])
    slope = wp.length(gradient)
    if slope < real(1.0e-9):
        return Vec4(real(0.0), real(0.0), real(0.0), real(wp.inf))
    rest_edges = edges_of(corners, rest, 0)
    g = wp.transpose(wp.inverse(edges_of(corners, positions, world))) * (wp.transpose(rest_edges) * gradient)
    length = wp.length(g)
    gap = level[3] / (length * wp.max(real(1.0), MIN_SLOPE / slope))
    return Vec4(g[0] / length, g[1] / length, g[2] / length, gap)


@wp.func
def frame_of_normal(n: Vec3) -> Mat33:
    """Return the contact frame with rows n, t1, t2 for a unit normal ``n``. The frame is continuous in n except where
    |n_x| is 0.8, so for a normal along an axis it does not depend on rounding."""
    helper = Vec3(real(1.0), real(0.0), real(0.0))
    if wp.abs(n[0]) > real(0.8):
        helper = Vec3(real(0.0), real(1.0), real(0.0))
    first = wp.normalize(wp.cross(helper, n))
    return wp.matrix_from_rows(n, first, wp.cross(n, first))


@wp.kernel
def tet_boxes_kernel(
    # Model:
    tets: wp.array[wp.vec4i],
    margin: real,
    # In:
    positions: wp.array2d[Vec3],
    # Out:
    lowers_out: wp.array[wp.vec3],
    uppers_out: wp.array[wp.vec3],
):
    """Compute the bounding box of each deformed tetrahedron of each world, enlarged by ``margin`` on all sides.

    Args:
        tets: (T,) nodes of the tetrahedra.
        margin: m.
        positions: (B, N) m, nodes.
        lowers_out, uppers_out: (B T,) m, corners of the boxes.
    """
    world, tet = wp.tid()
    corners = tets[tet]
    low = positions[world, corners[0]]
    high = low
    for i in range(1, 4):
        x = positions[world, corners[i]]
        low = wp.min(low, x)
        high = wp.max(high, x)
    inflation = Vec3(margin, margin, margin)
    row = world * tets.shape[0] + tet
    lowers_out[row] = single(low - inflation)
    uppers_out[row] = single(high + inflation)


@wp.kernel
def close_tets_kernel(
    # Model:
    tet_count: int,
    boxes: wp.uint64,
    # In:
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    # Out:
    close_out: wp.array2d[bool],
):
    """Mark the tetrahedra of body a whose boxes overlap the box of a tetrahedron of body b.

    Args:
        tet_count: number T of tetrahedra of body a.
        boxes: bounding volume hierarchy of the tetrahedra of body b, with a group for each world.
        lowers, uppers: (B T,) m, corners of the boxes of the tetrahedra of body a.
        close_out: (B, T) True for tetrahedra with an overlap.
    """
    world, tet = wp.tid()
    row = world * tet_count + tet
    query = wp.bvh_query_aabb(boxes, lowers[row], uppers[row], wp.bvh_get_group_root(boxes, world))
    candidate = int(0)
    close_out[world, tet] = wp.bvh_query_next(query, candidate)


@wp.kernel
def self_close_tets_kernel(
    # Model:
    tets: wp.array[wp.vec4i],
    rest: wp.array2d[Vec3],
    boxes: wp.uint64,
    reach: real,
    # In:
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    positions: wp.array2d[Vec3],
    # Out:
    close_out: wp.array2d[bool],
):
    """Mark the tetrahedra of a body whose points may touch another tetrahedron of the body.

    A point inside a tetrahedron is a convex combination of its corners, and so is its X - X_p. So tetrahedra whose
    corners are all beyond the same face of another one, or all have an X close to their rest positions, are not close.

    Args:
        tets: (T,) nodes of the tetrahedra.
        rest: (1, N) m, nodes at rest.
        boxes: bounding volume hierarchy of the deformed tetrahedra, with a group for each world.
        reach: m, maximum distance outside of a tetrahedron.
        lowers, uppers: (B T,) m, corners of the boxes of the tetrahedra.
        positions: (B, N) m, nodes.
        close_out: (B, T) True for tetrahedra whose points have to be tested.
    """
    world, tet = wp.tid()
    row = world * tets.shape[0] + tet
    query = wp.bvh_query_aabb(boxes, lowers[row], uppers[row], wp.bvh_get_group_root(boxes, world))
    candidate = int(0)
    close = bool(False)
    while not close and wp.bvh_query_next(query, candidate):
        corners = tets[candidate - world * tets.shape[0]]
        edges = edges_of(corners, positions, world)
        if wp.determinant(edges) > real(0.0):
            inverse = wp.inverse(edges)
            highest = Vec4(real(-wp.inf))
            shift = real(0.0)
            for i in range(4):
                node = tets[tet][i]
                w = inverse * (positions[world, node] - positions[world, corners[0]])
                weights = Vec4(real(1.0) - w[0] - w[1] - w[2], w[0], w[1], w[2])
                highest = wp.max(highest, weights)
                shift = wp.max(shift, wp.length(embedded_point(corners, weights, rest, 0) - rest[0, node]))
            if shift >= SELF_SHIFT * reach:
                close = is_in_reach(highest, inverse, reach)
    close_out[world, tet] = close


@wp.kernel
def pair_gaps_kernel(
    # Model:
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    point_starts: wp.array[int],
    points_by_tet: wp.array[int],
    tets: wp.array[wp.vec4i],
    rest: wp.array2d[Vec3],
    boxes: wp.uint64,
    lattice: LevelSetLattice,
    coefficients: wp.array[float],
    reach: real,
    # In:
    close: wp.array2d[bool],
    positions: wp.array2d[Vec3],
    other_positions: wp.array2d[Vec3],
    # Out:
    gaps_out: wp.array2d[real],
    tets_out: wp.array2d[int],
):
    """Compute the gap of each point of body a to body b, and the tetrahedron of b that contains the point. A thread
    computes all points of a tetrahedron of a, because few tetrahedra are close to b.

    The gap is infinite and the tetrahedron -1 if the box of no tetrahedron of b contains the point, or if b is a and
    the point touches no other part of it.

    Args:
        nodes: (P,) nodes of the tetrahedron of each point of a.
        weights: (P,) barycentric weights of each point.
        point_starts: (T + 1,) first entry of each tetrahedron of a in ``points_by_tet``, and P.
        points_by_tet: (P,) points of a, sorted by their tetrahedra.
        tets: tetrahedra of b.
        rest: (1, N) m, nodes of b at rest.
        boxes: bounding volume hierarchy of the deformed tetrahedra of b.
        lattice, coefficients: level set of b.
        reach: m, maximum distance outside of the tetrahedra if b is a (``tet_at_point``); 0 for another body.
        close: (B, T) tetrahedra of a whose points are tested.
        positions, other_positions: (B, N) m, nodes of a and of b.
        gaps_out: (B, P) m, gaps.
        tets_out: (B, P) tetrahedra of b.
    """
    world, own_tet = wp.tid()
    is_close = close[world, own_tet]
    for entry in range(point_starts[own_tet], point_starts[own_tet + 1]):
        point = points_by_tet[entry]
        tet = int(-1)
        gap = real(wp.inf)
        if is_close:
            x = embedded_point(nodes[point], weights[point], positions, world)
            own = Vec3()
            if reach > real(0.0):
                own = embedded_point(nodes[point], weights[point], rest, 0)
            tet = tet_at_point(x, own, reach, world, tets, rest, other_positions, boxes)
            if tet >= 0:
                corners = tets[tet]
                shares = weights_in_tet(corners, other_positions, world, x)
                gap = normal_and_gap(shares, corners, rest, other_positions, world, lattice, coefficients)[3]
        gaps_out[world, point] = gap
        tets_out[world, point] = tet


@wp.kernel
def pair_record_kernel(
    # Model:
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    tets: wp.array[wp.vec4i],
    rest: wp.array2d[Vec3],
    boxes: wp.uint64,
    lattice: LevelSetLattice,
    coefficients: wp.array[float],
    reach: real,
    # In:
    points: wp.array2d[int],
    end_tets: wp.array2d[int],
    positions: wp.array2d[Vec3],
    other_positions: wp.array2d[Vec3],
    # Out:
    nodes_out: wp.array2d[wp.vec4i],
    weights_out: wp.array2d[Vec4],
    other_nodes_out: wp.array2d[wp.vec4i],
    other_weights_out: wp.array2d[Vec4],
    axes_out: wp.array2d[Mat33],
    gaps_out: wp.array2d[real],
):
    """Write the record of the contacts of body a with body b: nodes and weights on both sides, frame and gap.

    A point may lie outside the boxes of all tetrahedra of b at the start of the step, but inside one at its end. Its
    weights are then extrapolated from the tetrahedron ``end_tets``. If this is -1 too, the axes are zero and the gap is
    infinite.

    Args:
        nodes: (P,) nodes of the tetrahedron of each point of a.
        weights: (P,) barycentric weights of each point.
        tets: tetrahedra of b.
        rest: (1, N) m, nodes of b at rest.
        boxes: bounding volume hierarchy of the deformed tetrahedra of b.
        lattice, coefficients: level set of b.
        reach: m, maximum distance outside of the tetrahedra if b is a (``tet_at_point``); 0 for another body.
        points: (B, K) indices of the contact points of a.
        end_tets: (B, P) tetrahedron of b at the end of the step, or -1.
        positions, other_positions: (B, N) m, nodes of a and of b at the start of the step.
        nodes_out, weights_out, other_nodes_out, other_weights_out: (B, K) nodes and weights on the sides of a and of b.
        axes_out: (B, K) contact frames.
        gaps_out: (B, K) m, gaps.
    """
    world, k = wp.tid()
    other_nodes = wp.vec4i()
    other_weights = Vec4()
    frame = Mat33()
    gap = real(wp.inf)
    point = points[world, k]
    x = embedded_point(nodes[point], weights[point], positions, world)
    own = Vec3()
    if reach > real(0.0):
        own = embedded_point(nodes[point], weights[point], rest, 0)
    tet = tet_at_point(x, own, reach, world, tets, rest, other_positions, boxes)
    if tet < 0:
        tet = end_tets[world, point]
    if tet >= 0:
        other_nodes = tets[tet]
        other_weights = weights_in_tet(other_nodes, other_positions, world, x)
        normal = normal_and_gap(other_weights, other_nodes, rest, other_positions, world, lattice, coefficients)
        frame = frame_of_normal(Vec3(normal[0], normal[1], normal[2]))
        gap = normal[3]
    nodes_out[world, k] = nodes[point]
    weights_out[world, k] = weights[point]
    other_nodes_out[world, k] = other_nodes
    other_weights_out[world, k] = other_weights
    axes_out[world, k] = frame
    gaps_out[world, k] = gap
