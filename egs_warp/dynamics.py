"""One implicit Euler step as a minimisation over the end velocity (Eq. 4, 6), with Newton's method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import qdldl

from egs_warp.body import BodyState, SoftBody


class NewtonStatus(Enum):
    """How a Newton solve ended; the value says cause and cure."""

    CONVERGED = "converged"
    STALLED = "the line search found no lower energy; halve the step"
    ITERATION_LIMIT = "the iteration limit was reached; halve the step"


@dataclass(frozen=True)
class NewtonResult:
    """End of a Newton solve."""

    velocities: np.ndarray
    """(N, 3) m/s."""
    status: NewtonStatus
    iterations: int
    residual: float
    """Norm of the gradient over dt x weight."""


@dataclass(frozen=True)
class PenaltyTerms:
    """Value, gradient and Hessian entries of a penalty added to Phi (stage 1's contact)."""

    energy: Callable[[np.ndarray], float]
    """(N, 3) end velocity -> joules."""
    gradient: Callable[[np.ndarray], np.ndarray]
    """(N, 3) end velocity -> (N, 3) N s."""
    add_hessian: Callable[[np.ndarray, np.ndarray], None]
    """(N, 3) end velocity, matrix entries to add to in place."""


class Factorisation:
    """Sparse LDL^T of S = M + dt C + dt^2 K; the symbolic analysis is done once a body."""

    def __init__(self, body: SoftBody) -> None:
        self._body = body
        self._solver: qdldl.Solver | None = None

    def update(self, entries: np.ndarray) -> bool:
        """Factor the matrix with these upper entries; False if it is not positive definite."""
        matrix = self._body.assembly.matrix(entries)
        if not np.isfinite(entries).all():
            return False
        try:
            if self._solver is None:
                self._solver = qdldl.Solver(matrix, upper=True)
            else:
                self._solver.update(matrix, upper=True)
        except RuntimeError:
            self._solver = None
            return False
        assert self._solver is not None
        pivots = self._solver.factors()[1]
        return bool(np.all(pivots > 0.0) and np.isfinite(pivots).all())

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solve for (N, 3), or for each column of (3N, m)."""
        assert self._solver is not None, "update() comes first"
        if right.ndim == 2 and right.shape == self._body.mesh.nodes.shape:
            return self._solver.solve(right.ravel()).reshape(right.shape)
        return np.stack([self._solver.solve(np.ascontiguousarray(column)) for column in right.T], axis=1)


@dataclass
class ImplicitStep:
    """The function Phi of one step (DESIGN 5) and its minimisation; forces are constant over the step.

    Phi(v) = 1/2 (v-v0)^T M (v-v0) + Psi(p + dt v) + dt beta/2 sum V E':C:E' - dt v^T f, E' the mean strain rate of the step
    """

    body: SoftBody
    state: BodyState
    dt: float
    """Seconds."""
    factorisation: Factorisation
    drag: float = 0.0
    """alpha of Rayleigh damping (drag against the air), 1/s."""
    tolerance: float = 1e-7
    """Norm of the gradient over dt x weight at which Newton stops."""
    iteration_limit: int = 60
    newton_iterations: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.body.assembly.begin_step(self.state.positions)
        self._mass = self.body.node_mass[:, None]

    def end_positions(self, velocities: np.ndarray) -> np.ndarray:
        """(N, 3) p + dt v."""
        return self.state.positions + self.dt * velocities

    def energy(self, velocities: np.ndarray, force: np.ndarray) -> float:
        """Phi, joules; infinite where an element is inverted."""
        change = velocities - self.state.velocities
        elastic = self.body.assembly.energy(self.end_positions(velocities), self.dt)
        inertia = 0.5 * float((self._mass * change**2).sum())
        drag = 0.5 * self.dt * self.drag * float((self._mass * velocities**2).sum())
        return inertia + elastic + drag - self.dt * float((velocities * force).sum())

    def gradient(self, velocities: np.ndarray, force: np.ndarray) -> np.ndarray:
        """(N, 3) dPhi/dv, N s."""
        internal = self.body.assembly.gradient(self.end_positions(velocities), self.dt)
        inertia = self._mass * (velocities - self.state.velocities + self.dt * self.drag * velocities)
        return inertia + self.dt * (internal - force)

    def matrix_entries(self, velocities: np.ndarray, *, projected: bool) -> np.ndarray:
        """Upper entries of S = (1 + dt alpha) M + dt C + dt^2 K, the second derivative of Phi, at the end positions of ``velocities``."""
        assembly = self.body.assembly
        entries = assembly.matrix_entries(
            self.end_positions(velocities), self.dt, factor=self.dt**2, projected=projected
        )
        entries[assembly.diagonal_entries] += (1.0 + self.dt * self.drag) * np.repeat(self.body.node_mass, 3)
        return entries

    def factor(self, velocities: np.ndarray, penalty: PenaltyTerms | None = None, *, projected: bool = False) -> None:
        """Factor the true S at ``velocities``, or the projected one where the true one is not positive definite."""
        for project in (True,) if projected else (False, True):
            entries = self.matrix_entries(velocities, projected=project)
            if penalty is not None:
                penalty.add_hessian(velocities, entries)
            if self.factorisation.update(entries):
                return
        raise FloatingPointError("the projected Hessian is not positive definite")

    def minimise(
        self,
        force: np.ndarray,
        start: np.ndarray,
        penalty: PenaltyTerms | None = None,
        *,
        tolerance: float | None = None,
    ) -> NewtonResult:
        """Newton with a line search that stays feasible (J > 0), from ``start`` (N, 3) under ``force`` (N, 3) newtons."""
        tolerance = self.tolerance if tolerance is None else tolerance

        def phi(v: np.ndarray) -> float:
            value = self.energy(v, force)
            return value + penalty.energy(v) if penalty is not None and np.isfinite(value) else value

        def slope(v: np.ndarray) -> np.ndarray:
            value = self.gradient(v, force)
            return value + penalty.gradient(v) if penalty is not None else value

        unit = self.dt * self.body.weight
        velocities = start
        value = phi(velocities)
        if not np.isfinite(value):
            velocities = np.zeros_like(start)
            value = phi(velocities)
        gradient = slope(velocities)
        residual = float(np.linalg.norm(gradient)) / unit
        for iteration in range(self.iteration_limit):
            if residual <= tolerance:
                return NewtonResult(velocities, NewtonStatus.CONVERGED, iteration, residual)
            self.newton_iterations += 1
            self.factor(velocities, penalty)
            direction = -self.factorisation.solve(gradient)
            descent = float((gradient * direction).sum())
            length = 1.0
            while True:
                trial = velocities + length * direction
                trial_value = phi(trial)
                if trial_value <= value + 1e-4 * length * descent:
                    trial_gradient = slope(trial)
                    break
                # Near the minimum the decrease drowns in rounding; there a smaller gradient is the better witness.
                if np.isfinite(trial_value) and trial_value - value <= 1e-10 * abs(value):
                    trial_gradient = slope(trial)
                    if np.linalg.norm(trial_gradient) < residual * unit:
                        break
                length *= 0.5
                if length < 1e-9:
                    accepted = residual <= 10.0 * tolerance
                    status = NewtonStatus.CONVERGED if accepted else NewtonStatus.STALLED
                    return NewtonResult(velocities, status, iteration, residual)
            velocities, value, gradient = trial, trial_value, trial_gradient
            residual = float(np.linalg.norm(gradient)) / unit
        status = NewtonStatus.CONVERGED if residual <= tolerance else NewtonStatus.ITERATION_LIMIT
        return NewtonResult(velocities, status, self.iteration_limit, residual)


def conserve_angular_momentum(
    body: SoftBody, before: BodyState, positions: np.ndarray, velocities: np.ndarray, external: np.ndarray, dt: float
) -> tuple[np.ndarray, float]:
    """Velocities (N, 3) whose spin obeys L+ = L + dt sum (x - c) x f with the arms of the step's start (DESIGN 5).

    ``external`` (N, 3) newtons: forces that carry torque (contact, drag). Also returns the size of the added spin, rad/s.
    """
    arms = before.positions - body.centre_of_mass(before.positions)
    target = body.angular_momentum(before.positions, before.velocities) + dt * np.cross(arms, external).sum(axis=0)
    missing = target - body.angular_momentum(positions, velocities)
    spin = np.linalg.solve(body.inertia(positions), missing)
    arms_after = positions - body.centre_of_mass(positions)
    return velocities + np.cross(spin, arms_after), float(np.linalg.norm(spin))
