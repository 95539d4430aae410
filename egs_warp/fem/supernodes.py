"""Symbolic analysis of a sparse symmetric matrix: fill-reducing order, supernodes and their elimination tree.

Multifrontal method of Duff and Reid (1983) with supernodes: consecutive columns of the factor with the same rows below
them are stored as one dense block.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

_MAX_MERGED_WIDTH, _MAX_CHILD_WIDTH = 16, 6
"""Maximum widths in columns: a merged block is narrow if its own width is at most the first value, or the width of the
merged child at most the second."""
_FILL_FRACTION = 0.3
"""Maximum fraction of zeros in a narrow merged block. For other merged blocks it is a third of this."""


@dataclass(frozen=True)
class Supernodes:
    """Blocks of the factor L in P A P^T = L D L^T, in the order of elimination; children come before their parent.

    Block s has ``widths[s]`` columns from ``first[s]`` on. Its front has the rows with the numbers of these columns,
    and below them the rows ``rows[row_offsets[s] + widths[s] : row_offsets[s + 1]]``; all numbers are permuted.
    """

    permutation: np.ndarray
    """(n,) position of each row of A in the order of elimination."""
    first: np.ndarray
    """(S,) first column of each block."""
    widths: np.ndarray
    """(S,) number of columns of each block."""
    row_offsets: np.ndarray
    """(S + 1,) offset of each front in ``rows``."""
    rows: np.ndarray
    """(row_offsets[S],) rows of all fronts, ascending in each front."""
    parents: np.ndarray
    """(S,) parent of each block in the elimination tree, -1 for roots."""

    @property
    def count(self) -> int:
        """Number of blocks S."""
        return len(self.first)

    @property
    def heights(self) -> np.ndarray:
        """(S,) number of rows of each front."""
        return np.diff(self.row_offsets)

    @classmethod
    def of(cls, upper: sparse.csc_matrix) -> Supernodes:
        """Analyse a symmetric matrix whose pattern has the upper triangle ``upper``, including the diagonal."""
        full = (upper + upper.T).tocsc()
        full.sort_indices()
        groups = np.cumsum(first_of_equal_rows(full)) - 1
        sizes = np.bincount(groups)
        thin = _between_groups(upper, groups, len(sizes))
        order = _ordered(thin)
        blocks = _merged(*_fundamental(_structures(thin, order)[0]), sizes[order])
        # Expand groups to rows.
        starts = np.concatenate([[0], np.cumsum(sizes[order])])
        position = np.empty(len(sizes), dtype=np.int64)
        position[order] = np.arange(len(sizes))
        within = np.argsort(position[groups], kind="stable")
        permutation = np.empty(len(groups), dtype=np.int32)
        permutation[within] = np.arange(len(groups))
        fronts = [
            np.concatenate([np.arange(starts[c], starts[c + 1]) for c in (*own, *below)]) for own, below in blocks
        ]
        widths = np.array([starts[own[-1] + 1] - starts[own[0]] for own, _ in blocks], dtype=np.int32)
        first = np.array([starts[own[0]] for own, _ in blocks], dtype=np.int32)
        block_of = np.repeat(np.arange(len(blocks)), widths)
        parents = [
            block_of[front[width]] if len(front) > width else -1 for front, width in zip(fronts, widths, strict=True)
        ]
        offsets = np.concatenate([[0], np.cumsum([len(front) for front in fronts])])
        return cls(
            permutation,
            first,
            widths,
            offsets.astype(np.int32),
            np.concatenate(fronts).astype(np.int32),
            np.array(parents, dtype=np.int32),
        )


def first_of_equal_rows(full: sparse.csc_matrix) -> np.ndarray:
    """Return (n,) bool, False for each row with the same pattern as the previous row, for example the rows of one node.

    ``full`` is a symmetric matrix with both triangles and sorted indices.
    """
    keys = [full.indices[a:b].tobytes() for a, b in pairwise(full.indptr)]
    return np.array([True, *(key != last for last, key in pairwise(keys))])


def _between_groups(upper: sparse.csc_matrix, groups: np.ndarray, count: int) -> sparse.csc_matrix:
    """Return the pattern (G, G) of both triangles between groups of rows, with diagonally dominant values."""
    entries = upper.tocoo()
    rows, columns = groups[entries.row], groups[entries.col]
    both = np.concatenate([rows, columns]), np.concatenate([columns, rows])
    thin = sparse.csc_matrix((np.ones(2 * len(rows)), both), (count, count))
    thin.sum_duplicates()
    thin.data[:] = -1.0
    thin.setdiag(1.0 + np.diff(thin.indptr))
    return thin


def _ordered(thin: sparse.csc_matrix) -> np.ndarray:
    """Return the groups (G,) in a fill-reducing order: a minimum degree order, postordered along the
    elimination tree."""
    factors = splu(thin, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    order = np.argsort(factors.perm_c)
    _, parents = _structures(thin, order)
    return order[_postorder(parents)]


def _structures(thin: sparse.csc_matrix, order: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the structure of the factor of ``thin`` in ``order``: rows below the diagonal of each column, and parents.

    Rows are ascending. Parents are columns in the elimination tree, -1 for roots.
    """
    count = len(order)
    position = np.empty(count, dtype=np.int64)
    position[order] = np.arange(count)
    below: list[np.ndarray] = []
    children: list[list[int]] = [[] for _ in range(count)]
    parents = np.full(count, -1)
    for j, group in enumerate(order):
        near = position[thin.indices[thin.indptr[group] : thin.indptr[group + 1]]]
        parts = [near[near > j], *(below[child][1:] for child in children[j])]
        below.append(np.unique(np.concatenate(parts)))
        if len(below[j]) > 0:
            parents[j] = below[j][0]
            children[parents[j]].append(j)
    return below, parents


def _postorder(parents: np.ndarray) -> np.ndarray:
    """Return the nodes (n,) of a forest in an order in which each node follows all of its descendants."""
    children: list[list[int]] = [[] for _ in parents]
    for node, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(node)
    stack, order = [int(root) for root in np.flatnonzero(parents < 0)], []
    while stack:
        node = stack.pop()
        order.append(node)
        stack += children[node]
    return np.array(order[::-1])


def _fundamental(columns: list[np.ndarray]) -> tuple[list[tuple[int, int]], list[np.ndarray]]:
    """Return runs of columns with the same rows below them, as (first, last + 1), and the rows below each run."""
    runs: list[tuple[int, int]] = []
    start = 0
    for j in range(1, len(columns) + 1):
        if j == len(columns) or len(columns[j - 1]) != len(columns[j]) + 1 or columns[j - 1][0] != j:
            runs.append((start, j))
            start = j
    return runs, [columns[last - 1] for _, last in runs]


def _merged(runs: list[tuple[int, int]], below: list[np.ndarray], sizes: np.ndarray) -> list[tuple[range, np.ndarray]]:
    """Merge each run into the next one, its parent, if that adds few zeros; return columns and rows of the blocks."""
    starts = np.concatenate([[0], np.cumsum(sizes)])

    def area(first: int, last: int, rows: np.ndarray) -> float:
        width = float(starts[last] - starts[first])
        return width * (0.5 * width + float(sizes[rows].sum()))

    blocks: list[tuple[int, int, np.ndarray, float]] = []
    """First column, last column + 1, rows below, and number of entries that are not padding, for each block."""
    for (first, last), rows in zip(runs, below, strict=True):
        own = area(first, last, rows)
        # The children of the run are among the preceding blocks; they are visited in reverse order.
        while blocks and len(blocks[-1][2]) > 0 and blocks[-1][2][0] < last and blocks[-1][2][0] >= first:
            before, _, _, needed = blocks[-1]
            merged = area(before, last, rows)
            narrow = (
                starts[last] - starts[before] <= _MAX_MERGED_WIDTH or starts[first] - starts[before] <= _MAX_CHILD_WIDTH
            )
            if merged - own - needed > (_FILL_FRACTION if narrow else _FILL_FRACTION / 3.0) * merged:
                break
            blocks.pop()
            first, own = before, own + needed
        blocks.append((first, last, rows, own))
    return [(range(first, last), rows) for first, last, rows, _ in blocks]
