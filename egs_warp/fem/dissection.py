"""A body cut into slabs that do not meet, so that their factors can be made at once."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import shortest_path

_MOST_CUTS = 3
_WORTH = 0.8
"""Of all unknowns: what cuts leave to be eliminated one after the other, if they are worth their launches."""


@dataclass(frozen=True)
class Dissection:
    """Unknowns of a symmetric matrix (n, n): no entry of it joins two ``parts``.

    One part is eliminated beside the other, then what lies ``between`` them: nested dissection (George, 1973), by one
    level, since on a GPU what is eliminated at once takes no longer than its largest part.
    """

    parts: list[np.ndarray]
    """Of each its unknowns."""
    separator: np.ndarray
    """The others."""

    @property
    def order(self) -> np.ndarray:
        """(n,) the unknowns, part by part, then those between."""
        return np.concatenate([*self.parts, self.separator])

    @classmethod
    def of(cls, upper: sparse.csc_matrix | sparse.csc_array) -> Dissection:
        """Of a matrix with a pattern whose upper triangle is ``upper``: levels of the graph from one of its ends on,
        some of which are cuts, so that the largest part and all cuts have the fewest unknowns together."""
        count = len(upper.indptr) - 1
        whole = cls([np.arange(count)], np.zeros(0, int))
        level = _levels(sparse.csr_matrix(abs(upper) + abs(upper).T))
        widths = np.bincount(level)
        ends = np.concatenate([[0], np.cumsum(widths)])
        best, cuts = _WORTH * count, ()
        for number in range(1, _MOST_CUTS + 1):
            for chosen in combinations(range(1, len(widths) - 1), number):
                sizes = [ends[last] - ends[first + 1] for first, last in pairwise((-1, *chosen, len(widths)))]
                left = max(sizes) + widths[list(chosen)].sum()
                if min(sizes) > 0 and left < best:
                    best, cuts = left, chosen
        if not cuts:
            return whole
        parts = [np.flatnonzero((level > a) & (level < b)) for a, b in pairwise((-1, *cuts, len(widths)))]
        return cls(parts, np.flatnonzero(np.isin(level, cuts)))


def _levels(graph: sparse.csr_matrix) -> np.ndarray:
    """(n,) how many edges each vertex is from one of the ends of the ``graph``; what is not joined to that is one level
    further than all others."""
    level = np.zeros(len(graph.indptr) - 1)
    for _ in range(2):
        level = shortest_path(graph, unweighted=True, indices=int(np.argmax(np.where(np.isfinite(level), level, -1.0))))
    joined = np.isfinite(level)
    return np.where(joined, level, level[joined].max() + 1.0).astype(int)
