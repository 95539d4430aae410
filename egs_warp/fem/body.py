"""The soft body: what never changes (``SoftBody``) and what a step changes (``BodyState``)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg

from egs_warp.errors import ArgumentError
from egs_warp.fem.assembly_topology import Material
from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh

GRAVITY = 9.81
"""m/s^2."""
DEFAULT_SAG = 0.05
"""rho g H / E of a column."""
SMALLEST_HEIGHT, LARGEST_HEIGHT = 0.001, 1000.0
"""Metres; smaller and larger bodies are refused as a slip of the pen."""
MAX_SAG = 0.02
"""Body heights by which the centre of mass may sink from the unloaded to the standing body."""

_HINGED = 1e4
"""Body heights by which, linearly, only what swings on hinges sinks."""


@dataclass(frozen=True)
class SoftBody:
    """A tetrahedral body under gravity."""

    mesh: TetMesh
    assembly: ElasticAssembly
    node_mass: np.ndarray
    """(N,) float64, kg."""
    gravity: np.ndarray
    """(3,) float64, m/s^2."""
    height: float
    """H, metres: extent along the plane's normal."""

    @cached_property
    def mass(self) -> float:
        """Kilograms."""
        return float(self.node_mass.sum())

    @property
    def young_modulus(self) -> float:
        """Pascals."""
        return self.assembly.material.young_modulus

    @property
    def stiffening(self) -> float:
        """E over that of a column of the same height with the default sag."""
        return self.young_modulus * DEFAULT_SAG / (self.assembly.material.density * GRAVITY * self.height)

    @cached_property
    def weight(self) -> float:
        """Newtons."""
        return self.mass * float(np.linalg.norm(self.gravity))

    @cached_property
    def time_unit(self) -> float:
        """sqrt(H / g), seconds."""
        return float(np.sqrt(self.height / np.linalg.norm(self.gravity)))

    @cached_property
    def speed_unit(self) -> float:
        """sqrt(g H), m/s."""
        return float(np.sqrt(np.linalg.norm(self.gravity) * self.height))

    @cached_property
    def mean_rows(self) -> np.ndarray:
        """(3, 3N) whose product with velocities is that of the centre of mass."""
        return np.kron(self.node_mass / self.mass, np.eye(3))

    @cached_property
    def mass_roots(self) -> np.ndarray:
        """(3N,) of the square root of each node's share of the mass, for each of its axes."""
        return np.sqrt(np.repeat(self.node_mass / self.mass, 3))

    def centre_of_mass(self, positions: np.ndarray) -> np.ndarray:
        """(3,) mean of ``positions`` (N, 3) weighted by mass; of velocities, the velocity of the centre of mass."""
        return self.node_mass @ positions / self.mass

    def angular_momentum(self, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
        """(3,) kg m^2/s about the centre of mass."""
        arms = positions - self.centre_of_mass(positions)
        moment = arms.T @ (self.node_mass[:, None] * velocities)
        return (moment - moment.T)[[1, 2, 0], [2, 0, 1]]

    def inertia(self, positions: np.ndarray) -> np.ndarray:
        """(3, 3) kg m^2 about the centre of mass."""
        arms = positions - self.centre_of_mass(positions)
        second = np.einsum("n,ni,nj->ij", self.node_mass, arms, arms)
        return np.trace(second) * np.eye(3) - second

    def best_fit_rotation(self, positions: np.ndarray) -> np.ndarray:
        """(3, 3) rotation that best carries the rest shape to ``positions`` (Kabsch, mass-weighted)."""
        rest = self.mesh.nodes - self.centre_of_mass(self.mesh.nodes)
        arms = positions - self.centre_of_mass(positions)
        return kabsch_rotation(self.node_mass, rest, arms)

    def mechanical_energy(self, positions: np.ndarray, velocities: np.ndarray) -> float:
        """Kinetic + elastic + gravitational energy, joules."""
        kinetic = 0.5 * float(self.node_mass @ (velocities**2).sum(axis=1))
        elastic = self.assembly.energy(positions)
        return kinetic + elastic - self.mass * float(self.gravity @ self.centre_of_mass(positions))


@dataclass(frozen=True)
class BodyState:
    """Positions and velocities of the nodes at one time."""

    positions: np.ndarray
    """(N, 3) float64, metres."""
    velocities: np.ndarray
    """(N, 3) float64, m/s."""
    time: float = 0.0
    """Seconds."""

    def with_velocity_kick(self, kick: np.ndarray | None) -> BodyState:
        """With nodes that are faster by ``kick`` (N, 3) m/s, if something gives them that.

        An implicit step from there is, to the letter, the step from here with the impulses beside its forces,
        M (v - v0) = dt f + M kick: both momenta get them, and contact answers to them in the same step.
        """
        return self if kick is None else replace(self, velocities=self.velocities + kick)


def make_body(
    mesh: TetMesh,
    plane: Plane,
    *,
    up: np.ndarray | None = None,
    sag: float = DEFAULT_SAG,
    poisson_ratio: float = 0.4,
    density: float = 1000.0,
    damping_ratio: float = 0.05,
    device: str | None = None,
) -> SoftBody:
    """A body whose elasticity follows from its own height H: E = density g H / sag, that of a column.

    See docs/concepts/cage.md.

    A body on thin legs would sink further into them than a column does; it is stiffened until its centre of mass sinks
    by no more than ``LARGEST_SINK`` H under its weight.

    ``up`` (3,) is against gravity where the ground is a slope. Raises ``UserError`` for a height that no body has.

    ``damping_ratio`` is that of the first mode of the body held at its base (nodes within 5 % of H above the plane); it
    sets the Rayleigh coefficient beta.
    """
    heights = plane.heights(mesh.nodes)
    height = float(heights.max() - heights.min())
    if not SMALLEST_HEIGHT <= height <= LARGEST_HEIGHT:
        raise ArgumentError(
            "metres_per_unit",
            f"the body is {height:.3g} m high; choose it so that this is from {SMALLEST_HEIGHT:g} to"
            f" {LARGEST_HEIGHT:g} m",
        )
    young = density * GRAVITY * height / sag
    node_mass = mesh.lumped_masses(density)
    free = heights > heights.min() + 0.05 * height
    column = ElasticAssembly(mesh, Material(young, poisson_ratio, density, 0.0), device=device)
    sink = _sink(column, node_mass, free, -GRAVITY * plane.normal)
    # It is no number, or below zero, where the stiffness is singular.
    if not 0.0 <= sink < _HINGED * height:
        raise ArgumentError("nodes", "the cage has parts that hang on a corner or an edge alone; give it more")
    young *= max(1.0, sink / (MAX_SAG * height))
    undamped = ElasticAssembly(mesh, Material(young, poisson_ratio, density, 0.0), device=device)
    frequency = _first_frequency(undamped, node_mass, free)
    damped = Material(young, poisson_ratio, density, 2.0 * damping_ratio / frequency)
    assembly = ElasticAssembly(mesh, damped, device=device)
    return SoftBody(mesh, assembly, node_mass, -GRAVITY * (plane.normal if up is None else up), height)


def _held_stiffness(assembly: ElasticAssembly, free: np.ndarray) -> tuple[sparse.csc_matrix, np.ndarray]:
    """Stiffness at rest of the ``free`` (N,) nodes, and the indices of their coordinates."""
    upper = assembly.matrix(assembly.hessian_entries(assembly.mesh.nodes))
    kept = np.flatnonzero(np.repeat(free, 3))
    return (upper + sparse.triu(upper, 1).T).tocsc()[kept][:, kept], kept


def _sink(assembly: ElasticAssembly, node_mass: np.ndarray, free: np.ndarray, gravity: np.ndarray) -> float:
    """Metres by which the centre of mass moves along ``gravity`` (3,) under the weight, linearly."""
    stiffness, kept = _held_stiffness(assembly, free)
    force = (node_mass[:, None] * gravity).ravel()
    moved = np.zeros_like(force)
    with warnings.catch_warnings():
        # What is singular sinks by no number.
        warnings.simplefilter("ignore", sparse_linalg.MatrixRankWarning)
        moved[kept] = sparse_linalg.spsolve(stiffness, force[kept])
    return float(node_mass @ moved.reshape(-1, 3) @ gravity / (node_mass.sum() * np.linalg.norm(gravity)))


def _first_frequency(assembly: ElasticAssembly, node_mass: np.ndarray, free: np.ndarray) -> float:
    """Smallest angular frequency, rad/s, with the nodes that are not ``free`` (N,) held."""
    stiffness, kept = _held_stiffness(assembly, free)
    mass = sparse.diags(np.repeat(node_mass, 3)[kept]).tocsc()
    start = np.ones(len(kept))
    value = sparse_linalg.eigsh(stiffness, k=1, M=mass, sigma=0.0, v0=start, return_eigenvectors=False)[0]
    return float(np.sqrt(value))
