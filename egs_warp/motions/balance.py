"""Balance of standing bodies: measured quantities, the family of target poses, and target velocities that do not tip
the body (docs/concepts/motions.md).

In the shapes below, "..." is the world axis, or nothing for one world.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from egs_warp.fem.batched import BatchedRecord
from egs_warp.geometry.frames import dots, nearest_rotation, times
from egs_warp.locomotion.reduced_objectives import (
    AffineObjectives,
    ReducedObjectives,
    centre_of_mass_objectives,
    strain_objectives,
)
from egs_warp.motions.free_turn import rotation_vectors, rotations_of
from egs_warp.motions.moments import PartMoments, ReducedState
from egs_warp.motions.pendulum import capture_point, momentum_as_velocity
from egs_warp.motions.support import SupportPolygon

SHEAR_BASIS = np.einsum("ki,j->kij", np.eye(3)[:2], np.eye(3)[2])
"""(2, 3, 3) derivatives of a sheared pose with respect to the lean forward and to the left."""
SUPPORT_MARGIN = 0.95
"""Fraction of the footprint within which the centre of pressure stays."""
_PUSH_REACH = 0.04
"""Half width, in body heights, of the square about the centre of mass in which the centre of pressure may always lie,
even outside the footprint."""
_BALANCE_PRIORITY_MARGINS = (0.25, 0.5)
"""Capture margins (``Balance.capture_margin``) between which the priority of balance over uprighting grows from 0 to
1."""
MAX_LEAN = 0.5
"""Largest lean of a target pose (``Balance.leaning_pose``), relative to the standing height of the centre of mass."""
SQUARE = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
"""(4, 2) corners of a square about the origin."""
FRICTION_FRACTION = 0.95
"""Fraction of the friction cone that objectives may use; with a larger fraction, feet slide and other objectives are
missed."""


@dataclass(frozen=True)
class Weights(BatchedRecord):
    """Weights of a motion's objectives, numbers or arrays (...,); speeds are measured in units of sqrt(g H).

    The weights are large compared to the weight of muscle effort, so that balance has priority over low effort.
    """

    com: Any = 600.0
    """Weight of the velocity of the centre of mass along the ground."""
    up: Any = 600.0
    """Weight of the upward velocity of the centre of mass."""
    spin: Any = 600.0
    pose: Any = 0.02
    landing: Any = 0.1
    """Factor on ``com``, ``up`` and ``spin`` after touch-down, when the body has to come to rest, but not at a
    prescribed time. The same factor applies to ``com`` while the body follows key frames."""


@dataclass(frozen=True)
class Measurement(BatchedRecord):
    """Measured quantities of a body in the ground frame: x forward, y left, z up."""

    com: np.ndarray
    """(..., 3) m, centre of mass relative to the origin of the ground frame."""
    velocity: np.ndarray
    """(..., 3) m/s, velocity of the centre of mass."""
    foot_centre: np.ndarray
    """(..., 2) m, centre of the feet: the nodes that are near the ground at rest."""
    sole_height: np.ndarray
    """(...,) m, height of the lowest contact point above the ground, or above a body that supports it."""
    in_contact: np.ndarray
    """(...,) bool, True if a contact force acts."""
    normal_load: np.ndarray
    """(...,) sum of the normal contact forces, body weights."""
    heading: np.ndarray
    """(...,) radians about z, heading relative to the start."""
    sole_heading: np.ndarray
    """(...,) radians about z, rotation of the feet relative to the start."""
    support: SupportPolygon
    """Hull of the points in contact, ground coordinates."""
    angular_velocity_term: np.ndarray
    """(..., 2) m/s, contribution of the spin to the angular momentum about the feet, expressed as a velocity of the
    centre of mass along the ground."""
    rotation: np.ndarray
    """(..., 3, 3) best-fit rotation from the standing pose, world axes."""
    angular_momentum: np.ndarray
    """(..., 3) kg m^2/s, angular momentum about the centre of mass, world axes."""
    inertia: np.ndarray
    """(..., 3, 3) kg m^2, inertia tensor about the centre of mass, world axes."""


@dataclass(frozen=True)
class Balance(BatchedRecord):
    """Balance controllers of one or many worlds: measurement, target poses and target velocities.

    Target poses are affine maps of the rest shape: stretch along the up axis, bulging across it, and shear or bending
    by the lean.
    """

    mass: float
    """kg, mass of the body."""
    height: float
    """m, height of the body."""
    gravity: float
    """m/s^2, magnitude of gravity."""
    axes: np.ndarray
    """(..., 3, 3) axes of the ground frame, as rows."""
    origin: np.ndarray
    """(..., 3) m, origin of the ground frame."""
    normal: np.ndarray
    """(..., 3) unit normal of the ground surface, ground axes."""
    friction: np.ndarray
    """(...,) Coulomb coefficient."""
    standing_height: np.ndarray
    """(...,) m, height of the centre of mass at rest."""
    base_offset: np.ndarray
    """(..., 2) m, position of the middle of the feet relative to the centre of mass at rest, ground axes."""
    footprint: SupportPolygon
    """Hull of the contact points at rest, relative to the centre of mass."""
    standing: PartMoments
    """Moments of the body at rest. The reference arms of all moments are those of the nodes at rest, ground axes."""

    gesture_turn: np.ndarray
    """(..., 3) rotation vector of the body that is caused by gestures of its parts, radians, ground axes; it is
    excluded from the measured rotation."""

    def fall_time(self, velocity: np.ndarray, gap: np.ndarray) -> np.ndarray:
        """Return the time (...,) in seconds until a body in free flight with ``velocity`` (..., 3) m/s has moved by
        ``gap`` (...,) m, not negative, towards the ground, which may slope."""
        speed, pull = dots(velocity, self.normal), self.gravity * self.normal[..., 2]
        return (speed + np.sqrt(speed**2 + 2.0 * pull * gap)) / pull

    def measure(self, state: ReducedState) -> Measurement:
        """Measure the body from its reduced ``state``; the second part of the state is the centre of the feet."""
        moments, mass = state.moments, self.mass
        rotation = nearest_rotation(moments.cross[..., 0, :, :] @ self.axes)
        if self.gesture_turn.any():
            rotation = rotations_of(-times(self.axes.swapaxes(-1, -2), self.gesture_turn)) @ rotation
        com, feet = (times(self.axes, moments.centres[..., part, :] - self.origin) for part in (0, 1))
        momentum, second = mass * moments.spin, moments.second[..., 0, :, :]
        trace = np.trace(second, axis1=-2, axis2=-1)[..., None, None]
        return Measurement(
            com=com,
            velocity=times(self.axes, moments.velocity),
            foot_centre=feet[..., :2],
            sole_height=state.gap,
            in_contact=state.load > 1e-6 * mass * self.gravity,
            normal_load=state.load / (mass * self.gravity),
            heading=_angle_about_up(self.axes @ rotation @ self.axes.swapaxes(-1, -2)),
            sole_heading=_angle_about_up(self.axes @ moments.cross[..., 1, :, :]),
            support=self._support(state, feet[..., :2]),
            angular_velocity_term=self._angular_velocity_term(momentum, self._com_height(com)),
            rotation=rotation,
            angular_momentum=momentum,
            inertia=mass * (trace * np.eye(3) - second),
        )

    def _support(self, state: ReducedState, feet: np.ndarray) -> SupportPolygon:
        """Return ``Measurement.support``; without contacts, the footprint at rest. ``feet`` (..., 2) are the middles of
        the feet."""
        at_rest = self.footprint.moved(feet - self.base_offset)
        has_contacts = state.contact_counts > 0
        if not has_contacts.any():
            return at_rest
        points = times(self.axes[..., None, :, :], state.contact_points - self.origin[..., None, :])[..., :2]
        if has_contacts.all():
            return SupportPolygon.hull(np.ascontiguousarray(points), state.contact_counts)
        # The polygon is returned as the hull of its own corners.
        most = max(points.shape[-2], at_rest.corners.shape[-2])
        either = np.where(has_contacts[..., None, None], _widened(points, most), _widened(at_rest.corners, most))
        counts = np.where(has_contacts, state.contact_counts, at_rest.corners.shape[-2])
        return SupportPolygon.hull(either, counts)

    def balance_targets(
        self, measurement: Measurement, velocity: np.ndarray, spin: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Project the requested velocities onto the set that the feet can produce without tipping or slipping.

        The rate of change of the angular momentum about the feet, m h (v + angular_velocity_term), is the weight times
        the horizontal distance from the centre of pressure to the centre of mass. The sum of both terms is bounded
        because the centre of pressure must stay in the footprint; the first term is bounded by friction.

        Args:
            measurement: measured body.
            velocity: (..., 3) m/s, requested velocity of the centre of mass, ground axes.
            spin: (..., 3) rad/s, requested angular velocity, world axes.
            dt: time step, s.

        Returns:
            Velocity (..., 3) in m/s and spin (..., 3) in rad/s at the end of the step.
        """
        gravity = self.gravity
        up = np.maximum(gravity + (velocity[..., 2] - measurement.velocity[..., 2]) / dt, 0.2 * gravity)
        height = self._com_height(measurement.com)
        level = velocity[..., :2] - measurement.velocity[..., :2]
        requested = times(measurement.inertia, spin)
        turn = self._angular_velocity_term(requested, height) - measurement.angular_velocity_term
        load = up[..., None] * np.array([0.0, 0.0, 1.0])

        def within_grip(change: np.ndarray) -> np.ndarray:
            push = np.concatenate([change / dt, np.zeros_like(change[..., :1])], axis=-1)
            share = _share_in_cone(push, load, self.normal, FRICTION_FRACTION * self.friction)
            return change * np.minimum(1.0, share)[..., None]

        level = within_grip(level)
        com = measurement.com[..., :2]
        pressure = com - (height / up)[..., None] * (level + turn) / dt
        # Allow a small push in any direction even if the centre of mass is beyond the edge, so that the targets never
        # require the body to fall.
        slack = com[..., None, :] + _PUSH_REACH * self.height * SQUARE
        allowed = SupportPolygon.hull(np.concatenate([measurement.support.scaled(SUPPORT_MARGIN).corners, slack], -2))
        both = (com - allowed.nearest(pressure)) * (up / height)[..., None] * dt
        # Distribute the reduction over both terms according to the costs of their objectives; the radius of gyration
        # converts spins to speeds. The part of the speed that exceeds the friction limit is assigned to the spin.
        trace = np.trace(measurement.inertia, axis1=-2, axis2=-1)
        share = 1.0 / (1.0 + 0.5 * trace / (self.mass * height**2))
        shared = level + share[..., None] * (both - level - turn)
        # Uprighting must not drive the centre of mass away from the feet: if the capture point is far out, the body
        # must not move outward faster than it would without uprighting.
        away = self._capture(measurement) - measurement.support.middle
        away = away / np.maximum(np.linalg.norm(away, axis=-1), 1e-12)[..., None]
        excess = np.maximum(dots(away, shared) - np.maximum(dots(away, level), dots(away, both)), 0.0)
        level = within_grip(shared - (self._balance_priority(measurement) * excess)[..., None] * away)
        swing = measurement.angular_velocity_term + both - level
        momentum = times(self.axes, requested)
        momentum[..., 0] = -self.mass * height * swing[..., 1]
        momentum[..., 1] = self.mass * height * swing[..., 0]
        return (
            np.concatenate([measurement.velocity[..., :2] + level, velocity[..., 2:]], axis=-1),
            solved(measurement.inertia, times(self.axes.swapaxes(-1, -2), momentum)),
        )

    def capture_acceleration(self, measurement: Measurement, goal: np.ndarray) -> np.ndarray:
        """Return the acceleration (..., 2) in m/s^2 along the ground that brings an inverted pendulum to rest over
        ``goal`` (..., 2). It steers the capture point, computed from the angular momentum about the feet, to the goal.
        """
        pendulum = self._pendulum_rate2(measurement)[..., None]
        return -2.0 * pendulum * (self._capture(measurement) - goal) + pendulum * (measurement.com[..., :2] - goal)

    def capture_margin(self, measurement: Measurement) -> np.ndarray:
        """Return the distance (...,) of the capture point from the middle of the support, as a fraction of the distance
        to the edge in the same direction. Beyond 1, the body falls unless it steps."""
        return measurement.support.relative_distance(self._capture(measurement), 1e-3 * self.height)

    def _balance_priority(self, measurement: Measurement) -> np.ndarray:
        """Return the priority (...,) of balance over uprighting, from 0 to 1."""
        start, full = _BALANCE_PRIORITY_MARGINS
        return np.clip((self.capture_margin(measurement) - start) / (full - start), 0.0, 1.0)

    def _pendulum_rate2(self, measurement: Measurement) -> np.ndarray:
        """Return the squared rate (...,) of the linear inverted pendulum, g / h, 1/s^2."""
        return self.gravity / self._com_height(measurement.com)

    def _capture(self, measurement: Measurement) -> np.ndarray:
        """Return the capture point (..., 2), over which the feet could bring the body to rest."""
        velocity = measurement.velocity[..., :2] + measurement.angular_velocity_term
        return capture_point(measurement.com[..., :2], velocity, np.sqrt(self._pendulum_rate2(measurement)))

    def _com_height(self, com: np.ndarray) -> np.ndarray:
        """Return the height (...,) in metres of the centre of mass ``com`` (..., 3), ground coordinates, above the
        feet; at least 0.3 of the standing height."""
        return np.maximum(com[..., 2], 0.3 * self.standing_height)

    def _angular_velocity_term(self, momentum: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Return ``Measurement.angular_velocity_term`` (..., 2) of an angular ``momentum`` (..., 3), world axes."""
        return momentum_as_velocity(times(self.axes, momentum), self.mass, height)

    def leaning_pose(
        self, com: np.ndarray, base: np.ndarray, heading: np.ndarray | float = 0.0, leans: np.ndarray = SHEAR_BASIS
    ) -> np.ndarray:
        """Return the pose (..., 3, 3), world axes, with a flat sole at ``base`` and the centre of mass at ``com``:
        stretch along the up axis; bulging, which cancels half of the volume change; lean; and a rotation.

        Args:
            com: (..., 3) m, ground coordinates.
            base: (..., 2) m, ground coordinates.
            heading: (...,) radians, rotation about the up axis.
            leans: (..., 2, 3, 3) derivatives of the pose with respect to lean forward and to the left, ground axes. The
                default shears the body.
        """
        cosine, sine = np.cos(heading), np.sin(heading)
        turn = np.zeros((*np.shape(heading), 3, 3))
        turn[..., 0, 0] = turn[..., 1, 1] = cosine
        turn[..., 0, 1], turn[..., 1, 0], turn[..., 2, 2] = -sine, sine, 1.0
        lean = com[..., :2] - base + times(turn[..., :2, :2], self.base_offset)
        lean = lean / self.standing_height[..., None]
        lean = lean * np.minimum(1.0, MAX_LEAN / np.maximum(np.linalg.norm(lean, axis=-1), 1e-9))[..., None]
        stretch = np.clip(com[..., 2] / self.standing_height, 0.6, 1.25)
        bulge = stretch**-0.25
        stretches = np.stack([bulge, bulge, stretch], axis=-1)[..., None] * np.eye(3)
        local = turn @ (stretches + (lean[..., None, None] * leans).sum(axis=-3))
        return self.axes.swapaxes(-1, -2) @ local @ self.axes

    def turn_towards(self, measurement: Measurement, pose: np.ndarray) -> np.ndarray:
        """Return the rotation vector (..., 3), world axes, from the measured best-fit rotation to the best-fit rotation
        of ``pose`` (..., 3, 3)."""
        target = nearest_rotation(pose @ self.standing.second[..., 0, :, :])
        return rotation_vectors(target @ measurement.rotation.swapaxes(-1, -2))

    def objectives(
        self,
        moments: PartMoments,
        measurement: Measurement,
        *,
        com_velocity: np.ndarray,
        pose: np.ndarray,
        pose_rate: np.ndarray,
        spin: np.ndarray,
        follow: np.ndarray | float,
        weights: Weights,
    ) -> ReducedObjectives:
        """Return the objectives of a time step.

        Args:
            moments: moments at the start of the time step.
            measurement: measured body.
            com_velocity: (..., 3) m/s, target velocity of the centre of mass, ground axes.
            pose: (..., 3, 3) target pose, world axes.
            pose_rate: (..., 3, 3) 1/s, rate of the target pose.
            spin: (..., 3) rad/s, target angular velocity, world axes.
            follow: (...,) 1/s, rate at which the pose is approached.
            weights: weights of the objectives.
        """
        parts, second = moments.centres.shape[-2], moments.second[..., 0, :, :]
        rate = np.asarray(follow)[..., None, None]
        from_standing = (moments.cross[..., 0, :, :] @ self.axes).swapaxes(-1, -2)
        shape = (pose_rate + rate * pose) @ from_standing - rate * second
        one = np.ones(com_velocity.shape[:-1])
        by_axis = np.stack([weights.com * one, weights.com * one, weights.up * one], axis=-1)
        return ReducedObjectives(
            AffineObjectives.combined(
                [
                    centre_of_mass_objectives(parts, self.axes, com_velocity, by_axis),
                    strain_objectives(parts, second, shape, weights.pose * one),
                ]
            ),
            times(measurement.inertia, spin),
            weights.spin * one,
        )


def solved(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the solutions (..., 3) of linear systems with ``matrices`` (..., 3, 3) and right sides ``vectors``
    (..., 3)."""
    return np.linalg.solve(matrices, vectors[..., None])[..., 0]


def _angle_about_up(matrix: np.ndarray) -> np.ndarray:
    """Return the angle (...,) of the best-fit rotation about the third axis to ``matrix`` (..., 3, 3)."""
    return np.arctan2(matrix[..., 1, 0] - matrix[..., 0, 1], matrix[..., 0, 0] + matrix[..., 1, 1])


def _share_in_cone(push: np.ndarray, load: np.ndarray, normal: np.ndarray, friction: np.ndarray | float) -> np.ndarray:
    """Return the largest s (...,) for which ``load`` + s ``push`` (..., 3) is in the friction cone about ``normal``
    (..., 3). It is 0 if ``load`` is outside the cone, and infinite if no s leads out of the cone."""
    wide = 1.0 + np.square(friction)
    a = dots(push, push) - wide * dots(push, normal) ** 2
    b = dots(push, load) - wide * dots(push, normal) * dots(load, normal)
    c = dots(load, load) - wide * dots(load, normal) ** 2
    leaves = a > 0.0
    share = (np.sqrt(np.maximum(b * b - a * c, 0.0)) - b) / np.where(leaves, a, 1.0)
    return np.where(c > 0.0, 0.0, np.where(leaves, share, np.inf))


def _widened(points: np.ndarray, count: int) -> np.ndarray:
    """Return ``points`` (..., k, 2), padded with zeros to (..., count, 2)."""
    wide = np.zeros((*points.shape[:-2], count, 2))
    wide[..., : points.shape[-2], :] = points
    return wide
