"""What a step's choice of contact points needs of the gaps of all points, found where these are."""

import warp as wp

from egs_warp.kernels.block import block_max, sync_block
from egs_warp.precision import Vec4, real

wp.set_module_options({"enable_backward": False})

BLOCK = 64
"""Threads for each cell on a GPU."""


@wp.kernel
def lowest_point_per_cell_kernel(
    # Model:
    order: wp.array[int],
    bounds: wp.array[int],
    near: real,
    alike: real,
    # In:
    gaps: wp.array[real],
    start_gaps: wp.array[real],
    start_faces: wp.array[int],
    # Out:
    lowest_out: wp.array[Vec4],
):
    """Of each cell, whose points are ``order`` from ``bounds[cell]`` on, the lowest of those nearer than ``near``, see
    ``ContactPoints``: its number, -1 if there is none, its gap, and gap and face at the start of the step."""
    cell, lane = wp.tid()
    least = real(wp.inf)
    first = real(wp.inf)
    for k in range(bounds[cell] + lane, bounds[cell + 1], wp.block_dim()):
        gap = gaps[order[k]]
        if gap < near:
            height = wp.rint(gap / alike)
            if height < least:
                least = height
                first = real(k)
    lowest = -block_max(-least)
    sync_block()
    if least > lowest:
        first = real(wp.inf)
    first = -block_max(-first)
    if lane == 0:
        found = Vec4(real(-1.0), real(0.0), real(0.0), real(0.0))
        if first < real(wp.inf):
            point = order[int(first)]
            found = Vec4(real(point), gaps[point], start_gaps[point], real(start_faces[point]))
        lowest_out[cell] = found


@wp.kernel
def gather_gaps_kernel(
    # In:
    points: wp.array[real],
    gaps: wp.array[real],
    start_gaps: wp.array[real],
    start_faces: wp.array[int],
    # Out:
    known_out: wp.array[Vec4],
):
    """The same of ``points``, which are known."""
    k = wp.tid()
    point = int(points[k])
    known_out[k] = Vec4(points[k], gaps[point], start_gaps[point], real(start_faces[point]))


@wp.kernel
def penetrating_points_kernel(
    # Model:
    depth: real,
    tolerance: real,
    sinks: real,
    creeps: real,
    # In:
    points: wp.array[int],
    counts: wp.array[int],
    gaps: wp.array[real],
    start_gaps: wp.array[real],
    # In and out:
    sinking: wp.array[real],
    # Out:
    deep_out: wp.array[real],
):
    """How many points more than ``depth`` metres deep sink, see ``CoupledSolver``, that are none of ``counts[0]``
    ``points``; their gaps in ``deep_out``, 0 for all others."""
    point = wp.tid()
    gap = gaps[point]
    deep = real(0.0)
    if gap < -depth:
        allowed = sinks * tolerance
        if gap < -tolerance:
            allowed = creeps * tolerance
        if gap < start_gaps[point] - allowed:
            among = int(0)
            for k in range(counts[0]):
                if points[k] == point:
                    among = 1
            if among == 0:
                wp.atomic_add(sinking, 0, real(1.0))
                deep = gap
    deep_out[point] = deep
