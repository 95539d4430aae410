"""Cover of occupied lattice cells by few boxes that may overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

_MIN_FILL = 0.85
"""Minimum occupied fraction of a layer of cells that is added to a box."""
_REST = 0.02
"""Fraction of the occupied cells that may stay uncovered."""
_MIN_NEW_CELLS = 8
"""Minimum number of cells that a box covers in addition to earlier boxes."""


@dataclass(frozen=True)
class BoxCover:
    """Boxes that cover the occupied cells of a lattice."""

    boxes: np.ndarray
    """(n, 2, 3) int, first cell of each box, and the cell after its last one."""
    share: float
    """Fraction of the occupied cells that the boxes cover; 1 if no cell is occupied."""


def cover_with_boxes(occupied: np.ndarray, *, max_boxes: int) -> BoxCover:
    """Cover the ``occupied`` (nx, ny, nz) bool cells of a lattice with at most ``max_boxes`` boxes.

    The method is greedy: the next box starts as the largest cube around the uncovered cell that is deepest inside, and
    grows layer by layer as long as most of the next layer is occupied, also by cells of earlier boxes. So boxes overlap
    where parts meet, and there are few faces inside the solid.
    """
    total = int(occupied.sum())
    if total == 0:
        return BoxCover(np.zeros((0, 2, 3), int), 1.0)
    sums = np.pad(np.cumsum(np.cumsum(np.cumsum(occupied, 0, int), 1), 2), ((1, 0),) * 3)
    padded = np.pad(occupied, 1)
    depth = np.asarray(ndimage.distance_transform_cdt(padded, metric="chessboard"))[1:-1, 1:-1, 1:-1]
    left, boxes = occupied.copy(), []
    while len(boxes) < max_boxes and left.sum() > _REST * total:
        seed = np.array(np.unravel_index(int(np.argmax(np.where(left, depth, 0))), depth.shape))
        reach = int(depth[tuple(seed)]) - 1
        low, high = _grown(sums, seed - reach, seed + reach + 1)
        inside = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        if left[inside].sum() >= _MIN_NEW_CELLS:
            boxes.append((low, high))
        left[inside] = False
    covered = np.zeros_like(occupied)
    for low, high in boxes:
        covered[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
    return BoxCover(np.array(boxes, int).reshape(-1, 2, 3), float((covered & occupied).sum() / total))


def _grown(sums: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the box from ``low`` (3,) to ``high`` (3,) after growing it; in each step, the side with the fullest next
    layer is extended."""
    low, high, limit = low.copy(), high.copy(), np.array(sums.shape) - 1
    while True:
        best, best_fill = None, _MIN_FILL
        for axis in range(3):
            for is_high in (False, True):
                first, last = low.copy(), high.copy()
                first[axis], last[axis] = (high[axis], high[axis] + 1) if is_high else (low[axis] - 1, low[axis])
                if first[axis] < 0 or last[axis] > limit[axis]:
                    continue
                fill = _count(sums, first, last) / np.prod(last - first)
                if fill >= best_fill:
                    best, best_fill = (axis, is_high), fill
        if best is None:
            return low, high
        axis, is_high = best
        if is_high:
            high[axis] += 1
        else:
            low[axis] -= 1


def _count(sums: np.ndarray, low: np.ndarray, high: np.ndarray) -> int:
    """Return the number of occupied cells in a box, from the cumulative sums (nx + 1, ny + 1, nz + 1) over all lower
    cells."""
    total = 0
    for corner in np.ndindex(2, 2, 2):
        at = np.where(corner, high, low)
        total += (-1) ** (3 - sum(corner)) * int(sums[tuple(at)])
    return total
