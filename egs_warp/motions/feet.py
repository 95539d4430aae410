"""Feet and legs of a body: separate patches on the ground, and the limbs that carry the body on them.

See docs/concepts/motions.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from egs_warp.contact.detection import ContactSet
from egs_warp.errors import UserError
from egs_warp.geometry.tetmesh import TetMesh, edge_graph
from egs_warp.locomotion.stepper import StepReport

_GROUND = 0.02
"""Body heights: nodes at most this high stand on the ground."""
_FOOT = 0.1
"""Body heights: ground patches that meet below this are one foot."""
_FLAT = 0.15
"""Part of a leg, from the ground up, that moves with the foot as one."""


@dataclass(frozen=True)
class Foot:
    """One foot and the leg above it."""

    sole: np.ndarray
    """(k,) nodes on the ground at rest."""
    leg: np.ndarray
    """(N,) 1 at the foot, falling smoothly to 0 where the leg joins the body, 0 elsewhere."""
    length: float
    """Metres from the ground to where the leg joins the body."""


def find_feet(mesh: TetMesh, heights: np.ndarray, body_height: float) -> tuple[Foot, ...]:
    """The separate feet of a standing body; ``heights`` (N,) of its nodes over the ground, ``body_height`` H, metres.

    A leg reaches up to where it first meets another foot's leg.
    """
    graph = edge_graph(mesh)
    on_ground = heights < heights.min() + _GROUND * body_height
    labels = _patches(graph, heights < heights.min() + _FOOT * body_height)
    patches = [np.flatnonzero(labels == label) for label in np.unique(labels[on_ground])]
    levels = np.unique(heights[heights >= heights.min() + _FOOT * body_height])
    limbs = list(patches)
    tops = np.full(len(patches), _FOOT * body_height)
    apart = np.ones(len(patches), bool)
    for level in levels:
        labels = _patches(graph, heights <= level)
        met = np.array([labels[patch[0]] for patch in patches])
        for i in np.flatnonzero(apart):
            if (met == met[i]).sum() > 1:
                apart[i] = False
            else:
                limbs[i], tops[i] = np.flatnonzero(labels == met[i]), level - heights.min()
    return tuple(
        Foot(patch[on_ground[patch]], _leg_weights(heights - heights.min(), limb, top), float(top))
        for patch, limb, top in zip(patches, limbs, tops, strict=True)
    )


def feet_around(feet: Sequence[Foot], positions: np.ndarray, up: np.ndarray) -> tuple[int, int, int, int]:
    """Indices of the feet of a four-legged body at ``positions`` (N, 3), anticlockwise seen against ``up`` (3,),
    unit.
    """
    if len(feet) != 4:
        raise UserError(f"walk: a walk needs four separate feet, the body has {len(feet)}")
    centres = np.array([positions[foot.sole].mean(axis=0) for foot in feet])
    arms = centres - centres.mean(axis=0)
    side = arms[0] - (arms[0] @ up) * up
    first, second, third, fourth = np.argsort(np.arctan2(arms @ np.cross(up, side), arms @ side) % (2.0 * np.pi))
    return int(first), int(second), int(third), int(fourth)


def foot_of_node(feet: Sequence[Foot]) -> np.ndarray:
    """(N,) index of the foot that each node goes with; 0 where it goes with none."""
    return np.argmax([foot.leg for foot in feet], axis=0)


def foot_of_contact(feet: Sequence[Foot], contacts: ContactSet) -> np.ndarray:
    """(n,) index of the foot that each contact point goes with."""
    return foot_of_node(feet)[contacts.nearest]


def foot_loads(feet: Sequence[Foot], report: StepReport | None, weight: float) -> np.ndarray:
    """(feet,) share of ``weight`` (newtons) that each foot carried in a step."""
    loads = np.zeros(len(feet))
    if report is not None:
        np.add.at(loads, foot_of_contact(feet, report.contacts), report.forces[:, 0] / weight)
    return loads


def _patches(graph: csr_matrix, kept: np.ndarray) -> np.ndarray:
    """(N,) label of each kept node's connected patch, -1 for the rest."""
    nodes = np.flatnonzero(kept)
    labels = np.full(len(kept), -1)
    labels[nodes] = connected_components(graph[nodes][:, nodes], directed=False)[1]
    return labels


def _leg_weights(heights: np.ndarray, limb: np.ndarray, top: float) -> np.ndarray:
    weights = np.zeros(len(heights))
    s = np.clip((heights[limb] / top - _FLAT) / (1.0 - _FLAT), 0.0, 1.0)
    weights[limb] = 1.0 - s * s * (3.0 - 2.0 * s)
    return weights
