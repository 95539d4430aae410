"""What a motion asks of a step's end: weighted squares of linear functions of it (docs/concepts/motions.md).

Each kind says what it measures in the end of a step: by ``rows`` of the end velocity, or by ``slopes`` (j, k) for each
of k unknowns that change the angular momentum by ``torques`` (3, k); and its ``gap`` (j,) at one end, as the slopes in
units of ``speed`` m/s, sqrt(g H).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import ConvexHull

from egs_warp.contact.detection import ContactSet
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.step_problem import StepProblem
from egs_warp.geometry.frames import cross_matrices, orthonormal_basis


@dataclass(frozen=True)
class Objective:
    """weight |rows v - target|^2, all in m/s so that weights compare."""

    name: str
    rows: sparse.csr_matrix | np.ndarray
    """(k, 3N), sparse where they are many."""
    target: np.ndarray
    """(k,) m/s."""
    weight: float

    def residual(
        self, problem: StepProblem, contacts: ContactSet, velocities: np.ndarray, gained: np.ndarray, speed: float
    ) -> np.ndarray:
        """At the end of ``velocities`` (3N,), the angular momentum ``gained`` (3,)."""
        return (self.rows @ velocities - self.target) / speed


def centre_of_mass_velocity(body: SoftBody, target: np.ndarray, weight: float) -> Objective:
    """Velocity (3,) of the centre of mass."""
    return Objective("com", body.mean_rows, np.asarray(target, float), weight)


@dataclass(frozen=True)
class AngularMomentumObjective:
    """weight |L+ - target|^2 / (m r)^2, r the radius of gyration, for the angular momentum about the centre of mass at
    the end of the step.

    The stepper keeps L+ = L + dt sum (x - c) x f (docs/concepts/body.md), so contact forces alone steer it.
    """

    target: np.ndarray
    """(3,) kg m^2/s."""
    weight: float

    def slopes(self, problem: StepProblem, contacts: ContactSet, torques: np.ndarray, speed: float) -> np.ndarray:
        """See the module."""
        return torques / self._unit(problem, speed)

    def residual(
        self, problem: StepProblem, contacts: ContactSet, velocities: np.ndarray, gained: np.ndarray, speed: float
    ) -> np.ndarray:
        """At the end of a step in which contact forces have ``gained`` (3,) kg m^2/s."""
        return (problem.angular_momentum + gained - self.target) / self._unit(problem, speed)

    @staticmethod
    def _unit(problem: StepProblem, speed: float) -> float:
        gyration = np.sqrt(0.5 * np.trace(problem.inertia) / problem.body.mass)
        return problem.body.mass * gyration * speed


@dataclass(frozen=True)
class LoadObjective:
    """weight times the squared share of the weight that each contact of some nodes carries.

    A contact that holds does so whatever its nodes are asked to do: what is to be lifted is unloaded first.
    """

    nodes: np.ndarray
    """(k,)."""
    weight: float

    def slopes(self, problem: StepProblem, contacts: ContactSet, torques: np.ndarray, speed: float) -> np.ndarray:
        """One row for each contact nearest to one of the nodes; the contact forces, in body weights, are the last
        unknowns.
        """
        loaded = self._loaded(contacts)
        rows = np.zeros((len(loaded), torques.shape[1]))
        rows[np.arange(len(loaded)), torques.shape[1] - 3 * contacts.count + 3 * loaded] = 1.0
        return rows

    def residual(
        self, problem: StepProblem, contacts: ContactSet, velocities: np.ndarray, gained: np.ndarray, speed: float
    ) -> np.ndarray:
        """None: a load is judged in the program alone."""
        return np.zeros(len(self._loaded(contacts)))

    def _loaded(self, contacts: ContactSet) -> np.ndarray:
        return np.flatnonzero(np.isin(contacts.nearest_nodes, self.nodes))


AnyObjective = Objective | AngularMomentumObjective | LoadObjective


def node_velocities(body: SoftBody, target: np.ndarray, weight: float) -> Objective:
    """Velocities (N, 3) of all nodes, each weighted by its share of the mass: a pose to move towards."""
    shares = body.mass_roots
    return Objective("pose", sparse.csr_matrix(sparse.diags(shares)), shares * target.ravel(), weight)


def deformation_velocities(body: SoftBody, positions: np.ndarray, target: np.ndarray, weight: float) -> Objective:
    """Of velocities (N, 3) the part that strains the body as a whole, the same everywhere: a pose to move towards that
    leaves the finer shape to the body's elasticity, where it goes to objectives of their own, and how it turns to its
    angular momentum.

    The six rows are orthonormal in the mean over the mass, so the weight compares with that of ``node_velocities``.
    """
    arms = positions - body.centre_of_mass(positions)
    modes = np.zeros((12, len(arms), 3))
    modes[:3], modes[3:6] = np.eye(3)[:, None], np.moveaxis(cross_matrices(arms), 2, 0)
    for mode, (i, k) in enumerate(combinations_with_replacement(range(3), 2), start=6):
        modes[mode, :, k] += arms[:, i]
        modes[mode, :, i] += arms[:, k]
    weights = body.mass_roots
    # By columns, as LAPACK takes them.
    orthonormal, triangle = np.linalg.qr((modes.reshape(12, -1) * weights).T)
    kept = 6 + np.flatnonzero(np.abs(np.diag(triangle)[6:]) > 1e-6 * np.abs(triangle).max())
    rows = (orthonormal[:, kept] * weights[:, None]).T
    return Objective("pose", rows, rows @ target.ravel(), weight)


@dataclass(frozen=True)
class BodyPart:
    """The whole body or a part of it (a foot, the head, the base): some nodes and their masses."""

    name: str
    nodes: np.ndarray
    """(k,)."""
    masses: np.ndarray
    """(k,) kg."""

    @classmethod
    def of(cls, body: SoftBody, name: str, nodes: np.ndarray) -> BodyPart:
        """The part made of ``nodes``."""
        return cls(name, nodes, body.node_mass[nodes])

    @classmethod
    def whole(cls, body: SoftBody) -> BodyPart:
        """All of it."""
        return cls.of(body, "body", np.arange(len(body.node_mass)))

    @classmethod
    def base(cls, body: SoftBody, heights: np.ndarray) -> BodyPart:
        """What stands on the ground: nodes whose height (N,) at rest is at most 0.06 H above the lowest."""
        return cls.of(body, "base", np.flatnonzero(heights < heights.min() + 0.06 * body.height))

    @classmethod
    def head(cls, body: SoftBody, heights: np.ndarray) -> BodyPart:
        """The topmost part: nodes whose height (N,) at rest is at most 0.15 H below the highest."""
        return cls.of(body, "head", np.flatnonzero(heights > heights.max() - 0.15 * body.height))

    def centre(self, points: np.ndarray) -> np.ndarray:
        """(3,) mass-weighted mean of ``points`` (N, 3) over the part."""
        return self.masses @ points[self.nodes] / self.masses.sum()

    def inertia(self, points: np.ndarray) -> np.ndarray:
        """(3, 3) kg m^2, inertia about the part's centre at ``points`` (N, 3)."""
        arms = points[self.nodes] - self.centre(points)
        second = np.einsum("n,ni,nj->ij", self.masses, arms, arms)
        return np.trace(second) * np.eye(3) - second


@dataclass(frozen=True)
class Coordinates:
    """Axes in which an objective is told, and whether relative to the centre of mass."""

    axes: np.ndarray
    """(3, 3) rows are unit vectors; a target's components are along them."""
    relative: bool
    """Whether the origin moves with the centre of mass of the whole body."""


WORLD = Coordinates(np.eye(3), False)


def part_velocity(
    body: SoftBody, part: BodyPart, target: np.ndarray, weight: float, coordinates: Coordinates = WORLD
) -> Objective:
    """Velocity (3,) m/s of the centre of ``part``; of the base, relative to the centre of mass, it steers a landing."""
    shares = np.zeros(len(body.node_mass))
    shares[part.nodes] = part.masses / part.masses.sum()
    if coordinates.relative:
        shares -= body.node_mass / body.mass
    return Objective(f"{part.name} velocity", _along(shares, coordinates.axes), np.asarray(target, float), weight)


def part_position(
    body: SoftBody,
    part: BodyPart,
    state: BodyState,
    target: np.ndarray,
    weight: float,
    rate: float,
    coordinates: Coordinates = WORLD,
) -> Objective:
    """Position (3,) metres of the centre of ``part``, approached at ``rate`` 1/s; 1/dt means at the end of the step."""
    place = part.centre(state.positions)
    if coordinates.relative:
        place = place - body.centre_of_mass(state.positions)
    return part_velocity(body, part, rate * (target - coordinates.axes @ place), weight, coordinates)


def part_acceleration(
    body: SoftBody,
    part: BodyPart,
    state: BodyState,
    target: np.ndarray,
    weight: float,
    dt: float,
    coordinates: Coordinates = WORLD,
) -> Objective:
    """Acceleration (3,) m/s^2 of the centre of ``part`` over the step of ``dt`` seconds."""
    velocity = part.centre(state.velocities)
    if coordinates.relative:
        velocity = velocity - body.centre_of_mass(state.velocities)
    return part_velocity(body, part, coordinates.axes @ velocity + dt * np.asarray(target), weight, coordinates)


def part_angular_momentum(
    body: SoftBody,
    part: BodyPart,
    state: BodyState,
    target: np.ndarray,
    weight: float,
    coordinates: Coordinates = WORLD,
) -> Objective:
    """Angular momentum (3,) kg m^2/s of ``part`` about its own centre; in relative coordinates about the centre of mass
    of the body, with velocities relative to its.

    Told in m/s: over mass x radius of gyration. For the whole body ``SpinObjective`` is exact, this is linear in the
    arms.
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
    """Angular velocity (3,) rad/s of ``part``, that of the rigid body with its momentum:
    the rate of its orientation.
    """
    momentum = part_angular_momentum(body, part, state, np.zeros(3), weight)
    unit = _gyration(part, state.positions) * part.masses.sum()
    radius = _gyration(part, state.positions)
    rows = coordinates.axes @ np.linalg.inv(part.inertia(state.positions)) * unit * radius
    return Objective(f"{part.name} turning", rows @ momentum.rows, radius * np.asarray(target, float), weight)


def base_area(part: BodyPart, state: BodyState, up: np.ndarray, target: float, weight: float, rate: float) -> Objective:
    """Area (m^2) of the convex hull of ``part`` seen along ``up`` (3,), approached at ``rate`` 1/s.

    Told in m/s: dA/dt over the hull's perimeter is the speed at which its sides move outwards.
    """
    plane = np.stack(orthonormal_basis(up))
    hull = ConvexHull(state.positions[part.nodes] @ plane.T)
    corners = part.nodes[hull.vertices]  # anticlockwise in two dimensions
    flat = state.positions[corners] @ plane.T
    ahead, behind = np.roll(flat, -1, axis=0), np.roll(flat, 1, axis=0)
    perimeter = float(np.linalg.norm(ahead - flat, axis=1).sum())
    slopes = 0.5 * np.stack([ahead[:, 1] - behind[:, 1], behind[:, 0] - ahead[:, 0]], axis=1) @ plane
    rows = np.zeros((len(state.positions), 3))
    rows[corners] = slopes / perimeter
    return Objective(
        f"{part.name} area",
        rows.reshape(1, -1),
        np.array([rate * (target - hull.volume) / perimeter]),
        weight,
    )


def part_nodes(body: SoftBody, part: BodyPart, target: np.ndarray, weight: float) -> Objective:
    """Velocities (k, 3) m/s of every node of ``part``, each with the same share of the weight:
    place and shape at once.
    """
    count = len(part.nodes)
    columns = (3 * part.nodes[:, None] + np.arange(3)).ravel()
    share = np.sqrt(1.0 / count)
    rows = sparse.csr_matrix(
        (np.full(3 * count, share), (np.arange(3 * count), columns)), shape=(3 * count, 3 * len(body.node_mass))
    )
    return Objective(f"{part.name} nodes", rows, share * np.asarray(target, float).ravel(), weight)


def no_slip_contacts(contacts: ContactSet, loads: np.ndarray, weight: float) -> Objective:
    """That no contact slides, each weighted by its share of the weight in ``loads`` (n,)."""
    shares = np.sqrt(np.repeat(loads, 3))
    shares[::3] = 0.0
    rows = sparse.csr_matrix(contacts.jacobian.multiply(shares[:, None]))
    return Objective("hold", rows, np.zeros(3 * contacts.count), weight)


def _along(shares: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """(k, 3N) rows of the mean by ``shares`` (N,) of velocities, along ``axes`` (k, 3)."""
    return (axes[:, None, :] * shares[:, None]).reshape(len(axes), -1)


def _gyration(part: BodyPart, points: np.ndarray) -> float:
    """Metres."""
    return float(np.sqrt(0.5 * np.trace(part.inertia(points)) / part.masses.sum()))
