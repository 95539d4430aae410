"""Real spherical harmonics up to degree 3 in INRIA's sign convention: colour in a direction, and its derivatives."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": True})

C0 = wp.constant(wp.float32(0.28209479177387814))
C1 = wp.constant(wp.float32(0.4886025119029199))
C2 = wp.constant(wp.float32(1.0925484305920792))
C20 = wp.constant(wp.float32(0.31539156525252005))
C22 = wp.constant(wp.float32(0.5462742152960396))
C33 = wp.constant(wp.float32(0.5900435899266435))
C32 = wp.constant(wp.float32(2.890611442640554))
C31 = wp.constant(wp.float32(0.4570457994644658))
C30 = wp.constant(wp.float32(0.3731763325901154))
C3B = wp.constant(wp.float32(1.445305721320277))
"""Factors of the basis functions: of band 0, of band 1, and of bands 2 and 3 by order."""


@wp.func
def sh_sum(sh: wp.array2d[wp.vec3], g: wp.int32, coefficients: wp.int32, d: wp.vec3) -> wp.vec3:
    """Return the sum of the spherical harmonics of Gaussian ``g`` in the unit direction ``d``, in INRIA's sign
    convention and without the offset of 0.5. ``coefficients`` is the number of coefficients.
    """
    x = d[0]
    y = d[1]
    z = d[2]
    c = C0 * sh[g, 0]
    if coefficients > 1:
        c = c + C1 * (-y * sh[g, 1] + z * sh[g, 2] - x * sh[g, 3])
    if coefficients > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        c = c + C2 * (x * y) * sh[g, 4]
        c = c - C2 * (y * z) * sh[g, 5]
        c = c + C20 * (2.0 * zz - xx - yy) * sh[g, 6]
        c = c - C2 * (x * z) * sh[g, 7]
        c = c + C22 * (xx - yy) * sh[g, 8]
    if coefficients > 9:
        xx = x * x
        yy = y * y
        zz = z * z
        c = c - C33 * y * (3.0 * xx - yy) * sh[g, 9]
        c = c + C32 * (x * y) * z * sh[g, 10]
        c = c - C31 * y * (4.0 * zz - xx - yy) * sh[g, 11]
        c = c + C30 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * sh[g, 12]
        c = c - C31 * x * (4.0 * zz - xx - yy) * sh[g, 13]
        c = c + C3B * z * (xx - yy) * sh[g, 14]
        c = c - C33 * x * (xx - 3.0 * yy) * sh[g, 15]
    return c


@wp.func
def sh_direction_gradient(sh: wp.array2d[wp.vec3], g: wp.int32, d: wp.vec3, by_colour: wp.vec3) -> wp.vec3:
    """Return the gradient with respect to the unit direction ``d`` towards Gaussian ``g``, given the gradient
    ``by_colour`` with respect to its colour. The three components of ``d`` are treated as independent.
    """
    x = d[0]
    y = d[1]
    z = d[2]
    coefficients = sh.shape[1]
    by_d = wp.vec3()
    if coefficients > 1:
        by_d = C1 * wp.vec3(-wp.dot(sh[g, 3], by_colour), -wp.dot(sh[g, 1], by_colour), wp.dot(sh[g, 2], by_colour))
    if coefficients > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        by_d += C2 * wp.dot(sh[g, 4], by_colour) * wp.vec3(y, x, 0.0)
        by_d -= C2 * wp.dot(sh[g, 5], by_colour) * wp.vec3(0.0, z, y)
        by_d += 2.0 * C20 * wp.dot(sh[g, 6], by_colour) * wp.vec3(-x, -y, 2.0 * z)
        by_d -= C2 * wp.dot(sh[g, 7], by_colour) * wp.vec3(z, 0.0, x)
        by_d += 2.0 * C22 * wp.dot(sh[g, 8], by_colour) * wp.vec3(x, -y, 0.0)
    if coefficients > 9:
        xx = x * x
        yy = y * y
        zz = z * z
        by_d -= C33 * wp.dot(sh[g, 9], by_colour) * wp.vec3(6.0 * x * y, 3.0 * xx - 3.0 * yy, 0.0)
        by_d += C32 * wp.dot(sh[g, 10], by_colour) * wp.vec3(y * z, x * z, x * y)
        by_d -= C31 * wp.dot(sh[g, 11], by_colour) * wp.vec3(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z)
        by_d += C30 * wp.dot(sh[g, 12], by_colour) * wp.vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy)
        by_d -= C31 * wp.dot(sh[g, 13], by_colour) * wp.vec3(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z)
        by_d += C3B * wp.dot(sh[g, 14], by_colour) * wp.vec3(2.0 * x * z, -2.0 * y * z, xx - yy)
        by_d -= C33 * wp.dot(sh[g, 15], by_colour) * wp.vec3(3.0 * xx - 3.0 * yy, -6.0 * x * y, 0.0)
    return by_d


@wp.func
def write_sh_gradient(by_sh: wp.array2d[wp.vec3], g: wp.int32, d: wp.vec3, by_colour: wp.vec3):
    """Write the gradient with respect to the SH coefficients of Gaussian ``g`` to row ``g`` of ``by_sh``, given the
    gradient ``by_colour`` with respect to its colour.
    """
    x = d[0]
    y = d[1]
    z = d[2]
    coefficients = by_sh.shape[1]
    by_sh[g, 0] = C0 * by_colour
    if coefficients > 1:
        by_sh[g, 1] = -C1 * y * by_colour
        by_sh[g, 2] = C1 * z * by_colour
        by_sh[g, 3] = -C1 * x * by_colour
    if coefficients > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        by_sh[g, 4] = C2 * (x * y) * by_colour
        by_sh[g, 5] = -C2 * (y * z) * by_colour
        by_sh[g, 6] = C20 * (2.0 * zz - xx - yy) * by_colour
        by_sh[g, 7] = -C2 * (x * z) * by_colour
        by_sh[g, 8] = C22 * (xx - yy) * by_colour
    if coefficients > 9:
        xx = x * x
        yy = y * y
        zz = z * z
        by_sh[g, 9] = -C33 * y * (3.0 * xx - yy) * by_colour
        by_sh[g, 10] = C32 * (x * y) * z * by_colour
        by_sh[g, 11] = -C31 * y * (4.0 * zz - xx - yy) * by_colour
        by_sh[g, 12] = C30 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * by_colour
        by_sh[g, 13] = -C31 * x * (4.0 * zz - xx - yy) * by_colour
        by_sh[g, 14] = C3B * z * (xx - yy) * by_colour
        by_sh[g, 15] = -C33 * x * (xx - 3.0 * yy) * by_colour
