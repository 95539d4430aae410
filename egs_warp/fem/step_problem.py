"""One implicit Euler step as an equation for the end velocity that keeps linear and angular momentum (Eq. 4, 6)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.fem.assembly_topology import Damping
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.geometry.frames import cross_matrices
from egs_warp.muscles.tension import MuscleEnergy

UNSOLVABLE = "the tangent is singular or not finite"
MIN_RELATIVE_STIFFNESS = 1e-3
"""Of the largest T / L of the muscles: those below it do not count in a tangent."""


class UnsolvableStepError(ArithmeticError):
    """A step's equations cannot be solved."""


@dataclass(frozen=True)
class StepProblem:
    """M (v - v0) + dt alpha M v = dt (P^T f(x + dt v) + M g + f_contact), f of elasticity, damping and muscles.

    Implicit Euler alone eats spin: with x+ = x + dt v the momentum changes by dt sum r x f with the arms r of the
    step's *start*, about which the forces at its end are not free of torque. P^T takes that torque off as the inertia
    of a rigid turn, M (w x r): P is v less the rigid turn with v's angular momentum. So L+ = L + dt sum r x (f_contact
    - alpha M v) holds to rounding, contact velocities are those that are solved for, and ``spin`` is the size of what
    was taken off.
    """

    body: SoftBody
    state: BodyState
    dt: float
    """Seconds."""
    drag: float = 0.0
    """alpha of Rayleigh damping (drag against the air), 1/s."""

    def starts_from(self, state: BodyState, dt: float) -> bool:
        """Whether it is the step of ``dt`` seconds from that very ``state``."""
        return self.state is state and self.dt == dt

    @cached_property
    def damping(self) -> Damping:
        """What the body's damping resists."""
        return self.body.assembly.damping(self.state.positions, self.dt)

    @cached_property
    def mass(self) -> np.ndarray:
        """(N, 1) kg."""
        return self.body.node_mass[:, None]

    @cached_property
    def rotation_modes(self) -> np.ndarray:
        """(3N, 3) nodal velocities e_k x r of the rigid turns about the centre of mass, ``arms`` r."""
        return cross_matrices(self.lever_arms).reshape(-1, 3)

    @cached_property
    def lever_arms(self) -> np.ndarray:
        """(N, 3) metres from the centre of mass at the start of the step."""
        return self.state.positions - self.body.centre_of_mass(self.state.positions)

    @cached_property
    def momenta(self) -> np.ndarray:
        """(3, 3N) angular momentum of nodal velocities about the centre of mass, arms at the start of the step."""
        return (self.rotation_modes * np.repeat(self.body.node_mass, 3)[:, None]).T

    @cached_property
    def inertia(self) -> np.ndarray:
        """(3, 3) kg m^2 at the start of the step."""
        return self.momenta @ self.rotation_modes

    @cached_property
    def inverse_inertia(self) -> np.ndarray:
        """(3, 3) 1/(kg m^2), the inverse of the inertia."""
        return np.linalg.inv(self.inertia)

    @cached_property
    def angular_momentum(self) -> np.ndarray:
        """(3,) kg m^2/s about the centre of mass at the start of the step."""
        return self.body.angular_momentum(self.state.positions, self.state.velocities)

    @property
    def residual_scale(self) -> float:
        """dt times the weight, N s: what residuals are told in."""
        return self.dt * self.body.weight

    def end_positions(self, velocities: np.ndarray) -> np.ndarray:
        """(N, 3) x + dt v."""
        return self.state.positions + self.dt * velocities

    def is_inversion_free(self, velocities: np.ndarray) -> bool:
        """Whether no element is inverted at the end of ``velocities`` (N, 3)."""
        return bool(self.body.assembly.determinants(self.end_positions(velocities)).min() > 0.0)

    @cached_property
    def rigid_guess(self) -> np.ndarray:
        """(N, 3) m/s to solve the step from: the body goes on rigidly with its momenta, so no element is inverted, and
        what is stiff, whose speed at the start says nothing about the end, is at rest."""
        positions, mass = self.state.positions, self.body.node_mass
        centre = self.body.centre_of_mass(positions)
        spin = self.inverse_inertia @ self.angular_momentum
        turned = Rotation.from_rotvec(self.dt * spin).apply(positions - centre)
        return mass @ self.state.velocities / mass.sum() + (turned - (positions - centre)) / self.dt

    def internal_gradient(self, velocities: np.ndarray, tension: MuscleEnergy | None) -> np.ndarray:
        """(N, 3) newtons, minus the forces of elasticity, damping and muscles at the end of ``velocities`` (N, 3)."""
        end = self.end_positions(velocities)
        return self.body.assembly.gradient(end, self.damping, tension)

    def momentum_correction(self, internal_gradient: np.ndarray) -> np.ndarray:
        """(3,) rad/s that the step gives back: the rigid turn whose momentum implicit Euler would have eaten."""
        return self.momentum_correction_from_torque(self.rotation_modes.T @ internal_gradient.ravel())

    def momentum_correction_from_torque(self, torque: np.ndarray) -> np.ndarray:
        """``spin`` of an internal gradient with this ``torque`` (3,) N m about the centre of mass."""
        return self.dt * (self.inverse_inertia @ torque)

    def residual(self, velocities: np.ndarray, tension: MuscleEnergy | None) -> np.ndarray:
        """(N, 3) N s, left side less right side of the equation without contact forces; not finite where an element is
        inverted.
        """
        internal = self.internal_gradient(velocities, tension)
        turned = (self.rotation_modes @ self.momentum_correction(internal)).reshape(velocities.shape)
        change = (1.0 + self.dt * self.drag) * velocities - self.state.velocities - self.dt * self.body.gravity - turned
        return self.mass * change + self.dt * internal

    def tangent(self, factors: LinearSolver, velocities: np.ndarray, tension: MuscleEnergy | None) -> Tangent:
        """The derivative of the residual at ``velocities`` (N, 3), or a definite one near it, factored by
        ``factors``. Raises ``UnsolvableStepError`` where it has no factors, or, of what is only begun, ``settle`` does.
        """
        if tension is None and not factors.is_host:
            factors.start_update(*self._matrix(factors, velocities, projected=False))
            return Tangent(self, factors, velocities)
        definite = self._factor(factors, velocities, projected=False)
        if tension is not None:
            across, rates = tension.hessian(self.end_positions(velocities)).factors(
                min_relative_stiffness=MIN_RELATIVE_STIFFNESS
            )
            if factors.add_low_rank(across, self.dt**2 * rates):
                return Tangent(self, factors)
        if not definite:
            self.factor_near(factors, velocities)
        return Tangent(self, factors)

    def factor_near(self, factors: LinearSolver, velocities: np.ndarray) -> None:
        """A definite matrix near S. Raises ``UnsolvableStepError`` where that has no factors."""
        self._factor(factors, velocities, projected=True)
        if not factors.is_ready:
            raise UnsolvableStepError(UNSOLVABLE)

    def _factor(self, factors: LinearSolver, velocities: np.ndarray, *, projected: bool) -> bool:
        """S = (1 + dt alpha) M + dt C + dt^2 K at the end of ``velocities``; whether it is definite."""
        return factors.update(*self._matrix(factors, velocities, projected=projected))

    def _matrix(self, factors: LinearSolver, velocities: np.ndarray, *, projected: bool) -> tuple[Any, np.ndarray]:
        """Entries and diagonal of S for ``factors``."""
        end = self.end_positions(velocities)
        entries = self.body.assembly.entries_for(factors, end, self.damping, factor=self.dt**2, projected=projected)
        return entries, (1.0 + self.dt * self.drag) * np.repeat(self.body.node_mass, 3)


@dataclass(frozen=True)
class Tangent:
    """Inverse J^-1 of the derivative of a step's residual: S of the elements, the muscles' stiffness, the momentum
    kept.

    J = S + dt^2 (K_a - M turns I^-1 turns^T (K + K_a)). Its inverse is that of S + dt^2 K_a with so much of a turn
    added that each column of the result has the angular momentum of the impulse.
    """

    problem: StepProblem
    factors: LinearSolver
    pending_velocities: np.ndarray | None = None
    """(N, 3) m/s at which the matrix is whose factors are only begun; None if they are there."""

    def wait(self) -> bool:
        """Wait for factors that are begun; whether they are there. If not, those of a definite matrix near by are
        then. Raises ``UnsolvableStepError`` if that has none."""
        if self.pending_velocities is None or self.factors.is_ready:
            return True
        self.problem.factor_near(self.factors, self.pending_velocities)
        return False

    @cached_property
    def momentum_projection(self) -> MomentumProjection:
        """Of the rigid turns of the step."""
        problem = self.problem
        ratio, momenta = 1.0 + problem.dt * problem.drag, np.ascontiguousarray(problem.momenta.T)
        turned = self.factors.solve(momenta)
        return MomentumProjection(
            problem.rotation_modes, momenta, ratio, turned, np.linalg.inv(ratio * momenta.T @ turned)
        )

    def solve(self, impulses: np.ndarray) -> np.ndarray:
        """(3N,) or (3N, m) m/s that ``impulses`` of that shape, N s, bring about."""
        self.wait()
        return self.factors.solve(impulses, self.momentum_projection)
