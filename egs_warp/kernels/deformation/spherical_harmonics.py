"""Rotation of the colour of Gaussians: real spherical harmonics of bands 1 to 3 in the INRIA sign convention.

A rotation is decomposed into rotations about z, y and z. A rotation about y equals a rotation about z between quarter
turns about x. A rotation about z rotates the coefficients of orders m and -m as a pair, and a quarter turn about x
mixes only a few coefficients (Pinchon and Hoggan 2007). The decomposition takes half the work of a full matrix for each
band, and no matrix is formed.
"""

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

Mat53 = wp.types.matrix(shape=(5, 3), dtype=wp.float32)
Mat73 = wp.types.matrix(shape=(7, 3), dtype=wp.float32)
Colour = wp.types.matrix(shape=(16, 3), dtype=wp.float32)
"""Type of the coefficients of degree 3, one row each."""

TINY = wp.constant(wp.float32(1.0e-18))
S34 = wp.constant(wp.float32(np.sqrt(3 / 4)))
S58 = wp.constant(wp.float32(np.sqrt(5 / 8)))
S38 = wp.constant(wp.float32(np.sqrt(3 / 8)))
S1516 = wp.constant(wp.float32(np.sqrt(15 / 16)))


@wp.func
def rotate_band_1(c: wp.mat33, turn: wp.mat33) -> wp.mat33:
    """Return the coefficients 1 to 3, one row each, after the rotation by the matrix ``turn``. The coefficients c
    represent the linear function w.d of the direction d, with w = (-c3, -c1, c2).
    """
    w = wp.mat33(-c[2, 0], -c[2, 1], -c[2, 2], -c[0, 0], -c[0, 1], -c[0, 2], c[1, 0], c[1, 1], c[1, 2])
    w = turn * w
    return wp.mat33(-w[1, 0], -w[1, 1], -w[1, 2], w[2, 0], w[2, 1], w[2, 2], -w[0, 0], -w[0, 1], -w[0, 2])


@wp.struct
class EulerAngles:
    """Cosine and sine of the angles of successive rotations about z, y and z."""

    first: wp.vec2
    tilt: wp.vec2
    last: wp.vec2


@wp.func
def euler_from_quaternion(q: wp.vec4) -> EulerAngles:
    """Return the Euler angles of the unit quaternion w, x, y, z. If the decomposition is not unique, every choice gives
    the same rotation up to rounding.
    """
    along = wp.sqrt(q[0] * q[0] + q[3] * q[3])
    across = wp.sqrt(q[1] * q[1] + q[2] * q[2])
    half_sum = wp.vec2(1.0, 0.0)
    half_difference = wp.vec2(1.0, 0.0)
    if along > TINY:
        half_sum = wp.vec2(q[0], q[3]) / along
    if across > TINY:
        half_difference = wp.vec2(q[2], -q[1]) / across
    rr = half_sum[0] * half_difference[0]
    ii = half_sum[1] * half_difference[1]
    ri = half_sum[0] * half_difference[1]
    ir = half_sum[1] * half_difference[0]
    result = EulerAngles()
    result.first = wp.vec2(rr + ii, ir - ri)
    result.tilt = wp.vec2(along * along - across * across, 2.0 * along * across)
    result.last = wp.vec2(rr - ii, ir + ri)
    return result


@wp.func
def double_angle(t: wp.vec2) -> wp.vec2:
    return wp.vec2(t[0] * t[0] - t[1] * t[1], 2.0 * t[0] * t[1])


@wp.func
def angle_sum(t: wp.vec2, u: wp.vec2) -> wp.vec2:
    return wp.vec2(t[0] * u[0] - t[1] * u[1], t[0] * u[1] + t[1] * u[0])


@wp.func
def band_2_about_z(c: Mat53, t: wp.vec2) -> Mat53:
    """Return the coefficients of band 2 after a rotation about z by the angle with cosine and sine ``t``. Orders m and
    -m rotate as a pair by m times the angle.
    """
    t2 = double_angle(t)
    result = Mat53()
    result[0] = t2[0] * c[0] + t2[1] * c[4]
    result[1] = t[0] * c[1] + t[1] * c[3]
    result[2] = c[2]
    result[3] = t[0] * c[3] - t[1] * c[1]
    result[4] = t2[0] * c[4] - t2[1] * c[0]
    return result


@wp.func
def rotate_band_2(c: Mat53, turns: EulerAngles) -> Mat53:
    """Return the coefficients 4 to 8, one row each, after the rotation. The rotation about y is applied as a rotation
    about z between quarter turns about x.
    """
    f = band_2_about_z(c, turns.first)
    g = Mat53()
    g[0] = f[3]
    g[1] = -f[1]
    g[2] = -0.5 * f[2] - S34 * f[4]
    g[3] = -f[0]
    g[4] = 0.5 * f[4] - S34 * f[2]
    f = band_2_about_z(g, turns.tilt)
    g[0] = -f[3]
    g[1] = -f[1]
    g[2] = -0.5 * f[2] - S34 * f[4]
    g[3] = f[0]
    g[4] = 0.5 * f[4] - S34 * f[2]
    return band_2_about_z(g, turns.last)


@wp.func
def band_3_about_z(c: Mat73, t: wp.vec2) -> Mat73:
    """Return the coefficients of band 3 after a rotation about z, like ``band_2_about_z``."""
    t2 = double_angle(t)
    t3 = angle_sum(t2, t)
    result = Mat73()
    result[0] = t3[0] * c[0] + t3[1] * c[6]
    result[1] = t2[0] * c[1] + t2[1] * c[5]
    result[2] = t[0] * c[2] + t[1] * c[4]
    result[3] = c[3]
    result[4] = t[0] * c[4] - t[1] * c[2]
    result[5] = t2[0] * c[5] - t2[1] * c[1]
    result[6] = t3[0] * c[6] - t3[1] * c[0]
    return result


@wp.func
def rotate_band_3(c: Mat73, turns: EulerAngles) -> Mat73:
    """Return the coefficients 9 to 15, one row each, after the rotation, by the method of ``rotate_band_2``."""
    f = band_3_about_z(c, turns.first)
    g = Mat73()
    g[0] = S38 * f[5] - S58 * f[3]
    g[1] = -f[1]
    g[2] = -S38 * f[3] - S58 * f[5]
    g[3] = S58 * f[0] + S38 * f[2]
    g[4] = -0.25 * f[4] - S1516 * f[6]
    g[5] = S58 * f[2] - S38 * f[0]
    g[6] = 0.25 * f[6] - S1516 * f[4]
    f = band_3_about_z(g, turns.tilt)
    g[0] = S58 * f[3] - S38 * f[5]
    g[1] = -f[1]
    g[2] = S38 * f[3] + S58 * f[5]
    g[3] = -S58 * f[0] - S38 * f[2]
    g[4] = -0.25 * f[4] - S1516 * f[6]
    g[5] = S38 * f[0] - S58 * f[2]
    g[6] = 0.25 * f[6] - S1516 * f[4]
    return band_3_about_z(g, turns.last)


@wp.func
def rotate_sh(c: Colour, q: wp.vec4, degree: wp.int32) -> Colour:
    """Return the coefficients up to ``degree`` after the rotation by the unit quaternion ``q`` (w, x, y, z); band 0 is
    unchanged.
    """
    result = c
    turns = euler_from_quaternion(q)
    if degree >= 1:
        first = wp.mat33()
        for j in range(3):
            first[j] = c[1 + j]
        first = rotate_band_1(first, wp.quat_to_matrix(wp.quat(q[1], q[2], q[3], q[0])))
        for j in range(3):
            result[1 + j] = first[j]
    if degree >= 2:
        second = Mat53()
        for j in range(5):
            second[j] = c[4 + j]
        second = rotate_band_2(second, turns)
        for j in range(5):
            result[4 + j] = second[j]
    if degree >= 3:
        third = Mat73()
        for j in range(7):
            third[j] = c[9 + j]
        third = rotate_band_3(third, turns)
        for j in range(7):
            result[9 + j] = third[j]
    return result


@wp.kernel
def rotate_sh_kernel(
    first_row: wp.int32,
    # In:
    turns: wp.array[wp.vec4],
    sh: wp.array2d[wp.vec3],
    degree: wp.int32,
    # Out:
    sh_out: wp.array2d[wp.vec3],
):
    """Rotate the coefficients of each Gaussian's colour; band 0 is not written.

    Args:
        turns: (n,) unit quaternions w, x, y, z.
        sh, sh_out: (n, coefficients) before and after the rotation.
        degree: degree of the coefficients, 1 to 3.
    """
    row = first_row + wp.tid()
    count = (degree + 1) * (degree + 1)
    # Read each coefficient once: the rows are 192 bytes apart, so the reads of neighbouring threads are not contiguous.
    colour = Colour()
    for j in range(1, 16):
        if j < count:
            colour[j] = sh[row, j]
    colour = rotate_sh(colour, turns[row], degree)
    for j in range(1, 16):
        if j < count:
            sh_out[row, j] = colour[j]
