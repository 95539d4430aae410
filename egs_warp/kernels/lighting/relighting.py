"""Kernel of relighting: it scales each Gaussian's colour by the irradiance at its rotated normal.

Host code: ``egs_warp/lighting/relighting.py``.
"""

import warp as wp

from egs_warp.kernels.render.spherical_harmonics import C0

wp.set_module_options({"enable_backward": False})

_STILL = wp.constant(wp.float32(0.0175))
"""Maximum rotation, rad, at which a Gaussian's colour stays bitwise unchanged: 1 degree, more than the sag of a body at
rest causes."""
_TURNED = wp.constant(wp.float32(0.07))
"""Minimum rotation, rad, from which on the relighting is complete: 4 degrees."""
_MIN_IRRADIANCE = wp.constant(wp.float32(0.2))
"""Minimum irradiance, relative to its mean; the quadratic form is slightly negative on the side opposite to a single
light."""
_MAX_RATIO = wp.constant(wp.float32(2.5))
"""Maximum ratio of two irradiances, because a captured colour near black or white cannot be scaled by more."""


@wp.func
def irradiance(form: wp.mat44, normal: wp.vec3) -> wp.float32:
    """Return the irradiance at a surface with the unit ``normal``, relative to the mean over all normals."""
    n = wp.vec4(normal[0], normal[1], normal[2], 1.0)
    return wp.max(wp.dot(n, form * n), _MIN_IRRADIANCE)


@wp.kernel
def relight_kernel(
    first_row: wp.int32,
    # In:
    form: wp.mat44,
    display_exponent: wp.float32,
    normals: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    sh: wp.array2d[wp.vec3],
    # Out:
    sh_out: wp.array2d[wp.vec3],
):
    """Scale the colour of each Gaussian by the ratio of the irradiance after its rotation to the irradiance at rest.

    Args:
        form: quadratic form of the irradiance, with mean 1 over all normals.
        display_exponent: exponent that converts a ratio of linear light to a ratio of displayed colours.
        normals: unit normal of each Gaussian at rest; zero where it is not known.
        rotations: unit quaternions (w, x, y, z) from the rest pose.
        sh: coefficients of the deformed Gaussians.
        sh_out: coefficients after relighting; bitwise equal to ``sh`` where the rotation is below ``_STILL``.
    """
    g = wp.tid() + first_row
    q = rotations[g]
    axis = wp.vec3(q[1], q[2], q[3])
    angle = 2.0 * wp.atan2(wp.length(axis), wp.abs(q[0]))
    share = wp.clamp((angle - _STILL) / (_TURNED - _STILL), 0.0, 1.0)
    n = normals[g]
    coefficients = sh.shape[1]
    if share == 0.0 or wp.dot(n, n) == 0.0:
        for k in range(coefficients):
            sh_out[g, k] = sh[g, k]
        return
    turned = n + 2.0 * wp.cross(axis, wp.cross(axis, n) + q[0] * n)
    ratio = wp.clamp(irradiance(form, turned) / irradiance(form, n), 1.0 / _MAX_RATIO, _MAX_RATIO)
    gain = 1.0 + share * (wp.pow(ratio, display_exponent) - 1.0)
    half = wp.vec3(0.5, 0.5, 0.5)
    sh_out[g, 0] = gain * sh[g, 0] + (gain - 1.0) / C0 * half
    for k in range(1, coefficients):
        sh_out[g, k] = gain * sh[g, k]
