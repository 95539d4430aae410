"""Kernels of contact selection: the lowest point of each cell, hysteresis, and points that penetrate too far (Eq. 8).

The first launch dimension is the world. On a GPU, ``BLOCK`` threads share a cell or a world; on a CPU, one thread
computes it.
"""

import warp as wp

from egs_warp.kernels.block import block_max, sum_of_block, sync_block
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

BLOCK = 64
"""Number of threads for each cell, or for each world, on a GPU."""


@wp.func
def lowest_of_block(order: wp.array[int], height: real, first: real):
    """Return the point with the lowest height in the block, or -1 if no thread has one. Of several, return the first in
    ``order``.

    Args:
        order: points of all cells.
        height: lowest height of the points of this thread.
        first: position in ``order`` of the first point of this thread with this height; infinite if it has no points.
    """
    lowest_height = -block_max(-height)
    sync_block()
    if height > lowest_height:
        first = real(wp.inf)
    first = -block_max(-first)
    sync_block()
    if first < real(wp.inf):
        return order[int(first)]
    return int(-1)


@wp.kernel
def lowest_point_per_cell_kernel(
    # Model:
    order: wp.array[int],
    bounds: wp.array[int],
    near: real,
    gap_tolerance: real,
    # In:
    gaps: wp.array2d[real],
    # Out:
    lowest_out: wp.array2d[int],
):
    """Find the lowest point of each cell whose gap is below ``near``, in each world.

    Args:
        order: (P,) points, grouped by cell.
        bounds: (C + 1,) offset of each cell in ``order``.
        near: m, upper limit of the gaps.
        gap_tolerance: m, gaps are rounded to multiples of it; of points with equal rounded gaps, the first is selected.
        gaps: (B, P) m.
        lowest_out: (B, C) lowest point of each cell, or -1.
    """
    world, cell, lane = wp.tid()
    min_height = real(wp.inf)
    first = real(wp.inf)
    for k in range(bounds[cell] + lane, bounds[cell + 1], wp.block_dim()):
        gap = gaps[world, order[k]]
        if gap < near:
            height = wp.rint(gap / gap_tolerance)
            if height < min_height:
                min_height = height
                first = real(k)
    point = lowest_of_block(order, min_height, first)
    if lane == 0:
        lowest_out[world, cell] = point


@wp.kernel
def penetrating_points_kernel(
    # Model:
    order: wp.array[int],
    bounds: wp.array[int],
    gap_tolerance: real,
    depth: real,
    tolerance: real,
    max_sink: real,
    max_creep: real,
    # In:
    points: wp.array2d[int],
    counts: wp.array[int],
    gaps: wp.array2d[real],
    start_gaps: wp.array2d[real],
    # In and out:
    penetrating: wp.array[real],
    # Out:
    lowest_out: wp.array2d[int],
):
    """Count the points of each world that penetrate too far and are not contacts, and find the lowest of them in each
    cell.

    A point penetrates too far if it is deeper than ``depth`` and has sunk by more than ``max_sink`` times ``tolerance``
    during the step, or by more than ``max_creep`` times ``tolerance`` if it is deeper than ``tolerance``.

    Args:
        order, bounds, gap_tolerance: as in ``lowest_point_per_cell_kernel``.
        depth: m, depth up to which a point is never added.
        tolerance: m, tolerated penetration.
        max_sink, max_creep: tolerated changes of the gap, as fractions of ``tolerance``.
        points: (B, K) contacts, of which the first ``counts`` (B,) are valid.
        gaps, start_gaps: (B, P) m, gaps at the end and at the start of the step.
        penetrating: (B,) increased by the number of points found.
        lowest_out: (B, C) lowest of these points in each cell, or -1.
    """
    world, cell, lane = wp.tid()
    min_height = real(wp.inf)
    first = real(wp.inf)
    found = real(0.0)
    for k in range(bounds[cell] + lane, bounds[cell + 1], wp.block_dim()):
        point = order[k]
        gap = gaps[world, point]
        if gap < -depth:
            allowed = max_sink * tolerance
            if gap < -tolerance:
                allowed = max_creep * tolerance
            if gap < start_gaps[world, point] - allowed:
                is_contact = int(0)
                for j in range(counts[world]):
                    if points[world, j] == point:
                        is_contact = 1
                if is_contact == 0:
                    found += real(1.0)
                    height = wp.rint(gap / gap_tolerance)
                    if height < min_height:
                        min_height = height
                        first = real(k)
    point = lowest_of_block(order, min_height, first)
    found = sum_of_block(found)
    if lane == 0:
        lowest_out[world, cell] = point
        if found > real(0.0):
            wp.atomic_add(penetrating, world, found)


@wp.kernel
def select_points_kernel(
    # Model:
    cell_from_point: wp.array[int],
    activation_distance: real,
    hysteresis: real,
    # In:
    previous: wp.array2d[int],
    previous_counts: wp.array[int],
    loaded: wp.array2d[int],
    gaps: wp.array2d[real],
    lowest: wp.array2d[int],
    # Out:
    candidates: wp.array2d[int],
    points_out: wp.array2d[int],
    counts_out: wp.array[int],
):
    """Select the contact points of a step by the rules of ``ContactSelector``, in ascending order.

    Args:
        cell_from_point: (P,) cell of each point.
        activation_distance: m, gap below which points become contacts.
        hysteresis: m, amount by which a point without load may be higher than the lowest point of its cell.
        previous: (B, L) contact points of the previous step, of which the first ``previous_counts`` (B,) are valid.
        loaded: (B, L) 1 for points that carried load.
        gaps: (B, P) m, gaps at the end of a ballistic step.
        lowest: (B, C) lowest active point of each cell, or -1.
        candidates: (B, L + C) workspace.
        points_out: (B, K) selected points, of which the first ``counts_out`` (B,) are valid.
    """
    world, lane = wp.tid()
    slots = previous.shape[1]
    count = slots + lowest.shape[1]
    for cell in range(lane, lowest.shape[1], wp.block_dim()):
        candidates[world, slots + cell] = lowest[world, cell]
    sync_block()
    for k in range(lane, slots, wp.block_dim()):
        candidate = int(-1)
        if k < previous_counts[world]:
            point = previous[world, k]
            cell = cell_from_point[point]
            gap = gaps[world, point]
            limit = real(wp.inf)
            if loaded[world, k] == 0 and lowest[world, cell] >= 0:
                limit = gaps[world, lowest[world, cell]] + hysteresis
            if gap < real(2.0) * activation_distance and gap <= limit:
                # A retained point prevents its cell from adding another. All threads that write this entry write the
                # same value.
                candidates[world, slots + cell] = -1
                candidate = point
        candidates[world, k] = candidate
    sync_block()
    valid = real(0.0)
    for i in range(lane, count, wp.block_dim()):
        point = candidates[world, i]
        if point >= 0:
            valid += real(1.0)
            rank = int(0)
            for j in range(count):
                other = candidates[world, j]
                if other >= 0 and other < point:
                    rank += 1
            points_out[world, rank] = point
    valid = sum_of_block(valid)
    if lane == 0:
        counts_out[world] = int(valid)


@wp.kernel
def append_points_kernel(
    # Model:
    gap_tolerance: real,
    # In:
    lowest: wp.array2d[int],
    gaps: wp.array2d[real],
    # In and out:
    points: wp.array2d[int],
    counts: wp.array[int],
):
    """Append the lowest point of each cell to the contact points of each world.

    The new points are sorted by their gaps, rounded to multiples of ``gap_tolerance`` metres, and points with equal
    rounded gaps by their indices.

    Args:
        gap_tolerance: m.
        lowest: (B, C) points to add; -1 for cells without one.
        gaps: (B, P) m, gaps of all points.
        points: (B, K) contact points, of which the first ``counts`` are valid, extended in place.
        counts: (B,) number of contact points, updated.
    """
    world, lane = wp.tid()
    first = counts[world]
    sync_block()
    valid = real(0.0)
    for i in range(lane, lowest.shape[1], wp.block_dim()):
        point = lowest[world, i]
        if point >= 0:
            valid += real(1.0)
            height = wp.rint(gaps[world, point] / gap_tolerance)
            rank = int(0)
            for j in range(lowest.shape[1]):
                other = lowest[world, j]
                if other >= 0:
                    other_height = wp.rint(gaps[world, other] / gap_tolerance)
                    if other_height < height or (other_height == height and other < point):
                        rank += 1
            points[world, first + rank] = point
    valid = sum_of_block(valid)
    if lane == 0:
        counts[world] = first + int(valid)
