"""Kernels of contact selection: reductions of the gaps of all points on a GPU (Eq. 8)."""

import warp as wp

from egs_warp.kernels.block import block_max, sync_block
from egs_warp.precision import Vec4, real

wp.set_module_options({"enable_backward": False})

BLOCK = 64
"""Number of threads for each cell on a GPU."""


@wp.kernel
def lowest_point_per_cell_kernel(
    # Model:
    order: wp.array[int],
    bounds: wp.array[int],
    near: real,
    gap_tolerance: real,
    # In:
    gaps: wp.array[real],
    start_gaps: wp.array[real],
    start_faces: wp.array[int],
    # Out:
    lowest_out: wp.array[Vec4],
):
    """Find the lowest point of each cell among those closer than ``near``, as ``ContactSelector`` does.

    The points of a cell are ``order[bounds[cell]:bounds[cell + 1]]``. Gaps that are equal within ``gap_tolerance`` tie,
    and the first point in ``order`` wins. The output is the point's index, -1 if there is none, its gap, and its gap
    and face at the start of the step.
    """
    cell, lane = wp.tid()
    min_height = real(wp.inf)
    first = real(wp.inf)
    for k in range(bounds[cell] + lane, bounds[cell + 1], wp.block_dim()):
        gap = gaps[order[k]]
        if gap < near:
            height = wp.rint(gap / gap_tolerance)
            if height < min_height:
                min_height = height
                first = real(k)
    min_height_of_cell = -block_max(-min_height)
    sync_block()
    if min_height > min_height_of_cell:
        first = real(wp.inf)
    first = -block_max(-first)
    if lane == 0:
        result = Vec4(real(-1.0), real(0.0), real(0.0), real(0.0))
        if first < real(wp.inf):
            point = order[int(first)]
            result = Vec4(real(point), gaps[point], start_gaps[point], real(start_faces[point]))
        lowest_out[cell] = result


@wp.kernel
def gather_gaps_kernel(
    # In:
    points: wp.array[real],
    gaps: wp.array[real],
    start_gaps: wp.array[real],
    start_faces: wp.array[int],
    # Out:
    gathered_out: wp.array[Vec4],
):
    """Write index, gap, and gap and face at the start of the step of the given ``points``."""
    k = wp.tid()
    point = int(points[k])
    gathered_out[k] = Vec4(points[k], gaps[point], start_gaps[point], real(start_faces[point]))


@wp.kernel
def penetrating_points_kernel(
    # Model:
    depth: real,
    tolerance: real,
    max_sink: real,
    max_creep: real,
    # In:
    points: wp.array[int],
    counts: wp.array[int],
    gaps: wp.array[real],
    start_gaps: wp.array[real],
    # In and out:
    penetrating: wp.array[real],
    # Out:
    deep_out: wp.array[real],
):
    """Count the points that penetrate too far (see ``CoupledSolver``) and are not among the first ``counts[0]``
    ``points``.

    A point is counted if it is deeper than ``depth`` metres and has sunk by more than ``tolerance`` times ``max_sink``,
    or times ``max_creep`` if it is deeper than ``tolerance``. ``deep_out`` has the gaps of these points, 0 for all
    others.
    """
    point = wp.tid()
    gap = gaps[point]
    deep = real(0.0)
    if gap < -depth:
        allowed = max_sink * tolerance
        if gap < -tolerance:
            allowed = max_creep * tolerance
        if gap < start_gaps[point] - allowed:
            is_active = int(0)
            for k in range(counts[0]):
                if points[k] == point:
                    is_active = 1
            if is_active == 0:
                wp.atomic_add(penetrating, 0, real(1.0))
                deep = gap
    deep_out[point] = deep
