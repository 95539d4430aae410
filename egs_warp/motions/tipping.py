"""Tipping of a rigid body over the edges of its convex hull: the height that its centre of mass has to reach, and the
largest energy with which the body comes to stand upright without tipping over the other side.

See docs/concepts/motions.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

_ANGLE_STEP = np.radians(2.0)
"""Angle between consecutive orientations at which heights are computed, radians."""
_NEXT_EDGE_ANGLE = 0.5 * np.pi
"""Angle past the upright orientation up to which the maximum on the other side is searched for, radians."""


@dataclass(frozen=True)
class TippingPath:
    """Heights of the centre of mass above the ground while a body is rotated to upright, and over the next edge, in
    contact with the ground."""

    top: float
    """m, maximum height of the centre of mass on the way to the upright orientation."""
    upright: float
    """m, height of the centre of mass of the upright body."""
    next_top: float
    """m, first maximum of the height on the way from the upright orientation to the other side."""
    speed_ratio: float
    """Ratio of the angular velocity about the last edge, after the base has landed flat on the ground, to the angular
    velocity about the first edge before. The angular momentum about the last edge is conserved in this impact."""
    inertia_ratio: float
    """Ratio of the moment of inertia about the last edge to the moment of inertia about the first edge."""

    @property
    def max_excess(self) -> float:
        """Largest kinetic energy at the top, divided by the weight, in metres, with which the body does not tip over
        the other side after the impact. It can be negative: a tall body on a narrow base tips over even from rest at
        the top, unless its muscles brake it."""
        if self.speed_ratio <= 0.0:
            return np.inf
        return (self.next_top - self.upright) / (self.speed_ratio**2 * self.inertia_ratio) - (self.top - self.upright)


def tipping_path(
    node_mass: np.ndarray, arms: np.ndarray, axis: np.ndarray, angle: float, normal: np.ndarray
) -> TippingPath:
    """Return the path of a body that is rotated about the horizontal ``axis``.

    Args:
        node_mass: (N,) kg, nodal masses.
        arms: (N, 3) m, nodes relative to the centre of mass.
        axis: (3,) horizontal unit vector.
        angle: rotation to the upright orientation, radians.
        normal: (3,) unit normal of the ground.
    """
    before = max(int(np.ceil(angle / _ANGLE_STEP)), 1)
    angles = np.concatenate(
        [np.linspace(0.0, angle, before + 1), angle + np.arange(_ANGLE_STEP, _NEXT_EDGE_ANGLE, _ANGLE_STEP)]
    )
    levels = Rotation.from_rotvec(-angles[:, None] * axis).apply(normal) @ arms.T
    lowest, heights = levels.argmin(axis=1), -levels.min(axis=1)
    highest, last = int(heights[: before + 1].argmax()), before + _first_top(heights[before:])
    flat = arms - np.outer(arms @ axis, axis)
    first_edge, last_edge = flat[lowest[highest]], flat[lowest[last]]
    about_centre = float(node_mass @ (flat * flat).sum(axis=1))
    mass = float(node_mass.sum())
    about_last = about_centre + mass * float(last_edge @ last_edge)
    return TippingPath(
        top=float(heights[highest]),
        upright=float(heights[before]),
        next_top=float(heights[last]),
        speed_ratio=(about_centre + mass * float(first_edge @ last_edge)) / about_last,
        inertia_ratio=about_last / (about_centre + mass * float(first_edge @ first_edge)),
    )


def _first_top(heights: np.ndarray) -> int:
    """Return the index of the first maximum of ``heights`` (n,) after an initial descent."""
    rises = np.diff(heights) > 0.0
    start = int(rises.argmax()) if rises.any() else 0
    falls = ~rises[start:]
    return start + (int(falls.argmax()) if falls.any() else len(rises) - start)
