"""Feet and legs of a body: the limbs that carry it, and where these stand on the ground.

See docs/motions/index.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from egs_warp.contact.detection import ContactSet
from egs_warp.geometry.tetmesh import TetMesh, edge_graph, mean_edge_length
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.limbs import Limbs, Sections, find_limbs

_GROUND = 0.02
"""Body heights: nodes at most this high above the lowest of a foot are its sole."""
_FOOT = 0.1
"""Body heights: below this a foot and its leg are one."""
_FLAT = 0.15
"""Part of a leg, from the ground up, that moves with the foot as one."""
_LONG = 3.0
"""Body heights and own widths: a base this long has no feet."""
_ROUND_SOLE, _ROUND = 0.6, 0.15
"""A ball stands on less than this part of its width, and its surface is as far from its middle everywhere but for a
standard deviation of this part."""
_HALF, _MIDDLE, _BETWEEN = 0.3, 0.2, 0.6
"""Of a base that is taken for two feet: body heights up to which a side of it moves as a foot does, the part of its
half width next to the middle that belongs to none, and the part over which the one side goes over into the other."""
FIRST_FOOT_ANGLE = np.radians(15.0)
"""A foot this little to the right of straight ahead is still the first."""


class SupportKind(Enum):
    """What a body stands on."""

    FEET = "feet"
    """Two or more."""
    SINGLE_BASE = "one base"
    ROUND_BASE = "a round base"
    """It can roll."""
    LYING = "its length"
    """It lies, and has no foot."""


@dataclass(frozen=True)
class Foot:
    """One foot and the leg above it."""

    sole: np.ndarray
    """(k,) nodes on the ground at rest."""
    leg: np.ndarray
    """(N,) 1 at the foot, falling smoothly to 0 where the leg joins the body, 0 elsewhere."""
    length: float
    """Metres from the ground to where the leg joins the body."""
    height: float = 0.0
    """Metres of its lowest node over that of the body: the leg is so much short."""
    is_joined: bool = False
    """The cage joins it to another foot by an edge below where the legs meet."""


def find_feet(mesh: TetMesh, heights: np.ndarray, body_height: float, limbs: Limbs | None = None) -> tuple[Foot, ...]:
    """The feet of a standing body, none if it lies along the ground; ``heights`` (N,) of its nodes over the ground,
    ``body_height`` H, metres.

    ``limbs`` are those of the capture, whose gaps may be finer than the cage's; without them, those of the cage. A leg
    reaches up to where it first meets another foot's leg.
    """
    limbs = limbs or find_limbs(Sections.of_mesh(mesh, heights), mesh.nodes)
    above = heights - heights.min()
    if limbs.count == 1:
        if support_kind_of(mesh, heights, 1) is SupportKind.LYING:
            return ()
        sole = np.flatnonzero(above < _GROUND * body_height)
        everything = np.arange(len(above))
        return (Foot(sole, _leg_weights(above, everything, float(above.max())), float(above.max())),)
    graph = edge_graph(mesh)
    found = [(np.flatnonzero(limbs.limb_from_node == limb), top) for limb, top in enumerate(limbs.tops)]
    found = [(nodes, top) for nodes, top in found if len(nodes)]
    found.sort(key=lambda one: int(one[0][above[one[0]] < above[one[0]].min() + _FOOT * body_height].min()))
    roots = [nodes for nodes, _ in found]
    legs, tops = list(roots), [top for _, top in found]
    lowest = [int(nodes[np.argmin(above[nodes])]) for nodes in roots]
    apart = np.ones(len(roots), bool)
    for level in np.unique(heights[above >= _FOOT * body_height]):
        labels = _connected_patches(graph, heights <= level)
        met = labels[lowest]
        for i in np.flatnonzero(apart & (met >= 0)):
            if (met == met[i]).sum() > 1:
                apart[i] = False
            else:
                legs[i], tops[i] = np.flatnonzero(labels == met[i]), float(level - heights.min())
        if not apart.any():
            break
    return tuple(
        Foot(
            nodes[above[nodes] < above[nodes].min() + _GROUND * body_height],
            _leg_weights(above, leg, top),
            top,
            float(above[nodes].min()),
            one,
        )
        for nodes, leg, top, one in zip(roots, legs, tops, _joined(graph, roots, above), strict=True)
    )


def support_kind_of(mesh: TetMesh, heights: np.ndarray, foot_count: int) -> SupportKind:
    """What a body stands on that has so many feet, or limbs that reach the ground; ``heights`` (N,): see
    ``find_feet``."""
    if foot_count > 1:
        return SupportKind.FEET
    nodes = mesh.nodes[np.unique(mesh.boundary_faces())]
    size = float(np.ptp(heights))
    up = _up(mesh, heights)
    flat = mesh.nodes - np.outer(mesh.nodes @ up, up)
    long, wide = _sides(flat[heights < heights.min() + _FOOT * size])
    if long > _LONG * max(wide, size):
        return SupportKind.LYING
    edge = 0.5 * mean_edge_length(mesh)
    sole, _ = _sides(flat[heights < heights.min() + _GROUND * size])
    away = np.linalg.norm(nodes - np.average(mesh.nodes, axis=0, weights=mesh.lumped_masses(1.0)), axis=1)
    # A coarse cage is flat where the body is round.
    is_ball = float(away.std()) < _ROUND * float(away.mean()) and sole - edge < _ROUND_SOLE * _sides(flat)[0]
    return SupportKind.ROUND_BASE if is_ball else SupportKind.SINGLE_BASE


def order_counterclockwise(places: np.ndarray) -> np.ndarray:
    """(feet,) indices of the feet at ``places`` (feet, 2), forward and left, as they are numbered: anticlockwise as
    seen from above, from straight ahead on."""
    ahead, left = (places - places.mean(axis=0)).T
    return np.argsort((np.arctan2(left, ahead) + FIRST_FOOT_ANGLE) % (2.0 * np.pi))


def split_base(
    place_of_sole: np.ndarray, heights: np.ndarray, sole: np.ndarray, body_height: float
) -> tuple[Foot, Foot]:
    """The left and the right side of a base as two feet, each without what is near the middle.

    ``place_of_sole`` (N, 2) is ahead and to the left of each node, ``heights`` (N,) over the ground, ``sole`` (k,) the
    nodes that stand on it.
    """
    left = place_of_sole[:, 1]
    middle = float(left[sole].mean())
    half = 0.5 * float(np.ptp(left[sole]))
    low = 1.0 - smooth_step(heights / (_HALF * body_height))
    first, second = (
        Foot(
            sole[side * (left[sole] - middle) > _MIDDLE * half],
            smooth_step(0.5 + side * (left - middle) / (_BETWEEN * half)) * low,
            _HALF * body_height,
        )
        for side in (1.0, -1.0)
    )
    return first, second


def foot_of_node(feet: Sequence[Foot]) -> np.ndarray:
    """(N,) index of the foot that each node goes with; 0 where it goes with none."""
    return np.argmax([foot.leg for foot in feet], axis=0)


def foot_of_contact(feet: Sequence[Foot], contacts: ContactSet) -> np.ndarray:
    """(n,) index of the foot that each contact point goes with."""
    return foot_of_node(feet)[contacts.nearest_nodes]


def foot_loads(feet: Sequence[Foot], report: StepReport | None, weight: float) -> np.ndarray:
    """(feet,) share of ``weight`` (newtons) that each foot carried in a step."""
    loads = np.zeros(len(feet))
    if report is not None:
        np.add.at(loads, foot_of_contact(feet, report.contacts), report.forces[:, 0] / weight)
    return loads


def _joined(graph: csr_matrix, limbs: Sequence[np.ndarray], above: np.ndarray) -> list[bool]:
    """Whether the lower half of each limb, a list of nodes, has an edge to another's; nodes are ``above`` (N,) the
    ground."""
    lower = np.full(len(above), -1)
    for limb, nodes in enumerate(limbs):
        lower[nodes[above[nodes] <= 0.5 * above[nodes].max()]] = limb
    edges = graph.tocoo()
    first, second = lower[edges.row], lower[edges.col]
    met = np.unique(first[(first != second) & (first >= 0) & (second >= 0)])
    return [limb in met for limb in range(len(limbs))]


def _up(mesh: TetMesh, heights: np.ndarray) -> np.ndarray:
    """(3,) unit, along which the ``heights`` (N,) of the nodes grow."""
    arms = mesh.nodes - mesh.nodes.mean(axis=0)
    up = np.linalg.lstsq(arms, heights - heights.mean(), rcond=None)[0]
    return up / np.linalg.norm(up)


def _sides(flat: np.ndarray) -> tuple[float, float]:
    """Length and width of points (n, 3) that lie in a plane: of the narrowest strip that holds them."""
    middle = flat.mean(axis=0)
    across = np.linalg.svd(flat - middle, full_matrices=False)[2][:2]
    spans = np.ptp((flat - middle) @ across.T, axis=0)
    return float(spans.max()), float(spans.min())


def _connected_patches(graph: csr_matrix, kept: np.ndarray) -> np.ndarray:
    """(N,) label of each kept node's connected patch, -1 for the rest."""
    nodes = np.flatnonzero(kept)
    labels = np.full(len(kept), -1)
    labels[nodes] = connected_components(graph[nodes][:, nodes], directed=False)[1]
    return labels


def _leg_weights(heights: np.ndarray, limb: np.ndarray, top: float) -> np.ndarray:
    weights = np.zeros(len(heights))
    weights[limb] = 1.0 - smooth_step((heights[limb] / top - _FLAT) / (1.0 - _FLAT))
    return weights


def smooth_step(s: np.ndarray) -> np.ndarray:
    """From 0 at 0 to 1 at 1, at rest at both."""
    s = np.clip(s, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)
