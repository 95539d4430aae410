"""Kernel of contact detection between embedded points and a height field (Eq. 8)."""

import warp as wp

from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})


@wp.func
def spline_weights(f: real):
    """Return the weights of a quadratic B-spline at the previous, the nearest and the next node; ``f`` is the offset
    from the nearest in spacings.
    """
    half = real(0.5)
    return Vec3(half * (half - f) * (half - f), real(0.75) - f * f, half * (half + f) * (half + f))


@wp.func
def spline_slopes(f: real):
    """Return the derivatives of ``spline_weights``."""
    return Vec3(f - real(0.5), -real(2.0) * f, f + real(0.5))


@wp.kernel
def ground_gaps_kernel(
    # Model:
    tets: wp.array[wp.vec4i],
    tet_from_point: wp.array[int],
    weights: wp.array[Vec4],
    axes: Mat33,
    origin: Vec3,
    spacing: real,
    coefficients: wp.array2d[real],
    # In:
    positions: wp.array[Vec3],
    # In and out:
    gaps: wp.array[real],
    faces: wp.array[int],
):
    """Compute the distance of each embedded point to the tangent plane of the ground below it, and merge it into
    ``gaps``.

    Where the ground is nearer than the obstacle in ``gaps``, its distance is stored and ``faces`` becomes 0. Elsewhere
    ``faces`` is incremented by 1, since the ground is face 0.
    """
    point = wp.tid()
    tet = tets[tet_from_point[point]]
    w = weights[point]
    x = w[0] * positions[tet[0]] + w[1] * positions[tet[1]] + w[2] * positions[tet[2]] + w[3] * positions[tet[3]]
    away = axes * (x - origin)
    u = away[0] / spacing
    v = away[1] / spacing
    rows = coefficients.shape[0]
    columns = coefficients.shape[1]
    # Far outside, the edge value extends without limit, so clamping the index changes nothing.
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
    first = first / spacing
    second = second / spacing
    gap = (away[2] - height) / wp.sqrt(real(1.0) + first * first + second * second)
    if gap <= gaps[point]:
        gaps[point] = gap
        faces[point] = 0
    else:
        faces[point] = faces[point] + 1
