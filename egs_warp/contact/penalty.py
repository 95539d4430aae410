"""Stage 1: the implicit step with penalty contact (Eq. 10, 11) that tells each contact's state (Eq. 12)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.contact.detection import ContactSet, push_out_speeds
from egs_warp.fem.implicit_step import ImplicitStep, NewtonResult
from egs_warp.muscles.tension import MuscleTension


@dataclass(frozen=True)
class Prediction:
    """End of stage 1."""

    velocities: np.ndarray
    """(N, 3) m/s."""
    normal_forces: np.ndarray
    """(n,) newtons."""
    tangential_forces: np.ndarray
    """(n, 2) newtons."""
    tangential_velocities: np.ndarray
    """(n, 2) m/s."""
    newton: NewtonResult


@dataclass(frozen=True)
class PenaltyContact:
    """Normal force -k_n min(0, c) and friction of Huber slope min(k_f |u_t|, cap);
    c is the normal measure of DESIGN 7.
    """

    contacts: ContactSet
    step: ImplicitStep
    normal_stiffness: float
    """k_n = k_f, N s/m: a resting body creeps at weight / sum k_n (Eq. 10 takes a velocity)."""
    shift: np.ndarray
    """(n,) m/s: c = N^T u' + shift."""
    friction_cap: np.ndarray
    """(n,) newtons, mu f_n of the last iterate."""

    def _measure(self, velocities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        local = (self.contacts.frame @ velocities.ravel()).reshape(-1, 3)
        return np.minimum(local[:, 0] + self.shift, 0.0), local[:, 1:]

    def forces(self, velocities: np.ndarray) -> np.ndarray:
        """(n, 3) newtons on the body at end velocity (N, 3) (Eq. 10, 11)."""
        depth, tangent = self._measure(velocities)
        speed = np.linalg.norm(tangent, axis=1)
        limited = np.minimum(self.normal_stiffness * speed, self.friction_cap)
        slope = np.where(speed > 0.0, limited / np.where(speed > 0.0, speed, 1.0), 0.0)
        return np.column_stack([-self.normal_stiffness * depth, -slope[:, None] * tangent])

    def energy(self, velocities: np.ndarray) -> float:
        """dt [k_n/2 min(0, c)^2 + huber(|u_t|)], joules."""
        depth, tangent = self._measure(velocities)
        speed = np.linalg.norm(tangent, axis=1)
        knee = self.friction_cap / self.normal_stiffness
        quadratic = 0.5 * self.normal_stiffness * speed**2
        linear = self.friction_cap * (speed - 0.5 * knee)
        huber = np.where(speed <= knee, quadratic, linear)
        return self.step.dt * float((0.5 * self.normal_stiffness * depth**2 + huber).sum())

    def gradient(self, velocities: np.ndarray) -> np.ndarray:
        """(N, 3) N s."""
        return -self.step.dt * (self.contacts.frame.T @ self.forces(velocities).ravel()).reshape(velocities.shape)

    def add_hessian(self, velocities: np.ndarray, entries: np.ndarray) -> None:
        """Add the positive semi-definite Hessian to the upper entries of S."""
        depth, tangent = self._measure(velocities)
        speed = np.linalg.norm(tangent, axis=1)
        knee = self.friction_cap / self.normal_stiffness
        blocks = np.zeros((len(depth), 3, 3))
        blocks[:, 0, 0] = np.where(depth < 0.0, self.normal_stiffness, 0.0)
        unit = tangent / np.where(speed > 0.0, speed, 1.0)[:, None]
        across = np.eye(2) - np.einsum("ni,nj->nij", unit, unit)
        slope = self.friction_cap / np.where(speed > 0.0, speed, 1.0)
        inside = speed <= knee
        blocks[:, 1:, 1:] = np.where(
            inside[:, None, None], self.normal_stiffness * np.eye(2), slope[:, None, None] * across
        )
        self._scatter(self.step.dt * blocks, entries)

    def _scatter(self, blocks: np.ndarray, entries: np.ndarray) -> None:
        contacts = self.contacts
        axes = contacts.axes
        world = np.einsum("nai,nab,nbj->nij", axes, blocks, axes)
        assembly = self.step.body.assembly
        for a in range(4):
            for b in range(4):
                first, second = contacts.nodes[:, a], contacts.nodes[:, b]
                upper = first <= second
                where = assembly.entries_of_node_pairs(first[upper], second[upper])
                product = contacts.weights[upper, a] * contacts.weights[upper, b]
                values = product[:, None] * world[upper].reshape(-1, 9)
                kept = where >= 0
                np.add.at(entries, where[kept], values[kept])


def predict(
    step: ImplicitStep,
    contacts: ContactSet,
    force: np.ndarray,
    start: np.ndarray,
    *,
    normal_forces: np.ndarray,
    friction: float,
    push_out_cap: float,
    tension: MuscleTension | None = None,
) -> Prediction:
    """Minimise Phi with penalty contact under ``force`` (N, 3) and the muscles' ``tension``.

    The friction cap is lagged: it comes from last step's ``normal_forces`` (n,), newtons, 0 for a new contact.
    """
    body = step.body
    creep = 5e-3 * body.height
    stiffness = body.weight / (max(contacts.count, 1) * creep)
    shift = push_out_speeds(contacts.gaps, step.dt, push_out_cap)
    share = body.weight / max(contacts.count, 1)
    penalty = PenaltyContact(contacts, step, stiffness, shift, friction * np.maximum(normal_forces, 0.5 * share))
    result = step.minimise(
        force,
        start,
        penalty if contacts.count else None,  # pyright: ignore[reportArgumentType]  # the same three functions
        tension=tension,
        tolerance=1e-3,
    )
    velocities = result.velocities
    forces = penalty.forces(velocities)
    tangent = (contacts.frame @ velocities.ravel()).reshape(-1, 3)[:, 1:]
    return Prediction(velocities, forces[:, 0], forces[:, 1:], tangent, result)
