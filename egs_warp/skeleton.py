"""Curve skeleton of a body: branches (legs, trunk, arms) from the ground up, each a polyline with sections.

A height-like function phi is made that grows along every limb away from the ground: first a drainage field u (the body
is heated evenly and cooled only at its base, so that heat flows down every limb to the ground: -lap u = 1, u = 0 at the
base; u has no minimum but the base and no maximum but the tips), then phi with the direction of u's gradient and unit
slope, as in the heat method of Crane, Weischedel and Wardetzky (2013). Connected slabs of phi are the body's sections;
how they join is its Reeb graph, whose short and thin chains are merged into their neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from egs_warp.attachments import edge_graph
from egs_warp.tetmesh import TetMesh

_BASE_FRACTION = 0.02
"""Nodes lower than this part of the body's height above its lowest point are its base (or half an edge, if more)."""
_SLAB_EDGES = 1.25
"""Thickness of a section in mean edge lengths: fewer would break sections into single nodes."""
_MIN_BRANCH_VOLUME = 0.01
"""A branch holds at least this part of the body's volume."""
_MIN_BRANCH_SLENDERNESS = 1.5
"""A branch that ends freely is at least this many of its own radii long; shorter ones are bumps."""


@dataclass(frozen=True)
class Branch:
    """One limb or the trunk: a polyline through the middles of its sections, running away from the ground. K points."""

    points: np.ndarray
    """(K, 3) float64, metres, K >= 2."""
    radii: np.ndarray
    """(K,) float64, metres: radius of the disc with the section's area."""
    sections: tuple[np.ndarray, ...]
    """K arrays of node indices: the nodes of each section."""
    starts_on_ground: bool
    """Its first point lies on the body's base."""
    volume: float
    """Cubic metres of the body that its sections hold."""

    @property
    def length(self) -> float:
        """Metres along the polyline."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


@dataclass(frozen=True)
class Skeleton:
    """All branches of a body, the most voluminous first."""

    branches: tuple[Branch, ...]
    up: np.ndarray
    """(3,) unit vector away from the ground."""


def skeleton(mesh: TetMesh, up: np.ndarray) -> Skeleton:
    """Curve skeleton of ``mesh`` that stands with its lowest nodes on the ground; ``up`` (3,) points away from it.

    The same mesh gives the same bits every time.
    """
    up = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    ascent = ascent_field(mesh, up)
    graph = _SectionGraph.sliced(mesh, ascent)
    graph.merge_insignificant_chains()
    branches = [graph.branch(chain, ascent) for chain in graph.joined_chains()]
    branches.sort(key=lambda branch: -branch.volume)
    return Skeleton(tuple(branches), up)


def base_nodes(mesh: TetMesh, up: np.ndarray) -> np.ndarray:
    """Indices of the nodes on which the body stands."""
    heights = mesh.nodes @ up
    edge = edge_graph(mesh).data.mean()
    return np.flatnonzero(heights <= heights.min() + max(_BASE_FRACTION * np.ptp(heights), 0.4 * edge))


def ascent_field(mesh: TetMesh, up: np.ndarray) -> np.ndarray:
    """(N,) metres: zero at the base, growing with about unit slope along every limb away from it (module docstring)."""
    volumes = mesh.volumes()
    corners = mesh.nodes[mesh.tets]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    gradients = np.concatenate([-inverse.sum(axis=2, keepdims=True), inverse], axis=2).transpose(0, 2, 1)
    stiffness = np.einsum("t,tai,tbi->tab", volumes, gradients, gradients)
    rows, columns = np.repeat(mesh.tets, 4, axis=1).ravel(), np.tile(mesh.tets, (1, 4)).ravel()
    laplacian = sp.csc_matrix((stiffness.ravel(), (rows, columns)), shape=(len(mesh.nodes),) * 2)
    free = np.setdiff1d(np.arange(len(mesh.nodes)), base_nodes(mesh, up))
    solver = splu(laplacian[free][:, free].tocsc())
    drainage, ascent = np.zeros(len(mesh.nodes)), np.zeros(len(mesh.nodes))
    drainage[free] = solver.solve(mesh.lumped_masses(1.0)[free])
    slopes = np.einsum("tai,ta->ti", gradients, drainage[mesh.tets])
    slopes /= np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-300)
    divergence = np.zeros(len(mesh.nodes))
    np.add.at(divergence, mesh.tets, np.einsum("t,tai,ti->ta", volumes, gradients, slopes))
    ascent[free] = solver.solve(divergence[free])
    return ascent


class _SectionGraph:
    """Sections (connected slabs of equal ascent) and which of them touch; merging changes it in place."""

    def __init__(self, mesh: TetMesh, label_from_node: np.ndarray, level_from_section: np.ndarray, thickness: float):
        self.mesh = mesh
        self.thickness = thickness
        self.level = {section: int(level) for section, level in enumerate(level_from_section)}
        self.nodes = {section: np.flatnonzero(label_from_node == section) for section in self.level}
        self.node_volumes = mesh.lumped_masses(1.0)
        self.total_volume = float(self.node_volumes.sum())
        edges = edge_graph(mesh).tocoo()
        pairs = np.stack([label_from_node[edges.row], label_from_node[edges.col]], axis=1)
        pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
        self.neighbours: dict[int, set[int]] = {section: set() for section in self.level}
        for a, b in pairs:
            self.neighbours[int(a)].add(int(b))

    @classmethod
    def sliced(cls, mesh: TetMesh, ascent: np.ndarray) -> _SectionGraph:
        edges = edge_graph(mesh).tocoo()
        levels = max(3, int(ascent.max() / (_SLAB_EDGES * edges.data.mean())))
        thickness = float(ascent.max()) / levels
        level = np.clip((ascent / thickness).astype(int), 0, levels - 1)
        same = level[edges.row] == level[edges.col]
        slabs = sp.coo_matrix((edges.data[same], (edges.row[same], edges.col[same])), shape=edges.shape)
        count, label = connected_components(slabs, directed=False)
        level_from_section = np.zeros(count, dtype=int)
        level_from_section[label] = level
        return cls(mesh, label, level_from_section, thickness)

    def volume(self, sections: Iterable[int]) -> float:
        return sum(float(self.node_volumes[self.nodes[section]].sum()) for section in sections)

    def merge_insignificant_chains(self) -> None:
        """Merge the least chain that is no limb, until every chain is one."""
        while True:
            chains = [chain for chain in self.chains() if self._is_insignificant(chain)]
            if not chains:
                return
            self._merge(min(chains, key=lambda chain: (self.volume(self._own(chain)), chain)))

    def chains(self) -> list[list[int]]:
        """Paths between branching or end sections, including these, each once, running upwards."""
        special = [
            section for section, others in self.neighbours.items() if len(others) != 2 or self._is_extreme(section)
        ]
        found = []
        for start in special:
            for following in sorted(self.neighbours[start]):
                chain = [start, following]
                while chain[-1] not in special:
                    (onward,) = self.neighbours[chain[-1]] - {chain[-2]}
                    chain.append(onward)
                if (self.level[chain[0]], chain[0], chain[1]) <= (self.level[chain[-1]], chain[-1], chain[-2]):
                    found.append(chain)
        return found

    def joined_chains(self) -> list[list[int]]:
        """Chains; one that comes up alone to a junction is continued by the most voluminous one that leaves it."""
        chains = self.chains() or [[section, section] for section in self.neighbours]
        for junction in sorted(self.neighbours, key=lambda section: (self.level[section], section)):
            below = [chain for chain in chains if chain[-1] == junction]
            above = [chain for chain in chains if chain[0] == junction]
            if len(below) == 1 and above:
                onward = max(above, key=lambda chain: (self.volume(chain[1:]), chain))
                chains = [chain for chain in chains if chain is not below[0] and chain is not onward]
                chains.append(below[0] + onward[1:])
        return chains

    def branch(self, chain: list[int], ascent: np.ndarray) -> Branch:
        """The polyline of a chain of sections; a free end is carried on to its tip, a ground end to the base."""
        sections = [self.nodes[section] for section in chain]
        points = [np.average(self.mesh.nodes[nodes], axis=0, weights=self.node_volumes[nodes]) for nodes in sections]
        radii = [self._radius(section) for section in chain]
        grounded = bool(np.any(ascent[sections[0]] == 0.0))
        if grounded or len(self.neighbours[chain[0]]) <= 1:
            lowest = sections[0][ascent[sections[0]] <= ascent[sections[0]].min() + 1e-9 * self.thickness]
            points.insert(0, np.average(self.mesh.nodes[lowest], axis=0, weights=self.node_volumes[lowest]))
            radii.insert(0, radii[0])
            sections.insert(0, sections[0])
        if len(self.neighbours[chain[-1]]) <= 1:
            top = sections[-1][ascent[sections[-1]] >= ascent[sections[-1]].max() - 0.25 * self.thickness]
            points.append(np.average(self.mesh.nodes[top], axis=0, weights=self.node_volumes[top]))
            radii.append(radii[-1])
            sections.append(sections[-1])
        polyline = np.array(points)
        for _ in range(2):
            polyline[1:-1] = 0.25 * polyline[:-2] + 0.5 * polyline[1:-1] + 0.25 * polyline[2:]
        return Branch(polyline, np.array(radii), tuple(sections), grounded, self.volume(set(chain)))

    def _radius(self, section: int) -> float:
        return float(np.sqrt(self.volume([section]) / (np.pi * self.thickness)))

    def _is_extreme(self, section: int) -> bool:
        levels = [self.level[other] for other in self.neighbours[section]]
        return min(levels) > self.level[section] or max(levels) < self.level[section]

    def _is_free(self, section: int) -> bool:
        return len(self.neighbours[section]) == 1

    def _own(self, chain: list[int]) -> list[int]:
        """The sections of a chain that are not shared with another chain."""
        return [section for section in chain if len(self.neighbours[section]) <= 2 and not self._is_junction(section)]

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
        # Between two junctions: a short link only separates limbs that leave the body at about the same place.
        return len(own) < 2 or length < mean_radius

    def _merge(self, chain: list[int]) -> None:
        """Unite a free chain level by level with the body beside it; a link between junctions, with both of these."""
        if self._is_free(chain[0]) or self._is_free(chain[-1]):
            junction, own = (chain[-1], chain[-2::-1]) if self._is_free(chain[0]) else (chain[0], chain[1:])
            upwards = self.level[own[0]] > self.level[junction]
            beside, avoid = junction, set(own)
            for section in own:
                onward = [
                    other
                    for other in self.neighbours[beside]
                    if other not in avoid and (self.level[other] > self.level[beside]) == upwards
                ]
                if onward and (self.level[section] > self.level[beside]) == upwards:
                    beside = max(onward, key=lambda other: (self.volume([other]), other))
                self._unite(beside, section)
        else:
            for section in chain[1:]:
                if section != chain[0]:
                    self._unite(chain[0], section)

    def _unite(self, kept: int, gone: int) -> None:
        self.nodes[kept] = np.sort(np.concatenate([self.nodes[kept], self.nodes.pop(gone)]))
        for other in self.neighbours.pop(gone):
            self.neighbours[other].discard(gone)
            if other != kept:
                self.neighbours[other].add(kept)
                self.neighbours[kept].add(other)
        del self.level[gone]
