"""Swing of a part about its joint: the axis and the angle with which its tip travels far in the picture of a film and
keeps clear of the rest of the body and of the ground (docs/motions/gestures.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.motions.body_parts import FreeBranch
from egs_warp.motions.sequence import Stance

TRAVEL = 0.3
"""Travel of the tip between the ends of a swing, body heights."""
MIN_ANGLE, MAX_ANGLE = 45.0, 90.0
"""Limits of the angle of a swing that is computed from the length of the part, degrees."""
LOW_FRACTION = 0.2
"""Angle of the lower end of a swing, as a fraction of the angle of the upper end."""
_AXES = 24
"""Number of axes that are compared."""
_ANGLE_STEP = 15.0
"""Step of the search for the largest angle at which a part is clear of the rest, degrees."""
_JOINT_SHARE = 0.25
"""Fraction of a part's nodes, nearest to its root, whose mean is its joint."""
_OUTER = 0.5
"""Nodes farther from the joint than this fraction of the part's length must be clear of the rest of the body and of the
ground; nodes near the joint bend with the body."""
_GROUND_GAP = 0.02
"""Minimum height of these nodes above the ground, body heights, unless they rest lower."""
_RISE_FRACTION = 0.25
"""Value of a rise of the tip relative to its travel in the picture."""


@dataclass(frozen=True)
class Swing:
    """Swing of a part about its joint."""

    axis: np.ndarray
    """(3,) Unit vector, ground axes (forward, left, up)."""
    degrees: float
    """Angle of the upper end of the swing."""
    arm: float
    """Distance of the tip from the axis, body heights."""

    @property
    def travel(self) -> float:
        """Distance between the ends of the tip's swing, body heights."""
        return _chord(self.arm, self.degrees)


def find_swing(stance: Stance, branch: FreeBranch, degrees: float) -> Swing:
    """Return the swing of ``branch`` by ``degrees``; for 0, the angle is computed from the length of the part, so that
    its tip travels ``TRAVEL``.

    Axes orthogonal to the part are compared: the larger the travel of the tip in the picture of the film
    (``Stance.view``) and the higher the tip rises, the better. The angle of the swing is reduced to the one up to which
    the part is clear of the rest of the body and of the ground; an angle that is given is not reduced.
    """
    height, view = stance.body.height, stance.view()
    turn = stance.ground.axes @ stance.body.best_fit_rotation(stance.standing)
    nodes = stance.body.mesh.nodes
    joint = _joint(nodes[branch.nodes], branch.root)
    offsets = (nodes[branch.nodes] - joint) @ turn.T / height
    lengths = np.linalg.norm(offsets, axis=1)
    tip, middle = offsets[np.argmax(lengths)], offsets.mean(axis=0)
    along = middle / np.linalg.norm(middle)
    across = np.linalg.svd(along[None])[2][1:]
    best, highest = None, -np.inf
    for angle in 2.0 * np.pi / _AXES * np.arange(_AXES):
        axis = np.cos(angle) * across[0] + np.sin(angle) * across[1]
        arm = float(np.linalg.norm(tip - (tip @ axis) * axis))
        wanted = degrees or float(np.clip(_angle_of_chord(arm), MIN_ANGLE, MAX_ANGLE))
        clear = min(_clear_angle(stance, branch.nodes, joint, turn.T @ axis, wanted), wanted)
        ends = [Rotation.from_rotvec(share * clear * axis, degrees=True).apply(tip) for share in (LOW_FRACTION, 1.0)]
        travel = ends[1] - ends[0]
        seen = float(np.linalg.norm(travel - (travel @ view) * view))
        value = seen + _RISE_FRACTION * float(ends[1][2] - tip[2])
        if value > highest:
            best, highest = Swing(axis, degrees or max(clear, _ANGLE_STEP), arm), value
    assert best is not None
    return best


def _chord(arm: float, degrees: float) -> float:
    return 2.0 * arm * float(np.sin(0.5 * np.radians((1.0 - LOW_FRACTION) * degrees)))


def _angle_of_chord(arm: float) -> float:
    """Return the angle in degrees of a swing whose tip, at the distance ``arm`` (body heights), travels ``TRAVEL``."""
    return float(np.degrees(2.0 * np.arcsin(min(0.5 * TRAVEL / arm, 1.0)))) / (1.0 - LOW_FRACTION)


def _joint(part: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return the point (3,) about which a part with its nodes at ``part`` (k, 3) rotates: their mean near ``root``
    (3,)."""
    away = np.linalg.norm(part - root, axis=1)
    return part[away <= np.quantile(away, _JOINT_SHARE)].mean(axis=0)


def _clear_angle(stance: Stance, part: np.ndarray, joint: np.ndarray, axis: np.ndarray, largest: float) -> float:
    """Return the largest angle in degrees, at most about ``largest``, up to which the outer nodes of a ``part`` (k,)
    are clear of the rest of the body and of the ground if it rotates about an ``axis`` (3,) through its ``joint`` (3,),
    body axes."""
    mesh, height = stance.body.mesh, stance.body.height
    offsets = mesh.nodes[part] - joint
    lengths = np.linalg.norm(offsets, axis=1)
    outer = offsets[lengths > _OUTER * lengths.max()]
    rest = mesh.tets[~np.isin(mesh.tets, part).any(axis=1)]
    corners = mesh.nodes[rest]
    inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).swapaxes(1, 2))
    up = stance.body.best_fit_rotation(stance.standing).T @ stance.ground.axes[2]
    lowest = float((mesh.nodes @ up).min())
    floor = min(lowest + _GROUND_GAP * height, float(((joint + outer) @ up).min()))
    clear = 0.0
    for angle in np.arange(_ANGLE_STEP, largest + _ANGLE_STEP, _ANGLE_STEP):
        points = joint + Rotation.from_rotvec(angle * axis, degrees=True).apply(outer)
        weights = np.einsum("tij,ptj->pti", inverse, points[:, None] - corners[:, 0])
        is_inside = (weights > 0.0).all(axis=2) & (weights.sum(axis=2) < 1.0)
        if is_inside.any() or (points @ up).min() < floor:
            break
        clear = float(angle)
    return clear
