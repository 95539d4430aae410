"""Binary graph cuts of a cloud along its weakest links, so that Gaussians that are close and similar stay together.

A graph links each Gaussian with its nearest neighbours. A cut assigns one of two labels to each Gaussian such that a
cost is minimal: the sum of the scores of the Gaussians that oppose their labels, and of the strengths of the links
between neighbours with different labels (Boykov and Jolly 2001; for Gaussians, GaussianCut, Jain et al. 2024). See
docs/concepts/segmentation.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, maximum_flow
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.launching import available_threads

_NEIGHBOURS = 10
_DETOUR = 6.0
"""Relative increase of the length of a link whose ends differ in colour by the mean difference over all links."""
_UNIT = 1000
"""Factor by which scores are multiplied before they are rounded to integers."""
_UNCUTTABLE = 1 << 28
"""Capacity of a link that must not be cut; the flow through all such links of a node must fit in 31 bits."""


@dataclass(frozen=True)
class SplatGraph:
    """Gaussians, and the links between neighbours; each link is listed once."""

    count: int
    first: np.ndarray
    """(m,) int32, index of the first end of each link."""
    second: np.ndarray
    """(m,) int32, index of the second end of each link."""
    length: np.ndarray
    """(m,) distance between the ends, divided by the median over all links; increased if the colours differ."""
    strength: np.ndarray
    """(m,) 0 to 1, cost of cutting the link."""
    colour_unit: float = 1.0
    """Mean distance between the colours (0 to 1) of the two ends of a link between neighbours."""

    @classmethod
    def of(cls, cloud: GaussianCloud, chosen: np.ndarray, *, neighbours: int = _NEIGHBOURS) -> SplatGraph:
        """Link each of the Gaussians with the indices ``chosen`` (n,) of ``cloud`` to its ``neighbours`` nearest ones.

        Training stacks Gaussians at one place; their nearest neighbours would be in the same stack. Therefore only one
        Gaussian of each place (``distinct_places``) is linked to its neighbours, and the others are linked to it.
        """
        points = cloud.means.numpy()[chosen].astype(np.float64)
        colours = cloud.sh.numpy()[chosen, 0].astype(np.float64) * SH_BAND_0 + 0.5
        first, place = distinct_places(points, cloud.breadths(chosen))
        graph = cls.linking(points[first], colours[first], neighbours=neighbours)
        others = np.setdiff1d(np.arange(len(points)), first).astype(np.int32)
        apart = np.linalg.norm(colours[others] - colours[first[place[others]]], axis=1) / graph.colour_unit
        return cls(
            len(points),
            np.concatenate([first[graph.first], first[place[others]]]).astype(np.int32),
            np.concatenate([first[graph.second], others]).astype(np.int32),
            np.concatenate([graph.length, np.zeros(len(others))]),
            np.concatenate([graph.strength, np.exp(-0.5 * apart**2)]),
            graph.colour_unit,
        )

    @classmethod
    def linking(cls, points: np.ndarray, colours: np.ndarray, *, neighbours: int = _NEIGHBOURS) -> SplatGraph:
        """Link each of the ``points`` (n, 3) with ``colours`` (n, 3), 0 to 1, to its ``neighbours`` nearest points."""
        count = len(points)
        if count < 2:
            nothing = np.zeros(0, np.int32)
            return cls(count, nothing, nothing, np.zeros(0), np.zeros(0))
        neighbours = min(neighbours + 1, count)
        _, others = KDTree(points).query(points, k=neighbours, workers=available_threads())
        ends = np.stack([np.repeat(np.arange(count), neighbours), np.ravel(others)]).astype(np.int64)
        # Coincident Gaussians may be listed before the point itself.
        ends = np.sort(ends[:, ends[0] != ends[1]], axis=0)
        # Encode each pair as one number, because sorting rows takes ten times as long.
        first, second = np.divmod(np.unique(ends[0] * count + ends[1]), count)
        first, second = first.astype(np.int32), second.astype(np.int32)
        away, apart, unit = _differences(points, colours, first, second)
        strength = np.exp(-0.5 * apart**2) / np.maximum(away, 1.0)
        return cls(count, first, second, away * (1.0 + _DETOUR * apart), strength, unit)

    def clustered(self, cluster: np.ndarray, points: np.ndarray, colours: np.ndarray) -> SplatGraph:
        """Return the graph of clusters. A link is as strong as all links between its two clusters together.

        Args:
            cluster: (n,) int, cluster of each Gaussian, from 0.
            points: (k, 3) centre of each cluster, scene units.
            colours: (k, 3) mean colour of each cluster, 0 to 1.
        """
        count = len(points)
        low, high = np.sort(cluster[np.stack([self.first, self.second])].astype(np.int64), axis=0)
        between = low != high
        codes, link = np.unique(low[between] * count + high[between], return_inverse=True)
        first, second = (ends.astype(np.int32) for ends in np.divmod(codes, count))
        away, apart, unit = _differences(points, colours, first, second)
        strength = np.bincount(link, weights=self.strength[between], minlength=len(codes))
        return SplatGraph(count, first, second, away * (1.0 + _DETOUR * apart), strength, unit)

    def where(self, chosen: np.ndarray) -> SplatGraph:
        """Return the graph with only the links selected by ``chosen`` (m,) bool."""
        return replace(
            self, **{name: getattr(self, name)[chosen] for name in ("first", "second", "length", "strength")}
        )

    def among(self, chosen: np.ndarray) -> SplatGraph:
        """Return the links between the Gaussians selected by ``chosen`` (n,) bool, which are renumbered in their
        order."""
        number = np.cumsum(chosen, dtype=np.int32) - 1
        inner = chosen[self.first] & chosen[self.second]
        first, second = number[self.first[inner]], number[self.second[inner]]
        return SplatGraph(int(chosen.sum()), first, second, self.length[inner], self.strength[inner])

    def strength_to(self, chosen: np.ndarray) -> np.ndarray:
        """Return the total strength (n,) of the links of each Gaussian to the Gaussians selected by ``chosen`` (n,)
        bool."""
        forward = np.bincount(self.first, self.strength * chosen[self.second], self.count)
        return forward + np.bincount(self.second, self.strength * chosen[self.first], self.count)

    def distances(self, seeds: np.ndarray) -> np.ndarray:
        """Return the length (n,) of the shortest path along the links from each Gaussian to one of the ``seeds`` (k,);
        infinite if there is none."""
        # Links of zero length would be treated as missing.
        links = coo_array((np.maximum(self.length, 1e-9), (self.first, self.second)), shape=(self.count,) * 2)
        return dijkstra(links.tocsr(), directed=False, indices=seeds, min_only=True)

    def cut(
        self, score: np.ndarray, included: np.ndarray, excluded: np.ndarray, *, smoothness: float = 1.0
    ) -> np.ndarray:
        """Compute the labels of minimum cost.

        Args:
            score: (n,) cost of excluding a Gaussian, or, if negative, of including it.
            included: (n,) bool, Gaussians that are always included.
            excluded: (n,) bool, Gaussians that are always excluded.
            smoothness: factor of the links' strength, which is the cost of cutting them.

        Returns:
            (n,) bool, True for included Gaussians.
        """
        source, sink = self.count, self.count + 1
        whole = np.rint(_UNIT * np.clip(score, -1e3, 1e3)).astype(np.int64)
        whole[included], whole[excluded] = _UNCUTTABLE, -_UNCUTTABLE
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
        """Return the connected part (n,) int32 of each Gaussian; links that the cut ``inside`` (n,) bool crosses are
        ignored."""
        whole = inside[self.first] == inside[self.second]
        links = coo_array(
            (np.ones(int(whole.sum()), np.int8), (self.first[whole], self.second[whole])), shape=(self.count,) * 2
        )
        return connected_components(links, directed=False)[1]


def distinct_places(points: np.ndarray, breadths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Group Gaussians of similar breadth by place, a cell of a grid whose spacing is about this breadth.

    Args:
        points: (n, 3) means.
        breadths: (n,) breadths, in the unit of ``points``.

    Returns:
        (k,) int, the first Gaussian of each place, and (n,) int, the place of each Gaussian.
    """
    if len(points) == 0:
        return np.zeros(0, int), np.zeros(0, int)
    unit = float(np.median(breadths))
    octave = np.floor(np.log2(np.maximum(breadths / unit, 1e-6)))
    cell = np.floor((points - points.min(axis=0)) / (unit * np.exp2(octave))[:, None])
    # Rank one column after the other, because sorting whole rows takes several times as long.
    first, place = np.zeros(0, int), np.zeros(len(points), np.int64)
    for column in (octave, *cell.T):
        low = column.min()
        codes = place * (int(column.max() - low) + 1) + (column - low).astype(np.int64)
        _, first, place = np.unique(codes, return_index=True, return_inverse=True)
    return first, place


def _differences(
    points: np.ndarray, colours: np.ndarray, first: np.ndarray, second: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return, for each link, the distance between its ends divided by the median of all links, and the distance between
    their colours divided by the mean of all links; and this mean."""
    away = np.linalg.norm(points[first] - points[second], axis=1)
    apart = np.linalg.norm(colours[first] - colours[second], axis=1)
    if len(away) == 0:
        return away, apart, 1.0
    unit = max(float(np.mean(apart)), 1e-6)
    return away / max(float(np.median(away)), 1e-30), apart / unit, unit
