"""Contact detection between embedded points and a height field (Eq. 8): gaps and frames."""

import warp as wp

from egs_warp.kernels.contact.gaps import embedded_point
from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})


@wp.func
def spline_weights(f: real):
    """Return the weights of a quadratic B-spline at the previous, the nearest and the next node; ``f`` is the offset
    from the nearest node, in spacings."""
    half = real(0.5)
    return Vec3(half * (half - f) * (half - f), real(0.75) - f * f, half * (half + f) * (half + f))


@wp.func
def spline_slopes(f: real):
    """Return the derivatives of ``spline_weights`` with respect to ``f``."""
    return Vec3(f - real(0.5), -real(2.0) * f, f + real(0.5))


@wp.func
def height_and_slopes(axes: Mat33, origin: Vec3, spacing: real, coefficients: wp.array2d[real], x: Vec3):
    """Return the height in metres of ``x`` above the ground along the third of the ``axes``, and the slopes of the
    ground below ``x`` along the first two axes.

    Args:
        axes: unit axes of the field, as rows.
        origin: m, position of node (0, 0).
        spacing: m, distance between nodes.
        coefficients: spline coefficients of the nodes, m.
        x: m, the point.
    """
    away = axes * (x - origin)
    u = away[0] / spacing
    v = away[1] / spacing
    rows = coefficients.shape[0]
    columns = coefficients.shape[1]
    # Far outside the lattice the height is that of the edge, so clamping the indices changes nothing.
    column = wp.clamp(wp.floor(u + real(0.5)), real(-2.0), real(columns) + real(2.0))
    row = wp.clamp(wp.floor(v + real(0.5)), real(-2.0), real(rows) + real(2.0))
    across = spline_weights(wp.clamp(u - column, real(-0.5), real(0.5)))
    along = spline_weights(wp.clamp(v - row, real(-0.5), real(0.5)))
    across_slope = spline_slopes(wp.clamp(u - column, real(-0.5), real(0.5)))
    along_slope = spline_slopes(wp.clamp(v - row, real(-0.5), real(0.5)))
    height = real(0.0)
    first = real(0.0)
    second = real(0.0)
    for j in range(3):
        for i in range(3):
            c = coefficients[wp.clamp(int(row) + j - 1, 0, rows - 1), wp.clamp(int(column) + i - 1, 0, columns - 1)]
            height += along[j] * across[i] * c
            first += along[j] * across_slope[i] * c
            second += along_slope[j] * across[i] * c
    return Vec3(away[2] - height, first / spacing, second / spacing)


@wp.func
def ground_frame(axes: Mat33, first: real, second: real):
    """Return the contact frame of ground with the slopes ``first`` and ``second`` along the first two ``axes``. Its
    rows are the normal and two tangents, which vary continuously with the slopes."""
    normal = Vec3(-first, -second, real(1.0)) / wp.sqrt(real(1.0) + first * first + second * second)
    along = Vec3(real(1.0), real(0.0), first) / wp.sqrt(real(1.0) + first * first)
    return wp.matrix_from_rows(normal, along, wp.cross(normal, along)) * axes


@wp.kernel
def ground_gaps_kernel(
    # Model:
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    axes: Mat33,
    origin: Vec3,
    spacing: real,
    coefficients: wp.array2d[real],
    # In:
    positions: wp.array2d[Vec3],
    # In and out:
    gaps: wp.array2d[real],
    faces: wp.array2d[int],
):
    """Merge the distance of each embedded point to uneven ground into the gaps of each world.

    The distance is measured to the tangent plane of the ground below the point. If the ground is nearer than the
    obstacle in ``gaps``, the gap becomes the distance to the ground and the face becomes 0. Otherwise the face is
    incremented by 1, since the ground is face 0.

    Args:
        nodes: (P,) nodes of the tetrahedron of each point.
        weights: (P,) barycentric weights of each point.
        axes, origin, spacing, coefficients: height field (``height_and_slopes``).
        positions: (B, N) m, nodes.
        gaps: (B, P) m, updated.
        faces: (B, P) faces of the obstacles, updated.
    """
    world, point = wp.tid()
    x = embedded_point(nodes[point], weights[point], positions, world)
    ground = height_and_slopes(axes, origin, spacing, coefficients, x)
    gap = ground[0] / wp.sqrt(real(1.0) + ground[1] * ground[1] + ground[2] * ground[2])
    if gap <= gaps[world, point]:
        gaps[world, point] = gap
        faces[world, point] = 0
    else:
        faces[world, point] = faces[world, point] + 1
