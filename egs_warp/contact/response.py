"""What contact forces bring about by a step's tangent, and Newton steps with them (Eq. 4, 8, 9)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np

from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.contact.course import Course
from egs_warp.contact.detection import ContactSet
from egs_warp.contact.newton_room import NewtonRoom, NewtonState, address_of, newton_room
from egs_warp.fem.body import BodyState
from egs_warp.fem.element_vectors import ElementVectors
from egs_warp.fem.step_problem import StepProblem, Tangent
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

    @classmethod
    def of(cls, tangent: Tangent, contacts: ContactSet, columns: np.ndarray | None = None) -> ContactResponse:
        """Of ``contacts``; ``columns`` if they are known."""
        if columns is None:
            columns = tangent.solve(contacts.frame.T)
            columns *= tangent.problem.dt
        return cls(tangent, contacts, columns)

    @cached_property
    def delassus(self) -> np.ndarray:
        """(3n, 3n) m/(N s), contact velocities for each newton."""
        return self.contacts.speeds(self.columns)

    @cached_property
    def columns_at(self) -> int:
        """Address of the ``columns`` on the host."""
        return address_of(self.columns)

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
        if _elements_are_here(self.tangent):
            return VectorIterate.at(self, tension, velocities, forces)
        return HostIterate(self, tension, velocities, forces)


class Responder(Protocol):
    """Responses of one body, by one tangent after the other."""

    def __call__(self, tangent: Tangent, contacts: ContactSet) -> ContactResponse:
        """Of ``contacts`` by ``tangent``."""
        ...

    def choose(self, problem: StepProblem, before: np.ndarray, loaded: np.ndarray) -> ContactSet | None:
        """The contacts of a step, after the points ``before`` (m,), of which those ``loaded`` (m,) bool pressed; None
        if the gaps are on the host."""
        ...

    def look_ahead(self, state: BodyState, dt: float, before: np.ndarray) -> None:
        """Begin to ``choose`` for a step of ``dt`` seconds from ``state``, after the points ``before`` (m,), which
        comes next, likely."""
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

    def choose(self, problem: StepProblem, before: np.ndarray, loaded: np.ndarray) -> ContactSet | None:
        """See ``Responder``."""
        return None

    def look_ahead(self, state: BodyState, dt: float, before: np.ndarray) -> None:
        """See ``Responder``: the host has nobody who would look meanwhile."""

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
        if _elements_are_here(tangent):
            room, state = newton_room(contacts.node_count), NewtonState.of(contacts, velocities, forces)
            room.trial(problem, tension, state)
            room.newton(tangent, state, rest=True)
            return state.loose if problem.feasible(state.loose) else None
        missing = problem.residual(velocities, tension).ravel() - problem.dt * contacts.pushes(forces)
        ahead = velocities - tangent.solve(missing).reshape(velocities.shape)
        return ahead if problem.feasible(ahead) else None


@dataclass(frozen=True)
class Seen:
    """What a trial on a GPU has seen on its way."""

    sinking: bool
    """Whether points sink that are in no contact, see ``CoupledSolver``."""
    least_gap: float
    """Metres, of all points."""
    torque: np.ndarray
    """(3,) N m about the centre of mass of the internal gradient at the end."""
    deepest: np.ndarray | None = None
    """(k, 4) the deepest of each cell of those that sink: its number, its gap there, metres, and gap and face at the
    start of the step; None if nobody asked which."""

    @classmethod
    def of(cls, found: np.ndarray) -> Seen:
        """As it was ``found`` (5,), one behind the other."""
        return cls(found[0] > 0.0, float(found[1]), np.array(found[2:]))


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

    @property
    def seen(self) -> Seen | None:
        """What is seen on the way; None if nobody looked."""
        ...

    def toward(self, forces: np.ndarray, length: float = 1.0) -> Iterate:
        """``length`` of the way to the end of a Newton step with contact ``forces`` (n, 3)."""
        ...

    def onward(self, shift: np.ndarray, friction: float, course: Course | None = None) -> Stretch:
        """A Newton step with the forces that obey contact and friction if the contacts move at these ``speeds`` without
        them; where the ``course`` of a round is known, as many of them as go well, if nobody need look at each."""
        ...

    def anew(self) -> Iterate:
        """The same place, of which the Newton step is by a tangent made there, with the muscles' stiffness."""
        ...


@dataclass(frozen=True)
class Stretch:
    """Newton steps with contact, of which the last is to be looked at."""

    sizes: tuple[float, ...]
    """Residuals after those before it, which went well."""
    base: Iterate
    """Where it begins."""
    forces: np.ndarray
    """(n, 3) newtons, with which it is."""
    missed: float
    """m/s by which they miss contact and friction."""
    end: Iterate


def _onward(now: VectorIterate | HostIterate, shift: np.ndarray, friction: float) -> Stretch:
    """``Iterate.onward`` by one step."""
    forces, missed = now.response.forces(now.speeds, shift, friction, now.forces)
    return Stretch((), now, forces, missed, now.toward(forces))


def _response_at(place: VectorIterate | HostIterate) -> ContactResponse:
    """Of the same contacts, by a tangent made at that ``place``."""
    old = place.response.tangent
    return ContactResponse.of(
        old.problem.tangent(old.factors, place.velocities, place.tension), place.response.contacts
    )


def _elements_are_here(tangent: Tangent) -> bool:
    """Whether the elements are on a CPU; the factors are, then."""
    return isinstance(tangent.problem.body.assembly.elements, ElementVectors)


@dataclass(frozen=True, eq=False)
class VectorIterate:
    """``Iterate`` by kernels of a CPU, which say what ``HostIterate`` says."""

    response: ContactResponse
    tension: MuscleTension | None
    state: NewtonState
    size: float
    seen: None = None

    @classmethod
    def at(
        cls, response: ContactResponse, tension: MuscleTension | None, velocities: np.ndarray, forces: np.ndarray
    ) -> Self:
        """At ``velocities`` (N, 3) and ``forces`` (n, 3)."""
        state = NewtonState.of(response.contacts, velocities, forces)
        return cls(response, tension, *_room_of(response).trial(response.tangent.problem, tension, state))

    @property
    def velocities(self) -> np.ndarray:
        """See ``Iterate``."""
        return self.state.velocities

    @property
    def forces(self) -> np.ndarray:
        """See ``Iterate``."""
        return self.state.forces

    @property
    def feasible(self) -> bool:
        """See ``Iterate``."""
        return bool(np.isfinite(self.size))

    @cached_property
    def _after(self) -> NewtonState:
        """The state, with what is after a Newton step without contact forces."""
        _room_of(self.response).newton(self.response.tangent, self.state)
        return self.state

    @property
    def speeds(self) -> np.ndarray:
        """See ``Iterate``."""
        return self._after.speeds

    def toward(self, forces: np.ndarray, length: float = 1.0) -> Self:
        """See ``Iterate``."""
        response = self.response
        step = response.columns_at, forces, length
        found = _room_of(response).trial(response.tangent.problem, self.tension, self._after, step)
        return type(self)(response, self.tension, *found)

    def onward(self, shift: np.ndarray, friction: float, course: Course | None = None) -> Stretch:
        """See ``Iterate``."""
        return _onward(self, shift, friction)

    def anew(self) -> Self:
        """See ``Iterate``."""
        return replace(self, response=_response_at(self), state=self.state.copy())


def _room_of(response: ContactResponse) -> NewtonRoom:
    return newton_room(response.contacts.node_count)


@dataclass(frozen=True)
class HostIterate:
    """``Iterate`` in arrays of the host, each made when it is asked for: for elements of a GPU without torch."""

    response: ContactResponse
    tension: MuscleTension | None
    velocities: np.ndarray
    forces: np.ndarray
    seen: None = None

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

    def onward(self, shift: np.ndarray, friction: float, course: Course | None = None) -> Stretch:
        """See ``Iterate``."""
        return _onward(self, shift, friction)

    def anew(self) -> Self:
        """See ``Iterate``."""
        other = replace(self, response=_response_at(self))
        vars(other)["_free"] = self._free
        return other
