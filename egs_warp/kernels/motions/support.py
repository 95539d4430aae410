"""Kernels of support polygons: convex hulls, and points in them that are nearest to given points; one thread
per world.
"""

import warp as wp

from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

Vec2 = wp.vec2d

LINE_TOLERANCE = wp.constant(real(1e-6))
"""Maximum ratio of width to length at which points are considered collinear."""
_CORNER_TOLERANCE = wp.constant(real(1e-14))
"""Minimum of twice the area of the triangle of a corner and its neighbours, relative to the sum of the squared
distances of the points from their mean. Flatter corners are dropped."""
_TOLERANCE = wp.constant(real(1e-9))
"""Maximum distance outside a half plane, relative to the distances involved, at which a point is considered inside."""


@wp.func
def doubled_area(a: Vec2, b: Vec2, c: Vec2):
    """Return twice the signed area of the triangle (a, b, c); positive if it is counterclockwise."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


@wp.func
def is_before(a: Vec2, b: Vec2):
    """Return True if ``a`` precedes ``b`` in the lexicographic order."""
    return a[0] < b[0] or (a[0] == b[0] and a[1] < b[1])


@wp.kernel
def hull_kernel(
    # In:
    points: wp.array2d[Vec2],
    counts: wp.array[int],
    # Scratch:
    order: wp.array2d[int],
    # Out:
    corners_out: wp.array2d[Vec2],
    normals_out: wp.array2d[Vec2],
    offsets_out: wp.array2d[real],
    corner_counts_out: wp.array[int],
    edge_counts_out: wp.array[int],
):
    """Compute the counterclockwise convex hull of the points of each world by Andrew's monotone chain.

    The hull of collinear points is the segment between the two outermost points, with four half planes. The rows of the
    outputs are padded with their last entries.

    Args:
        points: (B, P) points in a plane, of which the first ``counts`` (B,) are valid.
        order: (B, P) scratch memory.
        corners_out: (B, capacity) corners of the hulls.
        normals_out, offsets_out: (B, capacity) half planes n.x <= d of the edges: unit outward normals n, and d.
        corner_counts_out, edge_counts_out: (B,) numbers of corners and of half planes.
    """
    world = wp.tid()
    count = counts[world]
    mean = Vec2()
    for i in range(count):
        mean += points[world, i] / real(count)
    xx = real(0.0)
    xy = real(0.0)
    yy = real(0.0)
    for i in range(count):
        arm = points[world, i] - mean
        xx += arm[0] * arm[0]
        xy += arm[0] * arm[1]
        yy += arm[1] * arm[1]
    corners = int(0)
    edges = int(0)
    half = real(0.5) * (xx - yy)
    largest = real(0.5) * (xx + yy) + wp.sqrt(half * half + xy * xy)
    if count < 3 or xx * yy - xy * xy <= LINE_TOLERANCE * LINE_TOLERANCE * largest * largest:
        angle = real(0.5) * wp.atan2(real(2.0) * xy, xx - yy)
        along = Vec2(wp.cos(angle), wp.sin(angle))
        left = Vec2(-along[1], along[0])
        first = int(0)
        last = int(0)
        for i in range(1, count):
            if wp.dot(along, points[world, i]) < wp.dot(along, points[world, first]):
                first = i
            if wp.dot(along, points[world, i]) > wp.dot(along, points[world, last]):
                last = i
        corners_out[world, 0] = points[world, first]
        corners_out[world, 1] = points[world, last]
        corners = int(2)
        normals_out[world, 0] = along
        normals_out[world, 1] = -along
        normals_out[world, 2] = left
        normals_out[world, 3] = -left
        edges = int(4)
        for k in range(4):
            normal = normals_out[world, k]
            offsets_out[world, k] = wp.max(wp.dot(normal, corners_out[world, 0]), wp.dot(normal, corners_out[world, 1]))
    else:
        for i in range(count):
            at = int(i)
            while at > 0 and is_before(points[world, i], points[world, order[world, wp.max(at - 1, 0)]]):
                order[world, at] = order[world, at - 1]
                at -= 1
            order[world, at] = i
        tolerance = _CORNER_TOLERANCE * (xx + yy)
        # The lower chain from left to right, then the upper chain back.
        start = int(1)
        for step in range(2 * count - 1):
            at = step
            if step >= count:
                at = 2 * count - 2 - step
                if step == count:
                    start = corners
            point = points[world, order[world, at]]
            closed = (
                corners > start
                and doubled_area(
                    corners_out[world, wp.max(corners - 2, 0)], corners_out[world, wp.max(corners - 1, 0)], point
                )
                <= tolerance
            )
            while closed:
                corners -= 1
                closed = (
                    corners > start
                    and doubled_area(
                        corners_out[world, wp.max(corners - 2, 0)], corners_out[world, wp.max(corners - 1, 0)], point
                    )
                    <= tolerance
                )
            if step < 2 * count - 2:
                corners_out[world, corners] = point
                corners += 1
        edges = corners
        for k in range(corners):
            first_corner = corners_out[world, k]
            side = corners_out[world, (k + 1) % corners] - first_corner
            normal = wp.normalize(Vec2(side[1], -side[0]))
            normals_out[world, k] = normal
            offsets_out[world, k] = wp.dot(normal, first_corner)
    for k in range(corners, corners_out.shape[1]):
        corners_out[world, k] = corners_out[world, corners - 1]
    for k in range(edges, normals_out.shape[1]):
        normals_out[world, k] = normals_out[world, edges - 1]
        offsets_out[world, k] = offsets_out[world, edges - 1]
    corner_counts_out[world] = corners
    edge_counts_out[world] = edges


@wp.func
def largest_excess(normals: wp.array2d[Vec2], offsets: wp.array2d[real], world: int, point: Vec2):
    """Return the largest distance by which ``point`` lies outside a half plane of ``world``; negative if it lies inside
    all of them.
    """
    excess = real(-wp.inf)
    for k in range(normals.shape[1]):
        excess = wp.max(excess, wp.dot(normals[world, k], point) - offsets[world, k])
    return excess


@wp.kernel
def nearest_kernel(
    # In:
    normals: wp.array2d[Vec2],
    offsets: wp.array2d[real],
    points: wp.array[Vec2],
    # Out:
    nearest_out: wp.array[Vec2],
):
    """Compute, for each world, the point in the intersection of its half planes that is nearest to a given point; see
    ``motions.support.nearest_in_half_planes``.

    Args:
        normals, offsets: (B, capacity) half planes, as in ``hull_kernel``.
        points: (B,) given points.
        nearest_out: (B,) nearest points.
    """
    world = wp.tid()
    point = points[world]
    best = point
    if wp.isfinite(point[0]) and wp.isfinite(point[1]) and largest_excess(normals, offsets, world, point) > real(0.0):
        scale = wp.max(wp.abs(point[0]), wp.abs(point[1]))
        widest = real(0.0)
        for i in range(normals.shape[1]):
            widest = wp.max(widest, wp.abs(offsets[world, i]))
        tolerance = _TOLERANCE * (scale + widest)
        least = real(wp.inf)
        distance = real(wp.inf)
        # Candidates are the projections onto the edges, then the intersections of two edges.
        for i in range(normals.shape[1]):
            for j in range(-1, i):
                normal = normals[world, i]
                candidate = point - (wp.dot(normal, point) - offsets[world, i]) * normal
                is_valid = bool(True)
                if j >= 0:
                    other = normals[world, j]
                    determinant = normal[0] * other[1] - normal[1] * other[0]
                    is_valid = wp.abs(determinant) > _TOLERANCE
                    if is_valid:
                        a = offsets[world, i]
                        b = offsets[world, j]
                        candidate = Vec2(a * other[1] - b * normal[1], b * normal[0] - a * other[0]) / determinant
                apart = wp.length(candidate - point)
                if is_valid and (apart < distance or least > tolerance):
                    excess = largest_excess(normals, offsets, world, candidate)
                    if excess <= tolerance:
                        if least > tolerance or apart < distance:
                            best = candidate
                            distance = apart
                        least = wp.min(least, excess)
                    elif excess < least:
                        best = candidate
                        distance = apart
                        least = excess
    nearest_out[world] = best
