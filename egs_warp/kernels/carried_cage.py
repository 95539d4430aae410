"""The carried cage, and where it takes the arms of each Gaussian (Eq. 14)."""

import warp as wp

from egs_warp.kernels.decomposition import column, quaternion_of, rotation_part, turn_of
from egs_warp.kernels.embedding import axes_from_quaternion
from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})


@wp.func
def single(v: Vec3) -> wp.vec3:
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
def single_matrix(m: Mat33) -> wp.mat33:
    return wp.mat33(
        wp.float32(m[0, 0]), wp.float32(m[0, 1]), wp.float32(m[0, 2]),
        wp.float32(m[1, 0]), wp.float32(m[1, 1]), wp.float32(m[1, 2]),
        wp.float32(m[2, 0]), wp.float32(m[2, 1]), wp.float32(m[2, 2]),
    )  # fmt: skip


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 v = __ldg(reinterpret_cast<const float4*>(rows.data) + row);
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
#else
    return rows.data[row];
#endif
""")
def load_row(rows: wp.array[wp.vec4], row: wp.int32) -> wp.vec4:
    """``rows[row]`` in one 16-byte load, which Warp's own indexing makes four of."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    reinterpret_cast<float4*>(rows.data)[row] = make_float4(value[0], value[1], value[2], value[3]);
#else
    rows.data[row] = value;
#endif
""")
def store_row(rows: wp.array[wp.vec4], row: wp.int32, value: wp.vec4):
    """``rows[row] = value`` in one 16-byte store."""
    ...


TET_ROWS = wp.constant(5)
"""Rows of a carried tetrahedron: three rows of F, each with one coordinate of x0' behind it; x0; R_polar as w, x, y, z."""


@wp.kernel
def carry_tets_kernel(
    first_row: wp.int32,
    # In:
    positions: wp.array[Vec3],
    rest: wp.array[Vec3],
    tets: wp.array[wp.vec4i],
    inverse_edges: wp.array[Mat33],
    # Out:
    carried_out: wp.array[wp.vec4],
):
    """The affine map x0' + F (x - x0) of each tetrahedron and the rotation of F, as ``TET_ROWS`` rows."""
    t = first_row + wp.tid()
    corners = tets[t]
    x0 = positions[corners[0]]
    edges = wp.matrix_from_cols(positions[corners[1]] - x0, positions[corners[2]] - x0, positions[corners[3]] - x0)
    f = single_matrix(edges * inverse_edges[t])
    moved = single(x0)
    start = single(rest[corners[0]])
    for i in range(3):
        carried_out[TET_ROWS * t + i] = wp.vec4(f[i, 0], f[i, 1], f[i, 2], moved[i])
    carried_out[TET_ROWS * t + 3] = wp.vec4(start[0], start[1], start[2], 0.0)
    carried_out[TET_ROWS * t + 4] = quaternion_of(rotation_part(column(f, 0), column(f, 1), column(f, 2)))


@wp.struct
class Affine:
    """x -> moved + gradient (x - start)."""

    gradient: wp.mat33
    start: wp.vec3
    moved: wp.vec3


@wp.func
def affine_of(carried: wp.array[wp.vec4], tet: wp.int32) -> Affine:
    a = load_row(carried, TET_ROWS * tet)
    b = load_row(carried, TET_ROWS * tet + 1)
    c = load_row(carried, TET_ROWS * tet + 2)
    s = load_row(carried, TET_ROWS * tet + 3)
    result = Affine()
    result.gradient = wp.mat33(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2])
    result.moved = wp.vec3(a[3], b[3], c[3])
    result.start = wp.vec3(s[0], s[1], s[2])
    return result


@wp.func
def image(map: Affine, point: wp.vec3) -> wp.vec3:
    return map.moved + map.gradient * (point - map.start)


BRIDGES = wp.constant(wp.float32(2.0))
"""Share that marks an arm whose end has nothing to do with the tetrahedron of the mean: look where the end has gone."""

RIGID = wp.constant(wp.float32(3.0))
"""Share of the first arm that marks a Gaussian far outside the cage, which is not stretched but only turned and moved."""


@wp.kernel
def plan_arms_kernel(
    first_row: wp.int32,
    # In:
    rotations: wp.array[wp.vec4],
    point_tets: wp.array[wp.int32],
    weights: wp.array[Vec4],
    arms: wp.array2d[wp.float32],
    tets: wp.array[wp.vec4i],
    inverse_edges: wp.array[Mat33],
    least_bridge: wp.float32,
    # Out:
    mean_tets_out: wp.array[wp.int32],
    end_tets_out: wp.array2d[wp.int32],
    shares_out: wp.array2d[wp.float32],
):
    """What ``carried_arms`` wants to know about each Gaussian, once for all frames.

    The motion is continuous and linear in each tetrahedron. So an arm that goes from the tetrahedron of the mean (gradient F)
    through a face into the next one (gradient G) is carried to (u F + (1 - u) G) r per length, u the share of it before
    the face: no difference of positions, which for a tiny arm would be mostly rounding. A longer arm that ends elsewhere
    ``BRIDGES``.
    """
    row = first_row + wp.tid()
    mean_tet = point_tets[7 * row]
    corners = tets[mean_tet]
    axes = axes_from_quaternion(rotations[row])
    straddles = wp.bool(False)
    for k in range(6):
        tet = point_tets[7 * row + 1 + k]
        share = wp.float32(1.0)
        if tet != mean_tet:
            straddles = wp.bool(True)
            others = tets[tet]
            apart = wp.int32(0)
            opposite = wp.int32(0)
            for j in range(4):
                c = corners[j]
                if c != others[0] and c != others[1] and c != others[2] and c != others[3]:
                    apart += 1
                    opposite = j
            share = wp.float32(0.5)
            if apart == 1:
                axis = k % 3
                direction = Vec3(axes[0, axis], axes[1, axis], axes[2, axis])
                slopes = inverse_edges[mean_tet] * direction
                slope = -(slopes[0] + slopes[1] + slopes[2])
                if opposite > 0:
                    slope = slopes[opposite - 1]
                if k >= 3:
                    slope = -slope
                height = weights[7 * row][opposite]
                drop = -slope * real(arms[row, k])
                if drop > real(0.0):
                    share = wp.float32(wp.clamp(height / drop, real(0.0), real(1.0)))
            elif arms[row, k] > least_bridge:
                share = BRIDGES
        end_tets_out[k, row] = tet
        shares_out[k, row] = share
    w = weights[7 * row]
    if wp.min(w) < real(-1.0) or wp.max(w) > real(2.0):
        straddles = wp.bool(True)
        shares_out[0, row] = RIGID
    # One's complement marks a Gaussian that is not simply carried by one tetrahedron.
    mean_tets_out[row] = wp.where(straddles, -1 - mean_tet, mean_tet)


@wp.func
def carried_arm(
    k: wp.int32,
    gaussian: wp.int32,
    mean_tet: wp.int32,
    mean: wp.vec3,
    moved_mean: wp.vec3,
    axis: wp.vec3,
    through: wp.vec3,
    max_stretch: wp.float32,
    carried: wp.array[wp.vec4],
    end_tets: wp.array2d[wp.int32],
    shares: wp.array2d[wp.float32],
    arms: wp.array2d[wp.float32],
) -> wp.vec3:
    """Where one arm along ``axis`` has gone, per length: a column of D_s D_m^-1 R (Eq. 14). ``through`` is F axis.

    An arm that bridges a gap between two limbs can be stretched far more than the matter at either end. That is a spike:
    its length is held to ``max_stretch`` times the larger stretch at its two ends.
    """
    tet = end_tets[k, gaussian]
    if tet == mean_tet:
        return through
    end = affine_of(carried, tet)
    there = end.gradient * axis
    share = shares[k, gaussian]
    if share <= 1.0:
        return share * through + (1.0 - share) * there
    result = there + (image(end, mean) - moved_mean) / arms[gaussian, k]
    limit = max_stretch * wp.max(wp.length(through), wp.length(there))
    length = wp.length(result)
    if length > limit:
        result = result * (limit / length)
    return result


@wp.struct
class CarriedArms:
    """Columns of F+ R and F- R, and the carried mean."""

    plus: wp.mat33
    minus: wp.mat33
    through: wp.mat33
    """F R of the tetrahedron of the mean."""
    mean: wp.vec3


@wp.func
def carried_arms(
    gaussian: wp.int32,
    mean: wp.vec3,
    axes: wp.mat33,
    max_stretch: wp.float32,
    carried: wp.array[wp.vec4],
    mean_tets: wp.array[wp.int32],
    end_tets: wp.array2d[wp.int32],
    shares: wp.array2d[wp.float32],
    arms: wp.array2d[wp.float32],
) -> CarriedArms:
    """F+ R and F- R of Eq. (14)."""
    code = mean_tets[gaussian]
    tet = wp.where(code < 0, -1 - code, code)
    around = affine_of(carried, tet)
    straddles = code < 0
    if straddles and shares[0, gaussian] == RIGID:
        around.gradient = turn_of(load_row(carried, TET_ROWS * tet + 4))
        straddles = wp.bool(False)
    result = CarriedArms()
    result.mean = image(around, mean)
    result.through = around.gradient * axes
    result.plus = result.through
    result.minus = result.through
    # Most Gaussians are small and lie in one tetrahedron, whose gradient is then the answer.
    if straddles:
        r0 = column(axes, 0)
        r1 = column(axes, 1)
        r2 = column(axes, 2)
        t0 = column(result.through, 0)
        t1 = column(result.through, 1)
        t2 = column(result.through, 2)
        m = result.mean
        result.plus = wp.matrix_from_cols(
            carried_arm(0, gaussian, tet, mean, m, r0, t0, max_stretch, carried, end_tets, shares, arms),
            carried_arm(1, gaussian, tet, mean, m, r1, t1, max_stretch, carried, end_tets, shares, arms),
            carried_arm(2, gaussian, tet, mean, m, r2, t2, max_stretch, carried, end_tets, shares, arms),
        )
        result.minus = -wp.matrix_from_cols(
            carried_arm(3, gaussian, tet, mean, m, -r0, -t0, max_stretch, carried, end_tets, shares, arms),
            carried_arm(4, gaussian, tet, mean, m, -r1, -t1, max_stretch, carried, end_tets, shares, arms),
            carried_arm(5, gaussian, tet, mean, m, -r2, -t2, max_stretch, carried, end_tets, shares, arms),
        )
    return result
