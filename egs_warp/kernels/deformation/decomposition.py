"""Decompositions of 3 x 3 matrices in float32: one-sided Jacobi, polar rotations, and frames with matched order and
signs of axes.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

MAX_SWEEPS = wp.constant(8)
ORTHOGONALITY_TOLERANCE = wp.constant(wp.float32(1.0e-6))
MIN_RELATIVE_DETERMINANT = wp.constant(wp.float32(1.0e-3))


@wp.func
def rotation_from_quaternion(q: wp.vec4) -> wp.mat33:
    """Return the rotation matrix [r1 r2 r3] of the unit quaternion w, x, y, z."""
    return wp.quat_to_matrix(wp.normalize(wp.quat(q[1], q[2], q[3], q[0])))


@wp.func
def quaternion_from_rotation(m: wp.mat33) -> wp.vec4:
    """Return the quaternion w, x, y, z of a rotation matrix, computed from the quaternion's largest component. The
    component is selected by branches, because a variable index would move the matrix to local memory.
    """
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
class Pair:
    """Two columns of a 3x3 matrix, and two columns of the rotation that has been applied to the matrix from the
    right."""

    a: wp.vec3
    b: wp.vec3
    va: wp.vec3
    vb: wp.vec3
    sine: wp.float32
    """Sine of the angle of the last rotation."""


@wp.func
def orthogonal_pair(a: wp.vec3, b: wp.vec3, va: wp.vec3, vb: wp.vec3) -> Pair:
    """Rotate ``a`` and ``b`` in their plane so that they become orthogonal, and ``va`` and ``vb`` by the same
    rotation.
    """
    aa = wp.dot(a, a)
    bb = wp.dot(b, b)
    ab = wp.dot(a, b)
    cosine = wp.float32(1.0)
    sine = wp.float32(0.0)
    if ab * ab > ORTHOGONALITY_TOLERANCE * ORTHOGONALITY_TOLERANCE * aa * bb:
        cot = (bb - aa) / (2.0 * ab)
        tangent = wp.where(cot >= 0.0, 1.0, -1.0) / (wp.abs(cot) + wp.sqrt(1.0 + cot * cot))
        cosine = 1.0 / wp.sqrt(1.0 + tangent * tangent)
        sine = cosine * tangent
    result = Pair()
    result.a = cosine * a - sine * b
    result.b = sine * a + cosine * b
    result.va = cosine * va - sine * vb
    result.vb = sine * va + cosine * vb
    result.sine = sine
    return result


@wp.struct
class Columns:
    """3x3 matrix by columns, and the rotation by columns that has been applied to it from the right."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    va: wp.vec3
    vb: wp.vec3
    vc: wp.vec3


@wp.func
def orthogonal_columns(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> Columns:
    """Decompose M = [a b c] by one-sided Jacobi: return M V with orthogonal columns (left singular vectors times
    singular values), and V with det V = +1.

    Each column retains its own relative precision, so float32 is sufficient for splats whose scales differ by a factor
    of e^10. Each column stays as close as possible to its original direction.
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
        ab = orthogonal_pair(m.a, m.b, m.va, m.vb)
        ac = orthogonal_pair(ab.a, m.c, ab.va, m.vc)
        bc = orthogonal_pair(ab.b, ac.b, ab.vb, ac.vb)
        m.a = ac.a
        m.b = bc.a
        m.c = bc.b
        m.va = ac.va
        m.vb = bc.va
        m.vc = bc.vb
        sweep += 1
        if wp.abs(ab.sine) + wp.abs(ac.sine) + wp.abs(bc.sine) == 0.0:
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
    """Return a unit vector perpendicular to the unit vector ``u``."""
    helper = wp.where(wp.abs(u[0]) < 0.6, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0))
    return wp.normalize(wp.cross(u, helper))


@wp.func
def unit_pair(a: wp.vec3, b: wp.vec3) -> wp.mat33:
    """Return the right-handed frame [a/|a|, b/|b|, a x b] of two orthogonal columns, either of which may be zero."""
    first = wp.length_sq(a) >= wp.length_sq(b)
    longer = unit_or(wp.where(first, a, b), wp.where(first, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0)))
    shorter = wp.where(first, b, a)
    shorter = shorter - wp.dot(shorter, longer) * longer
    length = wp.length(shorter)
    if length > 1.0e-20:
        shorter = shorter / length
    else:
        shorter = perpendicular(longer)
    u = wp.where(first, longer, shorter)
    v = wp.where(first, shorter, longer)
    return wp.matrix_from_cols(u, v, wp.cross(u, v))


@wp.func
def proper_frame(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.mat33:
    """Return unit columns along three orthogonal columns; the shortest is replaced by the cross product of the other
    two, so that det = +1 always.

    The longer two are selected by comparison instead of branches, which would diverge on a GPU.
    """
    aa = wp.length_sq(a)
    bb = wp.length_sq(b)
    cc = wp.length_sq(c)
    third = cc <= aa and cc <= bb
    first = aa <= bb
    f = unit_pair(wp.where(third, a, wp.where(first, b, c)), wp.where(third, b, wp.where(first, c, a)))
    u = column(f, 0)
    v = column(f, 1)
    w = column(f, 2)
    return wp.matrix_from_cols(
        wp.where(third, u, wp.where(first, w, v)),
        wp.where(third, v, wp.where(first, u, w)),
        wp.where(third, w, wp.where(first, v, u)),
    )


@wp.func
def rotation_part(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.mat33:
    """Return the rotation of the polar decomposition of [a b c], with det = +1. For a matrix with a negative
    determinant, this is the nearest rotation.
    """
    m = orthogonal_columns(a, b, c)
    return proper_frame(m.a, m.b, m.c) * wp.transpose(wp.matrix_from_cols(m.va, m.vb, m.vc))


@wp.func
def match_columns(frame: wp.mat33, reference: wp.mat33) -> wp.vec3i:
    """Return, for each column of ``reference``, the index of the matching column of ``frame``. The indices are the
    permutation with the greatest sum of absolute cosines between matching columns.
    """
    d = wp.transpose(reference) * frame
    best = wp.vec3i(0, 1, 2)
    best_total = wp.abs(d[0, 0]) + wp.abs(d[1, 1]) + wp.abs(d[2, 2])
    total = wp.abs(d[0, 1]) + wp.abs(d[1, 0]) + wp.abs(d[2, 2])
    if total > best_total:
        best_total = total
        best = wp.vec3i(1, 0, 2)
    total = wp.abs(d[0, 0]) + wp.abs(d[1, 2]) + wp.abs(d[2, 1])
    if total > best_total:
        best_total = total
        best = wp.vec3i(0, 2, 1)
    total = wp.abs(d[0, 2]) + wp.abs(d[1, 1]) + wp.abs(d[2, 0])
    if total > best_total:
        best_total = total
        best = wp.vec3i(2, 1, 0)
    total = wp.abs(d[0, 1]) + wp.abs(d[1, 2]) + wp.abs(d[2, 0])
    if total > best_total:
        best_total = total
        best = wp.vec3i(1, 2, 0)
    total = wp.abs(d[0, 2]) + wp.abs(d[1, 0]) + wp.abs(d[2, 1])
    if total > best_total:
        best = wp.vec3i(2, 0, 1)
    return best


@wp.func
def rotation_of(m: wp.mat33) -> wp.mat33:
    """Return the ``rotation_part`` of a matrix with det > 0. Where it is known to converge fast, Newton's iteration X
    <- (g X + X^-T / g) / 2 (Higham 1986) is used, which takes half the work.
    """
    a = column(m, 0)
    b = column(m, 1)
    c = column(m, 2)
    size = wp.dot(a, a) + wp.dot(b, b) + wp.dot(c, c)
    if wp.dot(wp.cross(a, b), c) < MIN_RELATIVE_DETERMINANT * size * wp.sqrt(size):
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
        # Convergence is quadratic: another step would change the columns by 1e-8.
        if moved < 1.0e-8:
            step = MAX_SWEEPS
    return wp.matrix_from_cols(a, b, c)


@wp.func
def select_column(m: wp.mat33, k: wp.int32) -> wp.vec3:
    """Return column ``k``, selected by comparisons, because a variable index would move the matrix to local memory."""
    return wp.where(k == 0, column(m, 0), wp.where(k == 1, column(m, 1), column(m, 2)))


@wp.func
def align_signs(frame: wp.mat33, order: wp.vec3i, reference: wp.mat33) -> wp.mat33:
    """Return the columns of ``frame`` in the given ``order``, with the signs of ``reference``. If needed for det = +1,
    the sign of the least aligned column is flipped."""
    a = select_column(frame, order[0])
    b = select_column(frame, order[1])
    c = select_column(frame, order[2])
    da = wp.dot(a, column(reference, 0))
    db = wp.dot(b, column(reference, 1))
    dc = wp.dot(c, column(reference, 2))
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
def scaled_columns(m: wp.mat33, s: wp.vec3) -> wp.mat33:
    return wp.matrix_from_cols(s[0] * column(m, 0), s[1] * column(m, 1), s[2] * column(m, 2))
