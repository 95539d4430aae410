"""Swing of a part about its joint: the axis and the angle with which its tip travels far in the picture of a film and
keeps clear of the rest of the body and of the ground (docs/motions/gestures.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.deformation.embedding import CageLocator
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.motions.body_parts import FreeBranch
from egs_warp.motions.sequence import Stance
from egs_warp.precision import Vec3

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
    angles = 2.0 * np.pi / _AXES * np.arange(_AXES)
    axes = np.cos(angles)[:, None] * across[0] + np.sin(angles)[:, None] * across[1]
    arms = np.linalg.norm(tip - (axes @ tip)[:, None] * axes, axis=1)
    wanted = np.array([degrees or float(np.clip(_angle_of_chord(arm), MIN_ANGLE, MAX_ANGLE)) for arm in arms])
    clear_angles = np.minimum(_clear_angles(stance, branch.nodes, joint, axes @ turn, wanted), wanted)
    best, highest = None, -np.inf
    for axis, arm, clear in zip(axes, arms.tolist(), clear_angles.tolist(), strict=True):
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


def _clear_angles(
    stance: Stance, part: np.ndarray, joint: np.ndarray, axes: np.ndarray, largest: np.ndarray
) -> np.ndarray:
    """Return for each axis the largest angle in degrees, at most about ``largest``, up to which the outer nodes of a
    part are clear of the rest of the body and of the ground if the part rotates about the axis through its joint.

    Args:
        stance: Stance of the body.
        part: (k,) Nodes of the part.
        joint: (3,) m, joint of the part, body axes.
        axes: (A, 3) Unit vectors, body axes.
        largest: (A,) Degrees.
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
    while len(rows := rows[largest[rows] > angle - _ANGLE_STEP]) > 0:
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
