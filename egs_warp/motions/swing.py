"""Swing of a part about its joint: the axis and the angles with which its tip is high, travels far in the picture of a
film, and keeps clear of the rest of the body and of the ground (docs/motions/gestures.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from egs_warp.deformation.embedding import CageLocator
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.motions.body_parts import FreeBranch
from egs_warp.motions.sequence import Stance
from egs_warp.precision import Vec3

TRAVEL = 0.3
"""Travel of the tip between the ends of a swing, body heights."""
MIN_SWING, MAX_SWING = 36.0, 72.0
"""Limits of the angle between the ends of a swing, degrees."""
MAX_ANGLE = 120.0
"""Largest angle between the rest position and the upper end of a swing, degrees."""
LOW_FRACTION = 0.2
"""Smallest angle of the lower end of a swing, as a fraction of the angle of the upper end."""
_OUTSIDE_VALUE = 0.2
"""Value of a part that is outside the outline of the rest in the picture, relative to a travel of one body height."""
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
_RISE_FRACTION = 0.5
"""Value of the mean height of the tip relative to its travel in the picture."""


@dataclass(frozen=True)
class Swing:
    """Swing of a part about its joint."""

    axis: np.ndarray
    """(3,) Unit vector, ground axes (forward, left, up)."""
    degrees: float
    """Angle of the upper end of the swing, from the rest position."""
    low: float
    """Angle of the lower end, degrees."""
    arm: float
    """Distance of the tip from the axis, body heights."""
    joint: np.ndarray
    """(3,) m, joint of the part, body axes."""
    rise: float
    """Height of the tip above the joint at the upper end of the swing, body heights."""

    @property
    def travel(self) -> float:
        """Distance between the ends of the tip's swing, body heights."""
        return 2.0 * self.arm * float(np.sin(0.5 * np.radians(self.degrees - self.low)))


def find_swing(stance: Stance, branch: FreeBranch, degrees: float) -> Swing:
    """Return the swing of ``branch`` with the upper end at ``degrees``; for 0, this angle is found, too.

    Axes orthogonal to the part are compared and, if ``degrees`` is 0, angles up to the largest one at which the part is
    clear of the rest of the body and of the ground. The larger the travel of the tip in the picture of the film
    (``Stance.view``), up to ``TRAVEL``, the higher the tip, and the more of the part is outside the outline of the
    rest, the better. The angle between the ends of a swing follows from the length of the part, so that its tip
    travels ``TRAVEL``.
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
    angles = 2.0 * np.pi / _AXES * np.arange(_AXES)
    axes = np.cos(angles)[:, None] * across[0] + np.sin(angles)[:, None] * across[1]
    arms = np.linalg.norm(tip - (axes @ tip)[:, None] * axes, axis=1)
    clear_angles = np.maximum(_clear_angles(stance, branch.nodes, joint, axes @ turn), _ANGLE_STEP)
    is_outside = _outside_outline(stance, branch.nodes)
    outer = offsets[lengths > _OUTER * lengths.max()]
    centre = turn @ (joint - nodes.mean(axis=0)) / height
    # A height is not visible from above.
    rise_value, best, highest = _RISE_FRACTION * (1.0 - view[2] ** 2), None, -np.inf
    for axis, arm, clear in zip(axes, arms.tolist(), clear_angles.tolist(), strict=True):
        for upper in [degrees] if degrees else np.arange(_ANGLE_STEP, clear + 1.0, _ANGLE_STEP).tolist():
            lower = max(upper - _angle_of_chord(arm), LOW_FRACTION * upper)
            # An angle that is given may be too large for some of the axes.
            turns = [Rotation.from_rotvec(min(end, clear) * axis, degrees=True) for end in (lower, upper)]
            low, high = (each.apply(tip) for each in turns)
            travel = high - low
            seen = min(float(np.linalg.norm(travel - (travel @ view) * view)), TRAVEL)
            outside = float(np.mean([is_outside(centre + each.apply(outer)) for each in turns]))
            value = seen + rise_value * 0.5 * float(low[2] + high[2]) + _OUTSIDE_VALUE * outside
            if value > highest:
                tip_at_end = Rotation.from_rotvec(upper * axis, degrees=True).apply(tip)
                best, highest = Swing(axis, upper, lower, arm, joint, float(tip_at_end[2])), value
    assert best is not None
    return best


def _outside_outline(stance: Stance, part: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that maps points (n, 3), ground axes, body heights, relative to the mean of the nodes, to (n,)
    bool, True outside the outline of the body without the nodes ``part`` (k,) in the picture of the film."""
    body, view = stance.body, stance.view()
    picture = np.linalg.svd(view[None])[2][1:].T
    turn = stance.ground.axes @ body.best_fit_rotation(stance.standing)
    points = (body.mesh.nodes - body.mesh.nodes.mean(axis=0)) @ turn.T / body.height
    tets = body.mesh.tets[~np.isin(body.mesh.tets, part).any(axis=1)]
    shown = points[tets].mean(axis=1) @ picture
    edges = np.linalg.norm(points[tets[:, 1:]] - points[tets[:, :1]], axis=2)
    tree = KDTree(shown)
    return lambda points: np.asarray(tree.query(points @ picture)[0]) > float(edges.mean())


def _angle_of_chord(arm: float) -> float:
    """Return the angle in degrees of a swing whose tip, at the distance ``arm`` (body heights), travels ``TRAVEL``,
    between ``MIN_SWING`` and ``MAX_SWING``."""
    angle = float(np.degrees(2.0 * np.arcsin(min(0.5 * TRAVEL / arm, 1.0))))
    return float(np.clip(angle, MIN_SWING, MAX_SWING))


def _joint(part: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return the point (3,) about which a part with its nodes at ``part`` (k, 3) rotates: their mean near ``root``
    (3,)."""
    away = np.linalg.norm(part - root, axis=1)
    return part[away <= np.quantile(away, _JOINT_SHARE)].mean(axis=0)


def _clear_angles(stance: Stance, part: np.ndarray, joint: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return for each axis the largest angle in degrees, at most ``MAX_ANGLE``, up to which the outer nodes of a part
    are clear of the rest of the body and of the ground if the part rotates about the axis through its joint.

    Args:
        stance: Stance of the body.
        part: (k,) Nodes of the part.
        joint: (3,) m, joint of the part, body axes.
        axes: (A, 3) Unit vectors, body axes.
    """
    mesh, height = stance.body.mesh, stance.body.height
    offsets = mesh.nodes[part] - joint
    lengths = np.linalg.norm(offsets, axis=1)
    outer = offsets[lengths > _OUTER * lengths.max()]
    up = stance.body.best_fit_rotation(stance.standing).T @ stance.ground.axes[2]
    lowest = float((mesh.nodes @ up).min())
    floor = min(lowest + _GROUND_GAP * height, float(((joint + outer) @ up).min()))
    is_in_rest = _locator_without(mesh, part)
    angles = np.zeros(len(axes))
    rows, angle = np.arange(len(axes)), _ANGLE_STEP
    while len(rows) > 0 and angle <= MAX_ANGLE:
        turns = Rotation.from_rotvec(angle * axes[rows], degrees=True).as_matrix()
        points = joint + outer @ turns.swapaxes(1, 2)
        is_clear = (points @ up).min(axis=1) >= floor
        is_clear[is_clear] = ~is_in_rest(points[is_clear].reshape(-1, 3)).reshape(-1, len(outer)).any(axis=1)
        rows = rows[is_clear]
        angles[rows] = angle
        angle += _ANGLE_STEP
    return angles


def _locator_without(mesh: TetMesh, part: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that maps points (n, 3) to (n,) bool, True in the tetrahedra of ``mesh`` that have no node of a
    ``part`` (k,)."""
    tets = mesh.tets[~np.isin(mesh.tets, part).any(axis=1)]
    if len(tets) == 0:
        return lambda points: np.zeros(len(points), bool)
    used, corners = np.unique(tets, return_inverse=True)
    rest = TetMesh(mesh.nodes[used], corners.reshape(tets.shape))
    low, high = rest.nodes.min(axis=0), rest.nodes.max(axis=0)
    locator = CageLocator(rest)

    def is_inside(points: np.ndarray) -> np.ndarray:
        result = ((points > low) & (points < high)).all(axis=1)
        if result.any():
            near = wp.array(points[result], dtype=Vec3, device=locator.device)
            result[result] = locator.locate(near).inside.numpy()
        return result

    return is_inside
