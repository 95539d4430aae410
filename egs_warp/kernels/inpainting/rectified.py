"""Mean colour of Gaussians over several viewing directions."""

import warp as wp

from egs_warp.kernels.render.spherical_harmonics import sh_sum

wp.set_module_options({"enable_backward": False})


@wp.kernel
def mean_colour_kernel(
    # In:
    sh: wp.array2d[wp.vec3],
    directions: wp.array[wp.vec3],
    # Out:
    colour_out: wp.array[wp.vec3],
):
    """Compute the mean of each Gaussian's unclipped colour over several viewing directions.

    Args:
        sh: (n, coefficients) spherical harmonics.
        directions: unit vectors from the camera.
        colour_out: (n,) mean colours.
    """
    g = wp.tid()
    colour = wp.vec3()
    for k in range(directions.shape[0]):
        colour += sh_sum(sh, g, sh.shape[1], directions[k])
    colour_out[g] = colour / float(directions.shape[0]) + wp.vec3(0.5, 0.5, 0.5)
