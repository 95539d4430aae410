"""Limbs on which a body stands: the branches of its sections at equal height that reach the ground.

Level sections of a solid and how they touch are its Reeb graph of height. Limbs are found where they are apart, which
may be above feet that melt together, and followed up to where they meet and down to the ground.
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

_SLICE = 0.02
"""Body heights: thickness of a section of a mesh."""
_CLEAR = 1e-3
"""Slices: how far cuts are from nodes."""
_NEAR_GROUND = 0.07
"""Body heights: a limb that ends higher hangs."""
_APART = 0.08
"""Body heights over which a limb is apart from all others; what is shorter is a toe."""
_JOINED = 0.1
"""Body heights, or a mean edge of the mesh if that is more: limbs joined on the ground by more are one base."""
_BAR = 0.5
"""Body heights of air between two limbs: what joins them across more, however thin, is no flaw of a capture."""


@dataclass(frozen=True)
class Sections:
    """Connected slabs of equal height of a solid, and which of them touch. S sections, N nodes of the body's cage."""

    thickness: float
    """Metres."""
    levels: np.ndarray
    """(S,) int, counted from the ground."""
    centres: np.ndarray
    """(S, 3) metres, about."""
    volumes: np.ndarray
    """(S,) m^3."""
    joints: np.ndarray
    """(., 2) int: touching sections on consecutive levels, the lower one first."""
    section_from_node: np.ndarray
    """(N,) the section that holds each node of the cage, or is nearest to it."""
    melt: float
    """Metres: what is joined by no more than this on the ground may be apart in truth."""

    @classmethod
    def of_mesh(cls, mesh: TetMesh, heights: np.ndarray) -> Sections:
        """Of ``mesh`` itself, whose nodes are at ``heights`` (N,) over the ground."""
        size = float(np.ptp(heights))
        thickness = _SLICE * size
        field = (heights - heights.min()) / thickness
        # A face that lies in a cut belongs to no cell.
        field = np.where(np.abs(field - np.rint(field)) < _CLEAR, np.rint(field) + _CLEAR, field)
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
            max(_JOINED * size, mean_edge_length(mesh)),
        )

    @classmethod
    def of_solid(cls, solid: LatticeSolid, mesh: TetMesh) -> Sections:
        """Of the ``solid`` that the cage ``mesh`` was made around, whose gaps are finer than those of the mesh; both in
        the frame of the body."""
        places = np.argwhere(solid.inside)
        number = np.full(solid.inside.shape, -1)
        number[tuple(places.T)] = np.arange(len(places))
        number = np.pad(number, 1, constant_values=-1)
        sideways, upwards = [], []
        for x, y in ((0, 0), (1, 0), (0, 1), (1, 1), (1, -1), (-1, 0), (0, -1), (-1, -1), (-1, 1)):
            shifted = np.roll(number, (-x, -y), axis=(0, 1))
            if (x, y) > (0, 0):
                sideways.append(_both(number, shifted))
            upwards.append(_both(number, np.roll(shifted, -1, axis=2)))
        count, section = _components(len(places), np.concatenate(sideways))
        levels = np.zeros(count, int)
        levels[section] = places[:, 2]
        points = solid.points(places)
        return cls(
            solid.spacing,
            levels,
            _centres(section, points, np.ones(len(points)), count),
            solid.spacing**3 * np.bincount(section, minlength=count),
            _distinct(section[np.concatenate(upwards)], count),
            section[np.asarray(KDTree(points).query(mesh.nodes)[1])],
            _JOINED * float(np.ptp(mesh.nodes[:, 2])),
        )


def _components(count: int, pairs: np.ndarray) -> tuple[int, np.ndarray]:
    return connected_components(sp.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count)), directed=False)


def _distinct(pairs: np.ndarray, count: int) -> np.ndarray:
    """(., 2) each pair of numbers below ``count`` once."""
    return np.stack(np.divmod(np.unique(pairs[:, 0].astype(np.int64) * count + pairs[:, 1]), count), axis=1)


def _both(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    there = (first >= 0) & (second >= 0)
    return np.stack([first[there], second[there]], axis=1)


def _centres(section: np.ndarray, points: np.ndarray, masses: np.ndarray, count: int) -> np.ndarray:
    total = np.bincount(section, masses, count)
    return np.stack([np.bincount(section, masses * points[:, k], count) / total for k in range(3)], axis=1)


@dataclass(frozen=True)
class Limbs:
    """What a body stands on. N nodes."""

    limb_from_node: np.ndarray
    """(N,) int: the limb that each node is a part of, -1 for the body above them."""
    tops: tuple[float, ...]
    """Metres over the ground: where each limb meets another, or the body ends."""

    @property
    def count(self) -> int:
        """At least 1: a body without limbs, or on one alone, is one as a whole."""
        return len(self.tops)


def find_limbs(sections: Sections, nodes: np.ndarray) -> Limbs:
    """The limbs that reach the ground, of a body whose cage has ``nodes`` (N, 3), metres."""
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
    # Feet that have melted together are parted half way between their limbs.
    shared = np.isin(sections.section_from_node, list(graph.shared_below(limbs)))
    ends = np.array([sections.centres[list(limb.lowest), :2].mean(axis=0) for limb in limbs])
    limb_from_node[shared] = base_from_limb[np.asarray(KDTree(ends).query(nodes[shared, :2])[1], int)]
    tops = [
        sections.thickness * max(limb.top for limb, base in zip(limbs, base_from_limb, strict=True) if base == number)
        for number in range(int(base_from_limb.max()) + 1)
    ]
    return Limbs(limb_from_node, tuple(tops))


def _score(limbs: Sequence[_Limb], base_from_limb: np.ndarray) -> int:
    """Levels over which two feet or more are apart, together; 0 for fewer."""
    apart = np.zeros(int(base_from_limb.max(initial=-1)) + 1, int)
    np.maximum.at(apart, base_from_limb, [limb.apart for limb in limbs])
    return int(apart.sum()) if len(apart) > 1 else 0


@dataclass(frozen=True)
class _Limb:
    """A limb of a section graph; levels."""

    own: frozenset[int]
    """Its sections, where it is apart from all others."""
    lowest: frozenset[int]
    """Those of its own lowest level."""
    bottom: int
    """Its own lowest level."""
    top: int
    """The level at which it meets another."""
    joined: bool
    """It shares what is below with another."""

    @property
    def apart(self) -> int:
        """Levels over which it is apart."""
        return self.top - self.bottom


class _Graph:
    """Sections by level, with what touches from above and below."""

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
        """Metres."""
        self._near = int(np.ceil(_NEAR_GROUND * size))
        self._shortest = max(2, round(_APART * size))
        self._melt = int(np.ceil(sections.melt / sections.thickness))
        self._bar = _BAR * self.height

    def crossings(self) -> list[list[int]]:
        """For each level with more than one, its sections that lead down to the ground and together carry the body."""
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

        found = []
        for level in reversed(self.by_level):
            for section in level:
                for above in sorted(self.up[section]):
                    mine, other = find(section), find(above)
                    if mine != other:
                        root[other] = mine
                        mass[mine] += mass[other]
            if not level:
                continue
            # What stands apart from the body all the way up, such as a tail, carries nothing.
            body = max(map(find, level), key=lambda one: mass[one])
            crossing = [section for section in level if find(section) == body and grounded[section]]
            if len(crossing) > 1:
                found.append(crossing)
        return found[::-1]

    def limbs_through(self, crossing: Sequence[int]) -> list[_Limb]:
        """The limbs that go through the sections of one level, those of a good length; none if there are not two."""
        level = int(self.levels[crossing[0]])
        tops, above, _, _ = self._followed(crossing, self.up)
        bottoms, below, ends, met = self._followed(crossing, self.down)
        limbs = []
        for k in range(len(crossing)):
            bottom = level - bottoms[k]
            limb = _Limb(frozenset(above[k] | below[k]), frozenset(ends[k]), bottom, level + tops[k] + 1, met[k])
            if limb.apart >= self._shortest and (met[k] or bottom <= self._near):
                limbs.append(limb)
        return limbs if len(limbs) > 1 else []

    def _followed(
        self, crossing: Sequence[int], onwards: Sequence[set[int]]
    ) -> tuple[list[int], list[set[int]], list[set[int]], list[bool]]:
        """Of what is followed from each section until it meets another: levels gone, sections, the last of these, and
        whether it did meet."""
        count = len(crossing)
        front: list[set[int]] = [{section} for section in crossing]
        own, last, gone, met = [set(one) for one in front], list(front), [0] * count, [False] * count
        going = set(range(count))
        while going:
            # Those that have met go on, so that the others see what they have become.
            front = [set().union(*(onwards[section] for section in one)) for one in front]
            met = [
                met[k] or (k in going and any(front[k] & front[j] for j in range(count) if j != k))
                for k in range(count)
            ]
            going = {k for k in going if front[k] and not met[k]}
            for k in going:
                last[k], gone[k] = front[k], gone[k] + 1
                own[k] |= front[k]
        return gone, own, last, met

    def bases(self, limbs: Sequence[_Limb]) -> np.ndarray:
        """(limbs,) the number of each limb's foot: those that are joined by much have one, and those that a bar joins
        where no other limb stands between them."""
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
        """Metres between the lowest own sections of two limbs, each taken for a square."""
        at, volumes = self.sections.centres[:, :2], self.sections.volumes
        ends = [list(limb.lowest) for limb in (one, other)]
        first, second = (np.average(at[end], axis=0, weights=volumes[end]) for end in ends)
        sides = [np.sqrt(volumes[end].sum() / self.sections.thickness) for end in ends]
        return float(np.linalg.norm(second - first) - 0.5 * sum(sides))

    def _ground_under(self, limb: _Limb) -> set[int]:
        """The last sections that what is under the limb leads down to."""
        below = set(limb.lowest)
        while further := set().union(*(self.down[section] for section in below)):
            below = further
        return below

    def shared_below(self, limbs: Sequence[_Limb]) -> set[int]:
        """Sections under the limbs that are not their own."""
        own = set().union(*(limb.own for limb in limbs))
        found: set[int] = set()
        edge = {section for limb in limbs for section in limb.lowest}
        while edge:
            edge = set().union(*(self.down[section] for section in edge)) - found - own
            found |= edge
        return found
