"""Kernels that measure the extent of Gaussians across a plane, and that truncate Gaussians at a plane.

The plane is normal.x + offset = 0, with the unit ``normal`` N.
"""

import warp as wp

from egs_warp.kernels.deformation.deformer import orthogonal_columns, proper_frame
from egs_warp.kernels.render.projection import rotation_matrix

wp.set_module_options({"enable_backward": False})


@wp.kernel
def extent_kernel(
    first_row: wp.int32,
    # In:
    normal: wp.vec3,
    offset: wp.float32,
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    # Out:
    height_out: wp.array[wp.float32],
    axis_reach_out: wp.array[wp.float32],
    deviation_out: wp.array[wp.float32],
):
    """Compute the extent of each Gaussian across the plane.

    Args:
        normal, offset: the plane.
        means, rotations, log_scales: (n,) the Gaussians.
        height_out: (n,) height of the mean above the plane.
        axis_reach_out: (n,) largest |N.(s_i r_i)| of the axes (Eq. 20 divided by gamma).
        deviation_out: (n,) standard deviation along N.
    """
    row = first_row + wp.tid()
    along = wp.transpose(rotation_matrix(rotations[row])) * normal
    s = log_scales[row]
    w = wp.vec3(wp.abs(along[0]) * wp.exp(s[0]), wp.abs(along[1]) * wp.exp(s[1]), wp.abs(along[2]) * wp.exp(s[2]))
    height_out[row] = wp.dot(normal, means[row]) + offset
    axis_reach_out[row] = wp.max(w)
    deviation_out[row] = wp.length(w)


@wp.kernel
def half_space_kernel(
    first_row: wp.int32,
    # In:
    normal: wp.vec3,
    offset: wp.float32,
    source: wp.array[wp.int32],
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    # Out:
    mean_out: wp.array[wp.vec3],
    rotation_out: wp.array[wp.vec4],
    log_scale_out: wp.array[wp.vec3],
    opacity_logit_out: wp.array[wp.float32],
):
    """Truncate Gaussians at the plane: compute opacity, mean and shape of the part on the side to which the normal
    points.

    With A = R S and w = A^T N / sigma, Sigma - c Sigma N N^T Sigma / sigma^2 = A' A'^T for A' = A (I - (1 - sqrt(1 -
    c)) w w^T). The factor A' is decomposed instead of the covariance, whose rounding errors exceed the smallest
    variance of flat splats.

    Args:
        normal, offset: the plane.
        source: (rows,) Gaussian that each row truncates.
        means, rotations, log_scales, opacity_logits: (n,) the Gaussians.
        mean_out, rotation_out, log_scale_out, opacity_logit_out: (rows,) the truncated Gaussians.
    """
    row = first_row + wp.tid()
    g = source[row]
    turn = rotation_matrix(rotations[g])
    s = log_scales[g]
    scale = wp.vec3(wp.exp(s[0]), wp.exp(s[1]), wp.exp(s[2]))
    w = wp.cw_mul(scale, wp.transpose(turn) * normal)
    sigma = wp.length(w)
    w = w / sigma
    t = -(wp.dot(normal, means[g]) + offset) / sigma
    mass_fraction = 0.5 * wp.erfc(t * 0.70710678)
    # The hazard pdf / (1 - cdf) tends to 0 far above the plane and to t far below it.
    hazard = wp.where(t < 6.0, 0.3989422804 * wp.exp(-0.5 * t * t) / wp.max(mass_fraction, 1.0e-9), t)
    narrowed = wp.sqrt(wp.clamp(1.0 - hazard * (hazard - t), 1.0e-6, 1.0))
    mean_out[row] = means[g] + hazard * (turn * wp.cw_mul(scale, w))
    factor = (turn * wp.diag(scale)) * (wp.identity(n=3, dtype=wp.float32) - (1.0 - narrowed) * wp.outer(w, w))
    m = orthogonal_columns(
        wp.vec3(factor[0, 0], factor[1, 0], factor[2, 0]),
        wp.vec3(factor[0, 1], factor[1, 1], factor[2, 1]),
        wp.vec3(factor[0, 2], factor[1, 2], factor[2, 2]),
    )
    q = wp.quat_from_matrix(proper_frame(m.a, m.b, m.c))
    rotation_out[row] = wp.vec4(q[3], q[0], q[1], q[2])
    log_scale_out[row] = wp.vec3(
        wp.log(wp.max(wp.length(m.a), 1.0e-20)),
        wp.log(wp.max(wp.length(m.b), 1.0e-20)),
        wp.log(wp.max(wp.length(m.c), 1.0e-20)),
    )
    # Seen along the plane, the mass is proportional to opacity times width.
    opacity = 1.0 / (1.0 + wp.exp(-opacity_logits[g]))
    peak = wp.clamp(opacity * wp.min(mass_fraction / narrowed, 1.0), 1.0e-6, 0.999999)
    opacity_logit_out[row] = wp.log(peak / (1.0 - peak))
