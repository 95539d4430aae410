"""The soft body: its constant data (``SoftBody``) and the state that a step advances (``BodyState``)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg

from egs_warp.errors import ArgumentError
from egs_warp.fem.assembly_topology import Material
from egs_warp.fem.batched import BatchedRecord
from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.short_repr import short_repr

GRAVITY = 9.81
"""Gravitational acceleration, m/s^2."""
DEFAULT_SAG = 0.05
"""Default ratio rho g H / E of a column of height H; the column shortens by half of this fraction."""
MIN_HEIGHT, MAX_HEIGHT = 0.001, 1000.0
"""Minimum and maximum height of a body, m; other heights are rejected as a probable mistake in the units."""
MAX_SAG = 0.02
"""Maximum displacement of the centre of mass of the body under its weight, in body heights."""

_MAX_LINEAR_SAG = 1e4
"""Linear sag, in body heights, that only a body with a mechanism (a part on a hinge) exceeds."""


@dataclass(frozen=True)
class SoftBody:
    """A tetrahedral body under gravity."""

    __repr__ = short_repr

    mesh: TetMesh
    """Cage as captured, m; muscles, contact points and Gaussians are embedded in it."""
    assembly: ElasticAssembly
    """Elasticity; its mesh is the unloaded shape, which gravity deforms into ``mesh`` on the ground."""
    node_mass: np.ndarray
    """(N,) float64, kg, lumped masses."""
    gravity: np.ndarray
    """(3,) float64, m/s^2."""
    height: float
    """H, m, extent along the plane's normal."""

    @cached_property
    def mass(self) -> float:
        """Total mass, kg."""
        return float(self.node_mass.sum())

    @property
    def young_modulus(self) -> float:
        """Young's modulus E, Pa."""
        return self.assembly.material.young_modulus

    @property
    def stiffening(self) -> float:
        """Young's modulus, divided by the modulus of a column of the same height and density with the default sag."""
        return self.young_modulus * DEFAULT_SAG / (self.assembly.material.density * GRAVITY * self.height)

    @cached_property
    def weight(self) -> float:
        """Weight, N."""
        return self.mass * float(np.linalg.norm(self.gravity))

    @cached_property
    def time_unit(self) -> float:
        """Time scale sqrt(H / g), s."""
        return float(np.sqrt(self.height / np.linalg.norm(self.gravity)))

    @cached_property
    def speed_unit(self) -> float:
        """Speed scale sqrt(g H), m/s."""
        return float(np.sqrt(np.linalg.norm(self.gravity) * self.height))

    @cached_property
    def mean_rows(self) -> np.ndarray:
        """(3, 3N) matrix that maps nodal velocities to the velocity of the centre of mass."""
        return np.kron(self.node_mass / self.mass, np.eye(3))

    @cached_property
    def mass_roots(self) -> np.ndarray:
        """(3N,) square root of each node's fraction of the mass, repeated for its three axes."""
        return np.sqrt(np.repeat(self.node_mass / self.mass, 3))

    def centre_of_mass(self, positions: np.ndarray) -> np.ndarray:
        """Return the mass-weighted mean (3,) of ``positions`` (N, 3), or of velocities (N, 3)."""
        return self.node_mass @ positions / self.mass

    def angular_momentum(self, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
        """Return the angular momentum (3,) kg m^2/s about the centre of mass."""
        arms = positions - self.centre_of_mass(positions)
        moment = arms.T @ (self.node_mass[:, None] * velocities)
        return (moment - moment.T)[[1, 2, 0], [2, 0, 1]]

    def inertia(self, positions: np.ndarray) -> np.ndarray:
        """Return the inertia tensor (3, 3) kg m^2 about the centre of mass."""
        arms = positions - self.centre_of_mass(positions)
        second = np.einsum("n,ni,nj->ij", self.node_mass, arms, arms)
        return np.trace(second) * np.eye(3) - second

    def best_fit_rotation(self, positions: np.ndarray) -> np.ndarray:
        """Return the mass-weighted best-fit rotation (3, 3) from the rest shape to ``positions`` (N, 3) m (Kabsch)."""
        rest = self.mesh.nodes - self.centre_of_mass(self.mesh.nodes)
        arms = positions - self.centre_of_mass(positions)
        return kabsch_rotation(self.node_mass, rest, arms)

    def mechanical_energy(self, positions: np.ndarray, velocities: np.ndarray) -> float:
        """Return the sum of kinetic, elastic and gravitational energy, J."""
        kinetic = 0.5 * float(self.node_mass @ (velocities**2).sum(axis=1))
        elastic = self.assembly.energy(positions)
        return kinetic + elastic - self.mass * float(self.gravity @ self.centre_of_mass(positions))


@dataclass(frozen=True)
class BodyState(BatchedRecord):
    """Positions and velocities of the nodes at one point in time. For c worlds, they are tensors (c, N, 3)."""

    __repr__ = short_repr

    positions: np.ndarray
    """(N, 3) float64, m."""
    velocities: np.ndarray
    """(N, 3) float64, m/s."""
    time: float = 0.0
    """Time since the start of the simulation, s."""

    def is_finite(self) -> bool:
        """Return True if all positions and velocities of one world are finite."""
        return bool(np.isfinite(self.positions).all() and np.isfinite(self.velocities).all())

    def with_velocity_kick(self, kick: np.ndarray | None) -> BodyState:
        """Return the state with ``kick`` (N, 3) m/s added to the nodal velocities, or this state if it is None.

        An implicit step from the new state is exactly the step from this state with the additional impulses M kick:
        M (v - v0) = dt f + M kick. The impulses change linear and angular momentum, and the contact forces respond to
        them in the same step.
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
    """Make a body whose stiffness follows from its height H: E = density g H / sag, as for a column.

    A body on thin legs would sag more than a column. Its E is increased until its centre of mass sinks by at most
    ``MAX_SAG`` H under its weight (docs/concepts/cage.md).

    Args:
        mesh: cage at rest, m.
        plane: the ground; heights are measured along its normal.
        up: (3,) unit vector opposite to gravity, for sloped ground; default: the plane's normal.
        sag: ratio rho g H / E.
        poisson_ratio: Poisson's ratio nu.
        density: kg/m^3.
        damping_ratio: damping ratio of the first mode of the body clamped at its base (nodes within 5 % of H above the
            lowest); it sets the Rayleigh coefficient beta.
        device: Warp device of the assembly; default: Warp's current device.

    Raises:
        UserError: the height is outside ``MIN_HEIGHT`` to ``MAX_HEIGHT``, or the cage has a hinged part.
    """
    heights = plane.heights(mesh.nodes)
    height = float(heights.max() - heights.min())
    if not MIN_HEIGHT <= height <= MAX_HEIGHT:
        raise ArgumentError(
            "metres_per_unit",
            f"the body is {height:.3g} m high; choose a value that gives a height of {MIN_HEIGHT:g} to"
            f" {MAX_HEIGHT:g} m",
        )
    young = density * GRAVITY * height / sag
    node_mass = mesh.lumped_masses(density)
    free = heights > heights.min() + 0.05 * height
    column = ElasticAssembly(mesh, Material(young, poisson_ratio, density, 0.0), device=device)
    displacement = _linear_sag(column, node_mass, free, -GRAVITY * plane.normal)
    # NaN or negative if the stiffness is singular.
    if not 0.0 <= displacement < _MAX_LINEAR_SAG * height:
        raise ArgumentError("nodes", "parts of the cage are connected by a single corner or edge; request more nodes")
    young *= max(1.0, displacement / (MAX_SAG * height))
    undamped = ElasticAssembly(mesh, Material(young, poisson_ratio, density, 0.0), device=device)
    frequency = first_frequency(undamped, node_mass, free)
    damped = Material(young, poisson_ratio, density, 2.0 * damping_ratio / frequency)
    assembly = ElasticAssembly(mesh, damped, device=device)
    return SoftBody(mesh, assembly, node_mass, -GRAVITY * (plane.normal if up is None else up), height)


def first_frequency(assembly: ElasticAssembly, node_mass: np.ndarray, free: np.ndarray) -> float:
    """Return the smallest angular frequency, rad/s, with the nodes that are not ``free`` (N,) clamped."""
    stiffness, free_coordinates = _clamped_stiffness(assembly, free)
    mass = sparse.diags(np.repeat(node_mass, 3)[free_coordinates]).tocsc()
    start = np.ones(len(free_coordinates))
    value = sparse_linalg.eigsh(stiffness, k=1, M=mass, sigma=0.0, v0=start, return_eigenvectors=False)[0]
    return float(np.sqrt(value))


def _clamped_stiffness(assembly: ElasticAssembly, free: np.ndarray) -> tuple[sparse.csc_matrix, np.ndarray]:
    """Return the stiffness at rest of the ``free`` (N,) nodes, and the indices of their coordinates."""
    upper = assembly.matrix(assembly.hessian_entries(assembly.mesh.nodes))
    free_coordinates = np.flatnonzero(np.repeat(free, 3))
    return (upper + sparse.triu(upper, 1).T).tocsc()[free_coordinates][:, free_coordinates], free_coordinates


def _linear_sag(assembly: ElasticAssembly, node_mass: np.ndarray, free: np.ndarray, gravity: np.ndarray) -> float:
    """Return the linear displacement of the centre of mass along ``gravity`` (3,) under the weight, m."""
    stiffness, free_coordinates = _clamped_stiffness(assembly, free)
    force = (node_mass[:, None] * gravity).ravel()
    moved = np.zeros_like(force)
    with warnings.catch_warnings():
        # A singular stiffness gives NaN, which the caller rejects.
        warnings.simplefilter("ignore", sparse_linalg.MatrixRankWarning)
        moved[free_coordinates] = sparse_linalg.spsolve(stiffness, force[free_coordinates])
    return float(node_mass @ moved.reshape(-1, 3) @ gravity / (node_mass.sum() * np.linalg.norm(gravity)))
