"""Which columns of a sparse factor are alike, and what each group of them adds to which others: the symbolic analysis.

The multifrontal method of Duff and Reid (1983) with supernodes: columns of the factor that follow one another and reach
the same rows are kept as one dense block.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

_NARROW, _THIN = 16, 6
"""Columns up to which two blocks together, or the first alone, join if that ..."""
_FILL = 0.3
"""... makes at most this share of both zeros; others if it is a third of it."""


@dataclass(frozen=True)
class Supernodes:
    """Blocks of L, P A P^T = L D L^T, in the order in which they are eliminated; children come before their parent.

    Block s has the columns ``first[s]`` on, ``widths[s]`` of them, and of the permuted rows first those and then
    ``rows[row_offsets[s] + widths[s] : row_offsets[s + 1]]`` below them: its front.
    """

    permutation: np.ndarray
    """(n,) the permuted place of each row of A."""
    first: np.ndarray
    """(S,)."""
    widths: np.ndarray
    """(S,)."""
    row_offsets: np.ndarray
    """(S + 1,)."""
    rows: np.ndarray
    """Of all fronts, ascending in each."""
    parents: np.ndarray
    """(S,) -1 for roots."""

    @property
    def count(self) -> int:
        """S."""
        return len(self.first)

    @property
    def heights(self) -> np.ndarray:
        """(S,) rows of each front."""
        return np.diff(self.row_offsets)

    @classmethod
    def of(cls, upper: sparse.csc_matrix) -> Supernodes:
        """Of a symmetric matrix with a pattern whose upper triangle is ``upper``, its diagonal included."""
        full = (upper + upper.T).tocsc()
        full.sort_indices()
        groups = np.cumsum(first_of_equal_rows(full)) - 1
        sizes = np.bincount(groups)
        thin = _between_groups(upper, groups, len(sizes))
        order = _ordered(thin)
        blocks = _merged(*_fundamental(_structures(thin, order)[0]), sizes[order])
        # From groups to rows.
        starts = np.concatenate([[0], np.cumsum(sizes[order])])
        where = np.empty(len(sizes), dtype=np.int64)
        where[order] = np.arange(len(sizes))
        within = np.argsort(where[groups], kind="stable")
        place = np.empty(len(groups), dtype=np.int32)
        place[within] = np.arange(len(groups))
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
            place,
            first,
            widths,
            offsets.astype(np.int32),
            np.concatenate(fronts).astype(np.int32),
            np.array(parents, dtype=np.int32),
        )


def first_of_equal_rows(full: sparse.csc_matrix) -> np.ndarray:
    """(n,) whether a row of a symmetric pattern, both triangles of it, sorted, reaches others than the row before; the
    three of a node reach the same."""
    keys = [full.indices[a:b].tobytes() for a, b in pairwise(full.indptr)]
    return np.array([True, *(key != last for last, key in pairwise(keys))])


def _between_groups(upper: sparse.csc_matrix, groups: np.ndarray, count: int) -> sparse.csc_matrix:
    """(G, G) the pattern of both triangles, diagonally dominant."""
    entries = upper.tocoo()
    rows, columns = groups[entries.row], groups[entries.col]
    both = np.concatenate([rows, columns]), np.concatenate([columns, rows])
    thin = sparse.csc_matrix((np.ones(2 * len(rows)), both), (count, count))
    thin.sum_duplicates()
    thin.data[:] = -1.0
    thin.setdiag(1.0 + np.diff(thin.indptr))
    return thin


def _ordered(thin: sparse.csc_matrix) -> np.ndarray:
    """(G,) the groups in an order of small fill: by minimum degree, along the elimination tree."""
    found = splu(thin, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    order = np.argsort(found.perm_c)
    _, parents = _structures(thin, order)
    return order[_postorder(parents)]


def _structures(thin: sparse.csc_matrix, order: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Of each column of the factor of ``thin`` in ``order`` the rows below its diagonal, ascending, and its parent in
    the elimination tree or -1."""
    count = len(order)
    where = np.empty(count, dtype=np.int64)
    where[order] = np.arange(count)
    below: list[np.ndarray] = []
    children: list[list[int]] = [[] for _ in range(count)]
    parents = np.full(count, -1)
    for j, group in enumerate(order):
        near = where[thin.indices[thin.indptr[group] : thin.indptr[group + 1]]]
        parts = [near[near > j], *(below[child][1:] for child in children[j])]
        below.append(np.unique(np.concatenate(parts)))
        if len(below[j]) > 0:
            parents[j] = below[j][0]
            children[parents[j]].append(j)
    return below, parents


def _postorder(parents: np.ndarray) -> np.ndarray:
    """(n,) the nodes of a forest, each after all that are below it."""
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
    """Runs of columns that reach the same rows, (first, last + 1), and the rows below each."""
    runs: list[tuple[int, int]] = []
    start = 0
    for j in range(1, len(columns) + 1):
        if j == len(columns) or len(columns[j - 1]) != len(columns[j]) + 1 or columns[j - 1][0] != j:
            runs.append((start, j))
            start = j
    return runs, [columns[last - 1] for _, last in runs]


def _merged(runs: list[tuple[int, int]], below: list[np.ndarray], sizes: np.ndarray) -> list[tuple[range, np.ndarray]]:
    """Columns and rows below of blocks: a run joins the one after it, whose child it is, where that adds few zeros."""
    starts = np.concatenate([[0], np.cumsum(sizes)])

    def area(first: int, last: int, rows: np.ndarray) -> float:
        width = float(starts[last] - starts[first])
        return width * (0.5 * width + float(sizes[rows].sum()))

    blocks: list[tuple[int, int, np.ndarray, float]] = []
    """First, last + 1, rows below, and the area that is not zero."""
    for (first, last), rows in zip(runs, below, strict=True):
        own = area(first, last, rows)
        # Those before it that are its children, the last of them first.
        while blocks and len(blocks[-1][2]) > 0 and blocks[-1][2][0] < last and blocks[-1][2][0] >= first:
            before, _, _, needed = blocks[-1]
            joined = area(before, last, rows)
            narrow = starts[last] - starts[before] <= _NARROW or starts[first] - starts[before] <= _THIN
            if joined - own - needed > (_FILL if narrow else _FILL / 3.0) * joined:
                break
            blocks.pop()
            first, own = before, own + needed
        blocks.append((first, last, rows, own))
    return [(range(first, last), rows) for first, last, rows, _ in blocks]
