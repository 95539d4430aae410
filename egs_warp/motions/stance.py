"""Measured quantities of a body and the family of poses that motions steer through."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

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

SHEAR_BASIS = np.einsum("ki,j->kij", np.eye(3)[:2], np.eye(3)[2])
"""(2, 3, 3) what a unit of lean ahead and to the left adds to a pose that is sheared by it."""
_PINNED = 1e6
"""Of the largest stiffness: what holds a node where it stands."""
SOLE_HEIGHT = 0.06
"""Body heights: what is at most this far above a standing body's lowest node is its sole."""
REST_SPEED = 0.03
"""Speed of the centre of mass, in sqrt(g H), below which a standing body is calm."""
REST_TIME = 0.3
"""Of sqrt(H / g): for how long a body is calm before it is at rest."""
SUPPORT_MARGIN = 0.95
"""Of the footprint: where the centre of pressure may be."""
FRICTION_FRACTION = 0.95
"""Of what friction could give at most: asked for more, feet slide, and what else is asked falls short."""


@dataclass(frozen=True)
class Weights:
    """Weights of a motion's objectives; speeds are compared in sqrt(g H).

    What is asked for is what happens, since contact forces come as they are planned: balance goes before effort.
    """

    com: float = 600.0
    """Of the centre of mass, along the ground."""
    up: float = 600.0
    """Of the centre of mass, up."""
    spin: float = 600.0
    pose: float = 0.02
    landing: float = 0.1
    """Share of ``com``, ``up`` and ``spin`` that is asked for from touch-down on: what is left is to come to rest,
    at no given time."""


@dataclass(frozen=True)
class Measurement:
    """The body as the controller sees it, in the frame of the ground: x forward, y left, z up."""

    com: np.ndarray
    """(3,) metres, relative to the ground frame's origin."""
    velocity: np.ndarray
    """(3,) m/s."""
    foot_centre: np.ndarray
    """(2,) metres: centre of the feet (nodes near the sole at rest)."""
    sole_height: float
    """Metres: lowest contact point above the plane."""
    in_contact: bool
    """Whether a contact force acts."""
    normal_load: float
    """Normal contact forces, body weights."""
    heading: float
    """Radians about z, from the start."""
    support: np.ndarray
    """(2, 2) metres: least and largest coordinates along the ground of what the body can press on now."""
    angular_velocity_term: np.ndarray
    """(2,) m/s: what the spin about the centre of mass adds to its speed along the ground in the momentum about the
    feet."""
    rotation: np.ndarray
    """(3, 3) best-fit rotation from the standing pose, world axes."""
    angular_momentum: np.ndarray
    """(3,) kg m^2/s about the centre of mass, world axes."""
    inertia: np.ndarray
    """(3, 3) kg m^2 about the centre of mass, world axes."""


@dataclass(frozen=True)
class GroundFrame:
    """A right-handed frame on the plane: rows of ``axes`` are forward, left and up."""

    axes: np.ndarray
    """(3, 3)."""
    origin: np.ndarray
    """(3,) metres, on the plane."""
    surface_normal: np.ndarray
    """(3,) unit, of the plane; up, but on a slope."""

    @classmethod
    def on_plane(
        cls, plane: Plane, forward: np.ndarray, below: np.ndarray, *, up: np.ndarray | None = None
    ) -> GroundFrame:
        """Frame with its origin on the plane under the point ``below``; ``forward`` is made horizontal.

        ``up`` (3,) is against gravity where the plane is a slope.
        """
        vertical = plane.normal if up is None else up
        flat = forward - (forward @ vertical) * vertical
        flat /= np.linalg.norm(flat)
        origin = below - plane.heights(below) / (plane.normal @ vertical) * vertical
        return cls(np.stack([flat, np.cross(vertical, flat), vertical]), origin, plane.normal)

    def rotation_about_up(self, angle: float) -> np.ndarray:
        """(3, 3) rotation by ``angle`` radians about up, world axes."""
        return Rotation.from_rotvec(angle * self.axes[2]).as_matrix()

    def local(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) to ground coordinates."""
        return (points - self.origin) @ self.axes.T

    def world(self, points: np.ndarray) -> np.ndarray:
        """Ground coordinates (..., 3) to world points."""
        return self.origin + points @ self.axes


class RestDetector:
    """Whether the centre of mass has been slow for long enough."""

    def __init__(self, body: SoftBody) -> None:
        gravity = float(np.linalg.norm(body.gravity))
        self._speed = REST_SPEED * np.sqrt(gravity * body.height)
        self._time = REST_TIME * float(np.sqrt(body.height / gravity))
        self._since: float | None = None

    def update(self, velocity: np.ndarray, time: float) -> bool:
        """To be asked in every step, with the ``velocity`` (3,) of the centre of mass, m/s, and the ``time``, s."""
        if np.linalg.norm(velocity) > self._speed:
            self._since = None
        elif self._since is None:
            self._since = time
        return self._since is not None and time - self._since > self._time


class BalanceController:
    """Affine poses of the rest shape, A = stretch along up, bulge across it, shear by the lean.

    See docs/concepts/motions.md.
    """

    def __init__(
        self, body: SoftBody, ground: GroundFrame, standing: np.ndarray, touching: np.ndarray, friction: float
    ) -> None:
        """``standing`` (N, 3): nodes at rest; ``touching`` (k, 3): points of the body on the ground then; ``friction``:
        Coulomb coefficient."""
        self.body, self.ground, self.friction = body, ground, friction
        self._normal = ground.axes @ ground.surface_normal
        local = ground.local(standing)
        self.arms = (local - body.centre_of_mass(local)) @ ground.axes
        """(N, 3) metres, world axes: the standing nodes from their centre of mass."""
        self.standing_height = float(body.centre_of_mass(local)[2])
        self._sole_share = sole_shares(body, ground, standing)
        self._standing = standing
        self.base_offset = self._base(local) - body.centre_of_mass(local)[:2]
        footprint = ground.local(touching)[:, :2] - body.centre_of_mass(local)[:2]
        self.support_low = np.minimum(footprint.min(axis=0), -0.01 * body.height)
        self.support_high = np.maximum(footprint.max(axis=0), 0.01 * body.height)

    def balance_targets(
        self, seen: Measurement, velocity: np.ndarray, spin: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The end velocity (3,) m/s of the centre of mass, ground axes, and spin (3,) rad/s, world axes, nearest to
        those asked for that feet can bring about without tipping or sliding.

        About the feet the momentum m h (v + swing) changes by the weight times the way from the centre of pressure to
        the centre of mass, so that centre, kept within the footprint, bounds the sum of both; friction bounds the one.
        """
        gravity = float(np.linalg.norm(self.body.gravity))
        up = max(gravity + (velocity[2] - seen.velocity[2]) / dt, 0.2 * gravity)
        height = self._com_height(seen.com)
        level = velocity[:2] - seen.velocity[:2]
        turn = self._angular_velocity_term(seen.inertia @ spin, height) - seen.angular_velocity_term

        def within_grip(change: np.ndarray) -> np.ndarray:
            push = np.array([*(change / dt), 0.0])
            return change * min(
                1.0, _share_in_cone(push, np.array([0.0, 0.0, up]), self._normal, FRICTION_FRACTION * self.friction)
            )

        level = within_grip(level)
        pressure = seen.com[:2] - height / up * (level + turn) / dt
        middle, reach = seen.support.mean(axis=0), 0.5 * SUPPORT_MARGIN * (seen.support[1] - seen.support[0])
        # Never ask for a fall: some push either way stays allowed even where the centre of mass is past the edge.
        slack = 0.04 * self.body.height
        low = np.minimum(middle - reach, seen.com[:2] - slack)
        high = np.maximum(middle + reach, seen.com[:2] + slack)
        both = (seen.com[:2] - np.clip(pressure, low, high)) * up / height * dt
        # Each gives way as its objective weighs it, speeds as they are, spins with the radius of gyration; what
        # friction denies the one, the other takes.
        share = 1.0 / (1.0 + 0.5 * np.trace(seen.inertia) / (self.body.mass * height**2))
        level = within_grip(level + share * (both - level - turn))
        turn = both - level
        swing = seen.angular_velocity_term + turn
        momentum = self.ground.axes @ seen.inertia @ spin
        momentum[:2] = self.body.mass * height * np.array([-swing[1], swing[0]])
        return (
            np.array([*(seen.velocity[:2] + level), velocity[2]]),
            np.linalg.solve(seen.inertia, self.ground.axes.T @ momentum),
        )

    def capture_acceleration(self, seen: Measurement, goal: np.ndarray) -> np.ndarray:
        """(2,) m/s^2 along the ground that brings a body that falls like a pendulum to rest over ``goal`` (2,).

        The capture point, of the momentum about the feet, is steered to it.
        """
        pendulum = self._pendulum_rate2(seen)
        return -2.0 * pendulum * (self._capture(seen) - goal) + pendulum * (seen.com[:2] - goal)

    def capture_margin(self, seen: Measurement) -> float:
        """How far the capture point is from the middle of what the body stands on, 1 at its edge: beyond it, it falls
        unless it steps."""
        middle, reach = seen.support.mean(axis=0), 0.5 * (seen.support[1] - seen.support[0])
        return float((np.abs(self._capture(seen) - middle) / np.maximum(reach, 1e-3 * self.body.height)).max())

    def _pendulum_rate2(self, seen: Measurement) -> float:
        """1/s^2, of the linear inverted pendulum."""
        return float(np.linalg.norm(self.body.gravity)) / self._com_height(seen.com)

    def _capture(self, seen: Measurement) -> np.ndarray:
        """(2,) where the body, told to hold there, would come to rest over its feet."""
        return seen.com[:2] + (seen.velocity[:2] + seen.angular_velocity_term) / np.sqrt(self._pendulum_rate2(seen))

    def _com_height(self, com: np.ndarray) -> float:
        """Metres: height of the centre of mass ``com`` (3,), ground coordinates, over the feet."""
        return max(float(com[2]), 0.3 * self.standing_height)

    def _angular_velocity_term(self, momentum: np.ndarray, height: float) -> np.ndarray:
        """(2,) of ``Measurement``, of an angular ``momentum`` (3,), world axes."""
        turning = self.ground.axes @ momentum / (self.body.mass * height)
        return np.array([turning[1], -turning[0]])

    def _base(self, local: np.ndarray) -> np.ndarray:
        return (self._sole_share @ local)[:2]

    def measure(self, state: BodyState, report: StepReport | None) -> Measurement:
        """What the controller sees."""
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

    def _support(self, local: np.ndarray, report: StepReport | None) -> np.ndarray:
        """(2, 2) of ``Measurement``: the whole footprint where nothing is on the ground."""
        if report is None or report.contacts.count == 0:
            return self._base(local) - self.base_offset + np.stack([self.support_low, self.support_high])
        contacts = report.contacts
        places = np.einsum("cw,cwi->ci", contacts.weights, local[contacts.nodes])[:, :2]
        return np.stack([places.min(axis=0), places.max(axis=0)])

    def _rotation(self, positions: np.ndarray) -> np.ndarray:
        arms = positions - self.body.centre_of_mass(positions)
        return kabsch_rotation(self.body.node_mass, self.arms, arms)

    def sole_heading(self, positions: np.ndarray) -> float:
        """Radians about the ground's normal by which the feet alone are turned from the standing pose."""
        return heading_between(self.arms, positions, self._sole_share, self.ground)

    def over_base(self, com: np.ndarray, base: np.ndarray, heading: float = 0.0) -> np.ndarray:
        """(3, 3) the pose whose sole is flat at ``base`` (2,) while the centre of mass is at ``com`` (3,),
        ground coordinates: sheared by the lean between them.
        """
        return self._leaning(com, base, heading, SHEAR_BASIS)

    def bent_over_base(self, com: np.ndarray, base: np.ndarray, heading: float = 0.0) -> np.ndarray:
        """(3, 3) the same of a body that bends as it does by itself: turned as far as that strains it least."""
        return self._leaning(com, base, heading, self._bending)

    def _leaning(self, com: np.ndarray, base: np.ndarray, heading: float, leans: np.ndarray) -> np.ndarray:
        """(3, 3) world matrix: stretch along up, half the volume kept by bulging, ``leans`` (2, 3, 3) for each unit of
        lean, then turned by ``heading`` radians."""
        turn = Rotation.from_rotvec([0.0, 0.0, heading]).as_matrix()
        lean = (com[:2] - base + turn[:2, :2] @ self.base_offset) / self.standing_height
        lean = lean * min(1.0, 0.5 / max(float(np.linalg.norm(lean)), 1e-9))
        stretch = float(np.clip(com[2] / self.standing_height, 0.6, 1.25))
        bulge = stretch**-0.25
        local = turn @ (np.diag([bulge, bulge, stretch]) + np.einsum("k,kij->ij", lean, leans))
        return self.ground.axes.T @ local @ self.ground.axes

    @cached_property
    def _bending(self) -> np.ndarray:
        """(2, 3, 3) ground axes: what a unit of lean ahead and to the left adds to the pose of a body that a pull along
        the ground bends, its sole held: the affine map nearest to its small displacements, by mass."""
        body, assembly, axes = self.body, self.body.assembly, self.ground.axes
        entries = assembly.hessian_entries(self._standing, projected=True)
        held = np.repeat(self._sole_share > 0.0, 3)
        entries[assembly.diagonal_entries] += _PINNED * entries.max() * held
        factors = MultifrontalLdl(assembly.upper_pattern, assembly.analysis)
        factors.update(entries)
        pulls = np.stack([np.kron(body.node_mass, axis) for axis in axes[:2]], axis=1)
        bent = factors.solve(pulls * ~held[:, None]).reshape(len(body.node_mass), 3, 2)
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
        seen: Measurement,
        *,
        com_velocity: np.ndarray,
        pose: np.ndarray,
        pose_rate: np.ndarray,
        spin: np.ndarray,
        follow: float,
        weights: Weights,
    ) -> list[AnyObjective]:
        """Objectives for a step: centre-of-mass velocity (3,) in ground axes, angular velocity ``spin`` (3,) in world
        axes, and a pose.

        ``pose`` (3, 3) is approached at rate ``follow`` (1/s) on top of its own ``pose_rate`` (3, 3).
        """
        body = self.body
        com = body.centre_of_mass(state.positions)
        arms = state.positions - com
        velocity = self.ground.axes.T @ com_velocity
        wanted = self.arms @ pose.T
        pose_velocity = velocity + self.arms @ pose_rate.T + follow * (wanted - arms)
        momentum = seen.inertia @ spin
        return [
            *self._balance(velocity, weights),
            AngularMomentumObjective(momentum, weights.spin),
            deformation_velocities(body, state.positions, pose_velocity, weights.pose),
        ]

    def _balance(self, velocity: np.ndarray, weights: Weights) -> list[Objective]:
        """``velocity`` (3,) of the centre of mass, world axes."""
        both = centre_of_mass_velocity(self.body, velocity, weights.com)
        if weights.up == weights.com:
            return [both]
        level, up = self.ground.axes[:2], self.ground.axes[2:]
        return [
            replace(both, rows=level @ both.rows, target=level @ velocity),
            replace(both, rows=up @ both.rows, target=up @ velocity, weight=weights.up),
        ]

    def turn_towards(self, seen: Measurement, pose: np.ndarray) -> np.ndarray:
        """(3,) rotation vector, world axes, from the measured best-fit rotation to that of ``pose``."""
        wanted = kabsch_rotation(self.body.node_mass, self.arms, self.arms @ pose.T)
        return Rotation.from_matrix(wanted @ seen.rotation.T).as_rotvec()


def _share_in_cone(push: np.ndarray, held: np.ndarray, normal: np.ndarray, friction: float) -> float:
    """Largest s for which ``held`` + s ``push`` (3,) is in the friction cone about ``normal`` (3,); 0 where ``held`` is
    not; infinite where ``push`` never leaves it."""
    wide = 1.0 + friction**2
    a = float(push @ push - wide * (push @ normal) ** 2)
    b = float(push @ held - wide * (push @ normal) * (held @ normal))
    c = float(held @ held - wide * (held @ normal) ** 2)
    if c > 0.0:
        return 0.0
    if a <= 0.0:
        return float("inf")
    return (float(np.sqrt(b * b - a * c)) - b) / a


def sole_shares(body: SoftBody, ground: GroundFrame, standing: np.ndarray) -> np.ndarray:
    """(N,) weights, sum 1, whose mean is the centre of the feet:
    the mass of the nodes that are near the ground at rest.
    """
    heights = standing @ ground.surface_normal
    mass = body.node_mass * (heights < heights.min() + SOLE_HEIGHT * body.height)
    return mass / mass.sum()


def heading_between(before: np.ndarray, after: np.ndarray, share: np.ndarray, ground: GroundFrame) -> float:
    """Radians about the ground's up by which points ``before`` (N, 3), weighted by ``share`` (N,),
    best turn to ``after``.
    """
    flat_before, flat_after = ((x - share @ x) @ ground.axes[:2].T for x in (before, after))
    sine = share @ (flat_before[:, 0] * flat_after[:, 1] - flat_before[:, 1] * flat_after[:, 0])
    return float(np.arctan2(sine, share @ (flat_before * flat_after).sum(axis=1)))
