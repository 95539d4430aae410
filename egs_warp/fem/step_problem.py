"""One implicit Euler step as an equation for the end velocities that conserves both momenta (Eq. 4, 6)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.fem.assembly_topology import Damping
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.linear_solver import FactorStatus, LinearSolver
from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.geometry.frames import cross_matrices
from egs_warp.muscles.tension import MuscleEnergy

UNSOLVABLE = "the tangent is singular or not finite"
MIN_RELATIVE_STIFFNESS = 1e-3
"""Fraction of the largest T / L of the muscles below which a stiffness is left out of the tangent."""


class UnsolvableStepError(ArithmeticError):
    """The equations of a step cannot be solved."""


@dataclass(frozen=True)
class StepProblem:
    """One implicit step: M (v - v0) + dt alpha M v = dt (P^T f(x + dt v) + M g + f_contact), with the forces f of
    elasticity, damping and muscles.

    Implicit Euler alone loses angular momentum: with x+ = x + dt v the momentum changes by dt sum r x f, with the lever
    arms r at the *start* of the step, about which the internal forces at its end have a torque. P^T removes that torque
    as the inertial force of a rigid rotation, M (w x r): P v is v minus the rigid rotation with v's angular momentum.
    So L+ = L + dt sum r x (f_contact - alpha M v) holds up to rounding, contact velocities are those that are solved
    for, and ``momentum_correction`` is the angular velocity w of the removed rotation.
    """

    body: SoftBody
    """The body."""
    state: BodyState
    """State at the start of the step."""
    dt: float
    """Step size, s."""
    drag: float = 0.0
    """alpha of the Rayleigh damping (air drag), 1/s."""

    def starts_from(self, state: BodyState, dt: float) -> bool:
        """Return True if this is the step of ``dt`` seconds from the same ``state`` object."""
        return self.state is state and self.dt == dt

    @cached_property
    def damping(self) -> Damping:
        """Damping of the step."""
        return self.body.assembly.damping(self.state.positions, self.dt)

    @cached_property
    def mass(self) -> np.ndarray:
        """(N, 1) kg, lumped masses."""
        return self.body.node_mass[:, None]

    @cached_property
    def rotation_modes(self) -> np.ndarray:
        """(3N, 3) m, nodal velocities e_k x r of unit rotations about the centre of mass, with lever arms r."""
        return cross_matrices(self.lever_arms).reshape(-1, 3)

    @cached_property
    def lever_arms(self) -> np.ndarray:
        """(N, 3) m, positions relative to the centre of mass at the start of the step."""
        return self.state.positions - self.body.centre_of_mass(self.state.positions)

    @cached_property
    def momenta(self) -> np.ndarray:
        """(3, 3N) kg m, matrix that maps nodal velocities to the angular momentum about the centre of mass, with lever
        arms r."""
        return (self.rotation_modes * np.repeat(self.body.node_mass, 3)[:, None]).T

    @cached_property
    def inertia(self) -> np.ndarray:
        """(3, 3) kg m^2, inertia at the start of the step."""
        return self.momenta @ self.rotation_modes

    @cached_property
    def inverse_inertia(self) -> np.ndarray:
        """(3, 3) 1/(kg m^2), inverse of ``inertia``."""
        return np.linalg.inv(self.inertia)

    @cached_property
    def angular_momentum(self) -> np.ndarray:
        """(3,) kg m^2/s, angular momentum about the centre of mass at the start of the step."""
        return self.body.angular_momentum(self.state.positions, self.state.velocities)

    @property
    def inertia_ratio(self) -> float:
        """Factor 1 + dt alpha of the mass in the equation."""
        return 1.0 + self.dt * self.drag

    @property
    def residual_scale(self) -> float:
        """dt times the weight, N s, the unit of residual norms."""
        return self.dt * self.body.weight

    def end_positions(self, velocities: np.ndarray) -> np.ndarray:
        """Return x + dt v (N, 3), m."""
        return self.state.positions + self.dt * velocities

    def is_inversion_free(self, velocities: np.ndarray) -> bool:
        """Return True if no element is inverted at the end positions of ``velocities`` (N, 3)."""
        return bool(self.body.assembly.determinants(self.end_positions(velocities)).min() > 0.0)

    @cached_property
    def rigid_guess(self) -> np.ndarray:
        """(N, 3) m/s, initial guess of the solver: the rigid motion with the momenta of the state.

        It does not invert an element, and it contains no velocities of stiff modes, which change completely within a
        step.
        """
        positions, mass = self.state.positions, self.body.node_mass
        centre = self.body.centre_of_mass(positions)
        spin = self.inverse_inertia @ self.angular_momentum
        rotated = Rotation.from_rotvec(self.dt * spin).apply(positions - centre)
        return mass @ self.state.velocities / mass.sum() + (rotated - (positions - centre)) / self.dt

    def internal_gradient(self, velocities: np.ndarray, tension: MuscleEnergy | None) -> np.ndarray:
        """Return minus the forces of elasticity, damping and muscles at the end of the step: (N, 3) N."""
        end = self.end_positions(velocities)
        return self.body.assembly.gradient(end, self.damping, tension)

    def momentum_correction(self, internal_gradient: np.ndarray) -> np.ndarray:
        """Return the angular velocity (3,) rad/s of the rotation whose momentum implicit Euler alone would lose."""
        return self.momentum_correction_from_torque(self.rotation_modes.T @ internal_gradient.ravel())

    def momentum_correction_from_torque(self, torque: np.ndarray) -> np.ndarray:
        """Return ``momentum_correction`` of an internal gradient with ``torque`` (3,) N m about the centre of mass."""
        return self.dt * (self.inverse_inertia @ torque)

    def residual(self, velocities: np.ndarray, tension: MuscleEnergy | None) -> np.ndarray:
        """Return the left side minus the right side of the equation, without contact forces.

        Args:
            velocities: (N, 3) m/s, at the end of the step.
            tension: muscle energy, or None.

        Returns:
            (N, 3) N s; not finite where an element is inverted.
        """
        internal = self.internal_gradient(velocities, tension)
        correction = (self.rotation_modes @ self.momentum_correction(internal)).reshape(velocities.shape)
        change = self.inertia_ratio * velocities - self.state.velocities - self.dt * self.body.gravity - correction
        return self.mass * change + self.dt * internal

    def tangent(self, factors: LinearSolver, velocities: np.ndarray, tension: MuscleEnergy | None) -> Tangent:
        """Factor the derivative of the residual, or a positive definite approximation of it.

        Args:
            factors: solver that holds the factors.
            velocities: (N, 3) m/s, linearization point.
            tension: muscle energy, or None.

        Returns:
            The tangent. On a GPU without muscles its factors are only queued; ``Tangent.wait`` completes them.

        Raises:
            UnsolvableStepError: there are no factors.
        """
        self._factor(factors, velocities, projected=False)
        if tension is None and factors.is_asynchronous:
            return Tangent(self, factors, velocities)
        if tension is not None:
            across, rates = tension.hessian(self.end_positions(velocities)).factors(
                min_relative_stiffness=MIN_RELATIVE_STIFFNESS
            )
            if factors.add_low_rank(across, self.dt**2 * rates):
                return Tangent(self, factors)
        if factors.status is not FactorStatus.DEFINITE:
            self.factor_near(factors, velocities)
        return Tangent(self, factors)

    def factor_near(self, factors: LinearSolver, velocities: np.ndarray) -> None:
        """Factor a positive definite approximation of S.

        Raises:
            UnsolvableStepError: there are no factors.
        """
        self._factor(factors, velocities, projected=True)
        if factors.status is FactorStatus.NONE:
            raise UnsolvableStepError(UNSOLVABLE)

    def _factor(self, factors: LinearSolver, velocities: np.ndarray, *, projected: bool) -> None:
        """Factor S = (1 + dt alpha) M + dt C + dt^2 K at the end of ``velocities``."""
        end = self.end_positions(velocities)
        entries = self.body.assembly.enqueue_hessian(end, self.damping, factor=self.dt**2, projected=projected)
        factors.factor(factors.entries_from(entries), self.inertia_ratio * np.repeat(self.body.node_mass, 3))


@dataclass(frozen=True)
class Tangent:
    """Inverse J^-1 of the derivative of a step's residual.

    J = S + dt^2 (K_a - M T I^-1 T^T (K + K_a)) with the elements' matrix S, the muscles' stiffness K_a and the rotation
    modes T. Its inverse is that of S + dt^2 K_a plus rigid rotations that give each column of the result the angular
    momentum of its impulse.
    """

    problem: StepProblem
    """The step."""
    factors: LinearSolver
    """Factors of S + dt^2 K_a."""
    pending_velocities: np.ndarray | None = None
    """(N, 3) m/s, linearization point of factors that are only queued; None if they exist."""

    def wait(self) -> bool:
        """Wait for queued factors. If there are none, factor a positive definite approximation instead.

        Returns:
            False if the approximation was needed.

        Raises:
            UnsolvableStepError: the approximation has no factors.
        """
        if self.pending_velocities is None or self.factors.status is FactorStatus.DEFINITE:
            return True
        self.problem.factor_near(self.factors, self.pending_velocities)
        return False

    @cached_property
    def momentum_projection(self) -> MomentumProjection:
        """Momentum projection for the rotation modes of the step."""
        problem, momenta = self.problem, np.ascontiguousarray(self.problem.momenta.T)
        return MomentumProjection.of(
            problem.rotation_modes, momenta, problem.inertia_ratio, self.factors.solve(momenta)
        )

    def solve(self, impulses: np.ndarray) -> np.ndarray:
        """Return J^-1 ``impulses``, m/s, for impulses (3N,) or (3N, m), N s."""
        self.wait()
        return self.factors.solve(impulses, self.momentum_projection)
