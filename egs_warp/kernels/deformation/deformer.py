"""Kernels that deform Gaussians with the cage (Eq. 14, 15), and that measure how much the motion bends each of them
(Eq. 16).

Rotations are quaternions w, x, y, z. ``max_stretch`` is the limit of ``deform_arm``; ``cage`` and ``plan`` are the maps
of the deformed cage and the precomputed ``ArmPlan``.
"""

import warp as wp

from egs_warp.kernels.deformation.cage_maps import (
    RIGID,
    ArmPlan,
    CageMaps,
    affine_of,
    deform_arms,
    exponential,
    load_row,
    reach_of,
    rotation_of_tet,
    store_row,
)
from egs_warp.kernels.deformation.decomposition import (
    align_signs,
    column,
    match_columns,
    orthogonal_columns,
    proper_frame,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_of,
    rotation_part,
    scaled_columns,
    select_column,
)

wp.set_module_options({"enable_backward": False})

MIN_SCALE = wp.constant(wp.float32(1.0e-12))


@wp.struct
class DeformedShape:
    rotation: wp.vec4
    log_scales: wp.vec3


@wp.func
def deform_shape(stretched: wp.mat33, scales: wp.vec3, reference: wp.mat33) -> DeformedShape:
    """Return the shape of Eq. (15) for ``stretched`` = F R: the SVD of F R S, with the axes matched in order and sign
    to the axes R_polar r_i (``reference``).
    """
    factor = scaled_columns(stretched, scales)
    m = orthogonal_columns(column(factor, 0), column(factor, 1), column(factor, 2))
    frame = proper_frame(m.a, m.b, m.c)
    columns = wp.matrix_from_cols(m.a, m.b, m.c)
    order = match_columns(frame, reference)
    result = DeformedShape()
    result.rotation = quaternion_from_rotation(align_signs(frame, order, reference))
    result.log_scales = wp.vec3(
        wp.log(wp.max(wp.length(select_column(columns, order[0])), MIN_SCALE)),
        wp.log(wp.max(wp.length(select_column(columns, order[1])), MIN_SCALE)),
        wp.log(wp.max(wp.length(select_column(columns, order[2])), MIN_SCALE)),
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
    polar_rotations_out: wp.array[wp.vec4],
):
    """Write the shape and the polar rotation of Eq. (15) for ``stretched`` = F R to ``row`` of the outputs."""
    reference = rotation_part(column(stretched, 0), column(stretched, 1), column(stretched, 2))
    shape = deform_shape(stretched, scales, reference)
    rotations_out[row] = shape.rotation
    log_scales_out[row] = shape.log_scales
    polar_rotations_out[row] = quaternion_from_rotation(reference * wp.transpose(axes))


@wp.struct
class DeformedGaussian:
    mean: wp.vec3
    rotation: wp.vec4
    log_scales: wp.vec3
    polar_rotation: wp.vec4


@wp.func
def deform_gaussian(
    row: wp.int32,
    mean: wp.vec3,
    rotation: wp.vec4,
    log_scales: wp.vec3,
    max_stretch: wp.float32,
    cage: CageMaps,
    plan: ArmPlan,
) -> DeformedGaussian:
    """Deform a Gaussian by F = (F+ + F-) / 2 (Eq. 14), or by the F of the mean's tetrahedron if det F <= 0, and apply
    Eq. (15).

    The deformed mean is the mean of the Gaussian's mass to second order, E[x(m + sum z_k s_k r_k)] = x(m) + sum s_k^2
    x_kk / 2, where the second derivative x_kk is estimated from the difference of the two arms. The paper deforms the
    mean as a point.
    """
    axes = rotation_from_quaternion(rotation)
    scales = exponential(log_scales)
    both = deform_arms(row, mean, axes, max_stretch, cage, plan)
    result = DeformedGaussian()
    result.mean = both.mean
    stretched = both.through
    # For a Gaussian inside one tetrahedron or far outside the cage, or if F is inverted, the precomputed rotation is
    # used.
    is_affine = wp.bool(True)
    if both.straddles:
        bulge = wp.vec3(0.0)
        for k in range(3):
            bulge += plan.smoothing_lengths[k, row] * (column(both.plus, k) - column(both.minus, k))
        result.mean += bulge
        average = 0.5 * (both.plus + both.minus)
        if wp.determinant(average) > 0.0:
            stretched = average
            is_affine = wp.bool(False)
    turned = wp.mat33()
    if is_affine:
        result.polar_rotation = rotation_of_tet(cage, both.tet)
        turned = rotation_from_quaternion(result.polar_rotation) * axes
    else:
        turned = rotation_of(stretched)
        result.polar_rotation = quaternion_from_rotation(turned * wp.transpose(axes))
    shape = deform_shape(stretched, scales, turned)
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
    cage: CageMaps,
    plan: ArmPlan,
    # Out:
    means_out: wp.array[wp.vec3],
    rotations_out: wp.array[wp.vec4],
    log_scales_out: wp.array[wp.vec3],
    polar_rotations_out: wp.array[wp.vec4],
):
    """Deform each Gaussian with the cage (Eq. 14, 15).

    Args:
        means, rotations, log_scales: (n,) the Gaussians at rest.
        max_stretch, cage, plan: as in the module docstring.
        means_out, rotations_out, log_scales_out: (n,) the deformed Gaussians.
        polar_rotations_out: (n,) rotations R_polar.
    """
    row = first_row + wp.tid()
    result = deform_gaussian(
        row,
        means[row],
        load_row(rotations, row),
        log_scales[row],
        max_stretch,
        cage,
        plan,
    )
    means_out[row] = result.mean
    store_row(rotations_out, row, result.rotation)
    log_scales_out[row] = result.log_scales
    store_row(polar_rotations_out, row, result.polar_rotation)


@wp.func
def angle_between(a: wp.vec3, b: wp.vec3) -> wp.float32:
    return wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))


@wp.func
def bend_frame(side: wp.mat33, scales: wp.vec3) -> wp.mat33:
    """Return an eigenframe of Sigma'+- that is well defined even if scales are equal: the rotation part of [F R] S^2,
    with ``side`` F R.

    The frame differs from the exact eigenframe by terms of order (s_j/s_i)^2 where s_i >> s_j, and it follows the long
    axes rather than the short ones. Unlike eigenvectors, it is not arbitrary in the plane of a round disc.
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
    cage: CageMaps,
    plan: ArmPlan,
    arms: wp.array2d[wp.float32],
    # In and out:
    bend_out: wp.array[wp.float32],
    curl_out: wp.array[wp.vec3],
    error_out: wp.array[wp.vec3],
):
    """Update the maximum of each measure with the current frame: the angle of Eq. (16) and, along each axis, the
    deviation of the motion from an affine map.

    With arms of length L on both sides of axis k, the second derivative of the motion along axes k and j is about (F_k+
    - F_k-) r_j / 2L.

    Args:
        means, rotations, log_scales: (n,) the Gaussians at rest.
        max_stretch, cage, plan: as in the module docstring.
        arms: (n, 6) m, lengths of the arms.
        bend_out: (n,) degrees, maximum of the angle of Eq. (16).
        curl_out: (n,) degrees, for each axis k the maximum over j of the angle between the two vectors F_k+- r_j.
        error_out: (n,) m, for each axis the maximum displacement that F does not represent at one standard deviation
            along both axes.
    """
    row = first_row + wp.tid()
    if plan.mean_tets[row] < 0 and plan.inside_fractions[0, row] == RIGID:
        return
    scales = exponential(log_scales[row])
    axes = rotation_from_quaternion(rotations[row])
    both = deform_arms(row, means[row], axes, max_stretch, cage, plan)
    between = wp.transpose(bend_frame(both.plus, scales)) * bend_frame(both.minus, scales)
    twice_sine = wp.length(
        wp.vec3(between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1])
    )
    theta = wp.atan2(twice_sine, wp.trace(between) - 1.0)
    bend_out[row] = wp.max(bend_out[row], wp.degrees(theta))
    curl = curl_out[row]
    error = error_out[row]
    for k in range(3):
        f_plus = affine_of(cage, plan.end_tets[k, row]).gradient * axes
        f_minus = affine_of(cage, plan.end_tets[3 + k, row]).gradient * axes
        reach = reach_of(arms, row, k, scales[k])
        for j in range(3):
            # Along axis k the positions of both ends are known; along the other axes, only the gradients at the ends.
            a = wp.where(j == k, column(both.plus, k), column(f_plus, j))
            b = wp.where(j == k, column(both.minus, k), column(f_minus, j))
            axis_error = scales[k] * scales[j] * wp.length(a - b) / reach
            angle = wp.degrees(angle_between(a, b))
            # The mixed derivative is symmetric, so it is measured over the longer baseline only.
            if scales[j] > scales[k]:
                axis_error = 0.0
            # Axes that are too short to be visible are ignored.
            if axis_error > 0.25 * error[k]:
                curl[k] = wp.max(curl[k], angle)
            error[k] = wp.max(error[k], axis_error)
    curl_out[row] = curl
    error_out[row] = error
