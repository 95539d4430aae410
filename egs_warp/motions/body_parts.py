"""Head and branches of a body, detected in its curve skeleton. Key frames may refer to them by name."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from heapq import heappop, heappush

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.meshing.protrusions import find_protrusions
from egs_warp.muscles.skeleton import Branch, Skeleton, skeleton

_TOP = 0.25
"""Maximum depth of the tip of the head below the highest tip, in body heights; a raised tail may be higher."""
_TOP_DEPTH = 0.15
"""Depth in body heights over which the tops of a branch and of the rest of the body are compared."""
_NECK = 1.15
"""Minimum ratio of the radii above and below a neck to the radius of the neck."""
_NECK_WINDOW = 3
"""Number of sections over which areas are averaged, because the area of a single section depends on details of the
mesh."""
_MIN_MASS, _MAX_BRANCH_MASS = 0.02, 0.3
"""Minimum mass of a head, and maximum mass of a branch that counts as one part, as fractions of the body mass. The
maximum excludes the trunk."""
_BASE_HEIGHT = 0.06
"""Height in body heights below which a node belongs to the base."""
_MIN_NODES = 4
"""Minimum number of nodes of a part; with fewer nodes, the inertia tensor is singular."""


@dataclass(frozen=True)
class FreeBranch:
    """Part that is connected to the ground only through the rest of the body: an arm with what it holds, a tail, an
    ear."""

    nodes: np.ndarray
    """(k,) node indices."""
    root: np.ndarray
    """(3,) m, middle of the section of the rest of the body to which the part is attached."""
    tip_count: int
    """Number of ends in the air; an arm that holds a tool has several."""
    is_on_trunk: bool
    """True if the part is attached to the trunk, not to the head or to a limb."""


@dataclass(frozen=True)
class ShapeParts:
    """Head and branches of a body."""

    head: np.ndarray | None
    """(k,) nodes above the neck, of a small branch at the top, or of one of several tops; None if the shape shows no
    head."""
    branches: tuple[FreeBranch, ...]
    """Largest parts that leave the rest of the body at a junction, end in the air and are not the head; without a head,
    the top of the trunk is not a branch either."""


def find_shape_parts(mesh: TetMesh, node_mass: np.ndarray, up: np.ndarray) -> ShapeParts:
    """Find the head and the branches of a body at rest. The lowest nodes of ``mesh`` are on the ground.

    Candidates for the head are branches of the skeleton that end near the top. A candidate consists of the sections
    above its highest neck and the branches that start there; a small branch without a neck is a candidate as a whole. A
    candidate is considered a raised arm, or an object that an arm holds, if the rest of the body ends higher and has a
    heavier top. The head is the other candidate with the largest mass. A neck is a section between clearly thicker
    sections above and below.

    Without such a head, a body without its branches may have several tops (``_tops``), such as a head and an arm that
    is raised beside it and touches it. The head is the top with the smallest radius of gyration about the vertical line
    through the centre of mass: an arm is farther from this line and longer. The other tops are branches.

    Args:
        mesh: cage at rest, m.
        node_mass: (N,) kg, nodal masses.
        up: (3,) unit vector away from the ground.
    """
    shape = skeleton(mesh, up)
    heights = mesh.nodes @ shape.up
    height, mass = float(np.ptp(heights)), float(node_mass.sum())
    base = heights < heights.min() + _BASE_HEIGHT * height
    section_from_node = shape.section_from_sample[np.asarray(KDTree(shape.samples).query(mesh.nodes)[1])]

    def nodes_of(sections: set[int], minimum: float, maximum: float) -> np.ndarray | None:
        """Return the nodes of ``sections``; None if they are too few, stand on the ground, or have a mass outside the
        bounds."""
        nodes = np.flatnonzero(np.isin(section_from_node, list(sections)))
        share = float(node_mass[nodes].sum()) / mass
        return nodes if len(nodes) >= _MIN_NODES and minimum <= share <= maximum and not base[nodes].any() else None

    heads = []
    for branch in _ending_near_the_top(shape, _TOP * height):
        candidates = [(_above(shape, branch, neck), 1.0) for neck in _necks(branch)]
        for sections, maximum in [*candidates, (_own_sections(branch), _MAX_BRANCH_MASS)]:
            nodes = nodes_of(sections, _MIN_MASS, maximum)
            if nodes is not None:
                if not _is_raised_arm(nodes, heights, node_mass):
                    heads.append((float(node_mass[nodes].sum()), sections, nodes))
                break
    highest = int(shape.section_from_sample[np.argmax(shape.samples @ shape.up)])
    head_mass, head_sections, head = max(heads, key=lambda entry: entry[0], default=(0.0, {highest}, None))
    # Without a head, each part that may be the top of the trunk is no branch.
    branches, trunk = [], _trunk(shape, highest)
    for root, sections in _free_parts(shape):
        nodes = nodes_of(sections, 0.0, _MAX_BRANCH_MASS)
        if nodes is None:
            continue
        # The head itself may also be connected by a single link.
        is_on_head = sections < head_sections and bool(node_mass[nodes].sum() < 0.5 * head_mass)
        middle = shape.samples[shape.section_from_sample == root].mean(axis=0)
        if head is None:
            is_high = float(heights[nodes].max()) >= float(heights.max()) - _TOP * height
            is_heavy = float(node_mass[nodes].sum()) >= _MIN_MASS * mass
            is_top = is_high and is_heavy and _stands_above(mesh.nodes[nodes], middle, shape.up)
        else:
            is_top = not is_on_head and bool(sections & head_sections)
        if not is_top:
            tip_count = sum(len(shape.neighbours[section]) == 1 for section in sections)
            branches.append((sections, FreeBranch(nodes, middle, tip_count, root in trunk and not is_on_head)))
    whole = [part for sections, part in branches if not any(sections < other for other, _ in branches)]
    if head is None:
        tops = _tops(mesh, heights, node_mass, np.concatenate([np.zeros(0, int), *(part.nodes for part in whole)]))
        if tops:
            across = mesh.nodes - np.outer(heights, shape.up)
            away = ((across - node_mass @ across / mass) ** 2).sum(axis=1)
            tops.sort(key=lambda top: float(np.average(away[top], weights=node_mass[top])))
            head = tops[0]
            whole += [FreeBranch(top, root_of(mesh, top), 1, is_on_trunk=True) for top in tops[1:]]
    return ShapeParts(head, tuple(whole))


def protruding_part(mesh: TetMesh, up: np.ndarray, head: np.ndarray | None) -> FreeBranch | None:
    """Return the largest part that sticks out of a body at rest (``find_protrusions``), outside the ``head`` (k,); None
    if there is none. Such a part may be too short for a branch of the skeleton, such as the tail of a toy."""
    top = np.array([np.argmax(mesh.nodes @ up)]) if head is None else head
    found = [part.nodes for part in find_protrusions(mesh, up) if not np.isin(part.nodes, top).any()]
    masses = mesh.lumped_masses(1.0)
    if not found:
        return None
    nodes = max(found, key=lambda nodes: float(masses[nodes].sum()))
    return FreeBranch(nodes, root_of(mesh, nodes), 1, is_on_trunk=True)


def _tops(mesh: TetMesh, heights: np.ndarray, node_mass: np.ndarray, excluded: np.ndarray) -> list[np.ndarray]:
    """Return the nodes (k,) of each top of a body, if there are several.

    A top is a connected part of the body above a level, which meets another top at this level. It has the mass of a
    head and ends near the highest node. Ears are too light to be tops of their own.

    Args:
        mesh: cage at rest, m.
        heights: (N,) m, heights of its nodes.
        node_mass: (N,) kg, nodal masses.
        excluded: (n,) nodes that belong to no top.
    """
    is_part = np.ones(len(heights), bool)
    is_part[excluded] = False
    neighbours: list[set[int]] = [set() for _ in heights]
    for tet in mesh.tets[is_part[mesh.tets].all(axis=1)].tolist():
        for node in tet:
            neighbours[node].update(tet)
    lowest_peak = float(heights[is_part].max()) - _TOP * float(np.ptp(heights))
    least, most = (share * float(node_mass.sum()) for share in (_MIN_MASS, _MAX_BRANCH_MASS))
    parts: dict[int, list[int]] = {}
    part_from_node: dict[int, int] = {}
    tops: list[list[int]] = []
    # Lower the level from node to node. The key of a part is its highest node.
    for node in np.argsort(-heights, kind="stable").tolist():
        if not is_part[node]:
            continue
        touched = sorted({part_from_node[other] for other in neighbours[node] if other in part_from_node})
        high = [key for key in touched if heights[key] >= lowest_peak]
        meeting = [key for key in high if least <= float(node_mass[parts[key]].sum()) <= most]
        if len(meeting) > 1:
            found = {member for top in tops for member in top}
            tops += [list(parts[key]) for key in meeting if not found.intersection(parts[key])]
        target = max(touched, key=lambda key: (heights[key], key), default=node)
        members = parts.setdefault(target, [])
        for key in touched:
            if key != target:
                members += parts.pop(key)
        members.append(node)
        part_from_node.update(dict.fromkeys(members, target))
    return [np.sort(top) for top in tops]


def root_of(mesh: TetMesh, part: np.ndarray) -> np.ndarray:
    """Return the middle (3,) of the nodes that are adjacent to the nodes ``part`` (k,)."""
    inside = np.isin(mesh.tets, part)
    beside = mesh.tets[inside.any(axis=1)][~inside[inside.any(axis=1)]]
    return mesh.nodes[np.unique(beside)].mean(axis=0)


def _trunk(shape: Skeleton, highest: int) -> set[int]:
    """Return the sections on the widest paths from the section ``highest`` to all sections on the ground: the paths in
    the spanning tree with the largest radii. A hand that touches the hip does not make the arm a part of the trunk."""
    radius = {
        section: float(radius)
        for branch in shape.branches
        for numbers, radius in zip(branch.sections, branch.radii, strict=True)
        for section in numbers
    }
    before, front = {}, [(0.0, highest, highest)]
    while front:
        _, section, last = heappop(front)
        if section in before:
            continue
        before[section] = last
        for other in shape.neighbours[section]:
            heappush(front, (-min(radius.get(section, 0.0), radius.get(other, 0.0)), other, section))
    trunk = {highest}
    for section in shape.grounded & before.keys():
        while section not in trunk:
            trunk.add(section)
            section = before[section]
    return trunk


def _free_parts(shape: Skeleton) -> Iterator[tuple[int, set[int]]]:
    """Yield each part of the graph of sections that a single link connects to the rest and to the ground: the section
    of the junction at the other end of the link, and the sections of the part."""
    for root, others in sorted(shape.neighbours.items()):
        for start in sorted(others) if len(others) > 2 else ():
            part, front = {start}, [start]
            while front:
                further = shape.neighbours[front.pop()] - part - {root}
                part |= further
                front.extend(further)
            if len(others & part) == 1 and not part & shape.grounded:
                yield root, part


def _is_raised_arm(part: np.ndarray, heights: np.ndarray, node_mass: np.ndarray) -> bool:
    """Return True if the rest of the body ends higher than a ``part`` (k,) of its nodes, and has a heavier top."""
    rest = np.setdiff1d(np.arange(len(heights)), part)
    depth = _TOP_DEPTH * float(np.ptp(heights))
    tops = [nodes[heights[nodes] > heights[nodes].max() - depth] for nodes in (part, rest)]
    own, other = (float(node_mass[top].sum()) for top in tops)
    return heights[rest].max() > heights[part].max() and other > own


def _stands_above(points: np.ndarray, root: np.ndarray, up: np.ndarray) -> bool:
    """Return True if a part with the nodes ``points`` (k, 3) stands above its ``root`` (3,), as the top of a trunk
    does, and not beside it, as a raised arm does: its middle is closer to the vertical line through the root than the
    nodes are to their middle."""
    across = points - root
    across -= np.outer(across @ up, up)
    middle = across.mean(axis=0)
    return bool(middle @ middle < np.square(across - middle).sum(axis=1).mean())


def _ending_near_the_top(shape: Skeleton, depth: float) -> list[Branch]:
    """Return the branches whose tips are at most ``depth`` (m) below the highest tip."""
    tips = [float(branch.points[-1] @ shape.up) if branch.ends_freely else -np.inf for branch in shape.branches]
    return [branch for branch, tip in zip(shape.branches, tips, strict=True) if tip >= max(tips) - depth > -np.inf]


def _necks(branch: Branch) -> Iterator[int]:
    """Yield the point of each neck of a branch, starting at the end of the branch."""
    areas = np.pad(branch.radii**2, _NECK_WINDOW // 2, mode="edge")
    radii = np.sqrt(np.convolve(areas, np.full(_NECK_WINDOW, 1.0 / _NECK_WINDOW), mode="valid"))
    for k in range(len(radii) - 2, 0, -1):
        is_narrowest = radii[k] <= min(radii[k - 1], radii[k + 1])
        if is_narrowest and _NECK * radii[k] <= min(radii[:k].max(), radii[k + 1 :].max()):
            yield k


def _above(shape: Skeleton, branch: Branch, neck: int) -> set[int]:
    """Return the sections of ``branch`` after the point ``neck``, and the sections of the branches that start there."""
    sections = {section for numbers in branch.sections[neck + 1 :] for section in numbers}
    starting = [
        other
        for other in shape.branches
        if other is not branch and not other.starts_on_ground and sections.intersection(other.sections[0])
    ]
    return sections.union(*(_own_sections(other) for other in starting))


def _own_sections(branch: Branch) -> set[int]:
    return {section for numbers, own in zip(branch.sections, branch.own, strict=True) if own for section in numbers}
