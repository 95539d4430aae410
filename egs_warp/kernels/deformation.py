"""Carry Gaussians with the cage (Eq. 14, 15), measure how much each is bent (Eq. 16)."""

import warp as wp

from egs_warp.kernels.embedding import axes_from_quaternion
from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})

MAX_SWEEPS = wp.constant(8)
ORTHOGONAL = wp.constant(wp.float32(1.0e-6))
REGULAR = wp.constant(wp.float32(1.0e-3))
LEAST_SCALE = wp.constant(wp.float32(1.0e-12))


@wp.func
def turn_of(q: wp.vec4) -> wp.mat33:
    """Rotation matrix [r1 r2 r3] of a w, x, y, z quaternion."""
    return wp.quat_to_matrix(wp.normalize(wp.quat(q[1], q[2], q[3], q[0])))


@wp.func
def quaternion_of(m: wp.mat33) -> wp.vec4:
    """w, x, y, z of a rotation matrix, from the largest of the four; without an index, which would cost memory."""
    xx = m[0, 0]
    yy = m[1, 1]
    zz = m[2, 2]
    q = wp.vec4(1.0 + xx + yy + zz, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])
    if xx + yy + zz < 0.0:
        if xx >= yy and xx >= zz:
            q = wp.vec4(m[2, 1] - m[1, 2], 1.0 + xx - yy - zz, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0])
        elif yy >= zz:
            q = wp.vec4(m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1.0 - xx + yy - zz, m[1, 2] + m[2, 1])
        else:
            q = wp.vec4(m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1.0 - xx - yy + zz)
    return wp.normalize(q)


@wp.func
def column(m: wp.mat33, k: wp.int32) -> wp.vec3:
    return wp.vec3(m[0, k], m[1, k], m[2, k])


@wp.struct
class Columns:
    """A 3x3 matrix by columns, and the rotation that has been applied to it from the right."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    va: wp.vec3
    vb: wp.vec3
    vc: wp.vec3


@wp.func
def rotation_between(a: wp.vec3, b: wp.vec3) -> wp.vec2:
    """Cosine and sine for which cos a - sin b and sin a + cos b are orthogonal."""
    aa = wp.dot(a, a)
    bb = wp.dot(b, b)
    ab = wp.dot(a, b)
    if ab * ab <= ORTHOGONAL * ORTHOGONAL * aa * bb:
        return wp.vec2(1.0, 0.0)
    cot = (bb - aa) / (2.0 * ab)
    tangent = wp.where(cot >= 0.0, 1.0, -1.0) / (wp.abs(cot) + wp.sqrt(1.0 + cot * cot))
    cosine = 1.0 / wp.sqrt(1.0 + tangent * tangent)
    return wp.vec2(cosine, cosine * tangent)


@wp.func
def orthogonal_columns(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> Columns:
    """One-sided Jacobi: M V with orthogonal columns (left singular vectors times singular values), and V, det V = +1.

    Each column keeps its own relative precision, so float32 is enough for splats whose scales differ by e^10, and each
    column moves no further from where it was than it must.
    """
    m = Columns()
    m.a = a
    m.b = b
    m.c = c
    m.va = wp.vec3(1.0, 0.0, 0.0)
    m.vb = wp.vec3(0.0, 1.0, 0.0)
    m.vc = wp.vec3(0.0, 0.0, 1.0)
    sweep = wp.int32(0)
    while sweep < MAX_SWEEPS:
        turned = wp.float32(0.0)
        t = rotation_between(m.a, m.b)
        turned += wp.abs(t[1])
        p = t[0] * m.a - t[1] * m.b
        m.b = t[1] * m.a + t[0] * m.b
        m.a = p
        p = t[0] * m.va - t[1] * m.vb
        m.vb = t[1] * m.va + t[0] * m.vb
        m.va = p
        t = rotation_between(m.a, m.c)
        turned += wp.abs(t[1])
        p = t[0] * m.a - t[1] * m.c
        m.c = t[1] * m.a + t[0] * m.c
        m.a = p
        p = t[0] * m.va - t[1] * m.vc
        m.vc = t[1] * m.va + t[0] * m.vc
        m.va = p
        t = rotation_between(m.b, m.c)
        turned += wp.abs(t[1])
        p = t[0] * m.b - t[1] * m.c
        m.c = t[1] * m.b + t[0] * m.c
        m.b = p
        p = t[0] * m.vb - t[1] * m.vc
        m.vc = t[1] * m.vb + t[0] * m.vc
        m.vb = p
        sweep += 1
        if turned == 0.0:
            sweep = MAX_SWEEPS
    return m


@wp.func
def unit_or(v: wp.vec3, otherwise: wp.vec3) -> wp.vec3:
    length = wp.length(v)
    if length > 1.0e-20:
        return v / length
    return otherwise


@wp.func
def perpendicular(u: wp.vec3) -> wp.vec3:
    """Some unit vector perpendicular to the unit vector ``u``."""
    helper = wp.where(wp.abs(u[0]) < 0.6, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0))
    return wp.normalize(wp.cross(u, helper))


@wp.func
def unit_pair(a: wp.vec3, b: wp.vec3) -> wp.mat33:
    """Right-handed frame [a/|a|, b/|b|, a x b] of two orthogonal columns, either of which may have no length."""
    u = wp.vec3(1.0, 0.0, 0.0)
    v = wp.vec3(0.0, 1.0, 0.0)
    if wp.length_sq(a) >= wp.length_sq(b):
        u = unit_or(a, u)
        v = unit_or(b - wp.dot(b, u) * u, perpendicular(u))
    else:
        v = unit_or(b, v)
        u = unit_or(a - wp.dot(a, v) * v, perpendicular(v))
    return wp.matrix_from_cols(u, v, wp.cross(u, v))


@wp.func
def proper_frame(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.mat33:
    """Unit columns along orthogonal ones; the shortest follows from the two others, so that det = +1 always."""
    aa = wp.length_sq(a)
    bb = wp.length_sq(b)
    cc = wp.length_sq(c)
    if cc <= aa and cc <= bb:
        return unit_pair(a, b)
    if aa <= bb:
        f = unit_pair(b, c)
        return wp.matrix_from_cols(
            wp.vec3(f[0, 2], f[1, 2], f[2, 2]), wp.vec3(f[0, 0], f[1, 0], f[2, 0]), wp.vec3(f[0, 1], f[1, 1], f[2, 1])
        )
    f = unit_pair(c, a)
    return wp.matrix_from_cols(
        wp.vec3(f[0, 1], f[1, 1], f[2, 1]), wp.vec3(f[0, 2], f[1, 2], f[2, 2]), wp.vec3(f[0, 0], f[1, 0], f[2, 0])
    )


@wp.func
def rotation_part(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.mat33:
    """Rotation of the polar decomposition of [a b c], det = +1; for an inverted matrix, the rotation nearest to it."""
    m = orthogonal_columns(a, b, c)
    return proper_frame(m.a, m.b, m.c) * wp.transpose(wp.matrix_from_cols(m.va, m.vb, m.vc))


@wp.func
def matched_order(frame: wp.mat33, carried: wp.mat33) -> wp.vec3i:
    """Which column of ``frame`` belongs to each column of ``carried``: the permutation of greatest total alignment."""
    d = wp.transpose(carried) * frame
    best = wp.vec3i(0, 1, 2)
    most = wp.abs(d[0, 0]) + wp.abs(d[1, 1]) + wp.abs(d[2, 2])
    total = wp.abs(d[0, 1]) + wp.abs(d[1, 0]) + wp.abs(d[2, 2])
    if total > most:
        most = total
        best = wp.vec3i(1, 0, 2)
    total = wp.abs(d[0, 0]) + wp.abs(d[1, 2]) + wp.abs(d[2, 1])
    if total > most:
        most = total
        best = wp.vec3i(0, 2, 1)
    total = wp.abs(d[0, 2]) + wp.abs(d[1, 1]) + wp.abs(d[2, 0])
    if total > most:
        most = total
        best = wp.vec3i(2, 1, 0)
    total = wp.abs(d[0, 1]) + wp.abs(d[1, 2]) + wp.abs(d[2, 0])
    if total > most:
        most = total
        best = wp.vec3i(1, 2, 0)
    total = wp.abs(d[0, 2]) + wp.abs(d[1, 0]) + wp.abs(d[2, 1])
    if total > most:
        best = wp.vec3i(2, 0, 1)
    return best


@wp.func
def rotation_of(m: wp.mat33) -> wp.mat33:
    """``rotation_part`` of a matrix with det > 0, by Newton's iteration X <- (g X + X^-T / g) / 2 (Higham 1986) where that is safe:
    half the work."""
    a = column(m, 0)
    b = column(m, 1)
    c = column(m, 2)
    size = wp.dot(a, a) + wp.dot(b, b) + wp.dot(c, c)
    if wp.dot(wp.cross(a, b), c) < REGULAR * size * wp.sqrt(size):
        return rotation_part(a, b, c)
    step = wp.int32(0)
    while step < MAX_SWEEPS:
        ca = wp.cross(b, c)
        cb = wp.cross(c, a)
        cc = wp.cross(a, b)
        det = wp.dot(a, ca)
        size = wp.dot(a, a) + wp.dot(b, b) + wp.dot(c, c)
        scale = wp.sqrt(wp.sqrt((wp.dot(ca, ca) + wp.dot(cb, cb) + wp.dot(cc, cc)) / size) / det)
        straight = 0.5 * scale
        turned = 0.5 / (scale * det)
        na = straight * a + turned * ca
        nb = straight * b + turned * cb
        nc = straight * c + turned * cc
        moved = wp.length_sq(na - a) + wp.length_sq(nb - b) + wp.length_sq(nc - c)
        a = na
        b = nb
        c = nc
        step += 1
        # The error squares itself with every step: the next one would move by 1e-8.
        if moved < 1.0e-8:
            step = MAX_SWEEPS
    return wp.matrix_from_cols(a, b, c)


@wp.func
def chosen(m: wp.mat33, k: wp.int32) -> wp.vec3:
    """Column k, by comparison: an index that is not known in advance would put the matrix into memory."""
    return wp.where(k == 0, column(m, 0), wp.where(k == 1, column(m, 1), column(m, 2)))


@wp.func
def signed_as(frame: wp.mat33, order: wp.vec3i, carried: wp.mat33) -> wp.mat33:
    """Columns of ``frame`` in that order, turned to the side of ``carried``; the least aligned one makes det = +1."""
    a = chosen(frame, order[0])
    b = chosen(frame, order[1])
    c = chosen(frame, order[2])
    da = wp.dot(a, column(carried, 0))
    db = wp.dot(b, column(carried, 1))
    dc = wp.dot(c, column(carried, 2))
    a = wp.where(da < 0.0, -a, a)
    b = wp.where(db < 0.0, -b, b)
    c = wp.where(dc < 0.0, -c, c)
    if wp.dot(wp.cross(a, b), c) < 0.0:
        if wp.abs(dc) <= wp.abs(da) and wp.abs(dc) <= wp.abs(db):
            c = -c
        elif wp.abs(da) <= wp.abs(db):
            a = -a
        else:
            b = -b
    return wp.matrix_from_cols(a, b, c)


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


@wp.func
def interpolated(corners: wp.vec4i, weights: Vec4, positions: wp.array[Vec3]) -> Vec3:
    """Eq. (2) read backwards: the point with these weights."""
    return (
        weights[0] * positions[corners[0]]
        + weights[1] * positions[corners[1]]
        + weights[2] * positions[corners[2]]
        + weights[3] * positions[corners[3]]
    )


@wp.kernel
def tet_gradients_kernel(
    first_row: wp.int32,
    # In:
    positions: wp.array[Vec3],
    tets: wp.array[wp.vec4i],
    inverse_edges: wp.array[Mat33],
    # Out:
    gradients_out: wp.array[wp.mat33],
):
    """Deformation gradient of each tetrahedron."""
    t = first_row + wp.tid()
    corners = tets[t]
    x0 = positions[corners[0]]
    edges = wp.matrix_from_cols(positions[corners[1]] - x0, positions[corners[2]] - x0, positions[corners[3]] - x0)
    gradients_out[t] = single_matrix(edges * inverse_edges[t])


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


@wp.func
def scaled_columns(m: wp.mat33, s: wp.vec3) -> wp.mat33:
    return wp.matrix_from_cols(s[0] * column(m, 0), s[1] * column(m, 1), s[2] * column(m, 2))


@wp.func
def exponential(v: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.exp(v[0]), wp.exp(v[1]), wp.exp(v[2]))


@wp.struct
class CarriedShape:
    rotation: wp.vec4
    log_scales: wp.vec3


@wp.func
def carried_shape(stretched: wp.mat33, scales: wp.vec3, carried: wp.mat33) -> CarriedShape:
    """Eq. (15) for ``stretched`` = F R: the SVD of F R S, its axes matched in order and sign to R_polar r_i."""
    factor = scaled_columns(stretched, scales)
    m = orthogonal_columns(column(factor, 0), column(factor, 1), column(factor, 2))
    frame = proper_frame(m.a, m.b, m.c)
    columns = wp.matrix_from_cols(m.a, m.b, m.c)
    order = matched_order(frame, carried)
    result = CarriedShape()
    result.rotation = quaternion_of(signed_as(frame, order, carried))
    result.log_scales = wp.vec3(
        wp.log(wp.max(wp.length(chosen(columns, order[0])), LEAST_SCALE)),
        wp.log(wp.max(wp.length(chosen(columns, order[1])), LEAST_SCALE)),
        wp.log(wp.max(wp.length(chosen(columns, order[2])), LEAST_SCALE)),
    )
    return result


@wp.func
def write_gaussian(
    row: wp.int32,
    stretched: wp.mat33,
    axes: wp.mat33,
    scales: wp.vec3,
    rotations_out: wp.array[wp.vec4],
    log_scales_out: wp.array[wp.vec3],
    turns_out: wp.array[wp.vec4],
):
    """Shape and turn of Eq. (15) for ``stretched`` = F R."""
    carried = rotation_part(column(stretched, 0), column(stretched, 1), column(stretched, 2))
    shape = carried_shape(stretched, scales, carried)
    rotations_out[row] = shape.rotation
    log_scales_out[row] = shape.log_scales
    turns_out[row] = quaternion_of(carried * wp.transpose(axes))


@wp.struct
class CarriedGaussian:
    mean: wp.vec3
    rotation: wp.vec4
    log_scales: wp.vec3
    turn: wp.vec4


@wp.func
def carried_gaussian(
    row: wp.int32,
    mean: wp.vec3,
    rotation: wp.vec4,
    log_scales: wp.vec3,
    max_stretch: wp.float32,
    carried: wp.array[wp.vec4],
    mean_tets: wp.array[wp.int32],
    end_tets: wp.array2d[wp.int32],
    shares: wp.array2d[wp.float32],
    arms: wp.array2d[wp.float32],
) -> CarriedGaussian:
    """F = (F+ + F-)/2 (Eq. 14), or the F of the mean's tetrahedron where det F <= 0, then Eq. (15).

    The mean goes where the Gaussian's mass goes, to second order (beyond the paper, which carries the mean as a point):
    E[x(m + sum z_k s_k r_k)] = x(m) + sum s_k^2 x_kk / 2, and x_kk is seen from the difference of the two arms.
    """
    axes = turn_of(rotation)
    scales = exponential(log_scales)
    both = carried_arms(row, mean, axes, max_stretch, carried, mean_tets, end_tets, shares, arms)
    result = CarriedGaussian()
    result.mean = both.mean
    stretched = both.through
    code = mean_tets[row]
    # Alone in one tetrahedron, far outside, or where F is turned inside out: the rotation of that tetrahedron, found once
    # for all.
    own = wp.bool(True)
    if code < 0 and shares[0, row] < RIGID:
        bulge = wp.vec3(0.0)
        for k in range(3):
            reach = wp.max(arms[row, k] + arms[row, 3 + k], 3.0 * scales[k])
            bulge += (scales[k] * scales[k] / reach) * (column(both.plus, k) - column(both.minus, k))
        result.mean += bulge
        average = 0.5 * (both.plus + both.minus)
        if wp.determinant(average) > 0.0:
            stretched = average
            own = wp.bool(False)
    turned = wp.mat33()
    if own:
        result.turn = load_row(carried, TET_ROWS * wp.where(code < 0, -1 - code, code) + 4)
        turned = turn_of(result.turn) * axes
    else:
        turned = rotation_of(stretched)
        result.turn = quaternion_of(turned * wp.transpose(axes))
    shape = carried_shape(stretched, scales, turned)
    result.rotation = shape.rotation
    result.log_scales = shape.log_scales
    return result


@wp.kernel
def deform_kernel(
    first_row: wp.int32,
    # In:
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    max_stretch: wp.float32,
    carried: wp.array[wp.vec4],
    mean_tets: wp.array[wp.int32],
    end_tets: wp.array2d[wp.int32],
    shares: wp.array2d[wp.float32],
    arms: wp.array2d[wp.float32],
    # Out:
    means_out: wp.array[wp.vec3],
    rotations_out: wp.array[wp.vec4],
    log_scales_out: wp.array[wp.vec3],
    turns_out: wp.array[wp.vec4],
):
    """Each Gaussian as the cage has carried it (Eq. 14, 15)."""
    row = first_row + wp.tid()
    result = carried_gaussian(
        row,
        means[row],
        load_row(rotations, row),
        log_scales[row],
        max_stretch,
        carried,
        mean_tets,
        end_tets,
        shares,
        arms,
    )
    means_out[row] = result.mean
    store_row(rotations_out, row, result.rotation)
    log_scales_out[row] = result.log_scales
    store_row(turns_out, row, result.turn)


@wp.func
def angle_between(a: wp.vec3, b: wp.vec3) -> wp.float32:
    return wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))


@wp.func
def bend_frame(side: wp.mat33, scales: wp.vec3) -> wp.mat33:
    """Eigenframe of Sigma'+- that stays defined where scales are equal: the rotation part of [F R] S^2.

    It differs from the eigenframe by terms of order (s_j/s_i)^2 where s_i >> s_j, follows the long axes and not the
    short ones, and does not spin freely in the plane of a round disc, as eigenvectors do.
    """
    longest = wp.max(scales)
    relative = scales / longest
    weighted = scaled_columns(side, wp.cw_mul(relative, relative))
    return rotation_part(column(weighted, 0), column(weighted, 1), column(weighted, 2))


@wp.kernel
def measure_bend_kernel(
    first_row: wp.int32,
    # In:
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    max_stretch: wp.float32,
    carried: wp.array[wp.vec4],
    mean_tets: wp.array[wp.int32],
    end_tets: wp.array2d[wp.int32],
    shares: wp.array2d[wp.float32],
    arms: wp.array2d[wp.float32],
    # In and out:
    bend_out: wp.array[wp.float32],
    curl_out: wp.array[wp.vec3],
    error_out: wp.array[wp.vec3],
):
    """The most of each measure so far: the angle of Eq. (16), and, along each axis, how far the motion is from affine.

    With arms reaching L on both sides of axis k, the second derivative of the motion along axes k and j is about
    (F_k+ - F_k-) r_j / 2L; ``curl`` is the angle between the two vectors F_k+- r_j, the largest over j, and ``error``
    the displacement that F leaves out at one standard deviation along both axes.
    """
    row = first_row + wp.tid()
    if mean_tets[row] < 0 and shares[0, row] == RIGID:
        return
    scales = exponential(log_scales[row])
    axes = turn_of(rotations[row])
    both = carried_arms(row, means[row], axes, max_stretch, carried, mean_tets, end_tets, shares, arms)
    between = wp.transpose(bend_frame(both.plus, scales)) * bend_frame(both.minus, scales)
    twice_sine = wp.length(
        wp.vec3(between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1])
    )
    theta = wp.atan2(twice_sine, wp.trace(between) - 1.0)
    bend_out[row] = wp.max(bend_out[row], wp.degrees(theta))
    curl = curl_out[row]
    error = error_out[row]
    for k in range(3):
        f_plus = affine_of(carried, end_tets[k, row]).gradient * axes
        f_minus = affine_of(carried, end_tets[3 + k, row]).gradient * axes
        # Gradients jump between tetrahedra; over a much shortened arm the jump is no derivative.
        reach = wp.max(arms[row, k] + arms[row, 3 + k], 3.0 * scales[k])
        for j in range(3):
            # Along the axis itself the ends' own positions are known; across it only the gradients at the ends are.
            a = wp.where(j == k, column(both.plus, k), column(f_plus, j))
            b = wp.where(j == k, column(both.minus, k), column(f_minus, j))
            missed = scales[k] * scales[j] * wp.length(a - b) / reach
            angle = wp.degrees(angle_between(a, b))
            # The mixed derivative is the same both ways round; the longer baseline sees it better.
            if scales[j] > scales[k]:
                missed = 0.0
            # An axis too short to be seen bends nothing.
            if missed > 0.25 * error[k]:
                curl[k] = wp.max(curl[k], angle)
            error[k] = wp.max(error[k], missed)
    curl_out[row] = curl
    error_out[row] = error
