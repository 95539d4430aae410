"""Reference for Newton iterates with contact on CPU and GPU, from the equation of the step in NumPy (Eq. 4, 8)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from egs_warp.contact.newton import ContactLinearization
from egs_warp.muscles.tension import MuscleEnergy


@dataclass(frozen=True)
class ReferenceIterate:
    """Newton iterate: velocities (N, 3), m/s, and contact forces (n, 3), N, with its residual and its Newton step."""

    linearization: ContactLinearization
    tension: MuscleEnergy | None
    velocities: np.ndarray
    forces: np.ndarray

    @cached_property
    def free_residual(self) -> np.ndarray:
        """(N, 3) N s, residual without contact forces."""
        return self.linearization.tangent.problem.residual(self.velocities, self.tension)

    @cached_property
    def residual(self) -> np.ndarray:
        """(3N,) N s, residual with contact forces."""
        response = self.linearization
        pushes = response.contacts.nodal_forces(self.forces).ravel()
        return self.free_residual.ravel() - response.tangent.problem.dt * pushes

    @property
    def residual_norm(self) -> float:
        """Norm of the residual with contact forces, divided by dt times the weight; not finite if an element is
        inverted."""
        return float(np.linalg.norm(self.residual)) / self.linearization.tangent.problem.residual_scale

    @cached_property
    def free_velocities(self) -> np.ndarray:
        """(3N,) m/s, velocities after a Newton step without contact forces."""
        return self.velocities.ravel() - self.linearization.tangent.solve(self.free_residual.ravel())

    @property
    def free_contact_velocities(self) -> np.ndarray:
        """(3n,) m/s, contact velocities after a Newton step without contact forces."""
        return self.linearization.contacts.contact_velocities(self.free_velocities)

    @property
    def velocities_with_fixed_forces(self) -> np.ndarray:
        """(N, 3) m/s, velocities after a Newton step with the same contact forces."""
        return self.velocities - self.linearization.tangent.solve(self.residual).reshape(self.velocities.shape)

    def line_search_point(self, forces: np.ndarray, length: float = 1.0) -> Self:
        """Return the iterate after the fraction ``length`` of the Newton step with contact ``forces`` (n, 3)."""
        end = (self.free_velocities + self.linearization.columns @ forces.ravel()).reshape(self.velocities.shape)
        return replace(
            self,
            velocities=self.velocities + length * (end - self.velocities),
            forces=self.forces + length * (forces - self.forces),
        )

    def with_new_tangent(self) -> Self:
        """Return the same iterate with the tangent at its own velocities, including the stiffness of the muscles."""
        old, contacts = self.linearization.tangent, self.linearization.contacts
        tangent = old.problem.tangent(old.factors, self.velocities, self.tension)
        other = replace(self, linearization=ContactLinearization.of(tangent, contacts))
        vars(other)["free_residual"] = self.free_residual
        return other
