"""What contact forces bring about by a step's tangent, and Newton steps with them (Eq. 4, 8, 9)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np

from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.contact.detection import ContactSet
from egs_warp.fem.step_problem import Tangent
from egs_warp.muscles.tension import MuscleTension

SINGULAR = 1e-7
"""Of the mean of the Delassus operator's diagonal: more points than the cage can resolve leave it singular."""


@dataclass(frozen=True)
class ContactResponse:
    """What forces at contact points bring about, by the tangent of one step."""

    tangent: Tangent
    contacts: ContactSet
    columns: Any
    """(3N, 3n) m/s for each newton, where the factors are."""
    delassus: np.ndarray
    """(3n, 3n) m/(N s), contact velocities for each newton."""

    @classmethod
    def of(cls, tangent: Tangent, contacts: ContactSet, columns: np.ndarray | None = None) -> ContactResponse:
        """Of ``contacts``; ``columns`` if they are known."""
        if columns is None:
            columns = tangent.solve(contacts.frame.T)
            columns *= tangent.problem.dt
        delassus = contacts.speeds(columns)
        return cls(tangent, contacts, columns, delassus)

    @cached_property
    def _regular(self) -> np.ndarray:
        regular = self.delassus.copy()
        regular[np.diag_indices_from(regular)] += SINGULAR * regular.diagonal().mean()
        return regular

    def forces(
        self, speeds: np.ndarray, shift: np.ndarray, friction: float, start: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """(n, 3) newtons that obey contact and friction if the contacts move at ``speeds`` (3n,) without them, and the
        m/s by which they miss that."""
        if self.contacts.count == 0:
            return start, 0.0
        return coulomb_forces(self._regular, speeds, shift, friction, start)

    def wider(self, contacts: ContactSet) -> ContactResponse:
        """By the same tangent, of ``contacts`` that begin with these."""
        new = contacts.frame[3 * self.contacts.count :].T
        columns = np.hstack([self.columns, self.tangent.problem.dt * self.tangent.solve(new)])
        return ContactResponse.of(self.tangent, contacts, columns)

    def at(self, tension: MuscleTension | None, velocities: np.ndarray, forces: np.ndarray) -> Iterate:
        """The step's equation at ``velocities`` (N, 3) and contact ``forces`` (n, 3), under ``tension``."""
        return HostIterate(self, tension, velocities, forces)


class Responder(Protocol):
    """Responses of one body, by one tangent after the other."""

    def __call__(self, tangent: Tangent, contacts: ContactSet) -> ContactResponse:
        """Of ``contacts`` by ``tangent``."""
        ...

    def ahead(
        self,
        tangent: Tangent,
        contacts: ContactSet,
        tension: MuscleTension | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> np.ndarray | None:
        """(N, 3) m/s after a Newton step from ``velocities`` (N, 3) under ``tension`` and contact ``forces`` (n, 3), as
        they are; None if it inverts an element."""
        ...


class HostResponder:
    """``Responder`` in arrays of the host."""

    def __call__(self, tangent: Tangent, contacts: ContactSet) -> ContactResponse:
        """See ``Responder``."""
        return ContactResponse.of(tangent, contacts)

    def ahead(
        self,
        tangent: Tangent,
        contacts: ContactSet,
        tension: MuscleTension | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> np.ndarray | None:
        """See ``Responder``. One right-hand side, where a response has three for each contact."""
        problem = tangent.problem
        missing = problem.residual(velocities, tension).ravel() - problem.dt * contacts.pushes(forces)
        ahead = velocities - tangent.solve(missing).reshape(velocities.shape)
        return ahead if problem.feasible(ahead) else None


class Iterate(Protocol):
    """Velocities and contact forces at which the equation of a step is looked at, and the Newton step from there."""

    @property
    def response(self) -> ContactResponse:
        """By which the Newton step is."""
        ...

    @property
    def velocities(self) -> np.ndarray:
        """(N, 3) m/s."""
        ...

    @property
    def forces(self) -> np.ndarray:
        """(n, 3) newtons."""
        ...

    @property
    def size(self) -> float:
        """Norm of what the equation misses, over dt x weight; not finite where an element is inverted."""
        ...

    @property
    def feasible(self) -> bool:
        """Whether no element is inverted."""
        ...

    @property
    def speeds(self) -> np.ndarray:
        """(3n,) m/s of the contacts after a Newton step without contact forces."""
        ...

    def toward(self, forces: np.ndarray, length: float = 1.0) -> Iterate:
        """``length`` of the way to the end of a Newton step with contact ``forces`` (n, 3)."""
        ...

    def by(self, response: ContactResponse) -> Iterate:
        """The same place, of which the Newton step is by another ``response`` of the same contacts."""
        ...


@dataclass(frozen=True)
class HostIterate:
    """``Iterate`` in arrays of the host, each made when it is asked for."""

    response: ContactResponse
    tension: MuscleTension | None
    velocities: np.ndarray
    forces: np.ndarray

    @cached_property
    def _free(self) -> np.ndarray:
        """(N, 3) N s, the residual without contact."""
        return self.response.tangent.problem.residual(self.velocities, self.tension)

    @property
    def size(self) -> float:
        """See ``Iterate``."""
        return self._size

    @cached_property
    def _size(self) -> float:
        problem = self.response.tangent.problem
        rest = self._free.ravel() - problem.dt * self.response.contacts.pushes(self.forces)
        return float(np.linalg.norm(rest)) / problem.unit

    @property
    def feasible(self) -> bool:
        """See ``Iterate``."""
        return self.response.tangent.problem.feasible(self.velocities)

    @cached_property
    def _loose(self) -> np.ndarray:
        """(3N,) m/s after a Newton step without contact forces."""
        return self.velocities.ravel() - self.response.tangent.solve(self._free.ravel())

    @property
    def speeds(self) -> np.ndarray:
        """See ``Iterate``."""
        return self._speeds

    @cached_property
    def _speeds(self) -> np.ndarray:
        return self.response.contacts.speeds(self._loose)

    def toward(self, forces: np.ndarray, length: float = 1.0) -> Self:
        """See ``Iterate``."""
        end = (self._loose + self.response.columns @ forces.ravel()).reshape(self.velocities.shape)
        return replace(
            self,
            velocities=self.velocities + length * (end - self.velocities),
            forces=self.forces + length * (forces - self.forces),
        )

    def by(self, response: ContactResponse) -> Self:
        """See ``Iterate``."""
        other = replace(self, response=response)
        vars(other)["_free"] = self._free
        return other
