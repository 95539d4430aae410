"""Quadratic model of the elastic energy in a subspace (``LinearSolver.quadratic_form``), on a CPU.

The host code is in ``egs_warp.fem.multifrontal``.
"""

import warp as wp

from egs_warp.kernels.fem.products import (
    PANEL,
    STRIP,
    Rows,
    address_of,
    claim_next,
    finish_moves,
    multiply_strip,
    wait_for,
    write_quadratic,
)
from egs_warp.kernels.fem.supernodal import Fronts, MomentumProjection, solve_panel_native
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})


@wp.kernel
def quadratic_form_kernel(
    counters: wp.array[wp.int32],
    fronts: Fronts,
    blocks: wp.int32,
    unknowns: wp.int32,
    factor: wp.array[real],
    inverses: wp.array[real],
    reciprocals: wp.array[real],
    right: wp.uint64,
    row_stride: wp.int32,
    column_stride: wp.int32,
    count: wp.int32,
    weights: wp.uint64,
    dt_now: real,
    dt_ahead: real,
    reference: wp.array[real],
    gradient: wp.array[real],
    matrix: Rows,
    workspace: wp.array[real],
    # Out:
    moves: wp.array3d[real],
    products: wp.array3d[real],
    linear: wp.array2d[real],
    quadratic: wp.array2d[real],
) -> None:
    """Compute the quadratic model of the elastic energy (``LinearSolver.quadratic_form``).

    The displacements X = dt_now V + dt_ahead S^-1 diag(w) V, their products H X and the linear terms X^T g are computed
    panel by panel. When all panels are complete, the blocks of X^T H X follow. Several launches may share the work.

    Args:
        counters: (3,) next panel, next pair of panels, and number of complete panels; zero before the first launch.
        fronts, blocks, unknowns, factor, inverses, reciprocals: factors of S (``solve_panel_native``).
        right, row_stride, column_stride, count: address, strides and number of the vectors V.
        weights: address of w (n,).
        dt_now, dt_ahead: factors of the two terms of X, s.
        reference: (n,) subtracted from the last column of X.
        gradient: (n,) g.
        matrix: H.
        workspace: scratch memory of ``solve_panel_native``.
        moves, products: (panels, n, ``PANEL``) X and H X.
        linear: (panels, ``PANEL``) X^T g.
        quadratic: (panels ``PANEL``, panels ``PANEL``) X^T H X.
    """
    panels = moves.shape[0]
    panel = claim_next(counters, 0)
    while panel < panels:
        panel_address = address_of(moves[panel])
        solve_panel_native(
            fronts, blocks, unknowns, factor, inverses, reciprocals, right, row_stride, column_stride, count, weights,
            dt_now, dt_ahead, MomentumProjection(), panel, workspace, panel_address, PANEL,
        )  # fmt: skip
        finish_moves(count - PANEL * panel, reference, gradient, moves[panel], linear[panel])
        for strip in range(PANEL // STRIP):
            multiply_strip(unknowns, matrix, panel_address, PANEL, strip, address_of(products[panel]))
        claim_next(counters, 2)
        panel = claim_next(counters, 0)
    wait_for(counters, 2, panels)
    pair = claim_next(counters, 1)
    while pair < panels * panels:
        first = pair / panels
        second = pair % panels
        if first <= second:
            write_quadratic(first, second, moves[first], products[second], quadratic)
        pair = claim_next(counters, 1)
