"""Where the numbers of a factorisation by fronts lie in memory."""

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
    """Places, and how many numbers there are of each kind."""

    fronts: Any
    """The kernels' ``Fronts``."""
    front: int
    """Of the largest front, by rows whose lengths are multiples of 8."""
    scratch: int
    """Behind it."""
    stack: int
    """Of what fronts leave for their parents, while it waits."""
    factor: int
    """Of L, each block by rows."""
    inverses: int
    """Of its diagonal blocks' inverses."""

    @classmethod
    def of(cls, blocks: Supernodes, upper: sparse.csc_matrix) -> FrontLayout:
        """Of ``blocks``, into which the entries of ``upper`` (n, n) go in the order of its columns."""
        widths, heights, parents = (part.astype(np.int64) for part in (blocks.widths, blocks.heights, blocks.parents))
        strides, inverses = -(-heights // 8) * 8, -(-widths // BLOCK) * BLOCK**2
        place_in = _places_in_fronts(blocks)
        # An entry lies in the columns of the block that is eliminated first.
        ends = (
            blocks.permutation[upper.indices],
            blocks.permutation[np.repeat(np.arange(len(upper.indptr) - 1), np.diff(upper.indptr))],
        )
        column, row = np.minimum(*ends), np.maximum(*ends)
        block = np.repeat(np.arange(blocks.count), widths)[column]
        entries = np.argsort(block, kind="stable")
        entry_places = place_in(block, row) * strides[block] + column - blocks.first[block]
        # What a front leaves goes to its parent.
        left = np.concatenate([np.arange(height) >= width for height, width in zip(heights, widths, strict=True)])
        in_parent = np.zeros(len(blocks.rows), dtype=np.int64)
        in_parent[left] = place_in(np.repeat(parents, heights)[left], blocks.rows[left])
        children = np.argsort(parents, kind="stable")[np.count_nonzero(parents < 0) :]
        updates, stack = _stacked(heights - widths, parents)
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
            "update_offsets": updates,
            "place": blocks.permutation,
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
    """As the kernels take them."""
    return wp.array(np.asarray(values, dtype=np.int32), dtype=int, device="cpu")


def _offsets(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)])


def _places_in_fronts(blocks: Supernodes) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Where permuted rows lie in the fronts of given blocks."""
    keys = np.repeat(np.arange(blocks.count), blocks.heights) * len(blocks.permutation) + blocks.rows

    def found(block: np.ndarray, row: np.ndarray) -> np.ndarray:
        return np.searchsorted(keys, block * len(blocks.permutation) + row) - blocks.row_offsets[block]

    return found


def _stacked(left: np.ndarray, parents: np.ndarray) -> tuple[np.ndarray, int]:
    """(S,) where on a stack each front leaves its ``left`` (S,) rows and columns, and how much room all need: a front
    takes its children's off before it leaves its own."""
    waiting: list[int] = []
    where, top, most = np.zeros(len(left), dtype=np.int64), 0, 0
    for block, size in enumerate(left):
        while waiting and parents[waiting[-1]] == block:
            top -= int(left[waiting.pop()]) ** 2
        where[block] = top
        top += int(size) ** 2
        most = max(most, top)
        waiting.append(block)
    return where, most
