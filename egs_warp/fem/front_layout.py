"""Memory layout of the multifrontal factorisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sparse
import warp as wp

from egs_warp.fem.supernodes import Supernodes
from egs_warp.kernels.fem import supernodal as kernels
from egs_warp.kernels.vectors import BLOCK


@dataclass(frozen=True)
class FrontLayout:
    """Index maps of the fronts, and the sizes of the arrays in float64 numbers."""

    fronts: Any
    """``kernels.fem.supernodal.Fronts``, the struct with the index maps for the kernels."""
    front: int
    """Size of the largest front. A front is stored row by row, with row lengths padded to multiples of 8."""
    scratch: int
    """Size of the scratch memory behind the front."""
    stack: int
    """Maximum size of the stack of update matrices that have not been added to their parents yet."""
    factor: int
    """Size of L, each block stored row by row."""
    inverses: int
    """Size of the inverses of the diagonal blocks of L."""

    @classmethod
    def of(cls, blocks: Supernodes, upper: sparse.csc_matrix) -> FrontLayout:
        """Lay out the fronts of ``blocks``; matrix entries are numbered as in ``upper`` (n, n), column by column."""
        widths, heights, parents = (part.astype(np.int64) for part in (blocks.widths, blocks.heights, blocks.parents))
        strides, inverses = -(-heights // 8) * 8, -(-widths // BLOCK) * BLOCK**2
        row_in_front = _front_row_lookup(blocks)
        # Of the two unknowns of an entry, the one that is eliminated first determines its block.
        ends = (
            blocks.permutation[upper.indices],
            blocks.permutation[np.repeat(np.arange(len(upper.indptr) - 1), np.diff(upper.indptr))],
        )
        column, row = np.minimum(*ends), np.maximum(*ends)
        block = np.repeat(np.arange(blocks.count), widths)[column]
        entries = np.argsort(block, kind="stable")
        entry_places = row_in_front(block, row) * strides[block] + column - blocks.first[block]
        # The update matrix of a front is added to its parent.
        is_update = np.concatenate([np.arange(height) >= width for height, width in zip(heights, widths, strict=True)])
        in_parent = np.zeros(len(blocks.rows), dtype=np.int64)
        in_parent[is_update] = row_in_front(np.repeat(parents, heights)[is_update], blocks.rows[is_update])
        children = np.argsort(parents, kind="stable")[np.count_nonzero(parents < 0) :]
        update_offsets, stack = _stack_offsets(heights - widths, parents)
        fronts = kernels.Fronts()
        for name, values in {
            "first": blocks.first,
            "widths": widths,
            "row_offsets": blocks.row_offsets,
            "rows": blocks.rows,
            "in_parent": in_parent,
            "child_offsets": _offsets(np.bincount(parents[children], minlength=blocks.count)),
            "children": children,
            "entry_offsets": _offsets(np.bincount(block, minlength=blocks.count)),
            "entries": entries,
            "entry_places": entry_places[entries],
            "factor_offsets": _offsets(heights * widths),
            "inverse_offsets": _offsets(inverses),
            "update_offsets": update_offsets,
            "permutation": blocks.permutation,
        }.items():
            setattr(fronts, name, as_index_array(values))
        return cls(
            fronts,
            int((heights * strides).max()),
            BLOCK * int(strides.max()),
            stack,
            int((heights * widths).sum()),
            int(inverses.sum()),
        )


def as_index_array(values: np.ndarray) -> wp.array:
    """Return ``values`` as an int32 Warp array on the host."""
    return wp.array(np.asarray(values, dtype=np.int32), dtype=int, device="cpu")


def _offsets(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)])


def _front_row_lookup(blocks: Supernodes) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return a function that maps blocks and permuted rows to the position of each row in the block's front."""
    keys = np.repeat(np.arange(blocks.count), blocks.heights) * len(blocks.permutation) + blocks.rows

    def lookup(block: np.ndarray, row: np.ndarray) -> np.ndarray:
        return np.searchsorted(keys, block * len(blocks.permutation) + row) - blocks.row_offsets[block]

    return lookup


def _stack_offsets(sizes: np.ndarray, parents: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the offset (S,) of each front's update matrix on a stack, and the capacity that the stack needs.

    A front pops the update matrices of its children before it pushes its own, which has ``sizes`` (S,) rows and
    columns.
    """
    stack: list[int] = []
    offsets, top, capacity = np.zeros(len(sizes), dtype=np.int64), 0, 0
    for block, size in enumerate(sizes):
        while stack and parents[stack[-1]] == block:
            top -= int(sizes[stack.pop()]) ** 2
        offsets[block] = top
        top += int(size) ** 2
        capacity = max(capacity, top)
        stack.append(block)
    return offsets, capacity
