"""Measured quantities of a body and the family of poses that motions steer through."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.geometry.frames import best_turn
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.objectives import Objective, SpinObjective, centre_of_mass_velocity, straining_velocities
from egs_warp.locomotion.stepper import StepReport

SOLE = 0.06
"""Body heights: what is at most this far above a standing body's lowest node is its sole."""
CALM = 0.03
"""Speed of the centre of mass, in sqrt(g H), below which a standing body is calm."""
CALM_TIME = 0.3
"""Of sqrt(H / g): for how long a body is calm before it is at rest."""


@dataclass(frozen=True)
class Weights:
    """Weights of a motion's objectives; speeds are compared in sqrt(g H)."""

    com: float = 2.0
    spin: float = 5.0
    pose: float = 0.02


@dataclass(frozen=True)
class Measurement:
    """The body as the controller sees it, in the frame of the ground: x forward, y left, z up."""

    com: np.ndarray
    """(3,) metres, relative to the ground frame's origin."""
    velocity: np.ndarray
    """(3,) m/s."""
    base: np.ndarray
    """(2,) metres: centre of the feet (nodes near the sole at rest)."""
    sole_height: float
    """Metres: lowest contact point above the plane."""
    touching: bool
    """Whether a contact force acts."""
    load: float
    """Normal contact forces, body weights."""
    heading: float
    """Radians about z, from the start."""


@dataclass(frozen=True)
class Ground:
    """A right-handed frame on the plane: rows of ``axes`` are forward, left and up."""

    axes: np.ndarray
    """(3, 3)."""
    origin: np.ndarray
    """(3,) metres, on the plane."""
    surface_normal: np.ndarray
    """(3,) unit, of the plane; up, but on a slope."""

    @classmethod
    def on(cls, plane: Plane, forward: np.ndarray, below: np.ndarray, *, up: np.ndarray | None = None) -> Ground:
        """Frame with its origin on the plane under the point ``below``; ``forward`` is made horizontal.

        ``up`` (3,) is against gravity where the plane is a slope.
        """
        vertical = plane.normal if up is None else up
        flat = forward - (forward @ vertical) * vertical
        flat /= np.linalg.norm(flat)
        origin = below - plane.heights(below) / (plane.normal @ vertical) * vertical
        return cls(np.stack([flat, np.cross(vertical, flat), vertical]), origin, plane.normal)

    def turn(self, angle: float) -> np.ndarray:
        """(3, 3) rotation by ``angle`` radians about up, world axes."""
        return Rotation.from_rotvec(angle * self.axes[2]).as_matrix()

    def local(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) to ground coordinates."""
        return (points - self.origin) @ self.axes.T

    def world(self, points: np.ndarray) -> np.ndarray:
        """Ground coordinates (..., 3) to world points."""
        return self.origin + points @ self.axes


class Calm:
    """Whether the centre of mass has been slow for long enough."""

    def __init__(self, body: SoftBody) -> None:
        gravity = float(np.linalg.norm(body.gravity))
        self._speed = CALM * np.sqrt(gravity * body.height)
        self._time = CALM_TIME * float(np.sqrt(body.height / gravity))
        self._since: float | None = None

    def held(self, velocity: np.ndarray, time: float) -> bool:
        """To be asked in every step, with the ``velocity`` (3,) of the centre of mass, m/s, and the ``time``, s."""
        if np.linalg.norm(velocity) > self._speed:
            self._since = None
        elif self._since is None:
            self._since = time
        return self._since is not None and time - self._since > self._time


class PoseFamily:
    """Affine poses of the rest shape, A = stretch along up, bulge across it, shear by the lean.

    See docs/concepts/motions.md.
    """

    def __init__(self, body: SoftBody, ground: Ground, standing: np.ndarray, touching: np.ndarray) -> None:
        """``standing`` (N, 3): nodes at rest; ``touching`` (k, 3): points of the body on the ground then."""
        self.body, self.ground = body, ground
        local = ground.local(standing)
        self._arms = (local - body.centre_of_mass(local)) @ ground.axes
        self.standing_height = float(body.centre_of_mass(local)[2])
        self._sole_share = sole_shares(body, ground, standing)
        self._standing = standing
        self.base_offset = self._base(local) - body.centre_of_mass(local)[:2]
        footprint = ground.local(touching)[:, :2] - body.centre_of_mass(local)[:2]
        self.support_low = np.minimum(footprint.min(axis=0), -0.01 * body.height)
        self.support_high = np.maximum(footprint.max(axis=0), 0.01 * body.height)

    def balanced_acceleration(
        self, seen: Measurement, wanted: np.ndarray, up: float, gravity: float, *, margin: float = 0.8
    ) -> np.ndarray:
        """(2,) the horizontal acceleration nearest to ``wanted`` (2,) m/s^2 that the feet can give without tipping the
        body.

        The centre of pressure com - h a / (g + ``up``) stays within ``margin`` of the footprint (linear inverted
        pendulum).
        """
        lever = max(seen.com[2], 0.3 * self.standing_height) / max(gravity + up, 0.2 * gravity)
        pressure = seen.com[:2] - lever * wanted
        place = seen.base - self.base_offset
        # Never ask for a fall: some push either way stays allowed even where the centre of mass is past the edge.
        slack = 0.04 * self.body.height
        low = np.minimum(place + margin * self.support_low, seen.com[:2] - slack)
        high = np.maximum(place + margin * self.support_high, seen.com[:2] + slack)
        pressure = np.clip(pressure, low, high)
        return (seen.com[:2] - pressure) / lever

    def _base(self, local: np.ndarray) -> np.ndarray:
        return (self._sole_share @ local)[:2]

    def measure(self, state: BodyState, report: StepReport | None) -> Measurement:
        """What the controller sees."""
        local = self.ground.local(state.positions)
        forces = report.forces[:, 0].sum() if report is not None else self.body.weight
        turn = self.ground.axes @ self.rotation(state.positions) @ self.ground.axes.T
        return Measurement(
            com=self.body.centre_of_mass(local),
            velocity=self.ground.axes @ self.body.centre_of_mass(state.velocities),
            base=self._base(local),
            sole_height=report.min_gap if report is not None else 0.0,
            touching=bool(forces > 1e-6 * self.body.weight),
            load=float(forces / self.body.weight),
            heading=float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])),
        )

    def rotation(self, positions: np.ndarray) -> np.ndarray:
        """(3, 3) best-fit rotation from the standing pose, world axes."""
        arms = positions - self.body.centre_of_mass(positions)
        return best_turn(self.body.node_mass, self._arms, arms)

    def sole_heading(self, positions: np.ndarray) -> float:
        """Radians about the ground's normal by which the feet alone are turned from the standing pose."""
        return heading_between(self._arms, positions, self._sole_share, self.ground)

    def affine(self, stretch: float, lean: np.ndarray, heading: float = 0.0) -> np.ndarray:
        """(3, 3) world matrix: ``stretch`` along up, half the volume kept by bulging, sheared by ``lean`` (2,),
        then turned.
        """
        bulge = stretch**-0.25
        local = np.diag([bulge, bulge, stretch])
        local[:2, 2] = lean
        local = Rotation.from_rotvec([0.0, 0.0, heading]).as_matrix() @ local
        return self.ground.axes.T @ local @ self.ground.axes

    def over_base(self, com: np.ndarray, base: np.ndarray, heading: float = 0.0) -> np.ndarray:
        """(3, 3) the pose whose sole is flat at ``base`` (2,) while the centre of mass is at ``com`` (3,),
        ground coordinates.
        """
        turned = Rotation.from_rotvec([0.0, 0.0, heading]).as_matrix()[:2, :2] @ self.base_offset
        lean = (com[:2] - base + turned) / self.standing_height
        lean = lean * min(1.0, 0.5 / max(float(np.linalg.norm(lean)), 1e-9))
        stretch = float(np.clip(com[2] / self.standing_height, 0.6, 1.25))
        return self.affine(stretch, lean, heading)

    def objectives(
        self,
        state: BodyState,
        *,
        com_velocity: np.ndarray,
        pose: np.ndarray,
        pose_rate: np.ndarray,
        spin: np.ndarray,
        follow: float,
        weights: Weights,
    ) -> list[Objective | SpinObjective]:
        """Objectives for a step: centre-of-mass velocity (3,) in ground axes, angular velocity ``spin`` (3,) in world
        axes, and a pose.

        ``pose`` (3, 3) is approached at rate ``follow`` (1/s) on top of its own ``pose_rate`` (3, 3).
        """
        body = self.body
        com = body.centre_of_mass(state.positions)
        arms = state.positions - com
        velocity = self.ground.axes.T @ com_velocity
        wanted = self._arms @ pose.T
        pose_velocity = velocity + self._arms @ pose_rate.T + follow * (wanted - arms)
        momentum = body.inertia(state.positions) @ spin
        return [
            centre_of_mass_velocity(body, velocity, weights.com),
            SpinObjective(momentum, weights.spin),
            straining_velocities(body, state.positions, pose_velocity, weights.pose),
        ]

    def turn_towards(self, state: BodyState, pose: np.ndarray) -> np.ndarray:
        """(3,) rotation vector, world axes, from the measured best-fit rotation to that of ``pose``."""
        wanted = best_turn(self.body.node_mass, self._arms, self._arms @ pose.T)
        return Rotation.from_matrix(wanted @ self.rotation(state.positions).T).as_rotvec()


def sole_shares(body: SoftBody, ground: Ground, standing: np.ndarray) -> np.ndarray:
    """(N,) weights, sum 1, whose mean is the centre of the feet:
    the mass of the nodes that are near the ground at rest.
    """
    heights = standing @ ground.surface_normal
    mass = body.node_mass * (heights < heights.min() + SOLE * body.height)
    return mass / mass.sum()


def heading_between(before: np.ndarray, after: np.ndarray, share: np.ndarray, ground: Ground) -> float:
    """Radians about the ground's up by which points ``before`` (N, 3), weighted by ``share`` (N,),
    best turn to ``after``.
    """
    flat_before, flat_after = ((x - share @ x) @ ground.axes[:2].T for x in (before, after))
    sine = share @ (flat_before[:, 0] * flat_after[:, 1] - flat_before[:, 1] * flat_after[:, 0])
    return float(np.arctan2(sine, share @ (flat_before * flat_after).sum(axis=1)))
