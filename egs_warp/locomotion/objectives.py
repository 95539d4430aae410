"""Objectives of a motion: weighted squares of linear functions of the end of a step (docs/concepts/motions.md).

The residual of an ``Objective`` is linear in the end velocity, with the matrix ``rows``. The residuals of the other
kinds are affine in the k unknowns x of the QP: ``affine`` returns their derivative (j, k), computed from ``torques``
(3, k) kg m^2/s, the derivative of the angular momentum, and their value (j,) at x = 0. ``residual`` is the value at a
given end of the step. Residuals are in units of sqrt(g H).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
import scipy.sparse as sparse

from egs_warp.contact.contact_set import ContactSet
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.step_problem import StepProblem
from egs_warp.geometry.frames import cross_matrices
from egs_warp.short_repr import short_repr


@dataclass(frozen=True)
class Objective:
    """Objective that costs ``weight`` |rows v - target|^2 for the end velocity v, in m/s, so that weights are
    comparable."""

    name: str
    rows: sparse.csr_matrix | np.ndarray
    """(k, 3N) matrix, sparse or dense."""
    target: np.ndarray
    """(k,) m/s, target of rows v."""
    weight: float

    def residual(self, problem: StepProblem, velocities: np.ndarray) -> np.ndarray:
        """Return the residual (k,) at the end ``velocities`` (3N,) m/s."""
        return (self.rows @ velocities - self.target) / problem.body.speed_unit


def centre_of_mass_velocity(body: SoftBody, target: np.ndarray, weight: float) -> Objective:
    """Return the objective that drives the velocity of the centre of mass to ``target`` (3,) m/s."""
    return Objective("com", body.mean_rows, np.asarray(target, float), weight)


@dataclass(frozen=True)
class AngularMomentumObjective:
    """Objective that costs ``weight`` |L+ - target|^2 / (m r)^2 for the angular momentum L+ about the centre of mass at
    the end of the step, with the radius of gyration r.

    The stepper conserves L+ = L + dt sum (x - c) x f (docs/concepts/body.md), so only contact forces change the angular
    momentum.
    """

    target: np.ndarray
    """(3,) kg m^2/s, target angular momentum."""
    weight: float

    def affine(self, problem: StepProblem, contacts: ContactSet, torques: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return slopes (3, k) and offset (3,) of the residual."""
        return torques / self._unit(problem), self.residual(problem, np.zeros(3))

    def residual(self, problem: StepProblem, angular_impulse: np.ndarray) -> np.ndarray:
        """Return the residual (3,) at the end of a step in which contact forces add ``angular_impulse`` (3,) kg
        m^2/s."""
        return (problem.angular_momentum + angular_impulse - self.target) / self._unit(problem)

    @staticmethod
    def _unit(problem: StepProblem) -> float:
        gyration = np.sqrt(0.5 * np.trace(problem.inertia) / problem.body.mass)
        return problem.body.mass * gyration * problem.body.speed_unit


@dataclass(frozen=True)
class LoadObjective:
    """Objective that costs ``weight`` times the squared load, as a fraction of the body weight, of each contact at the
    ``nodes``.

    A loaded contact stays closed, whatever the target velocity of its nodes is. So a foot must be unloaded before it is
    lifted. Loads enter the QP only, not the objective value of a solved step.
    """

    nodes: np.ndarray
    """(k,) indices of the nodes to be unloaded."""
    weight: float

    def affine(self, problem: StepProblem, contacts: ContactSet, torques: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return slopes (j, k) and offset (j,) of the residual, with one row for each contact whose nearest node is one
        of ``nodes``. The last unknowns are the contact forces, in body weights."""
        loaded = np.flatnonzero(np.isin(contacts.nearest_nodes, self.nodes))
        rows = np.zeros((len(loaded), torques.shape[1]))
        rows[np.arange(len(loaded)), torques.shape[1] - 3 * contacts.count + 3 * loaded] = 1.0
        return rows, np.zeros(len(loaded))


AnyObjective = Objective | AngularMomentumObjective | LoadObjective


def node_velocities(body: SoftBody, target: np.ndarray, weight: float) -> Objective:
    """Return the objective that drives the velocities of all nodes to ``target`` (N, 3) m/s, for a motion towards a
    pose. Each node is weighted by its fraction of the mass."""
    shares = body.mass_roots
    return Objective("pose", sparse.csr_matrix(sparse.diags(shares)), shares * target.ravel(), weight)


def deformation_velocities(body: SoftBody, positions: np.ndarray, target: np.ndarray, weight: float) -> Objective:
    """Return the objective that drives the mean stretch and shear rates of the body to the rates of the ``target``
    velocities. Finer deformations are left to elasticity, and translation and rotation to other objectives.

    The six rows are orthonormal in the mass-weighted mean, so the weight is comparable with the weight of
    ``node_velocities``.

    Args:
        positions: (N, 3) m, at the start of the step.
        target: (N, 3) m/s, nodal velocities that lead to a pose.
        weight: weight.
    """
    arms, shares = positions - body.centre_of_mass(positions), body.node_mass / body.mass
    modes, is_independent = strain_modes(np.einsum("n,ni,nj->ij", shares, arms, arms))
    rows = np.einsum("n,rij,nj->rni", shares, modes[is_independent], arms).reshape(is_independent.sum(), -1)
    return Objective("pose", rows, rows @ target.ravel(), weight)


def strain_modes(second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rates of stretch and shear of a body as linear velocity fields A_r a, where the arm a of a node is its
    position relative to the centre of mass. The fields are orthonormal in the mass-weighted mean and orthogonal to
    rotations. "..." is the world axis, or nothing for one world.

    Args:
        second: (..., 3, 3) m^2, mass-weighted mean of the products a_i a_j of the arms.

    Returns:
        The matrices A_r (..., 6, 3, 3) 1/m, and (..., 6) bool, True for independent modes; a flat body has fewer.
    """
    moments, axes = np.linalg.eigh(second)
    roots = np.sqrt(np.maximum(moments, 0.0))[..., None, :]
    floor = _MIN_MODE * roots.max(axis=-1, keepdims=True)
    inverse = np.where(roots > floor, 1.0 / np.maximum(roots, floor), 0.0)
    # With half half^T = second, C = A half and D = B half, the mean of (A a) . (B a) is the sum of C_ij D_ij.
    coordinates = (_LINEAR_MODES @ (axes * roots)[..., None, :, :]).reshape(*second.shape[:-2], 9, 9)
    orthonormal, triangle = np.linalg.qr(coordinates.swapaxes(-1, -2))
    sizes = np.abs(np.diagonal(triangle, axis1=-2, axis2=-1))
    modes = orthonormal[..., 3:].swapaxes(-1, -2).reshape(*second.shape[:-2], 6, 3, 3)
    back = (axes * inverse).swapaxes(-1, -2)
    return modes @ back[..., None, :, :], sizes[..., 3:] > _MIN_MODE * sizes.max(axis=-1, keepdims=True)


def _linear_modes() -> np.ndarray:
    """Return (9, 3, 3), the matrices of three rotations and of the symmetric unit strains."""
    modes = np.zeros((9, 3, 3))
    modes[:3] = np.cross(np.eye(3)[:, None], np.eye(3)).swapaxes(1, 2)
    for mode, (i, k) in enumerate(combinations_with_replacement(range(3), 2), start=3):
        modes[mode, k, i] += 1.0
        modes[mode, i, k] += 1.0
    return modes


_LINEAR_MODES, _MIN_MODE = _linear_modes(), 1e-6
"""Matrices of rotations and strains, and minimum norm of an independent strain mode relative to the largest one."""


@dataclass(frozen=True)
class BodyPart:
    """Part of the body (a foot, the head, the base) or the whole body: nodes and their masses."""

    __repr__ = short_repr

    name: str
    nodes: np.ndarray
    """(k,) indices of the nodes."""
    masses: np.ndarray
    """(k,) kg, masses of the nodes."""

    @classmethod
    def of(cls, body: SoftBody, name: str, nodes: np.ndarray) -> BodyPart:
        """Return the part with these ``nodes`` (k,)."""
        return cls(name, nodes, body.node_mass[nodes])

    @classmethod
    def whole(cls, body: SoftBody) -> BodyPart:
        """Return the whole body."""
        return cls.of(body, "body", np.arange(len(body.node_mass)))

    @classmethod
    def base(cls, body: SoftBody, heights: np.ndarray) -> BodyPart:
        """Return the base: nodes whose height (N,) m at rest is at most 0.06 H above the lowest."""
        return cls.of(body, "base", np.flatnonzero(heights < heights.min() + 0.06 * body.height))

    @classmethod
    def head(cls, body: SoftBody, heights: np.ndarray) -> BodyPart:
        """Return the head: nodes whose height (N,) m at rest is at most 0.15 H below the highest."""
        return cls.of(body, "head", np.flatnonzero(heights > heights.max() - 0.15 * body.height))

    def centre(self, points: np.ndarray) -> np.ndarray:
        """Return (3,), the mass-weighted mean of ``points`` (N, 3) over the part."""
        return self.masses @ points[self.nodes] / self.masses.sum()

    def inertia(self, points: np.ndarray) -> np.ndarray:
        """Return (3, 3) kg m^2, inertia about the part's centre at ``points`` (N, 3) m."""
        arms = points[self.nodes] - self.centre(points)
        second = np.einsum("n,ni,nj->ij", self.masses, arms, arms)
        return np.trace(second) * np.eye(3) - second


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of the target of an objective."""

    axes: np.ndarray
    """(3, 3), rows are the unit vectors along which the components of a target are measured."""
    relative: bool
    """True if the origin moves with the centre of mass of the whole body."""


WORLD = Coordinates(np.eye(3), False)


def part_velocity(
    body: SoftBody, part: BodyPart, target: np.ndarray, weight: float, coordinates: Coordinates = WORLD
) -> Objective:
    """Return the objective that drives the velocity of the centre of ``part`` to ``target`` (3,) m/s in
    ``coordinates``. Applied to the base, in coordinates relative to the centre of mass, it controls a landing."""
    shares = np.zeros(len(body.node_mass))
    shares[part.nodes] = part.masses / part.masses.sum()
    if coordinates.relative:
        shares -= body.node_mass / body.mass
    return Objective(f"{part.name} velocity", _along(shares, coordinates.axes), np.asarray(target, float), weight)


def part_angular_momentum(
    body: SoftBody,
    part: BodyPart,
    state: BodyState,
    target: np.ndarray,
    weight: float,
    coordinates: Coordinates = WORLD,
) -> Objective:
    """Return the objective that drives the angular momentum of ``part`` about its own centre to ``target`` (3,) kg
    m^2/s. In relative coordinates, the objective concerns the angular momentum about the centre of mass of the body,
    with velocities relative to this centre.

    Rows are in m/s: angular momentum divided by mass x radius of gyration. For the whole body
    ``AngularMomentumObjective`` is exact, while this objective uses the lever arms at the start of the step.
    """
    if coordinates.relative:
        pivot, moving = body.centre_of_mass(state.positions), body.node_mass / body.mass
    else:
        pivot, moving = part.centre(state.positions), np.zeros(len(body.node_mass))
        moving[part.nodes] = part.masses / part.masses.sum()
    arms = state.positions[part.nodes] - pivot
    crosses = np.zeros((len(body.node_mass), 3, 3))
    crosses[part.nodes] = -part.masses[:, None, None] * cross_matrices(arms)
    crosses -= moving[:, None, None] * crosses.sum(axis=0)
    unit = _gyration(part, state.positions) * part.masses.sum()
    rows = np.einsum("ij,njk->ink", coordinates.axes, crosses).reshape(3, -1) / unit
    return Objective(f"{part.name} momentum", rows, np.asarray(target, float) / unit, weight)


def part_angular_velocity(
    body: SoftBody,
    part: BodyPart,
    state: BodyState,
    target: np.ndarray,
    weight: float,
    coordinates: Coordinates = WORLD,
) -> Objective:
    """Return the objective that drives the angular velocity of ``part`` to ``target`` (3,) rad/s. The angular velocity
    of a part is that of a rigid body with the same angular momentum. Rows are in m/s: angular velocity times radius of
    gyration."""
    momentum = part_angular_momentum(body, part, state, np.zeros(3), weight)
    unit = _gyration(part, state.positions) * part.masses.sum()
    radius = _gyration(part, state.positions)
    rows = coordinates.axes @ np.linalg.inv(part.inertia(state.positions)) * unit * radius
    return Objective(f"{part.name} turning", rows @ momentum.rows, radius * np.asarray(target, float), weight)


def part_shape(body: SoftBody, part: BodyPart, target: np.ndarray, weight: float) -> Objective:
    """Return the objective that drives the velocities of the nodes of ``part`` relative to its centre to ``target``
    (k, 3) m/s, each weighted by its fraction of the mass of the part. Translation of the part is left to other
    objectives."""
    shares = part.masses / part.masses.sum()
    roots = np.sqrt(shares)
    relative = np.zeros((len(part.nodes), len(body.node_mass)))
    relative[:, part.nodes] = roots[:, None] * (np.eye(len(part.nodes)) - shares)
    return Objective(
        f"{part.name} shape",
        sparse.csr_matrix(sparse.kron(sparse.csr_matrix(relative), np.eye(3))),
        (roots[:, None] * (target - shares @ target)).ravel(),
        weight,
    )


def part_nodes(body: SoftBody, part: BodyPart, target: np.ndarray, weight: float) -> Objective:
    """Return the objective that drives the velocities of the nodes of ``part`` to ``target`` (k, 3) m/s, with equal
    weights. This controls position and shape of the part together."""
    count = len(part.nodes)
    columns = (3 * part.nodes[:, None] + np.arange(3)).ravel()
    share = np.sqrt(1.0 / count)
    rows = sparse.csr_matrix(
        (np.full(3 * count, share), (np.arange(3 * count), columns)), shape=(3 * count, 3 * len(body.node_mass))
    )
    return Objective(f"{part.name} nodes", rows, share * np.asarray(target, float).ravel(), weight)


def no_slip_contacts(contacts: ContactSet, loads: np.ndarray, weight: float) -> Objective:
    """Return the objective that keeps contacts from sliding, each weighted by its load; ``loads`` (n,) are fractions of
    the body weight."""
    shares = np.sqrt(np.repeat(loads, 3))
    shares[::3] = 0.0
    rows = sparse.csr_matrix(contacts.jacobian.multiply(shares[:, None]))
    return Objective("hold", rows, np.zeros(3 * contacts.count), weight)


def _along(shares: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return (k, 3N), rows that map nodal velocities to their mean with weights ``shares`` (N,), along ``axes`` (k,
    3)."""
    return (axes[:, None, :] * shares[:, None]).reshape(len(axes), -1)


def _gyration(part: BodyPart, points: np.ndarray) -> float:
    """Return the radius of gyration, m, of ``part`` with nodes at ``points`` (N, 3) m."""
    return float(np.sqrt(0.5 * np.trace(part.inertia(points)) / part.masses.sum()))
