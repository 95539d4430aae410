"""Two-way cuts of a cloud along its weakest links: what lies near and looks alike stays together.

A graph links each Gaussian with its nearest ones. A cut gives each one of two labels at the least cost: what its own
leaning says against, and the links between unlike neighbours (Boykov and Jolly 2001; over Gaussians GaussianCut,
Jain et al. 2024). See docs/concepts/segmentation.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, maximum_flow
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud

_NEIGHBOURS = 10
_DETOUR = 6.0
"""How much longer a way is where it goes from one colour to another that differs by the links' mean difference."""
_UNIT = 1000
"""Whole numbers are cut: one unit of leaning is so many."""
_HELD = 1 << 28
"""A link that is never cut; a flow of all of them must fit 31 bits for each node."""


@dataclass(frozen=True)
class SplatGraph:
    """Gaussians and the links between neighbours, each link once."""

    count: int
    first: np.ndarray
    """(m,) int32 index of a link's one end."""
    second: np.ndarray
    """(m,) int32 index of its other."""
    length: np.ndarray
    """(m,) distance between them, medians of all links; longer where colours differ."""
    strength: np.ndarray
    """(m,) 0 to 1: what it costs to cut the link."""

    @classmethod
    def of(cls, cloud: GaussianCloud, chosen: np.ndarray) -> SplatGraph:
        """Of the ``chosen`` (n,) indices of ``cloud``."""
        points = cloud.means.numpy()[chosen].astype(np.float64)
        return cls.linking(points, cloud.sh.numpy()[chosen, 0].astype(np.float64) * SH_BAND_0 + 0.5)

    @classmethod
    def linking(cls, points: np.ndarray, colours: np.ndarray) -> SplatGraph:
        """Of ``points`` (n, 3) with ``colours`` (n, 3), 0 to 1."""
        count = len(points)
        if count < 2:
            nothing = np.zeros(0, np.int32)
            return cls(count, nothing, nothing, np.zeros(0), np.zeros(0))
        asked = min(_NEIGHBOURS + 1, count)
        _, others = KDTree(points).query(points, k=asked)
        ends = np.column_stack([np.repeat(np.arange(count), asked), np.ravel(others)])
        # Coincident Gaussians may come before the one that asks.
        ends = np.unique(np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1), axis=0)
        first, second = ends.T.astype(np.int32)
        away = np.linalg.norm(points[first] - points[second], axis=1)
        away /= max(float(np.median(away)), 1e-30)
        apart = np.linalg.norm(colours[first] - colours[second], axis=1)
        apart /= max(float(np.mean(apart)), 1e-6)
        strength = np.exp(-0.5 * apart**2) / np.maximum(away, 1.0)
        return cls(count, first, second, away * (1.0 + _DETOUR * apart), strength)

    def distances(self, seeds: np.ndarray) -> np.ndarray:
        """(n,) length of the shortest way along the links from each Gaussian to one of the ``seeds`` (k,); infinite
        where there is none.
        """
        # Ways of no length would be taken for no links.
        links = coo_array((np.maximum(self.length, 1e-9), (self.first, self.second)), shape=(self.count,) * 2)
        return dijkstra(links.tocsr(), directed=False, indices=seeds, min_only=True)

    def cut(self, leaning: np.ndarray, held: np.ndarray, dropped: np.ndarray, *, smoothness: float = 1.0) -> np.ndarray:
        """(n,) bool: the least cost of all labels. ``leaning`` (n,) is what it costs to leave a Gaussian out, or, where
        it is negative, to take it in; ``held`` (n,) bool are in and ``dropped`` (n,) bool out in any case. A link that
        is cut costs its strength times ``smoothness``.
        """
        source, sink = self.count, self.count + 1
        whole = np.rint(_UNIT * np.clip(leaning, -1e3, 1e3)).astype(np.int64)
        whole[held], whole[dropped] = _HELD, -_HELD
        links = np.rint(_UNIT * smoothness * self.strength).astype(np.int64)
        every = np.arange(self.count)
        rows = np.concatenate([self.first, self.second, np.full(self.count, source), every])
        columns = np.concatenate([self.second, self.first, every, np.full(self.count, sink)])
        values = np.concatenate([links, links, np.maximum(whole, 0), np.maximum(-whole, 0)]).astype(np.int32)
        table = csr_array(coo_array((values, (rows, columns)), shape=(self.count + 2,) * 2))
        left = table - maximum_flow(table, source, sink).flow
        left.data = np.maximum(left.data, 0)
        left.eliminate_zeros()
        inside = np.zeros(self.count + 2, bool)
        inside[breadth_first_order(csr_array(left), source, return_predecessors=False)] = True
        return inside[: self.count]

    def parts(self, inside: np.ndarray) -> np.ndarray:
        """(n,) int32: which of the pieces that hang together each belongs to, links across a cut ``inside`` (n,) bool
        left out.
        """
        whole = inside[self.first] == inside[self.second]
        links = coo_array(
            (np.ones(int(whole.sum()), np.int8), (self.first[whole], self.second[whole])), shape=(self.count,) * 2
        )
        return connected_components(links, directed=False)[1]
