"""Energy balance of every step, from the arrays of a trajectory alone (docs/concepts/ledger.md).

It shares no code with the solver: energies, damping and muscles are implemented a second time here, in NumPy, and no
term is computed as the remainder of the others. So ``EnergyBalance.residual`` is an error of the run or of one of the
two implementations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.short_repr import short_repr

STORED = ("kinetic_com", "kinetic_rotation", "kinetic_deformation", "potential", "elastic")
"""Names of the energies of a state."""
FLOWS = (
    "muscles",
    "pushes",
    "damping",
    "drag",
    "friction",
    "contact",
    "push_out",
    "joints",
    "lost_inertia",
    "lost_elastic",
    "lost_muscle",
    "lost_damping",
    "spin_inside",
    "spin_after",
)
"""Names of the terms that a step adds to the sum of the energies."""


@dataclass(frozen=True)
class EnergyBalance:
    """Energy balance in J of F+1 states and F steps. Terms that take energy from the body are negative."""

    energy_unit: float
    """m g H in joules, the unit of ``residual``."""
    kinetic_com: np.ndarray
    """(F+1,) kinetic energy of the motion of the centre of mass."""
    kinetic_rotation: np.ndarray
    """(F+1,) kinetic energy of the rigid rotation with the body's angular momentum."""
    kinetic_deformation: np.ndarray
    """(F+1,) kinetic energy of the remaining motion."""
    potential: np.ndarray
    """(F+1,) potential energy in gravity, relative to the origin."""
    elastic: np.ndarray
    """(F+1,) Neo-Hookean energy (Eq. 5)."""
    muscles: np.ndarray
    """(F,) work of muscles, sum of T (L before - L after)."""
    pushes: np.ndarray
    """(F,) kinetic energy that external pushes add at the start of the step."""
    damping: np.ndarray
    """(F,) dissipation of the material."""
    drag: np.ndarray
    """(F,) work of air drag."""
    friction: np.ndarray
    """(F,) work of tangential contact forces."""
    contact: np.ndarray
    """(F,) work of normal forces on points that approach their plane."""
    push_out: np.ndarray
    """(F,) work of normal forces on points that leave their plane."""
    joints: np.ndarray
    """(F,) work of the forces of joints."""
    lost_inertia: np.ndarray
    """(F,) kinetic energy lost by implicit Euler."""
    lost_elastic: np.ndarray
    """(F,) energy lost by implicit Euler because it applies the elastic force at the end of the step throughout the
    step."""
    lost_muscle: np.ndarray
    """(F,) energy lost by implicit Euler because it applies the muscles' forces at the end of the step throughout the
    step."""
    lost_damping: np.ndarray
    """(F,) energy lost by implicit Euler because it applies the damping forces at the end of the step throughout the
    step."""
    spin_inside: np.ndarray
    """(F,) work of the torque that is removed from the internal forces within the step, to conserve the angular
    momentum."""
    spin_after: np.ndarray
    """(F,) kinetic energy of the rotation that is added to the velocities after the step, to conserve the angular
    momentum."""
    muscle_work: np.ndarray
    """(F,) sum of max(0, T (L before - L after)): positive work of the muscles that shorten. It is not one of
    ``FLOWS``."""

    @property
    def stored(self) -> np.ndarray:
        """(F+1,) J, sum of all energies of a state."""
        return np.sum([getattr(self, name) for name in STORED], axis=0)

    @property
    def residual(self) -> np.ndarray:
        """(F,) change of the stored energy minus the sum of all flows, divided by m g H."""
        return (np.diff(self.stored) - np.sum([getattr(self, name) for name in FLOWS], axis=0)) / self.energy_unit

    @property
    def max_residual(self) -> float:
        """Largest absolute ``residual`` of a step."""
        # Not max(initial=0): the energy of an inverted element is NaN, which must not be hidden.
        return float(np.abs(self.residual).max()) if len(self.residual) else 0.0


@dataclass(frozen=True)
class EnergyTotals:
    """Energy balance summed over all steps, in units of m g H."""

    __repr__ = short_repr

    unit_joules: float
    """m g H in joules, the unit of the other fields."""
    muscle_work: float
    """Sum over segments and steps of max(0, T (L before - L after))."""
    flows: Mapping[str, float]
    """Sum of each of ``FLOWS``."""
    change: float
    """Stored energy of the last state minus stored energy of the first state."""
    peak_deformation: float
    """Maximum kinetic energy of deformation."""
    peak_elastic: float
    """Maximum elastic energy."""
    worst_residual: float
    """Largest absolute residual of a step."""

    @classmethod
    def of(cls, balance: EnergyBalance) -> EnergyTotals:
        """Sum the balance of a run."""
        return cls(
            balance.energy_unit,
            float(balance.muscle_work.sum() / balance.energy_unit),
            {name: float(getattr(balance, name).sum() / balance.energy_unit) for name in FLOWS},
            float((balance.stored[-1] - balance.stored[0]) / balance.energy_unit),
            float(balance.kinetic_deformation.max() / balance.energy_unit),
            float(balance.elastic.max() / balance.energy_unit),
            balance.max_residual,
        )


def energy_balance(trajectory: Trajectory) -> EnergyBalance:
    """Compute the energy balance of a trajectory."""
    t = trajectory
    mass = t.node_mass.sum()
    body = _Elements.of(t)
    muscles = _Muscles.of(t)
    stored = np.array([_stored(t, body, x, v) for x, v in zip(t.positions, t.velocities, strict=True)])
    flows = np.array([_flows(t, body, muscles, step) for step in range(len(t.dt))]).reshape(-1, len(FLOWS) + 1)
    return EnergyBalance(
        float(mass * np.linalg.norm(t.gravity) * t.height),
        **dict(zip(STORED, stored.T, strict=True)),
        **dict(zip((*FLOWS, "muscle_work"), flows.T, strict=True)),
    )


def _stored(t: Trajectory, body: _Elements, positions: np.ndarray, velocities: np.ndarray) -> tuple[float, ...]:
    """Return the energies of a state, in the order of ``STORED``."""
    mass = t.node_mass.sum()
    com, mean = t.node_mass @ positions / mass, t.node_mass @ velocities / mass
    rotation = np.cross(_spin(t.node_mass, positions, velocities), positions - com)
    return (
        0.5 * float(mass * mean @ mean),
        0.5 * _squared(t.node_mass, rotation),
        0.5 * _squared(t.node_mass, velocities - mean - rotation),
        -float(mass * com @ t.gravity),
        body.energy(positions),
    )


def _flows(t: Trajectory, body: _Elements, muscles: _Muscles, step: int) -> tuple[float, ...]:
    """Return the flows of a step, in the order of ``FLOWS``, then ``muscle_work``."""
    dt, mass = float(t.dt[step]), t.node_mass
    before, after = t.positions[step], t.positions[step + 1]
    displacements = after - before
    kick = t.kick_velocity[t.kick_step == step].sum(axis=0) if len(t.kick_step) else np.zeros_like(displacements)
    # Velocity in the equation of motion. The stored velocity may include an added rotation.
    velocity = displacements / dt
    element_result = body.step(before, after, dt)
    muscle_result = muscles.step(t.activations[step], before, after)
    added = _spin(mass, after, t.velocities[step + 1] - velocity)
    # The internal forces at the end of the step have no net torque with the lever arms at the end, but implicit Euler
    # applies them with the lever arms at the start of the step.
    lost_momentum = -dt * (element_result.torque + muscle_result.torque)
    inner_spin = np.linalg.solve(_inertia(mass, before), lost_momentum - _inertia(mass, after) @ added)
    friction, contact, push_out = _contacts(t, step, displacements)
    return (
        muscle_result.work,
        float(mass @ (kick * (t.velocities[step] + 0.5 * kick)).sum(axis=1)),
        element_result.dissipated,
        -t.drag * dt * _squared(mass, velocity),
        friction,
        contact,
        push_out,
        _joint_work(t, step, displacements),
        -0.5 * _squared(mass, velocity - t.velocities[step] - kick),
        element_result.lost_elastic,
        muscle_result.loss,
        element_result.lost_damping,
        float(inner_spin @ _momentum(mass, before, velocity)),
        float(added @ (_momentum(mass, after, velocity) + 0.5 * _inertia(mass, after) @ added)),
        muscle_result.effort,
    )


def _contacts(t: Trajectory, step: int, displacements: np.ndarray) -> tuple[float, float, float]:
    """Return the work of friction, of normal forces on points that approach their plane, and on points that leave
    it."""
    first, last = np.searchsorted(t.contact_step, [step, step + 1])
    point_displacements = np.einsum(
        "cw,cwi->ci", t.contact_weights[first:last], displacements[t.contact_nodes[first:last]]
    )
    normals, forces = t.contact_normal[first:last], t.contact_force[first:last]
    along, pressed = np.sum(point_displacements * normals, axis=1), np.sum(forces * normals, axis=1)
    work = pressed * along
    tangential = np.sum((forces - pressed[:, None] * normals) * (point_displacements - along[:, None] * normals))
    return float(tangential), float(work[along < 0.0].sum()), float(work[along >= 0.0].sum())


def _joint_work(t: Trajectory, step: int, displacements: np.ndarray) -> float:
    """Return the work of the joint forces on the body."""
    own = t.joint_step == step
    return float(np.einsum("jw,jwi,ji", t.joint_weights[own], displacements[t.joint_nodes[own]], t.joint_force[own]))


@dataclass(frozen=True)
class _Strain:
    """Dissipation, losses and torque of the elements in a step. Energies are in J."""

    dissipated: float
    lost_elastic: float
    lost_damping: float
    torque: np.ndarray
    """(3,) N m, torque of the elastic and damping forces at the end of the step, with the lever arms at its start."""


@dataclass(frozen=True)
class _Elements:
    """Neo-Hookean tetrahedra (Eq. 5) with the damping of docs/concepts/body.md."""

    tets: np.ndarray
    rest_inverses: np.ndarray
    """(T, 3, 3) inverses of the rest edge matrices, 1/m."""
    volumes: np.ndarray
    """(T,) m^3, volumes at rest times the relative stiffness, to which all terms of an element are proportional."""
    mu: float
    """Shear modulus mu, Pa."""
    lam: float
    """Lame's first parameter lambda, Pa."""
    damping_time: float
    """Rayleigh coefficient beta, s."""

    @classmethod
    def of(cls, t: Trajectory) -> _Elements:
        edges = _edges(t.unloaded_positions, t.tets)
        young, nu = t.young_modulus, t.poisson_ratio
        mu, lam = young / (2.0 * (1.0 + nu)), young * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
        volumes = np.linalg.det(edges) / 6.0
        if len(t.relative_stiffness):
            volumes = volumes * t.relative_stiffness
        return cls(t.tets, np.linalg.inv(edges), volumes, mu, lam, t.damping_time)

    def gradients(self, positions: np.ndarray) -> np.ndarray:
        """Return the deformation gradients F (T, 3, 3) at ``positions`` (N, 3) m."""
        return _edges(positions, self.tets) @ self.rest_inverses

    def energy(self, positions: np.ndarray) -> float:
        """Return the energy of all elements (Eq. 5), J; not finite if one is inverted."""
        F = self.gradients(positions)
        with np.errstate(invalid="ignore", divide="ignore"):
            log_j = np.log(np.linalg.det(F))
        density = 0.5 * self.mu * ((F * F).sum(axis=(1, 2)) - 3.0) - self.mu * log_j + 0.5 * self.lam * log_j**2
        return float(self.volumes @ density)

    def step(self, before: np.ndarray, after: np.ndarray, dt: float) -> _Strain:
        """Compute dissipation, losses and torque of the elements in a step."""
        F0, F1 = self.gradients(before), self.gradients(after)
        change = F1 - F0
        inverse = np.linalg.inv(F1)
        transposed = np.swapaxes(F1, 1, 2)
        rate = (transposed @ F1 - np.swapaxes(F0, 1, 2) @ F0) / (2.0 * dt)
        stress = self.damping_time * (2.0 * self.mu * rate + self.lam * _trace(rate)[:, None, None] * np.eye(3))
        with np.errstate(invalid="ignore", divide="ignore"):
            log_j = np.log(np.linalg.det(F1))
        elastic = self.mu * F1 + (self.lam * log_j - self.mu)[:, None, None] * np.swapaxes(inverse, 1, 2)
        force = elastic + F1 @ stress
        # The torque is the sum of x0 x (-P g) V over the corners; F0 is the sum of x0 g^T over the corners.
        turning = -np.einsum("t,tij,tkj->ik", self.volumes, F0, force)
        return _Strain(
            -dt * float(self.volumes @ (stress * rate).sum(axis=(1, 2))),
            -float(self.volumes @ self._remainder(change, inverse @ change, log_j)),
            -0.5 * float(self.volumes @ (stress * (np.swapaxes(change, 1, 2) @ change)).sum(axis=(1, 2))),
            np.array([turning[1, 2] - turning[2, 1], turning[2, 0] - turning[0, 2], turning[0, 1] - turning[1, 0]]),
        )

    def _remainder(self, change: np.ndarray, relative: np.ndarray, log_j: np.ndarray) -> np.ndarray:
        """Return (T,) Psi(F0) - Psi(F1) + P(F1) : (F1 - F0).

        Args:
            change: (T, 3, 3) F1 - F0.
            relative: (T, 3, 3) A = F1^-1 (F1 - F0); det F0 = det F1 det(I - A) for a step of any size.
            log_j: (T,) ln det F1.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            log_change = np.log(np.linalg.det(np.eye(3) - relative))
        curved = log_change + _trace(relative)  # For a small step this is about -tr(A A) / 2.
        squares = self.mu * (change * change).sum(axis=(1, 2)) + self.lam * log_change**2
        return 0.5 * squares + (self.lam * log_j - self.mu) * curved


@dataclass(frozen=True)
class _Pull:
    """Work, positive work, loss and torque of the muscles in a step. Energies are in J."""

    work: float
    effort: float
    loss: float
    torque: np.ndarray
    """(3,) N m, torque of the muscle forces at the end of the step, with the lever arms at its start."""


@dataclass(frozen=True)
class _Muscles:
    """Muscle segments, which pull along the line between their ends. In a step, the tension of a segment is constant
    above 0.7 of its rest length, decreases below that, and vanishes below 0.3 (docs/concepts/muscles.md)."""

    starts: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray
    segments: np.ndarray
    stiffness: np.ndarray
    rest_lengths: np.ndarray

    @classmethod
    def of(cls, t: Trajectory) -> _Muscles:
        return cls(
            *(t.muscle_end_starts, t.muscle_end_nodes, t.muscle_end_weights, t.muscle_segments, t.muscle_stiffness),
            t.muscle_rest_lengths,
        )

    def step(self, activations: np.ndarray, before: np.ndarray, after: np.ndarray) -> _Pull:
        """Compute work, loss and torque of all segments in a step."""
        tension = self.stiffness * activations
        start, end = self._lines(before), self._lines(after)
        long, short = np.linalg.norm(start, axis=1), np.linalg.norm(end, axis=1)
        limb = np.clip((short / self.rest_lengths - 0.3) / 0.4, 0.0, 1.0)
        share = 3.0 * limb**2 - 2.0 * limb**3
        work = tension * (self._pulled(long) - self._pulled(short))
        directions = end / np.maximum(short, 1e-300)[:, None]
        # Implicit Euler applies the force at the end of the step, ``share`` T u1, throughout the step. The loss is T
        # (W0 - W1 + share u1.(x1 - x0)), where W is the length over which the full tension does the same work. The loss
        # has two parts: the rotation of the line, and the change of ``share`` below 0.7 of the rest length.
        turned = 0.5 * share * long * ((start / np.maximum(long, 1e-300)[:, None] - directions) ** 2).sum(axis=1)
        weakened = self._pulled(long) - self._pulled(short) - share * (long - short)
        torque = -np.cross(start, (tension * share)[:, None] * directions).sum(axis=0)
        return _Pull(float(work.sum()), float(work[work > 0.0].sum()), -float(tension @ (turned + weakened)), torque)

    def _pulled(self, lengths: np.ndarray) -> np.ndarray:
        """Return (M,) m, the integral of the tension, as a fraction of the full tension, from length 0 to ``lengths``
        (M,) m."""
        rest = self.rest_lengths
        limb = np.clip((lengths / rest - 0.3) / 0.4, 0.0, 1.0)
        return rest * (0.4 * limb**3 - 0.2 * limb**4) + np.maximum(lengths - 0.7 * rest, 0.0)

    def _lines(self, positions: np.ndarray) -> np.ndarray:
        """Return (M, 3) m, the vectors from the first to the second end of each segment."""
        if len(self.segments) == 0:
            return np.zeros((0, 3))
        ends = np.add.reduceat(self.weights[:, None] * positions[self.nodes], self.starts[:-1], axis=0)
        return ends[self.segments[:, 1]] - ends[self.segments[:, 0]]


def _edges(positions: np.ndarray, tets: np.ndarray) -> np.ndarray:
    corners = positions[tets]
    return np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)


def _trace(matrices: np.ndarray) -> np.ndarray:
    return np.trace(matrices, axis1=1, axis2=2)


def _squared(mass: np.ndarray, velocities: np.ndarray) -> float:
    """Return v^T M v."""
    return float(mass @ (velocities**2).sum(axis=1))


def _momentum(mass: np.ndarray, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """Return (3,) kg m^2/s, angular momentum about the centre of mass."""
    return mass @ np.cross(positions - mass @ positions / mass.sum(), velocities)


def _inertia(mass: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return (3, 3) kg m^2, inertia about the centre of mass."""
    arms = positions - mass @ positions / mass.sum()
    return float(mass @ (arms**2).sum(axis=1)) * np.eye(3) - np.einsum("n,ni,nj->ij", mass, arms, arms)


def _spin(mass: np.ndarray, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """Return (3,) rad/s, angular velocity of the rigid rotation with the angular momentum of ``velocities``."""
    return np.linalg.solve(_inertia(mass, positions), _momentum(mass, positions, velocities))
