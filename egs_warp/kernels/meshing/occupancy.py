"""Occupancy of a lattice of points by Gaussians, and the empty points that occupied points enclose."""

import warp as wp

wp.set_module_options({"enable_backward": False})

OPACITY_UNIT = wp.constant(1024)
"""Opacities are summed as integer multiples of 1/1024, so that the order of atomic additions has no effect."""


@wp.kernel
def splat_occupancy_kernel(
    # In:
    means: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[float],
    origin: wp.vec3,
    spacing: float,
    max_sigma: float,
    # Out:
    opacity_sum_out: wp.array3d[int],
):
    """Add each Gaussian's opacity to the lattice points within its 2-sigma ellipsoid, widened by the lattice spacing.

    Every Gaussian is blurred by 0.45 spacings so that it reaches a lattice point; flat Gaussians would otherwise fall
    between the points.

    Args:
        means, rotations, log_scales, opacity_logits: the Gaussians; rotations are quaternions w, x, y, z.
        origin: position of lattice point (0, 0, 0); the lattice's axes are those of the cloud.
        spacing: distance between lattice points.
        max_sigma: limit of the standard deviations, so that huge faint outliers do not fill empty space.
        opacity_sum_out: sums of opacities at the lattice points, in units of 1 / ``OPACITY_UNIT``.
    """
    i = wp.tid()
    amount = int(float(OPACITY_UNIT) / (1.0 + wp.exp(-opacity_logits[i])) + 0.5)
    if amount <= 0:
        return
    wxyz = rotations[i]
    axes = wp.quat_to_matrix(wp.quat(wxyz[1], wxyz[2], wxyz[3], wxyz[0]))
    blur = 0.45 * spacing
    s = log_scales[i]
    sx = wp.min(wp.exp(s[0]), max_sigma)
    sy = wp.min(wp.exp(s[1]), max_sigma)
    sz = wp.min(wp.exp(s[2]), max_sigma)
    variance = wp.vec3(sx * sx + blur * blur, sy * sy + blur * blur, sz * sz + blur * blur)
    inverse = axes * wp.diag(wp.vec3(1.0 / variance[0], 1.0 / variance[1], 1.0 / variance[2])) * wp.transpose(axes)
    covariance = axes * wp.diag(variance) * wp.transpose(axes)
    centre = (means[i] - origin) / spacing
    reach = wp.vec3(
        2.0 * wp.sqrt(covariance[0, 0]) / spacing,
        2.0 * wp.sqrt(covariance[1, 1]) / spacing,
        2.0 * wp.sqrt(covariance[2, 2]) / spacing,
    )
    # The lattice index of a distant outlier would overflow.
    for axis in range(3):
        if not (centre[axis] + reach[axis] >= 0.0 and centre[axis] - reach[axis] <= float(opacity_sum_out.shape[axis])):
            return
    x0 = wp.max(int(wp.ceil(centre[0] - reach[0])), 0)
    y0 = wp.max(int(wp.ceil(centre[1] - reach[1])), 0)
    z0 = wp.max(int(wp.ceil(centre[2] - reach[2])), 0)
    x1 = wp.min(int(wp.floor(centre[0] + reach[0])), opacity_sum_out.shape[0] - 1)
    y1 = wp.min(int(wp.floor(centre[1] + reach[1])), opacity_sum_out.shape[1] - 1)
    z1 = wp.min(int(wp.floor(centre[2] + reach[2])), opacity_sum_out.shape[2] - 1)
    for x in range(x0, x1 + 1):
        for y in range(y0, y1 + 1):
            for z in range(z0, z1 + 1):
                d = (wp.vec3(float(x), float(y), float(z)) - centre) * spacing
                if wp.dot(d, inverse * d) <= 4.0:
                    wp.atomic_add(opacity_sum_out, x, y, z, amount)


@wp.kernel
def enclosed_kernel(
    # In:
    occupied: wp.array3d[wp.uint8],
    min_hits: int,
    # Out:
    filled_out: wp.array3d[wp.uint8],
):
    """Fill the empty points from which enough lattice directions hit the object or the ground, which is everything
    below layer 0. Unlike a flood fill, this test tolerates small holes in the capture.

    Args:
        occupied: (nx, ny, nz) 1 for occupied points.
        min_hits: minimum number of hits among the 26 lattice directions.
        filled_out: (nx, ny, nz) 1 for points that are occupied or filled.
    """
    x, y, z = wp.tid()
    if occupied[x, y, z] != wp.uint8(0):
        filled_out[x, y, z] = wp.uint8(1)
        return
    misses = int(0)
    for direction in range(27):
        if direction != 13:
            dx = direction // 9 - 1
            dy = (direction // 3) % 3 - 1
            dz = direction % 3 - 1
            px = x + dx
            py = y + dy
            pz = z + dz
            hit = int(0)
            while (
                hit == 0
                and px >= 0
                and py >= 0
                and px < occupied.shape[0]
                and py < occupied.shape[1]
                and pz < occupied.shape[2]
            ):
                if pz < 0 or occupied[px, py, pz] != wp.uint8(0):
                    hit = 1
                px += dx
                py += dy
                pz += dz
            if hit == 0:
                misses += 1
                if 26 - misses < min_hits:
                    break
    filled_out[x, y, z] = wp.where(26 - misses >= min_hits, wp.uint8(1), wp.uint8(0))


@wp.kernel
def inside_mesh_kernel(
    # In:
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    # Out:
    inside_out: wp.array[wp.uint8],
):
    """Write 1 for each point inside the ``mesh`` or within 1e-4 of its surface, and otherwise 0; the mesh has a size of
    about one unit.
    """
    i = wp.tid()
    p = points[i]
    query = wp.mesh_query_point_sign_winding_number(mesh, p, 4.0)
    if query.result:
        nearest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        if query.sign < 0.0 or wp.length(p - nearest) < 1.0e-4:
            inside_out[i] = wp.uint8(1)
