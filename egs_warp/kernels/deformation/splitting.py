"""Kernel that replaces Gaussians by several smaller ones in the rest configuration (Eq. 17)."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def split_kernel(
    first_row: wp.int32,
    # In:
    parents: wp.array[wp.int32],
    axes: wp.array[wp.int32],
    offsets: wp.array[wp.float32],
    shrink: wp.float32,
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    sh: wp.array2d[wp.vec3],
    # Out:
    means_out: wp.array[wp.vec3],
    rotations_out: wp.array[wp.vec4],
    log_scales_out: wp.array[wp.vec3],
    sh_out: wp.array2d[wp.vec3],
):
    """Write row by row either a copy of a Gaussian or one of its children.

    A child is displaced along one axis of its parent, along which its standard deviation is smaller.

    Args:
        parents: (rows,) index of the Gaussian.
        axes: (rows,) axis along which the child is displaced; -1 for a copy.
        offsets: (rows,) displacement in standard deviations of the parent.
        shrink: standard deviation of a child along the axis, divided by that of the parent.
        means, rotations, log_scales, sh: the Gaussians at rest.
        means_out, rotations_out, log_scales_out, sh_out: (rows,) the copies and children.
    """
    row = first_row + wp.tid()
    parent = parents[row]
    axis = axes[row]
    mean = means[parent]
    scales = log_scales[parent]
    q = rotations[parent]
    if axis >= 0:
        turn = wp.quat(q[1], q[2], q[3], q[0])
        step = wp.vec3(0.0)
        step[axis] = offsets[row] * wp.exp(scales[axis])
        mean = mean + wp.quat_rotate(turn, step)
        scales[axis] = scales[axis] + wp.log(shrink)
    means_out[row] = mean
    rotations_out[row] = q
    log_scales_out[row] = scales
    for k in range(sh.shape[1]):
        sh_out[row, k] = sh[parent, k]
