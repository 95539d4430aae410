"""Joints: points of two bodies, or of a body and the world, that stay together (docs/concepts/bodies.md).

A joint has three equality rows B x = c on the nodal positions at the end of a step. The rows are linear, because the
points are embedded with constant weights, so every step closes the joints up to rounding. The multipliers of the rows
are the impulses of the joints; -B^T maps them to forces on the nodes that cancel in force and torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.linalg import block_diag

from egs_warp.fem.step_problem import StepProblem

_RANK_TOLERANCE = 1e-9
"""Singular values below this fraction of the largest one count as zero."""


@dataclass(frozen=True)
class BodyPoint:
    """Point that moves with a tetrahedron of a body."""

    body: int
    """Index of the body."""
    nodes: np.ndarray
    """(4,) int, nodes of the tetrahedron."""
    weights: np.ndarray
    """(4,) barycentric weights, sum 1; negative if the point is outside the tetrahedron."""


@dataclass(frozen=True)
class PointJoint:
    """Joint of two points of different bodies, or of one point and a fixed place."""

    points: tuple[BodyPoint, ...]
    """One or two points."""
    place: np.ndarray
    """(3,) m, place of the joint at the start, where a single point stays."""

    @property
    def bodies(self) -> tuple[int, ...]:
        """Indices of the bodies of the points."""
        return tuple(point.body for point in self.points)

    @property
    def signs(self) -> tuple[float, ...]:
        """Signs with which the force of the joint acts on the body of each point."""
        return (1.0, -1.0)[: len(self.points)]

    def among(self, members: Sequence[int]) -> PointJoint:
        """Return the joint with the positions of its bodies in ``members`` as their indices."""
        return replace(self, points=tuple(replace(point, body=members.index(point.body)) for point in self.points))


@dataclass(frozen=True)
class JointForces:
    """Forces of k joints on one body in a step."""

    joints: np.ndarray
    """(k,) int, index of each joint in the world."""
    nodes: np.ndarray
    """(k, 4) int, nodes of the tetrahedron of each point."""
    weights: np.ndarray
    """(k, 4) barycentric weights of each point."""
    forces: np.ndarray
    """(k, 3) N, forces on the body in world axes."""

    def nodal_forces(self, node_count: int) -> np.ndarray:
        """Return the forces (N, 3) N on the N nodes."""
        forces = np.zeros((node_count, 3))
        np.add.at(forces, self.nodes, self.weights[:, :, None] * self.forces[:, None])
        return forces


@dataclass(frozen=True)
class JointRows:
    """Rows of j joints of an island with N nodes."""

    joints: tuple[PointJoint, ...]
    """The joints, whose bodies are indices in the island."""
    matrix: np.ndarray
    """(3j, 3N) matrix B, three rows for each joint."""
    places: np.ndarray
    """(3j,) m, right side c: the places of joints with one point, otherwise zero."""

    @classmethod
    def of(cls, joints: Sequence[PointJoint], node_starts: np.ndarray) -> Self:
        """Return the rows of ``joints``; ``node_starts`` (k + 1,) are the first node of each body and N."""
        matrix = np.zeros((len(joints), int(node_starts[-1])))
        for row, joint in enumerate(joints):
            for point, sign in zip(joint.points, joint.signs, strict=True):
                matrix[row, node_starts[point.body] + point.nodes] = sign * point.weights
        places = [joint.place if len(joint.points) == 1 else np.zeros(3) for joint in joints]
        return cls(tuple(joints), np.kron(matrix, np.eye(3)), np.concatenate(places))


class StepJoints:
    """Joints in one step of an island: feasible velocities, and the impulses that a residual contains."""

    def __init__(self, rows: JointRows, problems: Sequence[StepProblem], is_driven: Sequence[bool], dt: float) -> None:
        """Collect the data of a step.

        Args:
            rows: rows of the joints.
            problems: step of each body.
            is_driven: True for each body that follows a path, whose velocities joints do not change.
            dt: step size, s.
        """
        self.rows, matrix = rows, rows.matrix
        positions = np.concatenate([problem.state.positions.ravel() for problem in problems])
        self._speeds = (rows.places - matrix @ positions) / dt
        """(3j,) m/s, row velocities B v that close the joints at the end of the step."""
        parts = [(p.coordinate_mass, p.residual_scale, driven) for p, driven in zip(problems, is_driven, strict=True)]
        self._mass = np.concatenate([mass for mass, _, _ in parts])
        self._inverse_mass = np.concatenate([np.where(driven, 0.0, 1.0 / mass) for mass, _, driven in parts])
        squares = np.concatenate([np.where(driven, 0.0, np.full(len(m), scale**-2.0)) for m, scale, driven in parts])
        modes = [
            np.zeros((len(p.coordinate_mass), 0)) if driven else _rigid_modes(p)
            for p, driven in zip(problems, is_driven, strict=True)
        ]
        self._modes = block_diag(*modes)
        """(3N, 6k) nodal velocities of the rigid motions of the bodies that forces move."""
        self._of_modes = matrix @ self._modes
        # Least squares of the residual without impulses, in the units of ``IslandProblem.relative_norm``.
        scaled = matrix * squares
        self._estimate = np.linalg.solve(scaled @ matrix.T, scaled)
        self._correction = np.linalg.pinv(self._of_modes.T, rcond=_RANK_TOLERANCE)

    def feasible(self, velocities: np.ndarray) -> np.ndarray:
        """Return velocities (N, 3) m/s that close the joints, near ``velocities`` (N, 3): they differ by rigid motions
        as far as these suffice."""
        v, matrix = velocities.ravel(), self.rows.matrix
        kinetic = self._modes.T @ (self._modes * self._mass[:, None])
        response = np.linalg.solve(kinetic, self._of_modes.T)
        impulses = np.linalg.lstsq(self._of_modes @ response, self._speeds - matrix @ v, rcond=_RANK_TOLERANCE)[0]
        v = v + self._modes @ (response @ impulses)
        across = matrix * self._inverse_mass
        v += across.T @ np.linalg.solve(across @ matrix.T, self._speeds - matrix @ v)
        return v.reshape(velocities.shape)

    def impulses(self, residual: np.ndarray) -> np.ndarray:
        """Return the impulses (3j,) N s with which the joints balance a ``residual`` (N, 3) N s. They balance the
        momenta of each body, if impulses of the joints can, and are otherwise those of least squares."""
        r = residual.ravel()
        estimate = self._estimate @ r
        return estimate + self._correction @ (self._modes.T @ (r - self.rows.matrix.T @ estimate))

    def without_impulses(self, residual: np.ndarray) -> np.ndarray:
        """Return ``residual`` (N, 3) N s minus the impulses of the joints."""
        return residual - (self.rows.matrix.T @ self.impulses(residual)).reshape(residual.shape)


def _rigid_modes(problem: StepProblem) -> np.ndarray:
    """Return (3N, 6), the nodal velocities of unit translations and rotations about the centre of mass."""
    return np.hstack([np.tile(np.eye(3), (len(problem.node_mass), 1)), problem.rotation_modes])
