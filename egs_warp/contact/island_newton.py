"""Newton iterates of the step of an island: several bodies with contact between them (Eq. 4, 8).

``fem.island_problem`` contains the equations and the block-diagonal tangent. Contact velocities and Coulomb forces are
computed as for one body, from contacts with two sides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.newton import ContactLinearization, ContactLinearizer, HostNewtonStep
from egs_warp.fem.island_problem import IslandTangent, Tensions


@dataclass(frozen=True)
class IslandLinearization(ContactLinearization):
    """``ContactLinearization`` of an island."""

    tangent: IslandTangent

    def iterate_at(self, tension: Tensions, velocities: np.ndarray, forces: np.ndarray) -> IslandNewtonIterate:
        """Return the Newton iterate at ``velocities`` (N, 3) m/s and contact ``forces`` (n, 3) newtons."""
        return IslandNewtonIterate.at(self, tension, velocities, forces)


@dataclass(frozen=True, eq=False)
class IslandNewtonIterate(HostNewtonStep):
    """``NewtonIterate`` of an island, evaluated with NumPy."""

    linearization: IslandLinearization
    tensions: Tensions
    velocities: np.ndarray
    forces: np.ndarray
    free_residual: np.ndarray
    """(N, 3) N s, residual without contact forces."""
    residual_norm: float

    @classmethod
    def at(cls, response: IslandLinearization, tensions: Tensions, velocities: np.ndarray, forces: np.ndarray) -> Self:
        """Evaluate the iterate at ``velocities`` (N, 3) m/s and ``forces`` (n, 3) newtons."""
        problem, contacts = response.tangent.problem, response.contacts
        free = problem.residual(velocities, tensions)
        # For one column, the sparse product is faster than a kernel launch.
        pushes = (contacts.jacobian_columns @ forces.ravel()).reshape(-1, 3)
        norm = problem.relative_norm(free - problem.dt * pushes)
        return cls(response, tensions, velocities, forces, free, norm)

    @cached_property
    def _free_velocities(self) -> np.ndarray:
        """(3N,) m/s, after a Newton step without contact forces."""
        return self.velocities.ravel() - self.linearization.tangent.solve(self.free_residual.ravel())

    @cached_property
    def free_contact_velocities(self) -> np.ndarray:
        return self.linearization.contacts.jacobian @ self._free_velocities

    def line_search_point(self, forces: np.ndarray, length: float = 1.0) -> Self:
        end = (self._free_velocities + self.linearization.columns @ forces.ravel()).reshape(-1, 3)
        velocities = self.velocities + length * (end - self.velocities)
        return self.at(self.linearization, self.tensions, velocities, self.forces + length * (forces - self.forces))

    def with_new_tangent(self) -> Self:
        old = self.linearization.tangent
        tangent: Any = old.problem.tangent(old.factors, self.velocities, self.tensions)
        return replace(self, linearization=IslandLinearization.of(tangent, self.linearization.contacts))


class IslandLinearizer(ContactLinearizer):
    """Builder of the contact linearisations of an island."""

    def __call__(self, tangent: Any, contacts: ContactSet) -> IslandLinearization:
        """Linearise ``contacts`` with ``tangent``, an ``IslandTangent``."""
        return IslandLinearization.of(tangent, contacts)
