"""Curve skeleton of a body: its branches (legs, trunk, arms) as polylines with sections, directed away from the ground.

The sections of the body are the connected components between level sets of the geodesic height
(``egs_warp.muscles.geodesic_height``). Their adjacency is the Reeb graph. Short and thin chains of the graph are merged
into their neighbours. Level sets cut through tetrahedra, so the skeleton of a coarse mesh is as fine as that of a dense
one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.muscles.geodesic_height import geodesic_height
from egs_warp.muscles.level_set_cells import LevelSetCells

_SECTION_COUNT = 24
"""Number of sections from the base to the farthest tip."""
_SAMPLES_PER_EDGE = 4
"""Number of intervals along the edge of a tetrahedron, which is sampled at the 20 points of a lattice."""
_SMOOTHING_PASSES = 3
_CAP_SECTIONS = 3
"""Number of sections that are merged at a free end of a long branch."""
_MIN_BRANCH_VOLUME = 0.01
"""Minimum volume of a branch, as a fraction of the body's volume."""
_MIN_BRANCH_SLENDERNESS = 1.5
"""Minimum ratio of length to radius of a branch with a free end; shorter branches are bumps."""


@dataclass(frozen=True)
class Branch:
    """A limb or the trunk, as a polyline of K points through the centres of its sections, directed away from the
    ground.
    """

    points: np.ndarray
    """(K, 3) float64, m, points of the polyline, K >= 2."""
    radii: np.ndarray
    """(K,) float64, m, radius of the disc with the area of the section at each point."""
    own: np.ndarray
    """(K,) bool, True where the section belongs to this branch only, False inside a junction."""
    starts_on_ground: bool
    """True if the first point lies on the base of the body."""
    ends_freely: bool
    """True if the last point is a tip of the body."""
    volume: float
    """Volume of the sections that belong to this branch only, m^3."""
    sections: tuple[tuple[int, ...], ...]
    """Section numbers of each of the K points, including sections in junctions; empty for an end point that only
    extends the polyline."""

    @property
    def length(self) -> float:
        """Length of the polyline, m."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


@dataclass(frozen=True)
class Skeleton:
    """Curve skeleton of a body."""

    branches: tuple[Branch, ...]
    """Branches in descending order of volume."""
    up: np.ndarray
    """(3,) unit vector away from the ground."""
    samples: np.ndarray
    """(S, 3) m, points inside the body."""
    section_from_sample: np.ndarray
    """(S,) int, section of each sample."""
    neighbours: Mapping[int, frozenset[int]]
    """Adjacent sections of each section."""
    grounded: frozenset[int]
    """Sections that stand on the ground."""


def skeleton(mesh: TetMesh, up: np.ndarray) -> Skeleton:
    """Compute the curve skeleton of ``mesh``. Equal meshes give bitwise equal skeletons.

    The lowest nodes of the mesh are on the ground; ``up`` (3,) is the unit vector away from the ground.
    """
    up = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    graph = _SectionGraph(mesh, geodesic_height(mesh, up), up)
    graph.merge_insignificant_chains()
    branches = [graph.branch(chain) for chain in graph.joined_chains()]
    branches.sort(key=lambda branch: -branch.volume)
    section_from_sample = np.zeros(len(graph.samples), int)
    for section, members in graph.members.items():
        section_from_sample[members] = section
    neighbours = {section: frozenset(others) for section, others in graph.neighbours.items()}
    grounded = frozenset(section for section, touches in graph.grounded.items() if touches)
    return Skeleton(tuple(branches), up, graph.samples, section_from_sample, neighbours, grounded)


class _SectionGraph:
    """Graph of sections (connected components of a level) and their adjacency; merges modify the graph in place."""

    def __init__(self, mesh: TetMesh, ascent: np.ndarray, up: np.ndarray) -> None:
        self.thickness = float(ascent.max()) / _SECTION_COUNT
        self.up = up
        cells = LevelSetCells.cut(mesh.tets, ascent / self.thickness, level_count=_SECTION_COUNT)
        joined = sp.coo_matrix((np.ones(len(cells.touching)), cells.touching.T), shape=(cells.count,) * 2)
        count, section_from_cell = connected_components(joined, directed=False)
        self.level = dict.fromkeys(range(count), 0)
        for section, level in zip(section_from_cell, cells.level_from_cell, strict=True):
            self.level[int(section)] = int(level)
        grounded = np.zeros(count, dtype=bool)
        on_base = (ascent[mesh.tets] == 0.0).any(axis=1)[cells.tet_from_cell] & (cells.level_from_cell == 0)
        grounded[section_from_cell[on_base]] = True
        self.grounded = {section: bool(grounded[section]) for section in self.level}
        lattice = _tetrahedron_lattice(_SAMPLES_PER_EDGE)
        self.samples = np.einsum("sa,tai->tsi", lattice, mesh.nodes[mesh.tets]).reshape(-1, 3)
        self.sample_volumes = np.repeat(mesh.volumes() / len(lattice), len(lattice))
        tet_from_sample = np.repeat(np.arange(len(mesh.tets)), len(lattice))
        section_from_sample = section_from_cell[
            cells.holding(tet_from_sample, (ascent[mesh.tets] @ lattice.T).ravel() / self.thickness)
        ]
        order = np.argsort(section_from_sample, kind="stable")
        starts = np.searchsorted(section_from_sample[order], np.arange(count + 1))
        self.members = {section: order[starts[section] : starts[section + 1]] for section in self.level}
        self.lowest = float((mesh.nodes @ up).min())
        self.total_volume = float(self.sample_volumes.sum())
        self.neighbours: dict[int, set[int]] = {section: set() for section in self.level}
        for a, b in np.unique(section_from_cell[cells.stacked], axis=0):
            self.neighbours[int(a)].add(int(b))
            self.neighbours[int(b)].add(int(a))

    def volume(self, sections: Iterable[int]) -> float:
        """Return the total volume of ``sections``, m^3."""
        return sum(float(self.sample_volumes[self.members[section]].sum()) for section in sections)

    def merge_insignificant_chains(self) -> None:
        """Merge the smallest insignificant chain into its neighbours, repeatedly, until none is left."""
        while True:
            chains = [chain for chain in self.chains() if self._is_insignificant(chain)]
            if not chains:
                return
            self._merge(min(chains, key=lambda chain: (self.volume(self._own(chain)), chain)))

    def chains(self) -> list[list[int]]:
        """Return the chains, which are the paths between junctions or ends; both end points are included, and each
        chain is listed once, directed upwards."""
        special = [
            section for section, others in self.neighbours.items() if len(others) != 2 or self._is_extreme(section)
        ]
        chains = []
        for start in special:
            for following in sorted(self.neighbours[start]):
                chain = [start, following]
                while chain[-1] not in special:
                    (successor,) = self.neighbours[chain[-1]] - {chain[-2]}
                    chain.append(successor)
                if (self.level[chain[0]], chain[0], chain[1]) <= (self.level[chain[-1]], chain[-1], chain[-2]):
                    chains.append(chain)
        return chains

    def joined_chains(self) -> list[list[int]]:
        """Return the chains after joining: a chain that dominates the junction at its end continues with the largest
        chain above.

        A chain dominates a junction if it is the only one below the junction or has at least twice the volume of the
        second largest one. For example, a trunk dominates a hand that rests on the hip, but no leg of a stool dominates
        the others.
        """
        chains = self.chains() or [[section, section] for section in self.neighbours]
        for junction in sorted(self.neighbours, key=lambda section: (self.level[section], section)):
            below = sorted(
                (chain for chain in chains if chain[-1] == junction),
                key=lambda chain: (-self._own_volume(chain), chain),
            )
            above = [chain for chain in chains if chain[0] == junction]
            dominates = len(below) == 1 or (
                len(below) > 1 and self._own_volume(below[0]) > 2.0 * self._own_volume(below[1])
            )
            if dominates and above:
                continuation = max(above, key=lambda chain: (self._own_volume(chain), chain))
                chains = [chain for chain in chains if chain is not below[0] and chain is not continuation]
                chains.append(below[0] + continuation[1:])
        return chains

    def branch(self, chain: list[int]) -> Branch:
        """Return the branch of a chain of sections; its polyline extends to the tip of a free end, or to the base."""
        sections = [section for section in chain if len(self.members[section])] or chain
        grounded, ends_freely = self.grounded[sections[0]], len(self.neighbours[sections[-1]]) <= 1
        # The last sections of a blunt end depend on the mesh, so the centroid of their union is used.
        cap = _CAP_SECTIONS if len(sections) >= 3 * _CAP_SECTIONS else 1
        groups = [[section] for section in sections]
        if not grounded and self._is_free(sections[0]):
            groups[:cap] = [sections[:cap]]
        if ends_freely:
            groups[-cap:] = [sections[-cap:]]
        members = [np.concatenate([self.members[section] for section in group]) for group in groups]
        points = [self._middle(samples) for samples in members]
        radii = [float(np.mean([self._radius(section) for section in group])) for group in groups]
        own = [not any(self._is_junction(section) for section in group) for group in groups]
        numbers = [tuple(group) for group in groups]
        if grounded or self._is_free(sections[0]):
            points.insert(0, self._ground_point(sections[0]) if grounded else self._tip(members[0], points[1::-1]))
            radii.insert(0, radii[0])
            own.insert(0, own[0])
            numbers.insert(0, ())
        if ends_freely:
            points.append(self._tip(members[-1], points[-2:]))
            radii.append(radii[-1])
            own.append(own[-1])
            numbers.append(())
        polyline = np.array(points)
        for _ in range(_SMOOTHING_PASSES):
            polyline[1:-1] = 0.25 * polyline[:-2] + 0.5 * polyline[1:-1] + 0.25 * polyline[2:]
        volume = self._own_volume(chain)
        return Branch(polyline, np.array(radii), np.array(own), grounded, ends_freely, volume, tuple(numbers))

    def _middle(self, members: np.ndarray) -> np.ndarray:
        return np.average(self.samples[members], axis=0, weights=self.sample_volumes[members])

    def _tip(self, members: np.ndarray, last_points: list[np.ndarray]) -> np.ndarray:
        """Return the tip (3,) m of a free end: the last point, moved along the axis to the farthest sample."""
        middle = last_points[-1]
        axis = middle - last_points[0]
        length = float(np.linalg.norm(axis))
        axis = axis / length if length > 0.0 else self.up
        return middle + float(((self.samples[members] - middle) @ axis).max()) * axis

    def _ground_point(self, section: int) -> np.ndarray:
        """Return the centre (3,) m of the lowest layer of ``section``, projected onto the ground."""
        members = self.members[section]
        heights = self.samples[members] @ self.up
        base = self._middle(members[heights <= heights.min() + 0.5 * self.thickness])
        return base - (base @ self.up - self.lowest) * self.up

    def _radius(self, section: int) -> float:
        return float(np.sqrt(self.volume([section]) / (np.pi * self.thickness)))

    def _is_extreme(self, section: int) -> bool:
        levels = [self.level[other] for other in self.neighbours[section]]
        return min(levels) > self.level[section] or max(levels) < self.level[section]

    def _is_free(self, section: int) -> bool:
        return len(self.neighbours[section]) == 1

    def _own(self, chain: list[int]) -> list[int]:
        """Return the sections of a chain that it does not share with another chain."""
        return [section for section in chain if not self._is_junction(section)]

    def _own_volume(self, chain: list[int]) -> float:
        return self.volume(set(self._own(chain)))

    def _is_junction(self, section: int) -> bool:
        return len(self.neighbours[section]) > 2

    def _is_insignificant(self, chain: list[int]) -> bool:
        own = self._own(chain)
        if not (self._is_junction(chain[0]) or self._is_junction(chain[-1])):
            return False
        length = self.thickness * len(own)
        mean_radius = np.sqrt(self.volume(own) / (np.pi * max(length, self.thickness)))
        if self._is_free(chain[0]) or self._is_free(chain[-1]):
            too_small = self.volume(own) < _MIN_BRANCH_VOLUME * self.total_volume
            return too_small or len(own) < 2 or length < _MIN_BRANCH_SLENDERNESS * mean_radius
        # A short link between two junctions only separates limbs that leave the body at nearly the same position.
        return len(own) < 2 or length < mean_radius

    def _merge(self, chain: list[int]) -> None:
        """Merge a free chain into the adjacent body, level by level, or a link between two junctions into both of
        them."""
        if self._is_free(chain[0]) or self._is_free(chain[-1]):
            junction, own = (chain[-1], chain[-2::-1]) if self._is_free(chain[0]) else (chain[0], chain[1:])
            upwards = self.level[own[0]] > self.level[junction]
            neighbour, avoid = junction, set(own)
            for section in own:
                candidates = [
                    other
                    for other in self.neighbours[neighbour]
                    if other not in avoid and (self.level[other] > self.level[neighbour]) == upwards
                ]
                if candidates and (self.level[section] > self.level[neighbour]) == upwards:
                    neighbour = max(candidates, key=lambda other: (self.volume([other]), other))
                self._unite(neighbour, section)
        else:
            for section in chain[1:]:
                if section != chain[0]:
                    self._unite(chain[0], section)

    def _unite(self, target: int, merged: int) -> None:
        """Merge section ``merged`` into ``target``."""
        self.members[target] = np.sort(np.concatenate([self.members[target], self.members.pop(merged)]))
        self.grounded[target] |= self.grounded.pop(merged)
        for other in self.neighbours.pop(merged):
            self.neighbours[other].discard(merged)
            if other != target:
                self.neighbours[other].add(target)
                self.neighbours[target].add(other)
        del self.level[merged]


def _tetrahedron_lattice(per_edge: int) -> np.ndarray:
    """Return the barycentric coordinates (S, 4) of a lattice of points inside a tetrahedron."""
    indices = [
        (a, b, c, per_edge - 1 - a - b - c)
        for a in range(per_edge)
        for b in range(per_edge - a)
        for c in range(per_edge - a - b)
    ]
    return (np.array(indices) + 0.25) / per_edge
