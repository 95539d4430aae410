"""Updates of all Gaussians in every training step, besides those of Adam.

Host code: ``egs_warp/training/relocation.py``.
"""

import warp as wp

from egs_warp.kernels.deformation.decomposition import rotation_from_quaternion

wp.set_module_options({"enable_backward": False})

STEEPNESS = wp.constant(wp.float32(100.0))


@wp.func
def sigmoid(x: wp.float32) -> wp.float32:
    """Return 1 / (1 + exp(-x))."""
    return 1.0 / (1.0 + wp.exp(-x))


@wp.func
def opacity_penalty_gradient(by_opacity: wp.float32, logit: wp.float32) -> wp.float32:
    """Return the derivative of ``by_opacity`` times the opacity with respect to the ``logit``."""
    opacity = sigmoid(logit)
    return by_opacity * opacity * (1.0 - opacity)


@wp.func
def scale_penalty_gradient(by_scale: wp.float32, s: wp.vec3) -> wp.vec3:
    """Return the derivative of ``by_scale`` times the sum of the scales with respect to their logarithms ``s``."""
    return by_scale * wp.vec3(wp.exp(s[0]), wp.exp(s[1]), wp.exp(s[2]))


@wp.func
def displacement(
    size: wp.float32, faint: wp.float32, noise: wp.vec3, rotation: wp.vec4, s: wp.vec3, logit: wp.float32
) -> wp.vec3:
    """Return the displacement of the mean of one Gaussian (``jitter_kernel``)."""
    gate = sigmoid(-STEEPNESS * (sigmoid(logit) - faint))
    # Smaller displacements have no visible effect.
    if gate <= 1.0e-6:
        return wp.vec3()
    turn = rotation_from_quaternion(rotation)
    local = wp.transpose(turn) * noise
    local = wp.vec3(wp.exp(2.0 * s[0]) * local[0], wp.exp(2.0 * s[1]) * local[1], wp.exp(2.0 * s[2]) * local[2])
    return size * gate * (turn * local)


@wp.kernel
def regularization_kernel(
    first_row: wp.int32,
    by_opacity: wp.float32,
    by_scale: wp.float32,
    opacity_logits: wp.array[wp.float32],
    log_scales: wp.array[wp.vec3],
    opacity_gradient_out: wp.array[wp.float32],
    scale_gradient_out: wp.array[wp.vec3],
):
    """Add the derivatives of the regularisation to the gradients.

    Args:
        by_opacity: weight of the sum of the opacities.
        by_scale: weight of the sum of the scales.
        opacity_logits, log_scales: (n,) the Gaussians.
        opacity_gradient_out: (n,) gradients with respect to the logits, updated.
        scale_gradient_out: (n,) gradients with respect to the logarithms of the scales, updated.
    """
    n = first_row + wp.tid()
    opacity_gradient_out[n] = opacity_gradient_out[n] + opacity_penalty_gradient(by_opacity, opacity_logits[n])
    scale_gradient_out[n] = scale_gradient_out[n] + scale_penalty_gradient(by_scale, log_scales[n])


@wp.kernel
def jitter_kernel(
    first_row: wp.int32,
    size: wp.float32,
    faint: wp.float32,
    noise: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    means_out: wp.array[wp.vec3],
):
    """Displace each mean by a multiple of its covariance times ``noise``, which is smaller for more opaque Gaussians.

    Args:
        size: factor of the displacements.
        faint: opacity around which the displacement decreases.
        noise: (n,) random vectors.
        rotations, log_scales, opacity_logits: (n,) the Gaussians.
        means_out: (n,) means, updated.
    """
    n = first_row + wp.tid()
    means_out[n] = means_out[n] + displacement(size, faint, noise[n], rotations[n], log_scales[n], opacity_logits[n])
