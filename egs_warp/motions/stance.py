"""Measurement of a body, ground frames, detection of rest, and the balance controller with its family of poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.balance import SQUARE, Balance, Measurement, Weights
from egs_warp.motions.moments import ReducedState, part_moments, reduced_state
from egs_warp.motions.support import SupportPolygon

_PIN_STIFFNESS = 1e6
"""Stiffness with which a node is pinned, relative to the largest entry of the stiffness matrix."""
SOLE_HEIGHT = 0.06
"""Height of the sole above the lowest node of a standing body, body heights."""
REST_SPEED = 0.03
"""Speed of the centre of mass, in sqrt(g H), below which a standing body is considered slow."""
REST_TIME = 0.3
"""Time in sqrt(H / g) for which a body must be slow to be considered at rest."""
_MIN_FOOTPRINT = 0.01
"""Half width in body heights of the square about the centre of mass that every footprint contains."""


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
    """Detector of rest: a body is at rest if its centre of mass has been slow for ``REST_TIME``."""

    def __init__(self, body: SoftBody) -> None:
        self._body = body
        self._since = np.asarray(np.nan)

    def update(self, velocity: np.ndarray, time: float) -> bool:
        """Update the detector; call it in every time step.

        Args:
            velocity: (3,) m/s, velocity of the centre of mass.
            time: current time, s.

        Returns:
            True if the body is at rest.
        """
        body = self._body
        self._since, at_rest = update_rest(self._since, velocity, np.asarray(time), body.speed_unit, body.time_unit)
        return bool(at_rest)


def update_rest(
    since: np.ndarray, velocity: np.ndarray, time: np.ndarray, speed_unit: float, time_unit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Update the times since which bodies are slow; call it in every time step.

    Args:
        since: (...,) s, times before the step; NaN for bodies that were not slow.
        velocity: (..., 3) m/s, velocity of the centre of mass.
        time: (...,) s, current time.
        speed_unit: sqrt(g H), m/s.
        time_unit: sqrt(H / g), s.

    Returns:
        The updated times, and (...,) bool, True for bodies at rest.
    """
    is_slow = np.linalg.norm(velocity, axis=-1) <= REST_SPEED * speed_unit
    since = np.where(is_slow, np.where(np.isnan(since), time, since), np.nan)
    return since, time - since > REST_TIME * time_unit


class BalanceController:
    """Balance controller (``Balance``) of one standing body."""

    def __init__(
        self,
        body: SoftBody,
        ground: GroundFrame,
        standing: np.ndarray,
        contact_points: np.ndarray,
        friction: float,
        *,
        soles: Sequence[np.ndarray] = (),
    ) -> None:
        """Create the controller.

        Args:
            body: the body.
            ground: ground frame.
            standing: (N, 3) m, nodes at rest.
            contact_points: (k, 3) m, points of the body on the ground at rest.
            friction: Coulomb coefficient.
            soles: nodes of each sole whose moments are measured in addition.
        """
        self.body, self.ground = body, ground
        local = ground.local(standing)
        com = body.centre_of_mass(local)
        self.reference = local - com
        """(N, 3) m, standing nodes relative to their centre of mass, ground axes."""
        self.arms = self.reference @ ground.axes
        """(N, 3) m, standing nodes relative to their centre of mass, world axes."""
        self._sole_share = sole_shares(body, ground, standing)
        self.shares = np.stack(
            [body.node_mass / body.mass, self._sole_share, *(_shares_of(body, sole) for sole in soles)]
        )
        """(P, N) shares of the nodes in the mass of the body, of its base and of each sole."""
        self._standing = standing
        if len(contact_points) == 0:
            raise UserError(
                "body: no point of the body is on the ground at the start; check the ground", check=("plane", "up")
            )
        footprint = ground.local(contact_points)[:, :2] - com[:2]
        # Include a small square, because the centre of mass of a standing body lies in its footprint even if few points
        # are in contact.
        self.balance = Balance(
            mass=body.mass,
            height=body.height,
            gravity=float(np.linalg.norm(body.gravity)),
            axes=ground.axes,
            origin=ground.origin,
            normal=ground.axes @ ground.surface_normal,
            friction=np.asarray(friction),
            standing_height=np.asarray(com[2]),
            base_offset=(self._sole_share @ local)[:2] - com[:2],
            footprint=SupportPolygon.hull(np.concatenate([footprint, _MIN_FOOTPRINT * body.height * SQUARE])),
            standing=part_moments(self.shares, self.reference, standing, np.zeros_like(standing)),
            gesture_turn=np.zeros(3),
        )

    @property
    def gesture_turn(self) -> np.ndarray:
        """(3,) rotation vector of the body that is caused by gestures of its parts; see ``Balance.gesture_turn``."""
        return self.balance.gesture_turn

    @gesture_turn.setter
    def gesture_turn(self, turn: np.ndarray) -> None:
        self.balance.gesture_turn[:] = turn

    @property
    def friction(self) -> float:
        """Coulomb coefficient."""
        return float(self.balance.friction)

    @property
    def standing_height(self) -> float:
        """Height of the centre of mass at rest, m."""
        return float(self.balance.standing_height)

    @property
    def base_offset(self) -> np.ndarray:
        """(2,) m, position of the middle of the feet relative to the centre of mass at rest, ground axes."""
        return self.balance.base_offset

    @property
    def footprint(self) -> SupportPolygon:
        """Hull of the contact points at rest, relative to the centre of mass."""
        return self.balance.footprint

    def balance_targets(
        self, measurement: Measurement, velocity: np.ndarray, spin: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Project the requested velocities onto the feasible set; see ``Balance.balance_targets``."""
        return self.balance.balance_targets(measurement, velocity, spin, dt)

    def capture_acceleration(self, measurement: Measurement, goal: np.ndarray) -> np.ndarray:
        """Return the acceleration (2,) that brings the body to rest; see ``Balance.capture_acceleration``."""
        return self.balance.capture_acceleration(measurement, goal)

    def capture_margin(self, measurement: Measurement) -> float:
        """Return the relative distance of the capture point from the middle; see ``Balance.capture_margin``."""
        return float(self.balance.capture_margin(measurement))

    def turn_towards(self, measurement: Measurement, pose: np.ndarray) -> np.ndarray:
        """Return the rotation vector (3,) to a ``pose`` (3, 3); see ``Balance.turn_towards``."""
        return self.balance.turn_towards(measurement, pose)

    def reduced(self, state: BodyState, report: StepReport | None) -> ReducedState:
        """Return the reduced state of the body; ``report`` is the report of the previous time step."""
        return reduced_state(self.body, self.shares, self.reference, state, report)

    def measure(self, state: BodyState, report: StepReport | None) -> Measurement:
        """Measure the body; ``report`` is the report of the previous time step."""
        return self.balance.measure(self.reduced(state, report))

    def sole_heading(self, positions: np.ndarray) -> float:
        """Return the rotation of the feet about the up axis relative to the standing pose, radians."""
        return heading_between(self.arms, positions, self._sole_share, self.ground)

    def over_base(self, com: np.ndarray, base: np.ndarray, heading: float = 0.0) -> np.ndarray:
        """Return the pose (3, 3) with a flat sole at ``base`` (2,) and the centre of mass at ``com`` (3,), ground
        coordinates: the body is sheared by the lean between both."""
        return self.balance.leaning_pose(com, base, heading)

    def bent_over_base(self, com: np.ndarray, base: np.ndarray, heading: float = 0.0) -> np.ndarray:
        """Return the pose (3, 3) for the arguments of ``over_base`` if the body leans by bending, with the rotation
        that minimizes its strain."""
        return self.balance.leaning_pose(com, base, heading, self.bending)

    @cached_property
    def bending(self) -> np.ndarray:
        """(2, 3, 3) derivatives of the pose with respect to lean forward and to the left, ground axes, if a horizontal
        body force bends the body and its sole is fixed: the mass-weighted least-squares affine fit of its small
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
        """Return the objectives of a time step from ``state``; the other arguments are those of ``Balance.objectives``,
        without a world axis."""
        moments = part_moments(self.shares, self.reference, state.positions, state.velocities)
        reduced = self.balance.objectives(
            moments,
            measurement,
            com_velocity=com_velocity,
            pose=pose,
            pose_rate=pose_rate,
            spin=spin,
            follow=follow,
            weights=weights,
        )
        return reduced.with_world_axis().of_one_world(self.shares, state.positions)


def _shares_of(body: SoftBody, nodes: np.ndarray) -> np.ndarray:
    """Return the shares (N,) of ``nodes`` in their total mass; 0 for all other nodes."""
    shares = np.zeros(len(body.node_mass))
    shares[nodes] = body.node_mass[nodes]
    return shares / shares.sum()


def sole_shares(body: SoftBody, ground: GroundFrame, standing: np.ndarray) -> np.ndarray:
    """Return weights (N,) with sum 1, proportional to the masses of the nodes that are near the ground at rest. The
    weighted mean of all nodes is the centre of the feet."""
    heights = standing @ ground.surface_normal
    mass = body.node_mass * (heights < heights.min() + SOLE_HEIGHT * body.height)
    return mass / mass.sum()


def heading_between(before: np.ndarray, after: np.ndarray, share: np.ndarray, ground: GroundFrame) -> float:
    """Return the best-fit rotation angle in radians about the up axis from points ``before`` (N, 3) to ``after`` (N,
    3), weighted by ``share`` (N,)."""
    flat_before, flat_after = ((x - share @ x) @ ground.axes[:2].T for x in (before, after))
    sine = share @ (flat_before[:, 0] * flat_after[:, 1] - flat_before[:, 1] * flat_after[:, 0])
    return float(np.arctan2(sine, share @ (flat_before * flat_after).sum(axis=1)))
