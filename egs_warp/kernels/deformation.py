"""Carry Gaussians with the cage (Eq. 14, 15), measure how much each is bent (Eq. 16)."""

import warp as wp

from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})

MAX_SWEEPS = wp.constant(8)
ORTHOGONAL = wp.constant(wp.float32(3.0e-7))
LEAST_SCALE = wp.constant(wp.float32(1.0e-12))


@wp.func
def turn_of(q: wp.vec4) -> wp.mat33:
    """Rotation matrix [r1 r2 r3] of a w, x, y, z quaternion."""
    return wp.quat_to_matrix(wp.normalize(wp.quat(q[1], q[2], q[3], q[0])))


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
    if wp.abs(ab) <= ORTHOGONAL * wp.sqrt(aa) * wp.sqrt(bb):
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
def column(m: wp.mat33, k: wp.int32) -> wp.vec3:
    return wp.vec3(m[0, k], m[1, k], m[2, k])


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
def signed_as(frame: wp.mat33, order: wp.vec3i, carried: wp.mat33) -> wp.mat33:
    """Columns of ``frame`` in that order, turned to the side of ``carried``; the least aligned one makes det = +1."""
    a = column(frame, order[0])
    b = column(frame, order[1])
    c = column(frame, order[2])
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


@wp.func
def carried_arm(
    row: wp.int32,
    mean: Vec3,
    axis: wp.vec3,
    along_mean: wp.vec3,
    arm: wp.float32,
    max_stretch: wp.float32,
    positions: wp.array[Vec3],
    tets: wp.array[wp.vec4i],
    gradients: wp.array[wp.mat33],
    point_tets: wp.array[wp.int32],
    weights: wp.array[Vec4],
) -> wp.vec3:
    """Where one arm has gone, per length: a column of D_s D_m^-1 R (Eq. 14), for an end on the side of ``axis``.

    An arm can be stretched far more than the matter at either end where it extrapolates, or bridges a gap between two
    limbs. That is a spike: its length is held to ``max_stretch`` times the larger stretch at its two ends.
    """
    tet = point_tets[row]
    end = interpolated(tets[tet], weights[row], positions)
    moved = single((end - mean) / real(arm))
    limit = max_stretch * wp.max(wp.length(along_mean), wp.length(gradients[tet] * axis))
    length = wp.length(moved)
    if length > limit:
        moved = moved * (limit / length)
    return moved


@wp.struct
class CarriedArms:
    """Columns of F+ R and F- R, and the carried mean."""

    plus: wp.mat33
    minus: wp.mat33
    mean: Vec3


@wp.func
def carried_arms(
    gaussian: wp.int32,
    axes: wp.mat33,
    max_stretch: wp.float32,
    positions: wp.array[Vec3],
    tets: wp.array[wp.vec4i],
    gradients: wp.array[wp.mat33],
    point_tets: wp.array[wp.int32],
    weights: wp.array[Vec4],
    arms: wp.array2d[wp.float32],
) -> CarriedArms:
    """F+ R and F- R of Eq. (14)."""
    first = 7 * gaussian
    tet = point_tets[first]
    mean = interpolated(tets[tet], weights[first], positions)
    through = gradients[tet] * axes
    result = CarriedArms()
    result.mean = mean
    result.plus = through
    result.minus = through
    # Most Gaussians are small and lie in one tetrahedron, whose gradient is then the answer.
    alone = wp.bool(True)
    for k in range(1, 7):
        alone = alone and point_tets[first + k] == tet
    if not alone:
        r0 = column(axes, 0)
        r1 = column(axes, 1)
        r2 = column(axes, 2)
        t0 = column(through, 0)
        t1 = column(through, 1)
        t2 = column(through, 2)
        result.plus = wp.matrix_from_cols(
            carried_arm(
                first + 1, mean, r0, t0, arms[gaussian, 0], max_stretch, positions, tets, gradients, point_tets, weights
            ),
            carried_arm(
                first + 2, mean, r1, t1, arms[gaussian, 1], max_stretch, positions, tets, gradients, point_tets, weights
            ),
            carried_arm(
                first + 3, mean, r2, t2, arms[gaussian, 2], max_stretch, positions, tets, gradients, point_tets, weights
            ),
        )
        result.minus = -wp.matrix_from_cols(
            carried_arm(
                first + 4, mean, r0, t0, arms[gaussian, 3], max_stretch, positions, tets, gradients, point_tets, weights
            ),
            carried_arm(
                first + 5, mean, r1, t1, arms[gaussian, 4], max_stretch, positions, tets, gradients, point_tets, weights
            ),
            carried_arm(
                first + 6, mean, r2, t2, arms[gaussian, 5], max_stretch, positions, tets, gradients, point_tets, weights
            ),
        )
    return result


@wp.func
def scaled_columns(m: wp.mat33, s: wp.vec3) -> wp.mat33:
    return wp.matrix_from_cols(s[0] * column(m, 0), s[1] * column(m, 1), s[2] * column(m, 2))


@wp.func
def exponential(v: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.exp(v[0]), wp.exp(v[1]), wp.exp(v[2]))


@wp.func
def write_gaussian(
    row: wp.int32,
    stretched: wp.mat33,
    axes: wp.mat33,
    scales: wp.vec3,
    rotations_out: wp.array[wp.vec4],
    log_scales_out: wp.array[wp.vec3],
    turns_out: wp.array[wp.mat33],
):
    """Eq. (15) for ``stretched`` = F R: the SVD of F R S, its axes matched in order and sign to R_polar r_i."""
    carried = rotation_part(column(stretched, 0), column(stretched, 1), column(stretched, 2))
    factor = scaled_columns(stretched, scales)
    m = orthogonal_columns(column(factor, 0), column(factor, 1), column(factor, 2))
    frame = proper_frame(m.a, m.b, m.c)
    lengths = wp.vec3(wp.length(m.a), wp.length(m.b), wp.length(m.c))
    order = matched_order(frame, carried)
    q = wp.quat_from_matrix(signed_as(frame, order, carried))
    rotations_out[row] = wp.vec4(q[3], q[0], q[1], q[2])
    log_scales_out[row] = wp.vec3(
        wp.log(wp.max(lengths[order[0]], LEAST_SCALE)),
        wp.log(wp.max(lengths[order[1]], LEAST_SCALE)),
        wp.log(wp.max(lengths[order[2]], LEAST_SCALE)),
    )
    turns_out[row] = carried * wp.transpose(axes)


@wp.kernel
def deform_kernel(
    first_row: wp.int32,
    # In:
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    positions: wp.array[Vec3],
    tets: wp.array[wp.vec4i],
    gradients: wp.array[wp.mat33],
    point_tets: wp.array[wp.int32],
    weights: wp.array[Vec4],
    arms: wp.array2d[wp.float32],
    max_stretch: wp.float32,
    # Out:
    means_out: wp.array[wp.vec3],
    rotations_out: wp.array[wp.vec4],
    log_scales_out: wp.array[wp.vec3],
    turns_out: wp.array[wp.mat33],
):
    """F = (F+ + F-)/2 (Eq. 14), or the F of the mean's tetrahedron where det F <= 0, then Eq. (15).

    The mean goes where the Gaussian's mass goes, to second order (beyond the paper, which carries the mean as a point):
    E[x(m + sum z_k s_k r_k)] = x(m) + sum s_k^2 x_kk / 2, and x_kk is seen from the difference of the two arms.
    """
    row = first_row + wp.tid()
    axes = turn_of(rotations[row])
    both = carried_arms(row, axes, max_stretch, positions, tets, gradients, point_tets, weights, arms)
    scales = exponential(log_scales[row])
    bulge = wp.vec3(0.0)
    for k in range(3):
        reach = wp.max(arms[row, k] + arms[row, 3 + k], 3.0 * scales[k])
        bulge += (scales[k] * scales[k] / reach) * (column(both.plus, k) - column(both.minus, k))
    stretched = 0.5 * (both.plus + both.minus)
    if wp.determinant(stretched) <= 0.0:
        stretched = gradients[point_tets[7 * row]] * axes
    means_out[row] = single(both.mean) + bulge
    write_gaussian(row, stretched, axes, scales, rotations_out, log_scales_out, turns_out)


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
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    positions: wp.array[Vec3],
    tets: wp.array[wp.vec4i],
    gradients: wp.array[wp.mat33],
    point_tets: wp.array[wp.int32],
    weights: wp.array[Vec4],
    arms: wp.array2d[wp.float32],
    max_stretch: wp.float32,
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
    scales = exponential(log_scales[row])
    axes = turn_of(rotations[row])
    both = carried_arms(row, axes, max_stretch, positions, tets, gradients, point_tets, weights, arms)
    between = wp.transpose(bend_frame(both.plus, scales)) * bend_frame(both.minus, scales)
    twice_sine = wp.length(
        wp.vec3(between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1])
    )
    theta = wp.atan2(twice_sine, wp.trace(between) - 1.0)
    bend_out[row] = wp.max(bend_out[row], wp.degrees(theta))
    curl = curl_out[row]
    error = error_out[row]
    for k in range(3):
        f_plus = gradients[point_tets[7 * row + 1 + k]] * axes
        f_minus = gradients[point_tets[7 * row + 4 + k]] * axes
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
