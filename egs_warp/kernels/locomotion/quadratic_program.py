"""Kernel of the active-set method for one dense QP on a CPU. It calls the functions that the mode search uses on a GPU.

The host code is in ``egs_warp/locomotion/active_set.py``.
"""

import warp as wp

from egs_warp.kernels.locomotion.active_set import ActiveSet, UnitConstraints, find_optimum
from egs_warp.kernels.locomotion.block_algebra import compact_indices
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})


@wp.kernel
def optimum_kernel(
    # In:
    count: int,
    unknowns: int,
    cost_limit: real,
    rows: UnitConstraints,
    # In and out:
    state: ActiveSet,
    # Out:
    ended: wp.array[int],
):
    """Solve one QP by the active-set method, from the guess ``state.side`` (``find_optimum``).

    Args:
        count: number of rows m.
        unknowns: number of unknowns.
        cost_limit: cost z^T z / 2 above which the problem is treated as infeasible.
        rows: the rows and their bounds; each row is its own base row.
        state: guessed sides; on return, the optimum ``z`` and its active rows.
        ended: (2,) status and number of active rows.
    """
    rows.unknowns = unknowns
    rows.count = count
    rows.base_count = count
    rows.cost_limit = cost_limit
    rows.orthogonalizations = 2
    ended[0] = find_optimum(rows, state)
    ended[1] = compact_indices(state.side, count, 0, state.active)
