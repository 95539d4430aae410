"""Kernel that writes the rows of objectives on the end velocity of many worlds."""

import warp as wp

from egs_warp.precision import Vec3, real

wp.set_module_options({"enable_backward": False})


@wp.kernel
def affine_rows_kernel(
    # Model:
    shares: wp.array2d[real],
    # In:
    centres: wp.array[Vec3],
    positions: wp.array2d[Vec3],
    coefficients: wp.array4d[real],
    scales: wp.array2d[real],
    # Out:
    rows_out: wp.array3d[Vec3],
):
    """Write row r of each world: for node n, scale_r sum_p share_pn (A_rp (x_n - c) + b_rp).

    ``coefficients`` (B, R, P, 12) are the matrices (A_rp, b_rp) (3, 4) of each part p, row by row; ``centres`` are the
    points c.
    """
    world, row, node = wp.tid()
    arm = positions[world, node] - centres[world]
    total = Vec3()
    for part in range(shares.shape[0]):
        share = shares[part, node]
        if share != real(0.0):
            for i in range(3):
                value = coefficients[world, row, part, 4 * i + 3]
                for j in range(3):
                    value += coefficients[world, row, part, 4 * i + j] * arm[j]
                total[i] += share * value
    rows_out[world, row, node] = scales[world, row] * total
