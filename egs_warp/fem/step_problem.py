"""Implicit Euler step of one world, and its tangent (Eq. 4, 6)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.fem.assembly_topology import Damping
from egs_warp.fem.body import BodyState
from egs_warp.fem.implicit_step import MIN_RELATIVE_STIFFNESS, UNSOLVABLE, ImplicitStep, UnsolvableStepError
from egs_warp.fem.linear_solver import FactorStatus, LinearSolver
from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.geometry.frames import cross_matrices
from egs_warp.muscles.tension import MuscleEnergy


@dataclass(frozen=True)
class StepProblem(ImplicitStep):
    """Implicit step of one world, with NumPy arrays."""

    def starts_from(self, state: BodyState, dt: float) -> bool:
        """Return True if this is the step of ``dt`` seconds from the same ``state`` object."""
        return self.state is state and self.dt == dt

    @cached_property
    def damping(self) -> Damping:
        """Damping of the step."""
        return self.body.assembly.damping(self.state.positions, self.dt)

    @property
    def node_mass(self) -> np.ndarray:
        """(N,) kg, lumped masses."""
        return self.body.node_mass

    @property
    def gravity(self) -> np.ndarray:
        """(3,) m/s^2, gravitational acceleration."""
        return self.body.gravity

    @cached_property
    def rotation_modes(self) -> np.ndarray:
        """(3N, 3) m, nodal velocities e_k x r of unit rotations about the centre of mass, with lever arms r."""
        return cross_matrices(self.lever_arms).reshape(-1, 3)

    @cached_property
    def lever_arms(self) -> np.ndarray:
        """(N, 3) m, positions relative to the centre of mass at the start of the step."""
        return self.state.positions - self.body.centre_of_mass(self.state.positions)

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

    def is_inversion_free(self, velocities: np.ndarray) -> bool:
        """Return True if no element is inverted at the end positions for ``velocities`` (N, 3) m/s."""
        return bool(self.body.assembly.determinants(self.end_positions(velocities)).min() > 0.0)

    @cached_property
    def rigid_guess(self) -> np.ndarray:
        """(N, 3) m/s, initial guess of the solver: the rigid motion with the momenta of the state.

        This guess does not invert an element, and it contains no velocities of stiff modes, which change completely
        within a step.
        """
        positions, mass = self.state.positions, self.body.node_mass
        centre = self.body.centre_of_mass(positions)
        spin = self.inverse_inertia @ self.angular_momentum
        rotated = Rotation.from_rotvec(self.dt * spin).apply(positions - centre)
        return mass @ self.state.velocities / mass.sum() + (rotated - (positions - centre)) / self.dt

    def relative_norm(self, residual: np.ndarray) -> float:
        """Return the norm of a residual (N, 3) N s, divided by dt times the weight."""
        return float(np.linalg.norm(residual)) / self.residual_scale

    def internal_gradient(self, velocities: np.ndarray, tension: MuscleEnergy | None) -> np.ndarray:
        """Return minus the forces of elasticity, damping and muscles at the end of the step: (N, 3) N."""
        end = self.end_positions(velocities)
        return self.body.assembly.gradient(end, self.damping, tension)

    def tangent(self, factors: LinearSolver, velocities: np.ndarray, tension: MuscleEnergy | None) -> Tangent:
        """Factor the derivative of the residual, or a positive definite approximation of it.

        Args:
            factors: solver that holds the factors.
            velocities: (N, 3) m/s, linearisation point.
            tension: muscle energy, or None.

        Returns:
            The tangent. On a GPU, if ``tension`` is None, its factors are only queued; ``Tangent.wait`` blocks for
            them.

        Raises:
            UnsolvableStepError: the approximation cannot be factored either.
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
        """Factor a positive definite approximation of S, with projected element Hessians.

        Raises:
            UnsolvableStepError: the approximation cannot be factored.
        """
        self._factor(factors, velocities, projected=True)
        if factors.status is FactorStatus.NONE:
            raise UnsolvableStepError(UNSOLVABLE)

    def _factor(self, factors: LinearSolver, velocities: np.ndarray, *, projected: bool) -> None:
        """Factor S = (1 + dt alpha) M + dt C + dt^2 K at the end positions for ``velocities`` (N, 3) m/s."""
        end = self.end_positions(velocities)
        entries = self.body.assembly.enqueue_hessian(end, self.damping, factor=self.dt**2, projected=projected)
        factors.factor(factors.entries_from(entries), self.inertia_ratio * self.coordinate_mass)


@dataclass(frozen=True)
class Tangent:
    """Inverse J^-1 of the derivative of a step's residual.

    J = S + dt^2 K_a - dt M T I^-1 T^T (C + dt (K + K_a)), with the mass matrix M, the damping matrix C, the stiffness K
    of the elements and K_a of the muscles, S = (1 + dt alpha) M + dt C + dt^2 K, the rotation modes T and the inertia
    tensor I. J^-1 is the inverse of S + dt^2 K_a, followed by rigid rotations that give each column of the result the
    angular momentum of its impulse.
    """

    problem: StepProblem
    """The step."""
    factors: LinearSolver
    """Factors of S + dt^2 K_a."""
    pending_velocities: np.ndarray | None = None
    """(N, 3) m/s, linearisation point of factors that are only queued; None if the factors are computed."""

    def wait(self) -> bool:
        """Block until queued factors are computed. If S is not positive definite, factor an approximation instead.

        Returns:
            False if the approximation was needed.

        Raises:
            UnsolvableStepError: the approximation cannot be factored.
        """
        if self.pending_velocities is None or self.factors.status is FactorStatus.DEFINITE:
            return True
        self.problem.factor_near(self.factors, self.pending_velocities)
        return False

    def renewed(self, velocities: np.ndarray, tension: MuscleEnergy | None) -> Tangent:
        """Return the tangent at ``velocities`` (N, 3) m/s in the same solver; see ``StepProblem.tangent``."""
        return self.problem.tangent(self.factors, velocities, tension)

    @cached_property
    def momentum_projection(self) -> MomentumProjection:
        """Momentum projection for the rotation modes of the step."""
        momenta = np.ascontiguousarray(self.problem.momenta.T)
        return self.problem.momentum_projection(momenta, self.factors.solve(momenta))

    def solve(self, impulses: np.ndarray) -> np.ndarray:
        """Return J^-1 ``impulses``, m/s, for impulses (3N,) or (3N, m), N s."""
        self.wait()
        return self.factors.solve(impulses, self.momentum_projection)
