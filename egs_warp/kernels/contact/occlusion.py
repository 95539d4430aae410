"""Kernel that darkens the Gaussians of a body where another body is close and hides part of the sky."""

import warp as wp

from egs_warp.kernels.contact.level_set import LevelSetLattice
from egs_warp.kernels.contact.pair_contact import normal_and_gap, tet_at_point, weights_in_tet
from egs_warp.kernels.render.spherical_harmonics import C0
from egs_warp.precision import Vec3, real

wp.set_module_options({"enable_backward": False})


@wp.kernel
def occlude_kernel(
    first_row: wp.int32,
    # Model:
    tets: wp.array[wp.vec4i],
    rest: wp.array2d[Vec3],
    boxes: wp.uint64,
    lattice: LevelSetLattice,
    coefficients: wp.array[float],
    max_opacity: real,
    reach: real,
    # In:
    positions: wp.array2d[Vec3],
    low: wp.vec3,
    high: wp.vec3,
    means: wp.array[wp.vec3],
    # Out:
    sh_out: wp.array2d[wp.vec3],
):
    """Darken each Gaussian near the occluding body: multiply its colour by 1 - a with a = ``max_opacity`` exp(-max(gap,
    0) / reach) (1 - n_z) / 2.

    The gap and the outward normal n are those of the occluding body at the mean of the Gaussian. (1 - n_z) / 2 is the
    fraction of the sky that a plane with this normal hides. Gaussians outside the box from ``low`` to ``high`` do not
    change.

    Args:
        first_row: index of the Gaussian of the first thread.
        tets: (T,) nodes of the tetrahedra of the occluding body.
        rest, positions: (1, N) m, its nodes at rest and in the current pose.
        boxes: bounding volume hierarchy of its deformed tetrahedra.
        lattice, coefficients: its level set at rest.
        max_opacity: opacity at the surface of the occluding body.
        reach: m, decay length of the opacity.
        low, high: m, corners of the box.
        means: (n,) m, means of the Gaussians.
        sh_out: (n, coefficients) colours, updated.
    """
    g = first_row + wp.tid()
    mean = means[g]
    for axis in range(3):
        if mean[axis] < low[axis] or mean[axis] > high[axis]:
            return
    x = Vec3(real(mean[0]), real(mean[1]), real(mean[2]))
    tet = tet_at_point(x, Vec3(), real(0.0), 0, tets, rest, positions, boxes)
    if tet < 0:
        return
    corners = tets[tet]
    shares = weights_in_tet(corners, positions, 0, x)
    found = normal_and_gap(shares, corners, rest, positions, 0, lattice, coefficients)
    hidden = real(0.5) * (real(1.0) - found[2])
    opacity = max_opacity * wp.exp(-wp.max(found[3], real(0.0)) / reach) * hidden
    gain = wp.float32(real(1.0) - opacity)
    sh_out[g, 0] = gain * sh_out[g, 0] + (gain - 1.0) / C0 * wp.vec3(0.5, 0.5, 0.5)
    for k in range(1, sh_out.shape[1]):
        sh_out[g, k] = gain * sh_out[g, k]
