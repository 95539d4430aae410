"""Foothold planner of a walking body: nominal and measured footholds, and the area of support.

Footholds are (x, y, z, heading): metres in the ground frame of the start, radians about the up axis.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.motions.feet import Foot
from egs_warp.motions.sequence import Stance
from egs_warp.motions.support import SupportPolygon, is_line

LANDED_HEIGHT = 0.005
"""Height above the ground, in body heights, below which a foot at the end of its swing is considered landed, with or
without load."""
_AMBIGUOUS_FRACTION = 0.3
"""Minimum difference between the distances of a contact point from two feet for the point to belong to the nearer foot,
as a fraction of the distance between the feet."""


class FootholdPlanner:
    """Footholds of F feet relative to the soles at the start, on level or sloping ground."""

    def __init__(self, stance: Stance, feet: Sequence[Foot]) -> None:
        """Create the planner for the body that stands at ``stance`` on ``feet``."""
        self._feet, self._height = feet, stance.body.height
        normal = stance.ground.axes @ stance.ground.surface_normal
        self._slope = -normal[:2] / normal[2]
        standing = stance.ground.local(stance.standing)
        self._centre = stance.body.centre_of_mass(standing)[:2]
        self.soles = np.array([standing[foot.sole].mean(axis=0) for foot in feet])
        """(F, 3) m, middle of each sole."""
        self._arms = [standing[foot.sole] - sole for foot, sole in zip(feet, self.soles, strict=True)]
        self.grips = self._touching(stance.ground.local(stance.contact_points)[:, :2])
        """Convex hull (k, 2) m of the contact points of each foot, relative to the middle of its sole; the hull of the
        whole sole if the foot does not touch the ground."""

    def _touching(self, points: np.ndarray) -> list[np.ndarray]:
        centres = self.soles[:, :2]
        away = np.linalg.norm(points[:, None] - centres, axis=2)
        owner = np.argmin(away, axis=1)
        nearest, second = np.sort(away, axis=1)[:, :2].T
        clear = second - nearest > _AMBIGUOUS_FRACTION * np.linalg.norm(
            centres[owner] - centres[np.argsort(away)[:, 1]], axis=1
        )
        grips = []
        for index, arms in enumerate(self._arms):
            own = points[clear & (owner == index)] - centres[index]
            if len(own) < 3 or is_line(own):
                own = arms[:, :2]
            grips.append(SupportPolygon.hull(own).corners)
        return grips

    @property
    def start(self) -> np.ndarray:
        """(F, 4) footholds at the start."""
        return np.column_stack([self.soles, np.zeros(len(self.soles))])

    def nominal_foothold(self, planar_pose: np.ndarray, index: int) -> np.ndarray:
        """Return the nominal foothold (4,) of foot ``index`` for the body at ``planar_pose`` (3,); see
        ``motions.route``."""
        level = self._centre + planar_pose[:2] + _flat(planar_pose[2]) @ (self.soles[index, :2] - self._centre)
        return self._on_ground(index, level, float(planar_pose[2]))

    def landed_foothold(self, index: int, local: np.ndarray, planned: float) -> np.ndarray:
        """Return the foothold (4,) of foot ``index`` for nodes at ``local`` (N, 3), ground coordinates. Of the
        equivalent headings, it has the one nearest to ``planned``."""
        now = local[self._feet[index].sole, :2]
        arms, rest = now - now.mean(axis=0), self._arms[index][:, :2]
        heading = float(np.arctan2((rest[:, 0] * arms[:, 1] - rest[:, 1] * arms[:, 0]).sum(), (rest * arms).sum()))
        heading += 2.0 * np.pi * round((planned - heading) / (2.0 * np.pi))
        return self._on_ground(index, now.mean(axis=0), heading)

    def current_footholds(self, local: np.ndarray, footprints: np.ndarray) -> np.ndarray:
        """Return ``footprints`` (F, 4), moved to the current positions of the soles for nodes at ``local`` (N, 3)."""
        middles = np.array([local[foot.sole].mean(axis=0) for foot in self._feet])
        return np.column_stack([middles, footprints[:, 3]])

    def is_down(self, index: int, local: np.ndarray) -> bool:
        """Return True if foot ``index`` is on the ground, with or without load, for nodes at ``local`` (N, 3)."""
        sole = local[self._feet[index].sole].mean(axis=0)
        return bool(sole[2] - self._on_ground(index, sole[:2], 0.0)[2] < LANDED_HEIGHT * self._height)

    def sole(self, index: int, footprint: np.ndarray) -> np.ndarray:
        """Return the nodes (k, 3) of the sole of foot ``index`` when it stands flat on its ``footprint`` (4,)."""
        arms = self._arms[index]
        return np.column_stack([arms[:, :2] @ _flat(footprint[3]).T, arms[:, 2]]) + footprint[:3]

    def support(self, footprints: np.ndarray, standing: Sequence[int], margin: float) -> SupportPolygon:
        """Return the hull of the contact points of the ``standing`` feet on their ``footprints`` (F, 4). The contact
        points of each foot are scaled about its middle by ``margin``."""
        pieces = []
        for index in standing:
            grip, foot = self.grips[index], footprints[index]
            middle = grip.mean(axis=0)
            pieces.append(foot[:2] + (middle + margin * (grip - middle)) @ _flat(foot[3]).T)
        return SupportPolygon.hull(np.concatenate(pieces))

    def _on_ground(self, index: int, level: np.ndarray, heading: float) -> np.ndarray:
        """Return the foothold (4,) of foot ``index`` on the ground at the planar position ``level`` (2,)."""
        start = self.soles[index]
        return np.array([*level, start[2] + self._slope @ (level - start[:2]), heading])


def _flat(angle: float) -> np.ndarray:
    """Return the matrix (2, 2) of a rotation by ``angle`` radians."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
