"""One-level nested dissection of a matrix into slabs without common entries, which are factored in parallel."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import shortest_path

_MAX_CUTS = 3
"""Maximum number of cuts. With n cuts, the unknowns are divided into n + 1 parts."""
_MAX_SEQUENTIAL_FRACTION = 0.8
"""Maximum fraction of the unknowns that are eliminated in sequence. Above it, a dissection saves less time than its
launches cost."""


@dataclass(frozen=True)
class Dissection:
    """Partition of the unknowns of a symmetric matrix (n, n) such that no entry couples two ``parts``.

    The parts are eliminated in parallel, then the ``separator``: one level of nested dissection (George, 1973). On a
    GPU the parts together take as long as the largest of them.
    """

    parts: list[np.ndarray]
    """Unknowns of each part, ascending."""
    separator: np.ndarray
    """Unknowns that are in no part, ascending."""

    @property
    def order(self) -> np.ndarray:
        """(n,) order of elimination: the unknowns of each part, then the separator."""
        return np.concatenate([*self.parts, self.separator])

    @classmethod
    def of(cls, upper: sparse.csc_matrix | sparse.csc_array) -> Dissection:
        """Dissect a matrix whose pattern has the upper triangle ``upper``.

        The candidates for cuts are the levels of a breadth-first search from one end of the graph. The chosen cuts
        minimise the number of unknowns in the largest part plus the number of unknowns in all cuts.
        """
        count = len(upper.indptr) - 1
        whole = cls([np.arange(count)], np.zeros(0, int))
        level = _levels(sparse.csr_matrix(abs(upper) + abs(upper).T))
        widths = np.bincount(level)
        ends = np.concatenate([[0], np.cumsum(widths)])
        best, cuts = _MAX_SEQUENTIAL_FRACTION * count, ()
        for number in range(1, _MAX_CUTS + 1):
            for chosen in combinations(range(1, len(widths) - 1), number):
                sizes = [ends[last] - ends[first + 1] for first, last in pairwise((-1, *chosen, len(widths)))]
                sequential = max(sizes) + widths[list(chosen)].sum()
                if min(sizes) > 0 and sequential < best:
                    best, cuts = sequential, chosen
        if not cuts:
            return whole
        parts = [np.flatnonzero((level > a) & (level < b)) for a, b in pairwise((-1, *cuts, len(widths)))]
        return cls(parts, np.flatnonzero(np.isin(level, cuts)))


def _levels(graph: sparse.csr_matrix) -> np.ndarray:
    """Return (n,) int, the distance of each vertex in edges from one end of the ``graph``.

    Vertices that are not connected to this end form one additional level.
    """
    level = np.zeros(len(graph.indptr) - 1)
    for _ in range(2):
        level = shortest_path(graph, unweighted=True, indices=int(np.argmax(np.where(np.isfinite(level), level, -1.0))))
    connected = np.isfinite(level)
    return np.where(connected, level, level[connected].max() + 1.0).astype(int)
