"""Limbs on which a body stands: branches of its horizontal sections that reach the ground.

The horizontal sections of a solid and their contacts form the Reeb graph of its height. Limbs are detected at levels on
which they are separate, which may be above feet that are merged. They are then followed up to their junctions and down
to the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from egs_warp.geometry.tetmesh import TetMesh, mean_edge_length
from egs_warp.meshing.occupancy import LatticeSolid
from egs_warp.muscles.level_set_cells import LevelSetCells
from egs_warp.short_repr import short_repr

_SECTION_THICKNESS = 0.02
"""Thickness of a section of a mesh, in body heights."""
_CUT_MARGIN = 1e-3
"""Minimum distance between cuts and nodes, in section thicknesses."""
_NEAR_GROUND = 0.07
"""Maximum height, in body heights, of the lower end of a limb that stands on the ground; a limb that ends higher does
not support the body."""
_MIN_LIMB_HEIGHT = 0.08
"""Minimum height, in body heights, over which a limb is separate from all others; a shorter branch is a toe."""
_MAX_MERGED_HEIGHT = 0.1
"""Maximum height, in body heights, of a connection near the ground between two limbs that do not form one base; it is
at least the mean edge length of the mesh."""
_MAX_GAP = 0.5
"""Maximum gap between two limbs, in body heights, across which a connection may be an artefact of the capture."""


@dataclass(frozen=True)
class Sections:
    """Horizontal sections of a solid: connected slabs of equal thickness, and the pairs that touch.

    In the shapes below, S is the number of sections, J the number of pairs, and N the number of nodes of the body's
    cage.
    """

    thickness: float
    """Thickness of a section, m."""
    levels: np.ndarray
    """(S,) int, level of each section, from the ground upwards."""
    centres: np.ndarray
    """(S, 3) m, approximate centres."""
    volumes: np.ndarray
    """(S,) m^3, volumes."""
    joints: np.ndarray
    """(J, 2) int, pairs of touching sections on consecutive levels, the lower one first."""
    section_from_node: np.ndarray
    """(N,) int, section that contains each node of the cage, otherwise the section nearest to it."""
    melt: float
    """Maximum height, in metres, of a connection near the ground between parts that may be separate in reality."""

    @classmethod
    def of_mesh(cls, mesh: TetMesh, heights: np.ndarray) -> Sections:
        """Return the sections of ``mesh`` itself, whose nodes are at ``heights`` (N,) above the ground, m."""
        size = float(np.ptp(heights))
        thickness = _SECTION_THICKNESS * size
        field = (heights - heights.min()) / thickness
        # Move nodes out of the cuts, because a face that lies in a cut would belong to no cell.
        field = np.where(np.abs(field - np.rint(field)) < _CUT_MARGIN, np.rint(field) + _CUT_MARGIN, field)
        cells = LevelSetCells.cut(mesh.tets, field, level_count=int(np.ceil(field.max())))
        count, section = _components(cells.count, cells.touching)
        tet_from_node = np.zeros(len(mesh.nodes), int)
        tet_from_node[mesh.tets] = np.arange(len(mesh.tets))[:, None]
        volumes = (mesh.volumes() / np.bincount(cells.tet_from_cell))[cells.tet_from_cell]
        levels = np.zeros(count, int)
        levels[section] = cells.level_from_cell
        middles = mesh.nodes[mesh.tets].mean(axis=1)[cells.tet_from_cell]
        return cls(
            thickness,
            levels,
            _centres(section, middles, volumes, count),
            np.bincount(section, volumes, count),
            _distinct(section[cells.stacked], count),
            section[cells.holding(tet_from_node, field)],
            max(_MAX_MERGED_HEIGHT * size, mean_edge_length(mesh)),
        )

    @classmethod
    def of_solid(cls, solid: LatticeSolid, mesh: TetMesh) -> Sections:
        """Return the sections of the ``solid`` around which the cage ``mesh`` was generated. The solid resolves
        narrower gaps than the mesh. Both are in the frame of the body."""
        cells = np.argwhere(solid.inside)
        number = np.full(solid.inside.shape, -1)
        number[tuple(cells.T)] = np.arange(len(cells))
        number = np.pad(number, 1, constant_values=-1)
        sideways, upwards = [], []
        for x, y in ((0, 0), (1, 0), (0, 1), (1, 1), (1, -1), (-1, 0), (0, -1), (-1, -1), (-1, 1)):
            shifted = np.roll(number, (-x, -y), axis=(0, 1))
            if (x, y) > (0, 0):
                sideways.append(_both(number, shifted))
            upwards.append(_both(number, np.roll(shifted, -1, axis=2)))
        count, section = _components(len(cells), np.concatenate(sideways))
        levels = np.zeros(count, int)
        levels[section] = cells[:, 2]
        points = solid.points(cells)
        return cls(
            solid.spacing,
            levels,
            _centres(section, points, np.ones(len(points)), count),
            solid.spacing**3 * np.bincount(section, minlength=count),
            _distinct(section[np.concatenate(upwards)], count),
            section[np.asarray(KDTree(points).query(mesh.nodes)[1])],
            _MAX_MERGED_HEIGHT * float(np.ptp(mesh.nodes[:, 2])),
        )


def _components(count: int, pairs: np.ndarray) -> tuple[int, np.ndarray]:
    return connected_components(sp.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count)), directed=False)


def _distinct(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return the distinct rows (P, 2) of ``pairs`` (n, 2), which contain numbers below ``count``."""
    return np.stack(np.divmod(np.unique(pairs[:, 0].astype(np.int64) * count + pairs[:, 1]), count), axis=1)


def _both(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    valid = (first >= 0) & (second >= 0)
    return np.stack([first[valid], second[valid]], axis=1)


def _centres(section: np.ndarray, points: np.ndarray, masses: np.ndarray, count: int) -> np.ndarray:
    total = np.bincount(section, masses, count)
    return np.stack([np.bincount(section, masses * points[:, k], count) / total for k in range(3)], axis=1)


@dataclass(frozen=True)
class Limbs:
    """Limbs on which a body stands; N is the number of nodes."""

    __repr__ = short_repr

    limb_from_node: np.ndarray
    """(N,) int, limb of each node, -1 for nodes above the limbs."""
    tops: tuple[float, ...]
    """Heights in metres above the ground at which each limb joins another limb or the body ends."""

    @property
    def count(self) -> int:
        """Number of limbs; a body without limbs is considered one limb."""
        return len(self.tops)


def find_limbs(sections: Sections, nodes: np.ndarray) -> Limbs:
    """Find the limbs of a body that reach the ground; ``nodes`` (N, 3), m, are the nodes of its cage."""
    graph = _Graph(sections)
    candidates = [graph.limbs_through(crossing) for crossing in graph.crossings()]
    bases = [graph.bases(limbs) for limbs in candidates]
    scores = [_score(limbs, base) for limbs, base in zip(candidates, bases, strict=True)]
    if max(scores, default=0) == 0:
        return Limbs(np.zeros(len(nodes), int), (graph.height,))
    best = int(np.argmax(scores))
    limbs, base_from_limb = candidates[best], bases[best]
    base_from_section = np.full(len(sections.levels), -1)
    for limb, base in zip(limbs, base_from_limb, strict=True):
        base_from_section[list(limb.own)] = base
    limb_from_node = base_from_section[sections.section_from_node]
    # Feet that are merged are split halfway between their limbs.
    shared = np.isin(sections.section_from_node, list(graph.shared_below(limbs)))
    ends = np.array([sections.centres[list(limb.lowest), :2].mean(axis=0) for limb in limbs])
    limb_from_node[shared] = base_from_limb[np.asarray(KDTree(ends).query(nodes[shared, :2])[1], int)]
    tops = [
        sections.thickness * max(limb.top for limb, base in zip(limbs, base_from_limb, strict=True) if base == number)
        for number in range(int(base_from_limb.max()) + 1)
    ]
    return Limbs(limb_from_node, tuple(tops))


def _score(limbs: Sequence[_Limb], base_from_limb: np.ndarray) -> int:
    """Return the sum over the feet of the number of levels on which a foot is separate; 0 for fewer than two feet."""
    apart = np.zeros(int(base_from_limb.max(initial=-1)) + 1, int)
    np.maximum.at(apart, base_from_limb, [limb.apart for limb in limbs])
    return int(apart.sum()) if len(apart) > 1 else 0


@dataclass(frozen=True)
class _Limb:
    """Limb of a section graph; heights are given as levels."""

    own: frozenset[int]
    """Sections of the limb on levels at which it is separate from all others."""
    lowest: frozenset[int]
    """Sections of the limb on its lowest level."""
    bottom: int
    """Lowest level of the limb."""
    top: int
    """Level at which the limb joins another one."""
    is_joined: bool
    """True if the limb shares sections below ``own`` with another limb."""

    @property
    def apart(self) -> int:
        """Number of levels on which the limb is separate from all others."""
        return self.top - self.bottom


class _Graph:
    """Graph of the sections: each section is connected to the sections that touch it from above and below."""

    def __init__(self, sections: Sections) -> None:
        self.sections = sections
        self.levels = sections.levels
        count = len(self.levels)
        self.up: list[set[int]] = [set() for _ in range(count)]
        self.down: list[set[int]] = [set() for _ in range(count)]
        for lower, upper in sections.joints.tolist():
            self.up[lower].add(upper)
            self.down[upper].add(lower)
        self.by_level = [np.flatnonzero(self.levels == level).tolist() for level in range(int(self.levels.max()) + 1)]
        size = len(self.by_level)
        self.height = size * sections.thickness
        """Height of the body, m."""
        self._near = int(np.ceil(_NEAR_GROUND * size))
        self._shortest = max(2, round(_MIN_LIMB_HEIGHT * size))
        self._melt = int(np.ceil(sections.melt / sections.thickness))
        self._bar = _MAX_GAP * self.height

    def crossings(self) -> list[list[int]]:
        """Return the sections that are connected downwards to the ground and support the body, for each level with at
        least two such sections."""
        grounded = [level <= self._near for level in self.levels]
        for level in self.by_level:
            for section in level:
                grounded[section] |= any(grounded[below] for below in self.down[section])
        root = list(range(len(self.levels)))
        mass = self.sections.volumes.copy()

        def find(section: int) -> int:
            while root[section] != section:
                root[section] = root[root[section]]
                section = root[section]
            return section

        result = []
        for level in reversed(self.by_level):
            for section in level:
                for above in sorted(self.up[section]):
                    lower, upper = find(section), find(above)
                    if lower != upper:
                        root[upper] = lower
                        mass[lower] += mass[upper]
            if not level:
                continue
            # A part that is not connected to the body above this level, such as a tail, supports nothing.
            body = max(map(find, level), key=lambda one: mass[one])
            crossing = [section for section in level if find(section) == body and grounded[section]]
            if len(crossing) > 1:
                result.append(crossing)
        return result[::-1]

    def limbs_through(self, crossing: Sequence[int]) -> list[_Limb]:
        """Return the limbs through the sections of one level that are long enough; an empty list if fewer than two
        remain."""
        level = int(self.levels[crossing[0]])
        tops, above, _, _ = self._follow(crossing, self.up)
        bottoms, below, ends, met = self._follow(crossing, self.down)
        limbs = []
        for k in range(len(crossing)):
            bottom = level - bottoms[k]
            limb = _Limb(frozenset(above[k] | below[k]), frozenset(ends[k]), bottom, level + tops[k] + 1, met[k])
            if limb.apart >= self._shortest and (met[k] or bottom <= self._near):
                limbs.append(limb)
        return limbs if len(limbs) > 1 else []

    def _follow(
        self, crossing: Sequence[int], neighbours: Sequence[set[int]]
    ) -> tuple[list[int], list[set[int]], list[set[int]], list[bool]]:
        """Follow the graph from each section until it meets another section's path.

        Returns:
            For each section: the number of levels that its path covers, the sections of the path, the sections on its
            last level, and True if it has met another path.
        """
        count = len(crossing)
        front: list[set[int]] = [{section} for section in crossing]
        own, last, level_counts, met = [set(one) for one in front], list(front), [0] * count, [False] * count
        going = set(range(count))
        while going:
            # Paths continue after they have met, so that other paths can meet their continuation.
            front = [set().union(*(neighbours[section] for section in one)) for one in front]
            met = [
                met[k] or (k in going and any(front[k] & front[j] for j in range(count) if j != k))
                for k in range(count)
            ]
            going = {k for k in going if front[k] and not met[k]}
            for k in going:
                last[k], level_counts[k] = front[k], level_counts[k] + 1
                own[k] |= front[k]
        return level_counts, own, last, met

    def bases(self, limbs: Sequence[_Limb]) -> np.ndarray:
        """Return (limbs,) int, the index of the foot of each limb. Limbs share a foot if their connection near the
        ground is high, or if they are farther apart than ``_MAX_GAP`` and the connection is a bar without another limb
        between them."""
        if not limbs:
            return np.zeros(0, int)
        under = [self._ground_under(limb) for limb in limbs]
        joined = [(a, b) for a in range(len(limbs)) for b in range(a) if under[a] & under[b]]
        thick = [(a, b) for a, b in joined if min(limbs[a].bottom, limbs[b].bottom) > self._melt]
        near = [(a, b) for a, b in joined if self._air(limbs[a], limbs[b]) <= self._bar]
        _, side = _components(len(limbs), np.array(near, int).reshape(-1, 2))
        bars = [(a, b) for a, b in joined if side[a] != side[b]]
        return _components(len(limbs), np.array(thick + bars, int).reshape(-1, 2))[1]

    def _air(self, one: _Limb, other: _Limb) -> float:
        """Return the gap in metres between the lowest own sections of two limbs, each approximated by a square."""
        at, volumes = self.sections.centres[:, :2], self.sections.volumes
        ends = [list(limb.lowest) for limb in (one, other)]
        first, second = (np.average(at[end], axis=0, weights=volumes[end]) for end in ends)
        sides = [np.sqrt(volumes[end].sum() / self.sections.thickness) for end in ends]
        return float(np.linalg.norm(second - first) - 0.5 * sum(sides))

    def _ground_under(self, limb: _Limb) -> set[int]:
        """Return the lowest sections on the downward paths from the limb."""
        below = set(limb.lowest)
        while further := set().union(*(self.down[section] for section in below)):
            below = further
        return below

    def shared_below(self, limbs: Sequence[_Limb]) -> set[int]:
        """Return the sections under the limbs that belong to none of them."""
        own = set().union(*(limb.own for limb in limbs))
        result: set[int] = set()
        edge = {section for limb in limbs for section in limb.lowest}
        while edge:
            edge = set().union(*(self.down[section] for section in edge)) - result - own
            result |= edge
        return result
