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
    """Compute the rows of the objectives: in row r of a world, node n gets scale_r sum_p share_pn (A_rp (x_n - c) +
    b_rp).

    Args:
        shares: (P, N) share of each node in each part p of the body.
        centres: (B,) m, points c.
        positions: (B, N) m, x.
        coefficients: (B, R, P, 12) matrices [A_rp b_rp] (3, 4), row by row.
        scales: (B, R) factors of the rows.
        rows_out: (B, R, N) coefficients of the nodal velocities.
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
