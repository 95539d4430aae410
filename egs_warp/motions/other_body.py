"""Another body of a world, as an input of the motions of a creature: its current state, extent and tilt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from egs_warp.contact.detection import ContactGeometry
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.motions.sequence import Stance


@dataclass(frozen=True)
class OtherBody:
    """Another body of the world. Motions measure it whenever they need its position."""

    body: SoftBody
    state: Callable[[], BodyState]
    """Function that returns the current state of the body."""
    geometry: ContactGeometry
    """Contact points, which define the extent of a prop, because its single tetrahedron is larger than the object."""

    def points(self) -> np.ndarray:
        """Return the contact points (P, 3) m in the frame of the world."""
        geometry = self.geometry
        nodes = self.state().positions[geometry.mesh.tets[geometry.tet_from_point]]
        return np.einsum("pw,pwi->pi", geometry.weights, nodes)

    def centre(self, stance: Stance) -> np.ndarray:
        """Return the centre of mass (2,) m in the ground frame of ``stance``."""
        return self.body.centre_of_mass(stance.ground.local(self.state().positions))[:2]

    def place(self, stance: Stance) -> tuple[np.ndarray, float]:
        """Return the centre of mass (2,) m in the ground frame of ``stance``, and the approximate distance in metres
        between the centres of this body and the body of ``stance`` at which they touch."""
        own = radius_of(stance.ground.local(stance.standing))
        return self.centre(stance), own + radius_of(stance.ground.local(self.points()))

    def tilt_from(self, before: np.ndarray) -> float:
        """Return the angle in degrees by which the upright axis of the body has tilted since the node positions were
        ``before`` (N, 3)."""
        turn = self.body.best_fit_rotation(self.state().positions) @ self.body.best_fit_rotation(before).T
        up = -self.body.gravity / np.linalg.norm(self.body.gravity)
        return float(np.degrees(np.arccos(np.clip(up @ turn @ up, -1.0, 1.0))))


def radius_of(local: np.ndarray) -> float:
    """Return half of the mean horizontal extent, in metres, of points (N, 3) m."""
    return 0.25 * float(np.ptp(local[:, :2], axis=0).sum())
