"""Cholesky factors of many small matrices, and the inverses of the factors: a block of threads for each on a GPU."""

import warp as wp

from egs_warp.kernels.lanes import wait_for_lanes
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

BLOCK = 128
"""Threads for each matrix on a GPU."""
_ACROSS = wp.constant(32)
"""Of them side by side in a row."""


@wp.func
def factor(matrix: wp.array2d[real], lane: int):
    """S = U^T U in place, upper triangles; whether there is such a U. All lanes take the same way."""
    size = matrix.shape[0]
    across = wp.min(wp.block_dim(), _ACROSS)
    down = wp.block_dim() / across
    fine = bool(True)
    for j in range(size):
        pivot = matrix[j, j]
        # No number is not above zero either.
        if not (pivot > real(0.0) and pivot < real(wp.inf)):
            fine = False
            break
        wait_for_lanes()
        root = wp.sqrt(pivot)
        for k in range(j + lane, size, wp.block_dim()):
            matrix[j, k] = matrix[j, k] / root
        wait_for_lanes()
        for i in range(j + 1 + lane / across, size, down):
            share = matrix[j, i]
            for k in range(i + lane % across, size, across):
                matrix[i, k] = matrix[i, k] - share * matrix[j, k]
        wait_for_lanes()
    return fine


@wp.kernel
def panels_kernel(
    # In and out:
    matrices: wp.array3d[real],
    # Out:
    inverses_out: wp.array3d[real],
    fine_out: wp.array[wp.bool],
):
    """Of each matrix S (n, n), of which the upper triangle counts, U with S = U^T U in its place, and the lower
    triangle of the inverse of U^T; where there is none, neither is written in full."""
    problem, lane = wp.tid()
    fine = factor(matrices[problem], lane)
    fine_out[problem] = fine
    if fine:
        size = matrices.shape[1]
        # Column by column: each is its lane's alone.
        for k in range(lane, size, wp.block_dim()):
            for i in range(k, size):
                value = real(0.0)
                if i == k:
                    value = real(1.0)
                for m in range(k, i):
                    value -= matrices[problem, m, i] * inverses_out[problem, m, k]
                inverses_out[problem, i, k] = value / matrices[problem, i, i]
