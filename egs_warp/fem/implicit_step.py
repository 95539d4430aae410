"""One implicit Euler step as a minimisation over the end velocity (Eq. 4, 6), with Newton's method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.factorisation import Factorisation
from egs_warp.muscles.tension import MuscleTension, TensionStiffness

_CG_LIMIT = 60
_CG_TOLERANCE = 1e-5


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


@dataclass
class ImplicitStep:
    """The function Phi of one step (DESIGN 5) and its minimisation; forces and muscle tensions are constant over the
    step.

    Phi(v) = 1/2 (v-v0)^T M (v-v0) + Psi(p + dt v) + dt beta/2 sum V E':C:E' - dt v^T f, E' the mean strain rate of the
    step; ``minimise`` adds the energy of the muscles, V(p + dt v).
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
        self._damping = self.body.assembly.damping(self.state.positions, self.dt)
        self._mass = self.body.node_mass[:, None]

    def end_positions(self, velocities: np.ndarray) -> np.ndarray:
        """(N, 3) p + dt v."""
        return self.state.positions + self.dt * velocities

    def energy(self, velocities: np.ndarray, force: np.ndarray) -> float:
        """Phi, joules; infinite where an element is inverted."""
        change = velocities - self.state.velocities
        elastic = self.body.assembly.energy(self.end_positions(velocities), self._damping)
        inertia = 0.5 * float((self._mass * change**2).sum())
        drag = 0.5 * self.dt * self.drag * float((self._mass * velocities**2).sum())
        return inertia + elastic + drag - self.dt * float((velocities * force).sum())

    def gradient(self, velocities: np.ndarray, force: np.ndarray) -> np.ndarray:
        """(N, 3) dPhi/dv, N s."""
        internal = self.body.assembly.gradient(self.end_positions(velocities), self._damping)
        inertia = self._mass * (velocities - self.state.velocities + self.dt * self.drag * velocities)
        return inertia + self.dt * (internal - force)

    def matrix_entries(self, velocities: np.ndarray, *, projected: bool) -> np.ndarray:
        """Upper entries of S = (1 + dt alpha) M + dt C + dt^2 K, the second derivative of Phi,
        at the end positions of ``velocities``.
        """
        assembly = self.body.assembly
        entries = assembly.matrix_entries(
            self.end_positions(velocities), self._damping, factor=self.dt**2, projected=projected
        )
        entries[assembly.diagonal_entries] += (1.0 + self.dt * self.drag) * np.repeat(self.body.node_mass, 3)
        return entries

    def factor(
        self, velocities: np.ndarray, penalty: PenaltyTerms | None = None, *, projected: bool = False
    ) -> list[np.ndarray]:
        """Factor the true S at ``velocities``, or the projected one where the true one is not positive definite.

        Returns the entries of what was tried; the last were factored.
        """
        tried = []
        for project in (True,) if projected else (False, True):
            entries = self.matrix_entries(velocities, projected=project)
            if penalty is not None:
                penalty.add_hessian(velocities, entries)
            tried.append(entries)
            if self.factorisation.update(entries):
                return tried
        raise FloatingPointError("the projected Hessian is not positive definite")

    def _newton_direction(
        self,
        velocities: np.ndarray,
        gradient: np.ndarray,
        penalty: PenaltyTerms | None,
        tension: MuscleTension | None,
    ) -> np.ndarray:
        """(N, 3) minus the gradient over the second derivative, or over a positive definite one near it."""
        tried = self.factor(velocities, penalty)
        if tension is None:
            return -self.factorisation.solve(gradient)
        end = self.end_positions(velocities)
        for entries, pulling_only in ((tried[0], False), (tried[-1], True)):
            stiffness = tension.stiffness(end, pulling_only=pulling_only)
            direction = self._conjugate_gradients(entries, stiffness, -gradient)
            if direction is not None:
                return direction
        return -self.factorisation.solve(gradient)

    def tangent(self, velocities: np.ndarray, tension: MuscleTension | None) -> Callable[[np.ndarray], np.ndarray]:
        """Inverse of the tangent S + dt^2 K at ``velocities``, K of the muscles: takes and gives columns (3N, m).

        The elements that muscles compress lose of their stiffness what the tension adds, so S alone is often indefinite
        where the sum is not; the sum is inverted from the indefinite factors (Woodbury). Where it is indefinite too,
        the projected S alone stands for both.
        """
        definite = self.factorisation.update(self.matrix_entries(velocities, projected=False))
        across, rates = np.zeros((0, 0)), np.zeros(0)
        if tension is not None:
            across, rates = tension.stiffness(self.end_positions(velocities)).factors()
        if definite and len(rates) == 0:
            return self.factorisation.solve
        if self.factorisation.ready and len(rates) > 0:
            through = self.factorisation.solve(across)
            small = across.T @ through
            small[np.diag_indices_from(small)] += 1.0 / (self.dt**2 * rates)
            small = 0.5 * (small + small.T)
            # Haynsworth: negative eigenvalues of the sum = those of S + positive ones of the small matrix - pulling
            # directions.
            positive = int((np.linalg.eigvalsh(small) > 0.0).sum())
            if self.factorisation.negative_pivots + positive == int((rates > 0.0).sum()):

                def solve(right: np.ndarray) -> np.ndarray:
                    plain = self.factorisation.solve(right)
                    return plain - through @ np.linalg.solve(small, across.T @ plain)

                return solve
        self.factor(velocities, projected=True)
        return self.factorisation.solve

    def _conjugate_gradients(
        self, entries: np.ndarray, stiffness: TensionStiffness, right: np.ndarray
    ) -> np.ndarray | None:
        """x of (S + dt^2 K) x = ``right`` (N, 3), K of the muscles, with the factored S for a preconditioner; None if
        not definite.

        K joins nodes far apart: added to the matrix it would fill the factor, so it is only ever multiplied with.
        """
        upper = self.body.assembly.matrix(entries)
        diagonal = upper.diagonal()

        def product(x: np.ndarray) -> np.ndarray:
            flat = x.ravel()
            elastic = upper @ flat + upper.T @ flat - diagonal * flat
            return elastic.reshape(x.shape) + self.dt**2 * stiffness.product(x)

        x = np.zeros_like(right)
        residual = right.copy()
        scaled = self.factorisation.solve(residual)
        search, power = scaled.copy(), float((residual * scaled).sum())
        first = power
        for _ in range(_CG_LIMIT):
            image = product(search)
            curvature = float((search * image).sum())
            if curvature <= 0.0:
                return None
            length = power / curvature
            x += length * search
            residual -= length * image
            scaled = self.factorisation.solve(residual)
            before, power = power, float((residual * scaled).sum())
            if power <= _CG_TOLERANCE**2 * first:
                break
            search = scaled + (power / before) * search
        return x

    def minimise(
        self,
        force: np.ndarray,
        start: np.ndarray,
        penalty: PenaltyTerms | None = None,
        *,
        tension: MuscleTension | None = None,
        tolerance: float | None = None,
    ) -> NewtonResult:
        """Newton with a line search that stays feasible (J > 0),
        from ``start`` (N, 3) under ``force`` (N, 3) newtons.
        """
        tolerance = self.tolerance if tolerance is None else tolerance

        def phi(v: np.ndarray) -> float:
            value = self.energy(v, force)
            if not np.isfinite(value):
                return value
            value += penalty.energy(v) if penalty is not None else 0.0
            return value + tension.energy(self.end_positions(v)) if tension is not None else value

        def slope(v: np.ndarray) -> np.ndarray:
            value = self.gradient(v, force)
            if tension is not None:
                value -= self.dt * tension.forces(self.end_positions(v))
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
            direction = self._newton_direction(velocities, gradient, penalty, tension)
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

    ``external`` (N, 3) newtons: forces that carry torque (contact, drag). Also returns the size of the added spin,
    rad/s.
    """
    arms = before.positions - body.centre_of_mass(before.positions)
    target = body.angular_momentum(before.positions, before.velocities) + dt * np.cross(arms, external).sum(axis=0)
    missing = target - body.angular_momentum(positions, velocities)
    spin = np.linalg.solve(body.inertia(positions), missing)
    arms_after = positions - body.centre_of_mass(positions)
    return velocities + np.cross(spin, arms_after), float(np.linalg.norm(spin))
