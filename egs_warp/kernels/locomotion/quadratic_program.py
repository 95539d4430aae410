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
    """Find the optimum ``state.z`` from the guessed sides ``state.side`` of ``count`` rows (see ``find_optimum``).

    The status and the number of active rows are written to ``ended`` (2,).
    """
    rows.unknowns = unknowns
    rows.count = count
    rows.base_count = count
    rows.cost_limit = cost_limit
    rows.orthogonalizations = 2
    ended[0] = find_optimum(rows, state)
    ended[1] = compact_indices(state.side, count, 0, state.active)
