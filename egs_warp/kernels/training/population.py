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
    opacity = sigmoid(opacity_logits[n])
    opacity_gradient_out[n] = opacity_gradient_out[n] + by_opacity * opacity * (1.0 - opacity)
    s = log_scales[n]
    scale_gradient_out[n] = scale_gradient_out[n] + by_scale * wp.vec3(wp.exp(s[0]), wp.exp(s[1]), wp.exp(s[2]))


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
    gate = sigmoid(-STEEPNESS * (sigmoid(opacity_logits[n]) - faint))
    # Smaller displacements have no visible effect.
    if gate > 1.0e-6:
        turn = rotation_from_quaternion(rotations[n])
        local = wp.transpose(turn) * noise[n]
        s = log_scales[n]
        local = wp.vec3(wp.exp(2.0 * s[0]) * local[0], wp.exp(2.0 * s[1]) * local[1], wp.exp(2.0 * s[2]) * local[2])
        means_out[n] = means_out[n] + size * gate * (turn * local)
