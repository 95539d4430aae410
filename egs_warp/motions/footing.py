"""Where the feet of a walking body belong, stand, and may press on the ground.

Places of feet are (x, y, z, heading): metres in the frame of the start, radians about up.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from egs_warp.motions.feet import Foot
from egs_warp.motions.pendulum import is_line
from egs_warp.motions.sequence import Stance

DOWN = 0.005
"""Body heights over the ground at which a foot at the end of its swing counts as landed, too."""
_BETWEEN = 0.3
"""Of the distance of two feet: what is about as near to the one as to the other belongs to neither."""


class FootholdPlanner:
    """The soles of F feet, as they stand at the start, on level or sloping ground."""

    def __init__(self, place: Stance, feet: Sequence[Foot]) -> None:
        """The body stands at ``place`` on ``feet``."""
        self._feet, self._height = feet, place.body.height
        normal = place.ground.axes @ place.ground.surface_normal
        self._slope = -normal[:2] / normal[2]
        standing = place.ground.local(place.standing)
        self._centre = place.body.centre_of_mass(standing)[:2]
        self.soles = np.array([standing[foot.sole].mean(axis=0) for foot in feet])
        """(F, 3) their middles."""
        self._arms = [standing[foot.sole] - sole for foot, sole in zip(feet, self.soles, strict=True)]
        self.grips = self._touching(place.ground.local(place.contact_points)[:, :2])
        """For each foot (k, 2) where it touches the ground, from the middle of its sole; its whole sole where it
        hangs."""

    def _touching(self, points: np.ndarray) -> list[np.ndarray]:
        centres = self.soles[:, :2]
        away = np.linalg.norm(points[:, None] - centres, axis=2)
        owner = np.argmin(away, axis=1)
        nearest, second = np.sort(away, axis=1)[:, :2].T
        clear = second - nearest > _BETWEEN * np.linalg.norm(centres[owner] - centres[np.argsort(away)[:, 1]], axis=1)
        grips = []
        for index, arms in enumerate(self._arms):
            own = points[clear & (owner == index)] - centres[index]
            if len(own) < 3 or is_line(own):
                own = arms[:, :2]
            grips.append(own if is_line(own) else own[ConvexHull(own).vertices])
        return grips

    @property
    def start(self) -> np.ndarray:
        """(F, 4) where the feet stand at the start."""
        return np.column_stack([self.soles, np.zeros(len(self.soles))])

    def nominal_foothold(self, place: np.ndarray, index: int) -> np.ndarray:
        """(4,) where foot ``index`` belongs when the body is at ``place`` (3,): see ``motions.route``."""
        level = self._centre + place[:2] + _flat(place[2]) @ (self.soles[index, :2] - self._centre)
        return self._on_ground(index, level, float(place[2]))

    def landed_foothold(self, index: int, local: np.ndarray, planned: float) -> np.ndarray:
        """(4,) where foot ``index`` stands with the nodes at ``local`` (N, 3); its heading is told by whole turns as
        near to the ``planned`` one as may be."""
        now = local[self._feet[index].sole, :2]
        arms, rest = now - now.mean(axis=0), self._arms[index][:, :2]
        heading = float(np.arctan2((rest[:, 0] * arms[:, 1] - rest[:, 1] * arms[:, 0]).sum(), (rest * arms).sum()))
        heading += 2.0 * np.pi * round((planned - heading) / (2.0 * np.pi))
        return self._on_ground(index, now.mean(axis=0), heading)

    def current_footholds(self, local: np.ndarray, footprints: np.ndarray) -> np.ndarray:
        """(F, 4) ``footprints`` moved to where the soles of the nodes at ``local`` (N, 3) are."""
        middles = np.array([local[foot.sole].mean(axis=0) for foot in self._feet])
        return np.column_stack([middles, footprints[:, 3]])

    def is_down(self, index: int, local: np.ndarray) -> bool:
        """Whether foot ``index`` is on the ground, and if it carries nothing."""
        sole = local[self._feet[index].sole].mean(axis=0)
        return bool(sole[2] - self._on_ground(index, sole[:2], 0.0)[2] < DOWN * self._height)

    def sole(self, index: int, footprint: np.ndarray) -> np.ndarray:
        """(k, 3) the nodes of the sole of foot ``index``, flat on its ``footprint`` (4,)."""
        arms = self._arms[index]
        return np.column_stack([arms[:, :2] @ _flat(footprint[3]).T, arms[:, 2]]) + footprint[:3]

    def support_points(self, footprints: np.ndarray, standing: Sequence[int], margin: float) -> np.ndarray:
        """(k, 2) where the feet ``standing`` on their ``footprints`` (F, 4) touch, each drawn in towards its middle to
        ``margin`` of its size."""
        pieces = []
        for index in standing:
            grip, foot = self.grips[index], footprints[index]
            middle = grip.mean(axis=0)
            pieces.append(foot[:2] + (middle + margin * (grip - middle)) @ _flat(foot[3]).T)
        return np.concatenate(pieces)

    def _on_ground(self, index: int, level: np.ndarray, heading: float) -> np.ndarray:
        """(4,) foot ``index`` on the ground at ``level`` (2,)."""
        start = self.soles[index]
        return np.array([*level, start[2] + self._slope @ (level - start[:2]), heading])


def _flat(angle: float) -> np.ndarray:
    """(2, 2) turn by ``angle`` radians."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
