"""Real spherical harmonics up to degree 3, INRIA's signs: a colour towards a direction, and its derivatives."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.func
def sh_sum(sh: wp.array2d[wp.vec3], g: wp.int32, coefficients: wp.int32, d: wp.vec3) -> wp.vec3:
    """Spherical harmonics of Gaussian ``g`` towards the unit direction ``d``, INRIA signs, without the +0.5."""
    x = d[0]
    y = d[1]
    z = d[2]
    c = 0.28209479177387814 * sh[g, 0]
    if coefficients > 1:
        c = c + 0.4886025119029199 * (-y * sh[g, 1] + z * sh[g, 2] - x * sh[g, 3])
    if coefficients > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        c = c + 1.0925484305920792 * (x * y) * sh[g, 4]
        c = c - 1.0925484305920792 * (y * z) * sh[g, 5]
        c = c + 0.31539156525252005 * (2.0 * zz - xx - yy) * sh[g, 6]
        c = c - 1.0925484305920792 * (x * z) * sh[g, 7]
        c = c + 0.5462742152960396 * (xx - yy) * sh[g, 8]
    if coefficients > 9:
        xx = x * x
        yy = y * y
        zz = z * z
        c = c - 0.5900435899266435 * y * (3.0 * xx - yy) * sh[g, 9]
        c = c + 2.890611442640554 * (x * y) * z * sh[g, 10]
        c = c - 0.4570457994644658 * y * (4.0 * zz - xx - yy) * sh[g, 11]
        c = c + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * sh[g, 12]
        c = c - 0.4570457994644658 * x * (4.0 * zz - xx - yy) * sh[g, 13]
        c = c + 1.445305721320277 * z * (xx - yy) * sh[g, 14]
        c = c - 0.5900435899266435 * x * (xx - 3.0 * yy) * sh[g, 15]
    return c


@wp.func
def sh_direction_gradient(sh: wp.array2d[wp.vec3], g: wp.int32, d: wp.vec3, by_colour: wp.vec3) -> wp.vec3:
    """Gradient by the unit direction ``d`` towards Gaussian ``g``, as if its three numbers were free."""
    x = d[0]
    y = d[1]
    z = d[2]
    coefficients = sh.shape[1]
    by_d = wp.vec3()
    if coefficients > 1:
        c1 = 0.4886025119029199
        by_d = c1 * wp.vec3(-wp.dot(sh[g, 3], by_colour), -wp.dot(sh[g, 1], by_colour), wp.dot(sh[g, 2], by_colour))
    if coefficients > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        c2 = 1.0925484305920792
        c20 = 0.31539156525252005
        c22 = 0.5462742152960396
        by_d += c2 * wp.dot(sh[g, 4], by_colour) * wp.vec3(y, x, 0.0)
        by_d -= c2 * wp.dot(sh[g, 5], by_colour) * wp.vec3(0.0, z, y)
        by_d += 2.0 * c20 * wp.dot(sh[g, 6], by_colour) * wp.vec3(-x, -y, 2.0 * z)
        by_d -= c2 * wp.dot(sh[g, 7], by_colour) * wp.vec3(z, 0.0, x)
        by_d += 2.0 * c22 * wp.dot(sh[g, 8], by_colour) * wp.vec3(x, -y, 0.0)
    if coefficients > 9:
        xx = x * x
        yy = y * y
        zz = z * z
        c33 = 0.5900435899266435
        c32 = 2.890611442640554
        c31 = 0.4570457994644658
        c30 = 0.3731763325901154
        c3b = 1.445305721320277
        by_d -= c33 * wp.dot(sh[g, 9], by_colour) * wp.vec3(6.0 * x * y, 3.0 * xx - 3.0 * yy, 0.0)
        by_d += c32 * wp.dot(sh[g, 10], by_colour) * wp.vec3(y * z, x * z, x * y)
        by_d -= c31 * wp.dot(sh[g, 11], by_colour) * wp.vec3(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z)
        by_d += c30 * wp.dot(sh[g, 12], by_colour) * wp.vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy)
        by_d -= c31 * wp.dot(sh[g, 13], by_colour) * wp.vec3(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z)
        by_d += c3b * wp.dot(sh[g, 14], by_colour) * wp.vec3(2.0 * x * z, -2.0 * y * z, xx - yy)
        by_d -= c33 * wp.dot(sh[g, 15], by_colour) * wp.vec3(3.0 * xx - 3.0 * yy, -6.0 * x * y, 0.0)
    return by_d


@wp.func
def write_sh_gradient(by_sh: wp.array2d[wp.vec3], g: wp.int32, d: wp.vec3, by_colour: wp.vec3):
    """Put the gradient by the coefficients of Gaussian ``g`` into ``by_sh``."""
    x = d[0]
    y = d[1]
    z = d[2]
    coefficients = by_sh.shape[1]
    by_sh[g, 0] = 0.28209479177387814 * by_colour
    if coefficients > 1:
        c1 = 0.4886025119029199
        by_sh[g, 1] = -c1 * y * by_colour
        by_sh[g, 2] = c1 * z * by_colour
        by_sh[g, 3] = -c1 * x * by_colour
    if coefficients > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        c2 = 1.0925484305920792
        c20 = 0.31539156525252005
        c22 = 0.5462742152960396
        by_sh[g, 4] = c2 * (x * y) * by_colour
        by_sh[g, 5] = -c2 * (y * z) * by_colour
        by_sh[g, 6] = c20 * (2.0 * zz - xx - yy) * by_colour
        by_sh[g, 7] = -c2 * (x * z) * by_colour
        by_sh[g, 8] = c22 * (xx - yy) * by_colour
    if coefficients > 9:
        xx = x * x
        yy = y * y
        zz = z * z
        c33 = 0.5900435899266435
        c32 = 2.890611442640554
        c31 = 0.4570457994644658
        c30 = 0.3731763325901154
        c3b = 1.445305721320277
        by_sh[g, 9] = -c33 * y * (3.0 * xx - yy) * by_colour
        by_sh[g, 10] = c32 * (x * y) * z * by_colour
        by_sh[g, 11] = -c31 * y * (4.0 * zz - xx - yy) * by_colour
        by_sh[g, 12] = c30 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * by_colour
        by_sh[g, 13] = -c31 * x * (4.0 * zz - xx - yy) * by_colour
        by_sh[g, 14] = c3b * z * (xx - yy) * by_colour
        by_sh[g, 15] = -c33 * x * (xx - 3.0 * yy) * by_colour
