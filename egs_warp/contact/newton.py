"""What contact forces bring about by a step's tangent, and Newton steps with them (Eq. 4, 8, 9)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np

from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.contact.detection import ContactSet
from egs_warp.contact.host_newton import HostNewtonWorkspace, IterateBuffer, address_of, host_newton_workspace
from egs_warp.contact.newton_convergence import ConvergenceState
from egs_warp.fem.body import BodyState
from egs_warp.fem.simd_elasticity import SimdElasticity
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.muscles.tension import MuscleEnergy

DELASSUS_REGULARIZATION = 1e-7
"""Of the mean of the Delassus operator's diagonal: more points than the cage can resolve leave it singular."""


@dataclass(frozen=True)
class ContactLinearization:
    """What forces at contact points bring about, by the tangent of one step."""

    tangent: Tangent
    contacts: ContactSet
    columns: Any
    """(3N, 3n) m/s for each newton, where the factors are."""

    @classmethod
    def of(cls, tangent: Tangent, contacts: ContactSet, columns: np.ndarray | None = None) -> ContactLinearization:
        """Of ``contacts``; ``columns`` if they are known."""
        if columns is None:
            columns = tangent.solve(contacts.dense_jacobian.T)
            columns *= tangent.problem.dt
        return cls(tangent, contacts, columns)

    @cached_property
    def delassus(self) -> np.ndarray:
        """(3n, 3n) m/(N s), contact velocities for each newton."""
        return self.contacts.contact_velocities(self.columns)

    @cached_property
    def columns_address(self) -> int:
        """Address of the ``columns`` on the host."""
        return address_of(self.columns)

    @cached_property
    def _regular(self) -> np.ndarray:
        regular = self.delassus.copy()
        regular[np.diag_indices_from(regular)] += DELASSUS_REGULARIZATION * regular.diagonal().mean()
        return regular

    def solve_coulomb(
        self, speeds: np.ndarray, shift: np.ndarray, friction: float, start: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """(n, 3) newtons that obey contact and friction if the contacts move at ``speeds`` (3n,) without them, and the
        m/s by which they miss that."""
        if self.contacts.count == 0:
            return start, 0.0
        return coulomb_forces(self._regular, speeds, shift, friction, start)

    def with_added_contacts(self, contacts: ContactSet) -> ContactLinearization:
        """By the same tangent, of ``contacts`` that begin with these."""
        new = contacts.dense_jacobian[3 * self.contacts.count :].T
        columns = np.hstack([self.columns, self.tangent.problem.dt * self.tangent.solve(new)])
        return ContactLinearization.of(self.tangent, contacts, columns)

    def iterate_at(self, tension: MuscleEnergy | None, velocities: np.ndarray, forces: np.ndarray) -> NewtonIterate:
        """The step's equation at ``velocities`` (N, 3) and contact ``forces`` (n, 3), under ``tension``."""
        if _elements_are_here(self.tangent):
            return NativeNewtonIterate.at(self, tension, velocities, forces)
        return NumpyNewtonIterate(self, tension, velocities, forces)


class ContactLinearizer(Protocol):
    """Responses of one body, by one tangent after the other."""

    def __call__(self, tangent: Tangent, contacts: ContactSet) -> ContactLinearization:
        """Of ``contacts`` by ``tangent``."""
        ...

    def select_contacts(self, problem: StepProblem, before: np.ndarray, loaded: np.ndarray) -> ContactSet | None:
        """The contacts of a step, after the points ``before`` (m,), of which those ``loaded`` (m,) bool pressed; None
        if the gaps are on the host."""
        ...

    def prefetch_contacts(self, state: BodyState, dt: float, before: np.ndarray) -> None:
        """Begin to ``choose`` for a step of ``dt`` seconds from ``state``, after the points ``before`` (m,), which
        comes next, likely."""
        ...

    def predict_velocities(
        self,
        tangent: Tangent,
        contacts: ContactSet,
        tension: MuscleEnergy | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> np.ndarray | None:
        """(N, 3) m/s after a Newton step from ``velocities`` (N, 3) under ``tension`` and contact ``forces`` (n, 3), as
        they are; None if it inverts an element."""
        ...


class HostContactLinearizer:
    """``Responder`` in arrays of the host."""

    def __call__(self, tangent: Tangent, contacts: ContactSet) -> ContactLinearization:
        """See ``Responder``."""
        return ContactLinearization.of(tangent, contacts)

    def select_contacts(self, problem: StepProblem, before: np.ndarray, loaded: np.ndarray) -> ContactSet | None:
        """See ``Responder``."""
        return None

    def prefetch_contacts(self, state: BodyState, dt: float, before: np.ndarray) -> None:
        """See ``Responder``: the host has nobody who would look meanwhile."""

    def predict_velocities(
        self,
        tangent: Tangent,
        contacts: ContactSet,
        tension: MuscleEnergy | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> np.ndarray | None:
        """See ``Responder``. One right-hand side, where a response has three for each contact."""
        problem = tangent.problem
        if _elements_are_here(tangent):
            room, state = host_newton_workspace(contacts.node_count), IterateBuffer.of(contacts, velocities, forces)
            room.trial(problem, tension, state)
            room.newton(tangent, state, rest=True)
            return state.free_velocities if problem.is_inversion_free(state.free_velocities) else None
        missing = problem.residual(velocities, tension).ravel() - problem.dt * contacts.nodal_forces(forces)
        ahead = velocities - tangent.solve(missing).reshape(velocities.shape)
        return ahead if problem.is_inversion_free(ahead) else None


@dataclass(frozen=True)
class PenetrationCheck:
    """What a trial on a GPU has seen on its way."""

    is_penetrating: bool
    """Whether points sink that are in no contact, see ``CoupledSolver``."""
    min_gap: float
    """Metres, of all points."""
    internal_torque: np.ndarray
    """(3,) N m about the centre of mass of the internal gradient at the end."""
    deepest: np.ndarray | None = None
    """(k, 4) the deepest of each cell of those that sink: its number, its gap there, metres, and gap and face at the
    start of the step; None if nobody asked which."""

    @classmethod
    def of(cls, found: np.ndarray) -> PenetrationCheck:
        """As it was ``found`` (5,), one behind the other."""
        return cls(found[0] > 0.0, float(found[1]), np.array(found[2:]))


class NewtonIterate(Protocol):
    """Velocities and contact forces at which the equation of a step is looked at, and the Newton step from there."""

    @property
    def linearization(self) -> ContactLinearization:
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
    def residual_norm(self) -> float:
        """Norm of what the equation misses, over dt x weight; not finite where an element is inverted."""
        ...

    @property
    def is_inversion_free(self) -> bool:
        """Whether no element is inverted."""
        ...

    @property
    def free_contact_velocities(self) -> np.ndarray:
        """(3n,) m/s of the contacts after a Newton step without contact forces."""
        ...

    @property
    def penetration(self) -> PenetrationCheck | None:
        """What is seen on the way; None if nobody looked."""
        ...

    def line_search_point(self, forces: np.ndarray, length: float = 1.0) -> NewtonIterate:
        """``length`` of the way to the end of a Newton step with contact ``forces`` (n, 3)."""
        ...

    def newton_steps(
        self, shift: np.ndarray, friction: float, course: ConvergenceState | None = None
    ) -> NewtonStepResult:
        """A Newton step with the forces that obey contact and friction if the contacts move at these ``speeds`` without
        them; where the ``course`` of a round is known, as many of them as go well, if nobody need look at each."""
        ...

    def with_new_tangent(self) -> NewtonIterate:
        """The same place, of which the Newton step is by a tangent made there, with the muscles' stiffness."""
        ...


@dataclass(frozen=True)
class NewtonStepResult:
    """Newton steps with contact, of which the last is to be looked at."""

    accepted_residuals: tuple[float, ...]
    """Residuals after those before it, which went well."""
    base: NewtonIterate
    """Where it begins."""
    forces: np.ndarray
    """(n, 3) newtons, with which it is."""
    coulomb_violation: float
    """m/s by which they miss contact and friction."""
    trial: NewtonIterate


def _onward(now: NativeNewtonIterate | NumpyNewtonIterate, shift: np.ndarray, friction: float) -> NewtonStepResult:
    """``Iterate.onward`` by one step."""
    forces, missed = now.linearization.solve_coulomb(now.free_contact_velocities, shift, friction, now.forces)
    return NewtonStepResult((), now, forces, missed, now.line_search_point(forces))


def _response_at(place: NativeNewtonIterate | NumpyNewtonIterate) -> ContactLinearization:
    """Of the same contacts, by a tangent made at that ``place``."""
    old = place.linearization.tangent
    return ContactLinearization.of(
        old.problem.tangent(old.factors, place.velocities, place.tension), place.linearization.contacts
    )


def _elements_are_here(tangent: Tangent) -> bool:
    """Whether the elements are on a CPU; the factors are, then."""
    return isinstance(tangent.problem.body.assembly.elements, SimdElasticity)


@dataclass(frozen=True, eq=False)
class NativeNewtonIterate:
    """``Iterate`` by kernels of a CPU, which say what ``HostIterate`` says."""

    linearization: ContactLinearization
    tension: MuscleEnergy | None
    state: IterateBuffer
    residual_norm: float
    penetration: None = None

    @classmethod
    def at(
        cls, response: ContactLinearization, tension: MuscleEnergy | None, velocities: np.ndarray, forces: np.ndarray
    ) -> Self:
        """At ``velocities`` (N, 3) and ``forces`` (n, 3)."""
        state = IterateBuffer.of(response.contacts, velocities, forces)
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
    def is_inversion_free(self) -> bool:
        """See ``Iterate``."""
        return bool(np.isfinite(self.residual_norm))

    @cached_property
    def _after(self) -> IterateBuffer:
        """The state, with what is after a Newton step without contact forces."""
        _room_of(self.linearization).newton(self.linearization.tangent, self.state)
        return self.state

    @property
    def free_contact_velocities(self) -> np.ndarray:
        """See ``Iterate``."""
        return self._after.free_contact_velocities

    def line_search_point(self, forces: np.ndarray, length: float = 1.0) -> Self:
        """See ``Iterate``."""
        response = self.linearization
        step = response.columns_address, forces, length
        found = _room_of(response).trial(response.tangent.problem, self.tension, self._after, step)
        return type(self)(response, self.tension, *found)

    def newton_steps(
        self, shift: np.ndarray, friction: float, course: ConvergenceState | None = None
    ) -> NewtonStepResult:
        """See ``Iterate``."""
        return _onward(self, shift, friction)

    def with_new_tangent(self) -> Self:
        """See ``Iterate``."""
        return replace(self, linearization=_response_at(self), state=self.state.copy())


def _room_of(response: ContactLinearization) -> HostNewtonWorkspace:
    return host_newton_workspace(response.contacts.node_count)


@dataclass(frozen=True)
class NumpyNewtonIterate:
    """``Iterate`` in arrays of the host, each made when it is asked for: for elements of a GPU without torch."""

    linearization: ContactLinearization
    tension: MuscleEnergy | None
    velocities: np.ndarray
    forces: np.ndarray
    penetration: None = None

    @cached_property
    def _free(self) -> np.ndarray:
        """(N, 3) N s, the residual without contact."""
        return self.linearization.tangent.problem.residual(self.velocities, self.tension)

    @property
    def residual_norm(self) -> float:
        """See ``Iterate``."""
        return self._size

    @cached_property
    def _size(self) -> float:
        problem = self.linearization.tangent.problem
        rest = self._free.ravel() - problem.dt * self.linearization.contacts.nodal_forces(self.forces)
        return float(np.linalg.norm(rest)) / problem.residual_scale

    @property
    def is_inversion_free(self) -> bool:
        """See ``Iterate``."""
        return self.linearization.tangent.problem.is_inversion_free(self.velocities)

    @cached_property
    def _loose(self) -> np.ndarray:
        """(3N,) m/s after a Newton step without contact forces."""
        return self.velocities.ravel() - self.linearization.tangent.solve(self._free.ravel())

    @property
    def free_contact_velocities(self) -> np.ndarray:
        """See ``Iterate``."""
        return self._speeds

    @cached_property
    def _speeds(self) -> np.ndarray:
        return self.linearization.contacts.contact_velocities(self._loose)

    def line_search_point(self, forces: np.ndarray, length: float = 1.0) -> Self:
        """See ``Iterate``."""
        end = (self._loose + self.linearization.columns @ forces.ravel()).reshape(self.velocities.shape)
        return replace(
            self,
            velocities=self.velocities + length * (end - self.velocities),
            forces=self.forces + length * (forces - self.forces),
        )

    def newton_steps(
        self, shift: np.ndarray, friction: float, course: ConvergenceState | None = None
    ) -> NewtonStepResult:
        """See ``Iterate``."""
        return _onward(self, shift, friction)

    def with_new_tangent(self) -> Self:
        """See ``Iterate``."""
        other = replace(self, linearization=_response_at(self))
        vars(other)["_free"] = self._free
        return other
