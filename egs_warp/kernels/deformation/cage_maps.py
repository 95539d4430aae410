"""Affine maps of the deformed cage, and the deformed arms of each Gaussian (Eq. 14)."""

import warp as wp

from egs_warp.kernels.deformation.decomposition import (
    column,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_part,
)
from egs_warp.kernels.deformation.embedding import axes_from_quaternion
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
    """Return ``rows[row]`` with one 16-byte load, where Warp's own indexing makes four loads."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    reinterpret_cast<float4*>(rows.data)[row] = make_float4(value[0], value[1], value[2], value[3]);
#else
    rows.data[row] = value;
#endif
""")
def store_row(rows: wp.array[wp.vec4], row: wp.int32, value: wp.vec4):
    """Set ``rows[row]`` to ``value`` with one 16-byte store."""
    ...


@wp.struct
class CageMaps:
    """Affine map x -> x0' + F (x - x0) of each of T tetrahedra, and the polar rotation of F."""

    maps: wp.array[wp.vec4]
    """(3 T,) rows of F, each followed by one coordinate of x0'. Most arms read only this array."""
    frames: wp.array[wp.vec4]
    """(2 T,) two rows for each tetrahedron: x0, then R_polar as a quaternion w, x, y, z."""


@wp.kernel
def update_maps_kernel(
    first_row: wp.int32,
    # In:
    positions: wp.array[Vec3],
    rest: wp.array[Vec3],
    tets: wp.array[wp.vec4i],
    inverse_edges: wp.array[Mat33],
    # Out:
    cage_out: CageMaps,
):
    """Compute the map and the polar rotation of each tetrahedron.

    Args:
        positions, rest: (N,) m, nodes of the cage, deformed and at rest.
        tets: (T,) nodes of the tetrahedra.
        inverse_edges: (T,) 1/m, inverse edge matrices at rest.
        cage_out: maps of the cage, output.
    """
    t = first_row + wp.tid()
    corners = tets[t]
    x0 = positions[corners[0]]
    edges = wp.matrix_from_cols(positions[corners[1]] - x0, positions[corners[2]] - x0, positions[corners[3]] - x0)
    f = single_matrix(edges * inverse_edges[t])
    moved = single(x0)
    start = single(rest[corners[0]])
    for i in range(3):
        cage_out.maps[3 * t + i] = wp.vec4(f[i, 0], f[i, 1], f[i, 2], moved[i])
    cage_out.frames[2 * t] = wp.vec4(start[0], start[1], start[2], 0.0)
    cage_out.frames[2 * t + 1] = quaternion_from_rotation(rotation_part(column(f, 0), column(f, 1), column(f, 2)))


@wp.struct
class Affine:
    """Affine map x -> moved + gradient (x - start)."""

    gradient: wp.mat33
    start: wp.vec3
    moved: wp.vec3


@wp.func
def affine_of(cage: CageMaps, tet: wp.int32) -> Affine:
    a = load_row(cage.maps, 3 * tet)
    b = load_row(cage.maps, 3 * tet + 1)
    c = load_row(cage.maps, 3 * tet + 2)
    s = load_row(cage.frames, 2 * tet)
    result = Affine()
    result.gradient = wp.mat33(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2])
    result.moved = wp.vec3(a[3], b[3], c[3])
    result.start = wp.vec3(s[0], s[1], s[2])
    return result


@wp.func
def rotation_of_tet(cage: CageMaps, tet: wp.int32) -> wp.vec4:
    """Return the rotation R_polar of the tetrahedron ``tet`` as a quaternion w, x, y, z."""
    return load_row(cage.frames, 2 * tet + 1)


@wp.func
def image(map: Affine, point: wp.vec3) -> wp.vec3:
    return map.moved + map.gradient * (point - map.start)


RIGID = wp.constant(wp.float32(3.0))
"""Value of ``inside_fractions[0]`` for a Gaussian far outside the cage, which moves rigidly."""


SixTets = wp.types.vector(length=6, dtype=wp.int32)
SixShares = wp.types.vector(length=6, dtype=wp.float32)


@wp.func
def exponential(v: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.exp(v[0]), wp.exp(v[1]), wp.exp(v[2]))


@wp.func
def reach_of(arms: wp.array2d[wp.float32], row: wp.int32, axis: wp.int32, scale: wp.float32) -> wp.float32:
    """Return the distance between the two ends of ``axis``, but at least three standard deviations.

    Gradients jump between tetrahedra. Over much shortened arms, a difference quotient of such a jump would not
    approximate a derivative.

    Args:
        arms: (n, 6) m, lengths of the arms.
        row: index of the Gaussian.
        axis: index of the axis.
        scale: m, standard deviation along the axis.
    """
    return wp.max(arms[row, axis] + arms[row, 3 + axis], 3.0 * scale)


@wp.struct
class ArmPlan:
    """Precomputed input of ``deform_arms`` for n Gaussians, the same for all frames. The last dimension of each array
    is the Gaussian, so that neighbouring threads access memory contiguously.
    """

    mean_tets: wp.array[wp.int32]
    """(n,) tetrahedron t of the mean, or -1 - t for a Gaussian that needs more than the map of that tetrahedron."""
    end_tets: wp.array2d[wp.int32]
    """(6, n) tetrahedron of each arm's end."""
    inside_fractions: wp.array2d[wp.float32]
    """(6, n) fraction of each arm inside the tetrahedron of the mean. A negative value is minus the length of a longer
    arm that ends in another tetrahedron; the deformed arm is then the difference between its deformed end and the
    deformed mean."""
    smoothing_lengths: wp.array2d[wp.float32]
    """(3, n) m, s_k^2 divided by the distance between the two ends of axis k (``reach_of``)."""


@wp.kernel
def plan_arms_kernel(
    first_row: wp.int32,
    # In:
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    point_tets: wp.array[wp.int32],
    weights: wp.array[Vec4],
    arms: wp.array2d[wp.float32],
    tets: wp.array[wp.vec4i],
    inverse_edges: wp.array[Mat33],
    min_bridge: wp.float32,
    # Out:
    plan_out: ArmPlan,
):
    """Precompute the ``ArmPlan`` of all Gaussians.

    The motion is continuous, and affine in each tetrahedron. So an arm that crosses a face from the tetrahedron of the
    mean (gradient F) into the next one (gradient G) is deformed to (u F + (1 - u) G) r per unit length, where u is the
    fraction of the arm before the face. This avoids a difference of positions, which for a tiny arm would be mostly
    rounding error. A longer arm that ends in a tetrahedron without a common face gets a negative fraction.

    Args:
        rotations, log_scales: the Gaussians at rest.
        point_tets, weights: (7 n,) tetrahedra and weights of the points of ``embed_gaussians_kernel``.
        arms: (n, 6) m, lengths of the arms.
        tets: (T,) nodes of the tetrahedra.
        inverse_edges: (T,) 1/m, inverse edge matrices at rest.
        min_bridge: m, length above which an arm without a common face is deformed as a difference of positions.
        plan_out: the plan, output.
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
            unshared_count = wp.int32(0)
            opposite = wp.int32(0)
            for j in range(4):
                c = corners[j]
                if c != others[0] and c != others[1] and c != others[2] and c != others[3]:
                    unshared_count += 1
                    opposite = j
            share = wp.float32(0.5)
            if unshared_count == 1:
                axis = k % 3
                direction = Vec3(axes[0, axis], axes[1, axis], axes[2, axis])
                slopes = inverse_edges[mean_tet] * direction
                slope = -(slopes[0] + slopes[1] + slopes[2])
                if opposite > 0:
                    slope = slopes[opposite - 1]
                if k >= 3:
                    slope = -slope
                weight = weights[7 * row][opposite]
                weight_drop = -slope * real(arms[row, k])
                if weight_drop > real(0.0):
                    share = wp.float32(wp.clamp(weight / weight_drop, real(0.0), real(1.0)))
            elif arms[row, k] > min_bridge:
                share = -arms[row, k]
        plan_out.end_tets[k, row] = tet
        plan_out.inside_fractions[k, row] = share
    scales = exponential(log_scales[row])
    for k in range(3):
        plan_out.smoothing_lengths[k, row] = scales[k] * scales[k] / reach_of(arms, row, k, scales[k])
    w = weights[7 * row]
    if wp.min(w) < real(-1.0) or wp.max(w) > real(2.0):
        straddles = wp.bool(True)
        plan_out.inside_fractions[0, row] = RIGID
    plan_out.mean_tets[row] = wp.where(straddles, -1 - mean_tet, mean_tet)


@wp.func
def deform_arm(
    tet: wp.int32,
    share: wp.float32,
    mean_tet: wp.int32,
    mean: wp.vec3,
    moved_mean: wp.vec3,
    axis: wp.vec3,
    through: wp.vec3,
    max_stretch: wp.float32,
    cage: CageMaps,
) -> wp.vec3:
    """Return the deformed arm along ``axis``, per unit length: a column of D_s D_m^-1 R (Eq. 14).

    An arm that bridges a gap between two limbs can be stretched far more than the material at either end, which would
    appear as a spike. So its length is limited to ``max_stretch`` times the larger stretch at its two ends.

    Args:
        tet: tetrahedron at the end of the arm.
        share: entry of ``ArmPlan.inside_fractions``.
        mean_tet: tetrahedron of the mean.
        mean, moved_mean: m, mean at rest and deformed.
        axis: unit vector along the arm at rest.
        through: F ``axis``, with the gradient F of ``mean_tet``.
        max_stretch: maximum ratio of stretches.
        cage: maps of the deformed cage.
    """
    if tet == mean_tet:
        return through
    end = affine_of(cage, tet)
    end_arm = end.gradient * axis
    if share >= 0.0:
        return share * through + (1.0 - share) * end_arm
    result = end_arm - (image(end, mean) - moved_mean) / share
    limit = max_stretch * wp.max(wp.length(through), wp.length(end_arm))
    length = wp.length(result)
    if length > limit:
        result = result * (limit / length)
    return result


@wp.struct
class DeformedArms:
    """Columns of F+ R and F- R, and the deformed mean."""

    plus: wp.mat33
    minus: wp.mat33
    through: wp.mat33
    """F R, where F is the gradient of the tetrahedron of the mean."""
    mean: wp.vec3
    tet: wp.int32
    """Tetrahedron of the mean."""
    straddles: wp.bool
    """True if F+ and F- differ from F."""


@wp.func
def deform_arms(
    gaussian: wp.int32, mean: wp.vec3, axes: wp.mat33, max_stretch: wp.float32, cage: CageMaps, plan: ArmPlan
) -> DeformedArms:
    """Compute F+ R and F- R of Eq. (14), and the deformed mean, for one ``gaussian`` with the rest ``axes`` R."""
    code = plan.mean_tets[gaussian]
    result = DeformedArms()
    result.tet = wp.where(code < 0, -1 - code, code)
    result.straddles = code < 0
    around = affine_of(cage, result.tet)
    ends = SixTets()
    shares = SixShares()
    if result.straddles:
        # All loads are issued first: on a GPU, dependent loads would dominate the time.
        for k in range(6):
            ends[k] = plan.end_tets[k, gaussian]
            shares[k] = plan.inside_fractions[k, gaussian]
        if shares[0] == RIGID:
            around.gradient = rotation_from_quaternion(rotation_of_tet(cage, result.tet))
            result.straddles = wp.bool(False)
    result.mean = image(around, mean)
    result.through = around.gradient * axes
    result.plus = result.through
    result.minus = result.through
    # Most Gaussians are small and lie in one tetrahedron, so that F+ and F- are its gradient F.
    if result.straddles:
        t = result.tet
        m = result.mean
        for k in range(3):
            r = column(axes, k)
            f = column(result.through, k)
            plus = deform_arm(ends[k], shares[k], t, mean, m, r, f, max_stretch, cage)
            minus = deform_arm(ends[3 + k], shares[3 + k], t, mean, m, -r, -f, max_stretch, cage)
            for i in range(3):
                result.plus[i, k] = plus[i]
                result.minus[i, k] = -minus[i]
    return result
