"""Feet and legs of a body: the limbs that support it, and their soles on the ground.

See docs/motions/index.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from egs_warp.contact.contact_set import ContactSet
from egs_warp.fem.body import SoftBody
from egs_warp.geometry.tetmesh import TetMesh, edge_graph, mean_edge_length
from egs_warp.locomotion.objectives import BodyPart, Coordinates, Objective, part_velocity
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.limbs import Limbs, Sections, find_limbs

_SOLE_HEIGHT = 0.02
"""Height of the sole in body heights: nodes up to this height above the lowest node of a foot belong to its sole."""
_FOOT_HEIGHT = 0.1
"""Height, in body heights, of the lowest part of a body or leg, which is its base or foot. Junctions of legs below this
height are ignored."""
_RIGID_FRACTION = 0.15
"""Fraction of a leg, from the ground up, that moves rigidly with the foot."""
_LYING_RATIO = 3.0
"""Ratio of the length of a base to its width, and to the body height, above which the body lies and has no feet."""
_MAX_ROUND_SOLE, _MAX_ROUND_DEVIATION = 0.6, 0.15
"""Conditions for a ball: maximum width of the sole relative to the width of the body, and maximum ratio of the standard
deviation to the mean of the distances from its centre to its surface."""
_SIDE_HEIGHT, _MIDDLE_FRACTION, _BLEND_FRACTION = 0.3, 0.2, 0.6
"""Parameters of a base that is split into two feet: height in body heights up to which a side moves as a foot, width of
the middle strip that belongs to neither foot, and width over which the sides blend, both as fractions of the half
width."""
_HELD_LOAD = 0.1
"""Load of a foot, as a fraction of the body weight, at and above which its no-slip objective has its full weight."""
FIRST_FOOT_ANGLE = np.radians(15.0)
"""Maximum angle, in radians to the right of straight ahead, at which a foot can be the first."""


class SupportKind(Enum):
    """Kind of support of a body."""

    FEET = "feet"
    """Two feet or more."""
    SINGLE_BASE = "one base"
    ROUND_BASE = "a round base"
    """A round base, which can roll."""
    LYING = "its length"
    """The body lies along the ground and has no foot."""


@dataclass(frozen=True)
class Foot:
    """One foot and the leg above it."""

    sole: np.ndarray
    """(k,) indices of the nodes on the ground at rest."""
    leg: np.ndarray
    """(N,) weights: 1 at the foot, falling smoothly to 0 where the leg joins the body, 0 elsewhere."""
    length: float
    """Height above the ground of the top of the leg, where it joins the body, m."""
    height: float = 0.0
    """Height of the lowest node of the foot above the lowest node of the body, m; the length of the leg is reduced by
    it."""
    is_joined: bool = False
    """True if an edge of the cage connects the foot to another foot below the height at which their legs join."""


def find_feet(mesh: TetMesh, heights: np.ndarray, body_height: float, limbs: Limbs | None = None) -> tuple[Foot, ...]:
    """Return the feet of a standing body; none if it lies along the ground.

    A leg reaches up to where it first joins another foot's leg.

    Args:
        mesh: cage of the body.
        heights: (N,) heights of the nodes above the ground, m.
        body_height: H, m.
        limbs: limbs of the capture, between which gaps may be narrower than the cage resolves; None finds the limbs in
            the cage.
    """
    limbs = limbs or find_limbs(Sections.of_mesh(mesh, heights), mesh.nodes)
    above = heights - heights.min()
    if limbs.count == 1:
        if support_kind_of(mesh, heights, 1) is SupportKind.LYING:
            return ()
        sole = np.flatnonzero(above < _SOLE_HEIGHT * body_height)
        everything = np.arange(len(above))
        return (Foot(sole, _leg_weights(above, everything, float(above.max())), float(above.max())),)
    graph = edge_graph(mesh)
    candidates = [(np.flatnonzero(limbs.limb_from_node == limb), top) for limb, top in enumerate(limbs.tops)]
    candidates = [(nodes, top) for nodes, top in candidates if len(nodes)]
    candidates.sort(key=lambda one: int(one[0][above[one[0]] < above[one[0]].min() + _FOOT_HEIGHT * body_height].min()))
    roots = [nodes for nodes, _ in candidates]
    legs, tops = list(roots), [top for _, top in candidates]
    lowest = [int(nodes[np.argmin(above[nodes])]) for nodes in roots]
    apart = np.ones(len(roots), bool)
    for level in np.unique(heights[above >= _FOOT_HEIGHT * body_height]):
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
            nodes[above[nodes] < above[nodes].min() + _SOLE_HEIGHT * body_height],
            _leg_weights(above, leg, top),
            top,
            float(above[nodes].min()),
            one,
        )
        for nodes, leg, top, one in zip(roots, legs, tops, _are_joined(graph, roots, above), strict=True)
    )


def support_kind_of(mesh: TetMesh, heights: np.ndarray, foot_count: int) -> SupportKind:
    """Return the kind of support of a body.

    Args:
        mesh: cage of the body.
        heights: (N,) heights of the nodes above the ground, m.
        foot_count: number of feet, or of limbs that reach the ground.
    """
    if foot_count > 1:
        return SupportKind.FEET
    nodes = mesh.nodes[np.unique(mesh.boundary_faces())]
    size = float(np.ptp(heights))
    up = _up(mesh, heights)
    flat = mesh.nodes - np.outer(mesh.nodes @ up, up)
    long, wide = _sides(flat[heights < heights.min() + _FOOT_HEIGHT * size])
    if long > _LYING_RATIO * max(wide, size):
        return SupportKind.LYING
    edge = 0.5 * mean_edge_length(mesh)
    sole, _ = _sides(flat[heights < heights.min() + _SOLE_HEIGHT * size])
    away = np.linalg.norm(nodes - np.average(mesh.nodes, axis=0, weights=mesh.lumped_masses(1.0)), axis=1)
    # Reduce the width of the sole by ``edge``: the flat faces of a coarse cage widen the sole of a round body.
    is_ball = (
        float(away.std()) < _MAX_ROUND_DEVIATION * float(away.mean())
        and sole - edge < _MAX_ROUND_SOLE * _sides(flat)[0]
    )
    return SupportKind.ROUND_BASE if is_ball else SupportKind.SINGLE_BASE


def order_counterclockwise(positions: np.ndarray) -> np.ndarray:
    """Return the order (feet,) of feet, counterclockwise as seen from above and beginning straight ahead.

    ``positions`` (feet, 2) are the coordinates of the feet forward and to the left.
    """
    ahead, left = (positions - positions.mean(axis=0)).T
    return np.argsort((np.arctan2(left, ahead) + FIRST_FOOT_ANGLE) % (2.0 * np.pi))


def split_base(positions: np.ndarray, heights: np.ndarray, sole: np.ndarray, body_height: float) -> tuple[Foot, Foot]:
    """Split a base into two feet, its left and its right side, without the nodes near the middle.

    Args:
        positions: (N, 2) m, coordinates of each node forward and to the left.
        heights: (N,) m, heights of the nodes above the ground.
        sole: (k,) indices of the nodes that stand on the ground.
        body_height: H, m.
    """
    left = positions[:, 1]
    middle = float(left[sole].mean())
    half = 0.5 * float(np.ptp(left[sole]))
    low = 1.0 - smooth_step(heights / (_SIDE_HEIGHT * body_height))
    first, second = (
        Foot(
            sole[side * (left[sole] - middle) > _MIDDLE_FRACTION * half],
            smooth_step(0.5 + side * (left - middle) / (_BLEND_FRACTION * half)) * low,
            _SIDE_HEIGHT * body_height,
        )
        for side in (1.0, -1.0)
    )
    return first, second


def foot_of_node(feet: Sequence[Foot]) -> np.ndarray:
    """Return the index (N,) of the foot to which each node belongs; 0 for nodes that belong to no foot."""
    return np.argmax([foot.leg for foot in feet], axis=0)


def foot_of_contact(feet: Sequence[Foot], contacts: ContactSet) -> np.ndarray:
    """Return the index (n,) of the foot to which each contact point belongs."""
    return foot_of_node(feet)[contacts.nearest_nodes]


def foot_loads(feet: Sequence[Foot], report: StepReport | None, weight: float) -> np.ndarray:
    """Return the share (feet,) of ``weight``, in newtons, that each foot carried in a time step."""
    loads = np.zeros(len(feet))
    if report is not None:
        np.add.at(loads, foot_of_contact(feet, report.contacts), report.forces[:, 0] / weight)
    return loads


def no_slip_feet(
    body: SoftBody, feet: Sequence[Foot], contacts: ContactSet, loads: np.ndarray, axes: np.ndarray, weight: float
) -> list[Objective]:
    """Return one objective for each loaded foot: zero sliding velocity at its centre of pressure. The foot may turn
    about this point.

    The weight of the objective decreases only below a load of ``_HELD_LOAD``: the sole is strained, and a foot that is
    being unloaded would otherwise slide until the strain is released.

    Args:
        body: the body.
        feet: feet of the body.
        contacts: contacts of the previous time step.
        loads: (n,) load of each contact by which the mean is weighted, as a fraction of the body weight; 0 excludes a
            contact.
        axes: (2, 3) unit vectors along the ground.
        weight: weight of the objective of one foot.
    """
    objectives = []
    owner = foot_of_contact(feet, contacts)
    for index in range(len(feet)):
        own = np.where(owner == index, loads, 0.0)
        load = float(own.sum())
        if load <= 0.0:
            continue
        shares = np.bincount(
            contacts.nodes.ravel(), (own[:, None] * contacts.weights).ravel(), minlength=len(body.node_mass)
        )
        nodes = np.flatnonzero(shares)
        part = BodyPart(f"foot {index} contact", nodes, shares[nodes])
        held = weight * min(1.0, load / _HELD_LOAD)
        objectives.append(part_velocity(body, part, np.zeros(len(axes)), held, Coordinates(axes, False)))
    return objectives


def _are_joined(graph: csr_matrix, limbs: Sequence[np.ndarray], above: np.ndarray) -> list[bool]:
    """Return, for each limb, True if an edge connects its lower half to the lower half of another limb.

    Args:
        graph: (N, N) edges of the cage.
        limbs: nodes (k,) of each limb.
        above: (N,) heights of the nodes above the ground.
    """
    lower = np.full(len(above), -1)
    for limb, nodes in enumerate(limbs):
        lower[nodes[above[nodes] <= 0.5 * above[nodes].max()]] = limb
    edges = graph.tocoo()
    first, second = lower[edges.row], lower[edges.col]
    met = np.unique(first[(first != second) & (first >= 0) & (second >= 0)])
    return [limb in met for limb in range(len(limbs))]


def _up(mesh: TetMesh, heights: np.ndarray) -> np.ndarray:
    """Return the (3,) unit vector along which the ``heights`` (N,) of the nodes increase."""
    arms = mesh.nodes - mesh.nodes.mean(axis=0)
    up = np.linalg.lstsq(arms, heights - heights.mean(), rcond=None)[0]
    return up / np.linalg.norm(up)


def _sides(flat: np.ndarray) -> tuple[float, float]:
    """Return the length and width in metres of coplanar points (n, 3), along their principal axes."""
    middle = flat.mean(axis=0)
    across = np.linalg.svd(flat - middle, full_matrices=False)[2][:2]
    spans = np.ptp((flat - middle) @ across.T, axis=0)
    return float(spans.max()), float(spans.min())


def _connected_patches(graph: csr_matrix, mask: np.ndarray) -> np.ndarray:
    """Return the (N,) label of the connected patch of each node in ``mask`` (N,), -1 for the other nodes."""
    nodes = np.flatnonzero(mask)
    labels = np.full(len(mask), -1)
    labels[nodes] = connected_components(graph[nodes][:, nodes], directed=False)[1]
    return labels


def _leg_weights(heights: np.ndarray, limb: np.ndarray, top: float) -> np.ndarray:
    weights = np.zeros(len(heights))
    weights[limb] = 1.0 - smooth_step((heights[limb] / top - _RIGID_FRACTION) / (1.0 - _RIGID_FRACTION))
    return weights


def smooth_step(s: np.ndarray) -> np.ndarray:
    """Cubic smoothstep: from 0 at 0 to 1 at 1, with zero slope at both ends; clamped outside."""
    s = np.clip(s, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)
