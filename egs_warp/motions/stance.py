"""Measurement of a body, ground frames, detection of rest, and the balance controller with its family of poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.objectives import (
    AngularMomentumObjective,
    AnyObjective,
    Objective,
    centre_of_mass_velocity,
    deformation_velocities,
)
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.pendulum import capture_point, momentum_as_velocity
from egs_warp.motions.support import SupportPolygon

SHEAR_BASIS = np.einsum("ki,j->kij", np.eye(3)[:2], np.eye(3)[2])
"""(2, 3, 3) derivatives of a sheared pose with respect to lean forward and to the left."""
_PIN_STIFFNESS = 1e6
"""Stiffness that pins a node, relative to the largest entry of the stiffness matrix."""
SOLE_HEIGHT = 0.06
"""Height of the sole above the lowest node of a standing body, body heights."""
REST_SPEED = 0.03
"""Speed of the centre of mass, in sqrt(g H), below which a standing body is considered slow."""
REST_TIME = 0.3
"""Time in sqrt(H / g) for which a body must be slow to be at rest."""
SUPPORT_MARGIN = 0.95
"""Fraction of the footprint within which the centre of pressure stays."""
_MIN_FOOTPRINT = 0.01
"""Half width in body heights of the square about the centre of mass that every footprint contains."""
_PUSH_REACH = 0.04
"""Half width, in body heights, of the square about the centre of mass in which the centre of pressure may always lie,
even outside the footprint."""
_BALANCE_PRIORITY_MARGINS = (0.25, 0.5)
"""Capture margins (``BalanceController.capture_margin``) between which the priority of balance over uprighting grows
from 0 to 1."""
_SQUARE = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
FRICTION_FRACTION = 0.95
"""Fraction of the friction cone that objectives may use; with more, feet slide and other objectives are not reached."""


@dataclass(frozen=True)
class Weights:
    """Weights of a motion's objectives; speeds are measured in units of sqrt(g H).

    They are large compared to the weight of muscle effort, so that balance has priority over effort.
    """

    com: float = 600.0
    """Weight of the velocity of the centre of mass along the ground."""
    up: float = 600.0
    """Weight of the upward velocity of the centre of mass."""
    spin: float = 600.0
    pose: float = 0.02
    landing: float = 0.1
    """Factor on ``com``, ``up`` and ``spin`` after touch-down, when the body has to come to rest but at no prescribed
    time. The same factor applies to ``com`` while the body follows key frames."""


@dataclass(frozen=True)
class Measurement:
    """Measured quantities of a body in the ground frame: x forward, y left, z up."""

    com: np.ndarray
    """(3,) m, centre of mass relative to the origin of the ground frame."""
    velocity: np.ndarray
    """(3,) m/s, velocity of the centre of mass."""
    foot_centre: np.ndarray
    """(2,) m, centre of the feet: the nodes that are near the ground at rest."""
    sole_height: float
    """Height of the lowest contact point above the ground, m."""
    in_contact: bool
    """True if a contact force acts."""
    normal_load: float
    """Sum of the normal contact forces, body weights."""
    heading: float
    """Heading relative to the start, radians about z."""
    support: SupportPolygon
    """Hull of the points in contact, ground coordinates."""
    angular_velocity_term: np.ndarray
    """(2,) m/s, contribution of the spin to the angular momentum about the feet, expressed as a velocity of the centre
    of mass along the ground."""
    rotation: np.ndarray
    """(3, 3) best-fit rotation from the standing pose, world axes."""
    angular_momentum: np.ndarray
    """(3,) kg m^2/s, angular momentum about the centre of mass, world axes."""
    inertia: np.ndarray
    """(3, 3) kg m^2, inertia tensor about the centre of mass, world axes."""


@dataclass(frozen=True)
class GroundFrame:
    """Right-handed frame on a plane; the rows of ``axes`` are forward, left and up."""

    axes: np.ndarray
    """(3, 3) unit vectors forward, left and up, as rows."""
    origin: np.ndarray
    """(3,) m, origin on the plane."""
    surface_normal: np.ndarray
    """(3,) unit normal of the plane, which differs from up on a slope."""

    @classmethod
    def on_plane(
        cls, plane: Plane, forward: np.ndarray, below: np.ndarray, *, up: np.ndarray | None = None
    ) -> GroundFrame:
        """Create a frame on a plane.

        Args:
            plane: the ground.
            forward: (3,) forward direction; it is projected onto the horizontal plane.
            below: (3,) m, point below which the origin of the frame is placed.
            up: (3,) unit vector opposite to gravity; None uses the normal of the plane.
        """
        vertical = plane.normal if up is None else up
        flat = forward - (forward @ vertical) * vertical
        flat /= np.linalg.norm(flat)
        origin = below - plane.heights(below) / (plane.normal @ vertical) * vertical
        return cls(np.stack([flat, np.cross(vertical, flat), vertical]), origin, plane.normal)

    def rotation_about_up(self, angle: float) -> np.ndarray:
        """Return the matrix (3, 3) of a rotation by ``angle`` radians about the up axis, world axes."""
        return Rotation.from_rotvec(angle * self.axes[2]).as_matrix()

    def local(self, points: np.ndarray) -> np.ndarray:
        """Transform world points (..., 3) to ground coordinates."""
        return (points - self.origin) @ self.axes.T

    def world(self, points: np.ndarray) -> np.ndarray:
        """Transform ground coordinates (..., 3) to world points."""
        return self.origin + points @ self.axes


class RestDetector:
    """Detector of rest: the centre of mass has been slow for ``REST_TIME``."""

    def __init__(self, body: SoftBody) -> None:
        gravity = float(np.linalg.norm(body.gravity))
        self._speed = REST_SPEED * np.sqrt(gravity * body.height)
        self._time = REST_TIME * float(np.sqrt(body.height / gravity))
        self._since: float | None = None

    def update(self, velocity: np.ndarray, time: float) -> bool:
        """Update the detector; call it in every time step.

        Args:
            velocity: (3,) m/s, velocity of the centre of mass.
            time: current time, s.

        Returns:
            True if the body is at rest.
        """
        if np.linalg.norm(velocity) > self._speed:
            self._since = None
        elif self._since is None:
            self._since = time
        return self._since is not None and time - self._since > self._time


class BalanceController:
    """Balance controller whose target poses are affine maps of the rest shape: stretch along the up axis, bulging
    across it, and shear by the lean.

    See docs/concepts/motions.md.
    """

    def __init__(
        self, body: SoftBody, ground: GroundFrame, standing: np.ndarray, contact_points: np.ndarray, friction: float
    ) -> None:
        """Create the controller.

        Args:
            body: the body.
            ground: ground frame.
            standing: (N, 3) m, nodes at rest.
            contact_points: (k, 3) m, points of the body on the ground at rest.
            friction: Coulomb coefficient.
        """
        self.body, self.ground, self.friction = body, ground, friction
        self._normal = ground.axes @ ground.surface_normal
        local = ground.local(standing)
        self.arms = (local - body.centre_of_mass(local)) @ ground.axes
        """(N, 3) m, standing nodes relative to their centre of mass, world axes."""
        self.standing_height = float(body.centre_of_mass(local)[2])
        self._sole_share = sole_shares(body, ground, standing)
        self._standing = standing
        self.base_offset = self._base(local) - body.centre_of_mass(local)[:2]
        if len(contact_points) == 0:
            raise UserError(
                "body: no point of the body is on the ground at the start; check the ground", check=("plane", "up")
            )
        footprint = ground.local(contact_points)[:, :2] - body.centre_of_mass(local)[:2]
        # The centre of mass of a standing body lies in its footprint, even if few points are in contact.
        self.footprint = SupportPolygon.hull(np.concatenate([footprint, _MIN_FOOTPRINT * body.height * _SQUARE]))
        """Hull of the contact points at rest, relative to the centre of mass."""
        self.gesture_turn = np.zeros(3)
        """(3,) rotation vector of the body that is caused by gestures of its parts, radians, ground axes; it is
        excluded from the measured rotation."""

    def balance_targets(
        self, measurement: Measurement, velocity: np.ndarray, spin: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Project the requested velocities onto the set that the feet can produce without tipping or slipping.

        The rate of change of the angular momentum about the feet, m h (v + angular_velocity_term), is the weight times
        the horizontal distance from the centre of pressure to the centre of mass. The sum of both terms is bounded
        because the centre of pressure must stay in the footprint; the first term is bounded by friction.

        Args:
            measurement: measured body.
            velocity: (3,) m/s, requested velocity of the centre of mass, ground axes.
            spin: (3,) rad/s, requested angular velocity, world axes.
            dt: time step, s.

        Returns:
            Velocity (3,) in m/s and spin (3,) in rad/s at the end of the step.
        """
        gravity = float(np.linalg.norm(self.body.gravity))
        up = max(gravity + (velocity[2] - measurement.velocity[2]) / dt, 0.2 * gravity)
        height = self._com_height(measurement.com)
        level = velocity[:2] - measurement.velocity[:2]
        turn = self._angular_velocity_term(measurement.inertia @ spin, height) - measurement.angular_velocity_term

        def within_grip(change: np.ndarray) -> np.ndarray:
            push = np.array([*(change / dt), 0.0])
            return change * min(
                1.0, _share_in_cone(push, np.array([0.0, 0.0, up]), self._normal, FRICTION_FRACTION * self.friction)
            )

        level = within_grip(level)
        pressure = measurement.com[:2] - height / up * (level + turn) / dt
        # Allow a small push in any direction even if the centre of mass is beyond the edge, so that the targets never
        # request a fall.
        slack = measurement.com[:2] + _PUSH_REACH * self.body.height * _SQUARE
        allowed = SupportPolygon.hull(np.concatenate([measurement.support.scaled(SUPPORT_MARGIN).corners, slack]))
        both = (measurement.com[:2] - allowed.nearest(pressure)) * up / height * dt
        # Reduce both terms in proportion to the costs of their objectives; the radius of gyration relates spins to
        # speeds. The part of the speed that exceeds the friction limit is assigned to the spin.
        share = 1.0 / (1.0 + 0.5 * np.trace(measurement.inertia) / (self.body.mass * height**2))
        shared = level + share * (both - level - turn)
        # Uprighting must not drive the centre of mass away from the feet. If the capture point is far out, the body
        # must not move outward faster than it would without uprighting.
        away = self._capture(measurement) - measurement.support.middle
        away /= max(float(np.linalg.norm(away)), 1e-12)
        excess = max(float(away @ shared) - float(max(away @ level, away @ both)), 0.0)
        level = within_grip(shared - self._balance_priority(measurement) * excess * away)
        turn = both - level
        swing = measurement.angular_velocity_term + turn
        momentum = self.ground.axes @ measurement.inertia @ spin
        momentum[:2] = self.body.mass * height * np.array([-swing[1], swing[0]])
        return (
            np.array([*(measurement.velocity[:2] + level), velocity[2]]),
            np.linalg.solve(measurement.inertia, self.ground.axes.T @ momentum),
        )

    def capture_acceleration(self, measurement: Measurement, goal: np.ndarray) -> np.ndarray:
        """Return the acceleration (2,) in m/s^2 along the ground that brings an inverted pendulum to rest over ``goal``
        (2,). It steers the capture point, computed from the angular momentum about the feet, to the goal."""
        pendulum = self._pendulum_rate2(measurement)
        return -2.0 * pendulum * (self._capture(measurement) - goal) + pendulum * (measurement.com[:2] - goal)

    def capture_margin(self, measurement: Measurement) -> float:
        """Return the distance of the capture point from the middle of the support, as a fraction of the distance to the
        edge in the same direction. Beyond 1, the body falls unless it steps."""
        return measurement.support.relative_distance(self._capture(measurement), 1e-3 * self.body.height)

    def _balance_priority(self, measurement: Measurement) -> float:
        """Return the priority of balance over uprighting, from 0 to 1."""
        start, full = _BALANCE_PRIORITY_MARGINS
        return min(max((self.capture_margin(measurement) - start) / (full - start), 0.0), 1.0)

    def _pendulum_rate2(self, measurement: Measurement) -> float:
        """Return the squared rate of the linear inverted pendulum, 1/s^2."""
        return float(np.linalg.norm(self.body.gravity)) / self._com_height(measurement.com)

    def _capture(self, measurement: Measurement) -> np.ndarray:
        """Return the capture point (2,), over which the feet could bring the body to rest."""
        velocity = measurement.velocity[:2] + measurement.angular_velocity_term
        return capture_point(measurement.com[:2], velocity, float(np.sqrt(self._pendulum_rate2(measurement))))

    def _com_height(self, com: np.ndarray) -> float:
        """Return the height in metres of the centre of mass ``com`` (3,), ground coordinates, above the feet; at least
        0.3 of the standing height."""
        return max(float(com[2]), 0.3 * self.standing_height)

    def _angular_velocity_term(self, momentum: np.ndarray, height: float) -> np.ndarray:
        """Return ``Measurement.angular_velocity_term`` (2,) of an angular ``momentum`` (3,), world axes."""
        return momentum_as_velocity(self.ground.axes @ momentum, self.body.mass, height)

    def _base(self, local: np.ndarray) -> np.ndarray:
        return (self._sole_share @ local)[:2]

    def measure(self, state: BodyState, report: StepReport | None) -> Measurement:
        """Measure the body; ``report`` is the report of the previous time step."""
        local = self.ground.local(state.positions)
        forces = report.forces[:, 0].sum() if report is not None else self.body.weight
        rotation = self._rotation(state.positions)
        turn = self.ground.axes @ rotation @ self.ground.axes.T
        com = self.body.centre_of_mass(local)
        momentum = self.body.angular_momentum(state.positions, state.velocities)
        return Measurement(
            com=com,
            velocity=self.ground.axes @ self.body.centre_of_mass(state.velocities),
            foot_centre=self._base(local),
            sole_height=report.min_gap if report is not None else 0.0,
            in_contact=bool(forces > 1e-6 * self.body.weight),
            normal_load=float(forces / self.body.weight),
            heading=float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])),
            support=self._support(local, report),
            angular_velocity_term=self._angular_velocity_term(momentum, self._com_height(com)),
            rotation=rotation,
            angular_momentum=momentum,
            inertia=self.body.inertia(state.positions),
        )

    def _support(self, local: np.ndarray, report: StepReport | None) -> SupportPolygon:
        """Return ``Measurement.support``; without contacts, the footprint at rest."""
        if report is None or report.contacts.count == 0:
            return self.footprint.moved(self._base(local) - self.base_offset)
        contacts = report.contacts
        return SupportPolygon.hull(np.einsum("cw,cwi->ci", contacts.weights, local[contacts.nodes])[:, :2])

    def _rotation(self, positions: np.ndarray) -> np.ndarray:
        arms = positions - self.body.centre_of_mass(positions)
        turn = kabsch_rotation(self.body.node_mass, self.arms, arms)
        if not self.gesture_turn.any():
            return turn
        return Rotation.from_rotvec(-self.gesture_turn @ self.ground.axes).as_matrix() @ turn

    def sole_heading(self, positions: np.ndarray) -> float:
        """Return the rotation of the feet about the up axis relative to the standing pose, radians."""
        return heading_between(self.arms, positions, self._sole_share, self.ground)

    def over_base(self, com: np.ndarray, base: np.ndarray, heading: float = 0.0) -> np.ndarray:
        """Return the pose (3, 3) with a flat sole at ``base`` (2,) and the centre of mass at ``com`` (3,), ground
        coordinates: the body is sheared by the lean between both."""
        return self._leaning(com, base, heading, SHEAR_BASIS)

    def bent_over_base(self, com: np.ndarray, base: np.ndarray, heading: float = 0.0) -> np.ndarray:
        """Return the pose (3, 3) for the arguments of ``over_base`` in which the body leans by bending, with the
        rotation that minimizes its strain."""
        return self._leaning(com, base, heading, self._bending)

    def _leaning(self, com: np.ndarray, base: np.ndarray, heading: float, leans: np.ndarray) -> np.ndarray:
        """Return the pose (3, 3), world axes: stretch along the up axis; bulging, which cancels half of the volume
        change; lean, with the derivatives ``leans`` (2, 3, 3); and a rotation by ``heading`` radians."""
        turn = Rotation.from_rotvec([0.0, 0.0, heading]).as_matrix()
        lean = (com[:2] - base + turn[:2, :2] @ self.base_offset) / self.standing_height
        lean = lean * min(1.0, 0.5 / max(float(np.linalg.norm(lean)), 1e-9))
        stretch = float(np.clip(com[2] / self.standing_height, 0.6, 1.25))
        bulge = stretch**-0.25
        local = turn @ (np.diag([bulge, bulge, stretch]) + np.einsum("k,kij->ij", lean, leans))
        return self.ground.axes.T @ local @ self.ground.axes

    @cached_property
    def _bending(self) -> np.ndarray:
        """(2, 3, 3) derivatives of the pose with respect to lean forward and to the left, ground axes, for a body with
        a fixed sole that a horizontal body force bends: the mass-weighted least-squares affine fit of its small
        displacements."""
        body, assembly, axes = self.body, self.body.assembly, self.ground.axes
        entries = assembly.hessian_entries(self._standing, projected=True)
        is_fixed = np.repeat(self._sole_share > 0.0, 3)
        entries[assembly.diagonal_entries] += _PIN_STIFFNESS * entries.max() * is_fixed
        factors = MultifrontalLdl(assembly.upper_pattern, assembly.analysis)
        factors.factor(entries)
        loads = np.stack([np.kron(body.node_mass, axis) for axis in axes[:2]], axis=1)
        bent = factors.solve(loads * ~is_fixed[:, None]).reshape(len(body.node_mass), 3, 2)
        arms = self._standing - body.centre_of_mass(self._standing)
        spread = np.linalg.inv(np.einsum("n,ni,nj->ij", body.node_mass, arms, arms))
        fits = []
        for k in range(2):
            moved = body.centre_of_mass(bent[:, :, k])
            unit = self.standing_height / float(axes[k] @ moved)
            fit = unit * np.einsum("n,ni,nj->ij", body.node_mass, bent[:, :, k] - moved, arms) @ spread
            fits.append(axes @ fit @ axes.T)
        return np.stack(fits)

    def objectives(
        self,
        state: BodyState,
        measurement: Measurement,
        *,
        com_velocity: np.ndarray,
        pose: np.ndarray,
        pose_rate: np.ndarray,
        spin: np.ndarray,
        follow: float,
        weights: Weights,
    ) -> list[AnyObjective]:
        """Return the objectives of a time step.

        Args:
            state: current state.
            measurement: measured body.
            com_velocity: (3,) m/s, target velocity of the centre of mass, ground axes.
            pose: (3, 3) target pose, world axes.
            pose_rate: (3, 3) 1/s, rate of the target pose.
            spin: (3,) rad/s, target angular velocity, world axes.
            follow: 1/s, rate at which the pose is approached.
            weights: weights of the objectives.
        """
        body = self.body
        com = body.centre_of_mass(state.positions)
        arms = state.positions - com
        velocity = self.ground.axes.T @ com_velocity
        target = self.arms @ pose.T
        pose_velocity = velocity + self.arms @ pose_rate.T + follow * (target - arms)
        momentum = measurement.inertia @ spin
        return [
            *self._balance(velocity, weights),
            AngularMomentumObjective(momentum, weights.spin),
            deformation_velocities(body, state.positions, pose_velocity, weights.pose),
        ]

    def _balance(self, velocity: np.ndarray, weights: Weights) -> list[Objective]:
        """Return the objectives for the ``velocity`` (3,) of the centre of mass, world axes."""
        both = centre_of_mass_velocity(self.body, velocity, weights.com)
        if weights.up == weights.com:
            return [both]
        level, up = self.ground.axes[:2], self.ground.axes[2:]
        return [
            replace(both, rows=level @ both.rows, target=level @ velocity),
            replace(both, rows=up @ both.rows, target=up @ velocity, weight=weights.up),
        ]

    def turn_towards(self, measurement: Measurement, pose: np.ndarray) -> np.ndarray:
        """Return the rotation vector (3,), world axes, from the measured best-fit rotation to the best-fit
        rotation of ``pose``."""
        target = kabsch_rotation(self.body.node_mass, self.arms, self.arms @ pose.T)
        return Rotation.from_matrix(target @ measurement.rotation.T).as_rotvec()


def _share_in_cone(push: np.ndarray, load: np.ndarray, normal: np.ndarray, friction: float) -> float:
    """Return the largest s for which ``load`` + s ``push`` (3,) is in the friction cone about ``normal`` (3,); 0 if
    ``load`` is outside, infinite if ``push`` never leaves the cone."""
    wide = 1.0 + friction**2
    a = float(push @ push - wide * (push @ normal) ** 2)
    b = float(push @ load - wide * (push @ normal) * (load @ normal))
    c = float(load @ load - wide * (load @ normal) ** 2)
    if c > 0.0:
        return 0.0
    if a <= 0.0:
        return float("inf")
    return (float(np.sqrt(b * b - a * c)) - b) / a


def sole_shares(body: SoftBody, ground: GroundFrame, standing: np.ndarray) -> np.ndarray:
    """Return weights (N,) with sum 1, proportional to the masses of the nodes near the ground at rest: the mean of all
    nodes with these weights is the centre of the feet."""
    heights = standing @ ground.surface_normal
    mass = body.node_mass * (heights < heights.min() + SOLE_HEIGHT * body.height)
    return mass / mass.sum()


def heading_between(before: np.ndarray, after: np.ndarray, share: np.ndarray, ground: GroundFrame) -> float:
    """Return the best-fit rotation angle in radians about the up axis from points ``before`` (N, 3) to ``after`` (N,
    3), weighted by ``share`` (N,)."""
    flat_before, flat_after = ((x - share @ x) @ ground.axes[:2].T for x in (before, after))
    sine = share @ (flat_before[:, 0] * flat_after[:, 1] - flat_before[:, 1] * flat_after[:, 0])
    return float(np.arctan2(sine, share @ (flat_before * flat_after).sum(axis=1)))
