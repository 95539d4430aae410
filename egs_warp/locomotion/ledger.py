"""Where the energy of every step comes from and goes to, from a trajectory's arrays alone (docs/concepts/ledger.md).

Shares no code with the solver: energies, damping and muscles are written down a second time here, in NumPy, and no term
is what is left over of others. So ``Ledger.residual`` is an error of the run, or of one of the two.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from egs_warp.locomotion.trajectory import Trajectory

STORED = ("kinetic_com", "kinetic_rotation", "kinetic_deformation", "potential", "elastic")
"""Energies of a state."""
FLOWS = (
    "muscles",
    "pushes",
    "damping",
    "drag",
    "friction",
    "contact",
    "push_out",
    "lost_inertia",
    "lost_elastic",
    "lost_muscle",
    "lost_damping",
    "spin_inside",
    "spin_after",
)
"""What a step adds to their sum."""


@dataclass(frozen=True)
class EnergyBalance:
    """Joules: F+1 states, F steps. What takes energy from the body is negative."""

    energy_unit: float
    """m g H."""
    kinetic_com: np.ndarray
    """(F+1,) of the centre of mass."""
    kinetic_rotation: np.ndarray
    """(F+1,) of the rigid rotation with the body's angular momentum."""
    kinetic_deformation: np.ndarray
    """(F+1,) of what moves beside that."""
    potential: np.ndarray
    """(F+1,) in gravity, above the origin."""
    elastic: np.ndarray
    """(F+1,) Neo-Hookean (Eq. 5)."""
    muscles: np.ndarray
    """(F,) sum of T (L before - L after)."""
    pushes: np.ndarray
    """(F,) what is given to the nodes from outside as the step begins."""
    damping: np.ndarray
    """(F,) what the material dissipates."""
    drag: np.ndarray
    """(F,) of the air."""
    friction: np.ndarray
    """(F,) tangential contact forces."""
    contact: np.ndarray
    """(F,) normal forces on points that come nearer to their plane."""
    push_out: np.ndarray
    """(F,) normal forces on points that leave it."""
    lost_inertia: np.ndarray
    """(F,) by implicit Euler, of the kinetic energy."""
    lost_elastic: np.ndarray
    """(F,) by implicit Euler, which takes the elastic force of the step's end for the whole step."""
    lost_muscle: np.ndarray
    """(F,) likewise, of the muscles' forces."""
    lost_damping: np.ndarray
    """(F,) likewise, of the damping's."""
    spin_inside: np.ndarray
    """(F,) work of the torque that is taken off the internal forces within the step, to keep the angular momentum."""
    spin_after: np.ndarray
    """(F,) kinetic energy of the spin that is added to the velocities after the step, for the same end."""
    muscle_work: np.ndarray
    """(F,) sum of max(0, T (L before - L after)): what muscles give, those that are stretched not set off; no flow."""

    @property
    def stored(self) -> np.ndarray:
        """(F+1,) sum of all energies of a state."""
        return np.sum([getattr(self, name) for name in STORED], axis=0)

    @property
    def residual(self) -> np.ndarray:
        """(F,) what the stored energy gains beside all flows, over m g H."""
        return (np.diff(self.stored) - np.sum([getattr(self, name) for name in FLOWS], axis=0)) / self.energy_unit

    @property
    def max_residual(self) -> float:
        """Largest ``residual`` of any step, either way."""
        # Not max(initial=0): where an element is inverted there is no energy, and NaN must be seen.
        return float(np.abs(self.residual).max()) if len(self.residual) else 0.0


@dataclass(frozen=True)
class EnergyTotals:
    """A ledger over all steps, over m g H but for its unit."""

    unit_joules: float
    """m g H."""
    muscle_work: float
    """Sum over segments and steps of max(0, T (L before - L after))."""
    flows: Mapping[str, float]
    """Of each of ``FLOWS``, its sum."""
    change: float
    """Energy of the last state less that of the first."""
    peak_deformation: float
    """Largest kinetic energy of deformation."""
    peak_elastic: float
    """Largest elastic energy."""
    worst_residual: float
    """Of any step."""

    @classmethod
    def of(cls, books: EnergyBalance) -> EnergyTotals:
        """Of a run."""
        return cls(
            books.energy_unit,
            float(books.muscle_work.sum() / books.energy_unit),
            {name: float(getattr(books, name).sum() / books.energy_unit) for name in FLOWS},
            float((books.stored[-1] - books.stored[0]) / books.energy_unit),
            float(books.kinetic_deformation.max() / books.energy_unit),
            float(books.elastic.max() / books.energy_unit),
            books.max_residual,
        )


def energy_balance(trajectory: Trajectory) -> EnergyBalance:
    """Every term of every step."""
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
    mass = t.node_mass.sum()
    com, mean = t.node_mass @ positions / mass, t.node_mass @ velocities / mass
    turn = np.cross(_spin(t.node_mass, positions, velocities), positions - com)
    return (
        0.5 * float(mass * mean @ mean),
        0.5 * _squared(t.node_mass, turn),
        0.5 * _squared(t.node_mass, velocities - mean - turn),
        -float(mass * com @ t.gravity),
        body.energy(positions),
    )


def _flows(t: Trajectory, body: _Elements, muscles: _Muscles, step: int) -> tuple[float, ...]:
    dt, mass = float(t.dt[step]), t.node_mass
    before, after = t.positions[step], t.positions[step + 1]
    way = after - before
    kick = t.kick_velocity[t.kick_step == step].sum(axis=0) if len(t.kick_step) else np.zeros_like(way)
    # That of the equation of motion; a spin may have been added to what was stored.
    velocity = way / dt
    strain = body.step(before, after, dt)
    pull = muscles.step(t.activations[step], before, after)
    added = _spin(mass, after, t.velocities[step + 1] - velocity)
    # Of the internal forces, which have none about their own points of attack: implicit Euler lets them act at the
    # end's directions with the arms of the start.
    eaten = -dt * (strain.torque + pull.torque)
    given = np.linalg.solve(_inertia(mass, before), eaten - _inertia(mass, after) @ added)
    friction, contact, push_out = _contacts(t, step, way)
    return (
        pull.work,
        float(mass @ (kick * (t.velocities[step] + 0.5 * kick)).sum(axis=1)),
        strain.dissipated,
        -t.drag * dt * _squared(mass, velocity),
        friction,
        contact,
        push_out,
        -0.5 * _squared(mass, velocity - t.velocities[step] - kick),
        strain.lost_elastic,
        pull.lost,
        strain.lost_damping,
        float(given @ _momentum(mass, before, velocity)),
        float(added @ (_momentum(mass, after, velocity) + 0.5 * _inertia(mass, after) @ added)),
        pull.effort,
    )


def _contacts(t: Trajectory, step: int, way: np.ndarray) -> tuple[float, float, float]:
    """Work of friction, of normal forces on points that come nearer to their plane, and on those that leave it."""
    first, last = np.searchsorted(t.contact_step, [step, step + 1])
    moved = np.einsum("cw,cwi->ci", t.contact_weights[first:last], way[t.contact_nodes[first:last]])
    normals, forces = t.contact_normal[first:last], t.contact_force[first:last]
    along, pressed = np.sum(moved * normals, axis=1), np.sum(forces * normals, axis=1)
    work = pressed * along
    tangential = np.sum((forces - pressed[:, None] * normals) * (moved - along[:, None] * normals))
    return float(tangential), float(work[along < 0.0].sum()), float(work[along >= 0.0].sum())


@dataclass(frozen=True)
class _Strain:
    dissipated: float
    lost_elastic: float
    lost_damping: float
    torque: np.ndarray
    """(3,) N m of elastic and damping forces at the end, with the arms of the start."""


@dataclass(frozen=True)
class _Elements:
    """Neo-Hookean tetrahedra (Eq. 5) with the damping of docs/concepts/body.md."""

    tets: np.ndarray
    rest_inverses: np.ndarray
    """(T, 3, 3)."""
    volumes: np.ndarray
    """(T,)."""
    mu: float
    lam: float
    damping_time: float

    @classmethod
    def of(cls, t: Trajectory) -> _Elements:
        edges = _edges(t.rest_positions, t.tets)
        young, nu = t.young_modulus, t.poisson_ratio
        mu, lam = young / (2.0 * (1.0 + nu)), young * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
        return cls(t.tets, np.linalg.inv(edges), np.linalg.det(edges) / 6.0, mu, lam, t.damping_time)

    def gradients(self, positions: np.ndarray) -> np.ndarray:
        """(T, 3, 3) F."""
        return _edges(positions, self.tets) @ self.rest_inverses

    def energy(self, positions: np.ndarray) -> float:
        """Eq. 5 over all elements; not finite where one is inverted."""
        F = self.gradients(positions)
        with np.errstate(invalid="ignore", divide="ignore"):
            log_j = np.log(np.linalg.det(F))
        density = 0.5 * self.mu * ((F * F).sum(axis=(1, 2)) - 3.0) - self.mu * log_j + 0.5 * self.lam * log_j**2
        return float(self.volumes @ density)

    def step(self, before: np.ndarray, after: np.ndarray, dt: float) -> _Strain:
        """What the elements do in a step."""
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
        # sum over corners of x0 x -(P g) V, with F0 = sum of x0 outer g.
        turning = -np.einsum("t,tij,tkj->ik", self.volumes, F0, force)
        return _Strain(
            -dt * float(self.volumes @ (stress * rate).sum(axis=(1, 2))),
            -float(self.volumes @ self._remainder(change, inverse @ change, log_j)),
            -0.5 * float(self.volumes @ (stress * (np.swapaxes(change, 1, 2) @ change)).sum(axis=(1, 2))),
            np.array([turning[1, 2] - turning[2, 1], turning[2, 0] - turning[0, 2], turning[0, 1] - turning[1, 0]]),
        )

    def _remainder(self, change: np.ndarray, relative: np.ndarray, log_j: np.ndarray) -> np.ndarray:
        """(T,) Psi(F0) - Psi(F1) + P(F1) : (F1 - F0), from the ``change`` F1 - F0 (T, 3, 3) and ln det F1.

        ``relative`` is A = F1^-1 (F1 - F0), so det F0 = det F1 det(I - A), however far the step goes.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            fallen = np.log(np.linalg.det(np.eye(3) - relative))
        curved = fallen + _trace(relative)  # -tr(A A) / 2 of a small step
        squares = self.mu * (change * change).sum(axis=(1, 2)) + self.lam * fallen**2
        return 0.5 * squares + (self.lam * log_j - self.mu) * curved


@dataclass(frozen=True)
class _Pull:
    work: float
    effort: float
    lost: float
    torque: np.ndarray
    """(3,) N m at the end, with the arms of the start."""


@dataclass(frozen=True)
class _Muscles:
    """Segments that pull with a constant tension along the line between their ends, with less of it where they are
    shorter than 0.7 of their rest length, and nothing below 0.3 (docs/concepts/muscles.md)."""

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
        """What all segments do in a step."""
        tension = self.stiffness * activations
        start, end = self._lines(before), self._lines(after)
        long, short = np.linalg.norm(start, axis=1), np.linalg.norm(end, axis=1)
        limb = np.clip((short / self.rest_lengths - 0.3) / 0.4, 0.0, 1.0)
        share = 3.0 * limb**2 - 2.0 * limb**3
        work = tension * (self._pulled(long) - self._pulled(short))
        directions = end / np.maximum(short, 1e-300)[:, None]
        # The force of the end, share T u1, over the whole way: T (W0 - W1 + share u1.(x1 - x0)), W the length over
        # which all of the tension would do as much. A line that turns gets none of the force across it, one that
        # shortens below 0.7 the share of its end.
        turned = 0.5 * share * long * ((start / np.maximum(long, 1e-300)[:, None] - directions) ** 2).sum(axis=1)
        limped = self._pulled(long) - self._pulled(short) - share * (long - short)
        torque = -np.cross(start, (tension * share)[:, None] * directions).sum(axis=0)
        return _Pull(float(work.sum()), float(work[work > 0.0].sum()), -float(tension @ (turned + limped)), torque)

    def _pulled(self, lengths: np.ndarray) -> np.ndarray:
        """(M,) metres, the integral of the share of the tension that is left, from nothing to ``lengths`` (M,)."""
        rest = self.rest_lengths
        limb = np.clip((lengths / rest - 0.3) / 0.4, 0.0, 1.0)
        return rest * (0.4 * limb**3 - 0.2 * limb**4) + np.maximum(lengths - 0.7 * rest, 0.0)

    def _lines(self, positions: np.ndarray) -> np.ndarray:
        """(M, 3) from each segment's first end to its second."""
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
    """v.M v."""
    return float(mass @ (velocities**2).sum(axis=1))


def _momentum(mass: np.ndarray, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """(3,) angular momentum about the centre of mass."""
    return mass @ np.cross(positions - mass @ positions / mass.sum(), velocities)


def _inertia(mass: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """(3, 3) about the centre of mass."""
    arms = positions - mass @ positions / mass.sum()
    return float(mass @ (arms**2).sum(axis=1)) * np.eye(3) - np.einsum("n,ni,nj->ij", mass, arms, arms)


def _spin(mass: np.ndarray, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """(3,) rad/s of the rigid rotation that has the angular momentum."""
    return np.linalg.solve(_inertia(mass, positions), _momentum(mass, positions, velocities))
