"""Equation of one implicit Euler step, in one world or in many (Eq. 4, 6).

A step is an equation for the end velocities v: M (v - v0) + dt alpha M v = dt (P^T f(x + dt v) + M g + f_contact), with
the forces f of elasticity, damping and muscles. ``ImplicitStep`` contains the formulas. ``step_problem.StepProblem`` is
the step of one world, with NumPy arrays (N, 3); ``batch_problem.BatchProblem`` holds the steps of c worlds, with
PyTorch tensors (c, N, 3). In the shapes below, "..." is the world axis, or nothing for one world.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from egs_warp.fem.batched import ArrayT, BatchedRecord, array_module
from egs_warp.fem.body import SoftBody
from egs_warp.fem.momentum_projection import MomentumProjection

UNSOLVABLE = "the tangent is singular or not finite"
MIN_RELATIVE_STIFFNESS = 1e-3
"""Terms of the muscles' stiffness that are at most this fraction of the largest one are left out of the tangent."""


class UnsolvableStepError(ArithmeticError):
    """Error raised if the equations of a step cannot be solved."""


class StepValues(Protocol[ArrayT]):
    """Values that the subclasses of ``ImplicitStep`` provide."""

    node_mass: ArrayT
    """(N,) kg, lumped masses."""
    gravity: ArrayT
    """(3,) m/s^2, gravitational acceleration."""
    rotation_modes: ArrayT
    """(..., 3N, 3) m, nodal velocities e_k x r of unit rotations about the centre of mass, with lever arms r."""
    inverse_inertia: ArrayT
    """(..., 3, 3) 1/(kg m^2), inverse inertia at the start of the step."""

    def internal_gradient(self, velocities: ArrayT, tension: Any) -> ArrayT:
        """Return minus the forces of elasticity, damping and muscles at the end of the step: (..., N, 3) N."""
        ...


@dataclass(frozen=True)
class ImplicitStep(StepValues[ArrayT], BatchedRecord):
    """Equation of one implicit step.

    Implicit Euler alone loses angular momentum. With x+ = x + dt v, the momentum changes by dt sum r x f, where r are
    the lever arms at the *start* of the step. The internal forces f at its end have a torque with these lever arms. The
    projection P removes from v the rigid rotation with the angular momentum of v, so P^T f is f without its torque: it
    subtracts the inertial force M (w x r) of a rigid rotation. ``momentum_correction`` is the angular velocity w of
    that rotation. Then L+ = L + dt sum r x (f_contact - alpha M v) holds up to rounding. The correction acts on the
    forces only, so the unknowns v of the equation are the actual end velocities, also at the contacts.
    """

    body: SoftBody
    """The body."""
    state: Any
    """``BodyState`` at the start of the step, (..., N, 3)."""
    dt: float
    """Step size, s."""
    drag: float = 0.0
    """alpha of the Rayleigh damping (air drag), 1/s."""

    @property
    def momenta(self) -> ArrayT:
        """(..., 3, 3N) kg m, matrix that maps nodal velocities to the angular momentum about the centre of mass, with
        lever arms r."""
        return (self.rotation_modes * self.coordinate_mass[:, None]).swapaxes(-1, -2)

    @property
    def coordinate_mass(self) -> ArrayT:
        """(3N,) kg, mass of each coordinate."""
        mass = self.node_mass
        return array_module(mass).broadcast_to(mass[:, None], (len(mass), 3)).reshape(-1)

    @property
    def inertia_ratio(self) -> float:
        """Factor 1 + dt alpha of the mass in the equation."""
        return 1.0 + self.dt * self.drag

    @property
    def residual_scale(self) -> float:
        """dt times the weight, N s, the unit of residual norms."""
        return self.dt * self.body.weight

    @property
    def free_fall_speed(self) -> float:
        """Speed that free fall gains in the step, m/s."""
        return self.residual_scale / self.body.mass

    def end_positions(self, velocities: ArrayT) -> ArrayT:
        """Return x + dt v (..., N, 3), m."""
        return self.state.positions + self.dt * velocities

    @property
    def ballistic_positions(self) -> ArrayT:
        """(..., N, 3) m, end positions of the nodes without internal and contact forces."""
        return self.end_positions(self.state.velocities + self.dt * self.gravity)

    def momentum_correction(self, internal_gradient: ArrayT) -> ArrayT:
        """Return the angular velocity (..., 3) rad/s of the rotation whose momentum implicit Euler alone would lose."""
        flat = internal_gradient.reshape((*internal_gradient.shape[:-2], -1, 1))
        return self.momentum_correction_from_torque((self.rotation_modes.swapaxes(-1, -2) @ flat)[..., 0])

    def momentum_correction_from_torque(self, torque: ArrayT) -> ArrayT:
        """Return ``momentum_correction`` of an internal gradient with ``torque`` (..., 3) N m about the centre of
        mass."""
        return self.dt * (self.inverse_inertia @ torque[..., None])[..., 0]

    def residual(self, velocities: ArrayT, tension: Any) -> ArrayT:
        """Return the residual, the left side minus the right side of the equation, without contact forces.

        Args:
            velocities: (..., N, 3) m/s, at the end of the step.
            tension: muscles, as in ``internal_gradient``, or None.

        Returns:
            (..., N, 3) N s; not finite where an element is inverted.
        """
        internal = self.internal_gradient(velocities, tension)
        correction = self.rotation_modes @ self.momentum_correction(internal)[..., None]
        change = self.inertia_ratio * velocities - self.state.velocities - self.dt * self.gravity
        return self.node_mass[:, None] * (change - correction.reshape(velocities.shape)) + self.dt * internal

    def momentum_projection(self, momenta: ArrayT, rotation_response: ArrayT) -> MomentumProjection[ArrayT]:
        """Return the momentum projection of a tangent.

        Args:
            momenta: (..., 3N, 3), transpose of the property ``momenta``.
            rotation_response: (..., 3N, 3), solutions of the tangent for the right-hand sides ``momenta``.
        """
        return MomentumProjection.of(self.rotation_modes, momenta, self.inertia_ratio, rotation_response)
