"""Linearised contact and the Newton iterates of a step with contact (Eq. 4, 8, 9).

For a factored tangent J, ``ContactLinearization`` holds the columns dt J^-1 W^T and the Delassus operator G = dt W J^-1
W^T. A ``NewtonIterate`` is a pair of velocities and contact forces; its Newton step solves Coulomb's law at the
contact-free velocities and adds the columns times the forces. ``HostNewtonIterate`` is an iterate on the host, for one
body or an island; ``device_newton`` is the version on a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.coulomb import DELASSUS_REGULARIZATION, coulomb_forces, regularized
from egs_warp.contact.newton_convergence import NewtonProgress
from egs_warp.fem.body import BodyState
from egs_warp.fem.step_problem import StepProblem

TensionT = TypeVar("TensionT")
"""Type of muscle energies: ``MuscleEnergy | None`` for one body, ``Tensions`` for an island."""
ActiveT = TypeVar("ActiveT", contravariant=True)
"""``TensionT``, where values of the type are only arguments."""


class StepEquation(Protocol[ActiveT]):
    """Equation of the step of one body (``StepProblem``) or of an island (``IslandProblem``)."""

    @property
    def dt(self) -> float:
        """Step size, s."""
        ...

    @property
    def state(self) -> BodyState:
        """State at the start of the step."""
        ...

    @property
    def free_fall_speed(self) -> float:
        """Speed that free fall gains in the step, m/s."""
        ...

    def end_positions(self, velocities: np.ndarray) -> np.ndarray:
        """Return the positions (N, 3) m at the end of the step for ``velocities`` (N, 3) m/s."""
        ...

    def is_inversion_free(self, velocities: np.ndarray) -> bool:
        """Return True if no element is inverted at the end positions for ``velocities`` (N, 3) m/s."""
        ...

    def residual(self, velocities: np.ndarray, tension: ActiveT, /) -> np.ndarray:
        """Return the residual (N, 3) N s without contact forces at ``velocities`` (N, 3) m/s."""
        ...

    def relative_norm(self, residual: np.ndarray) -> float:
        """Return the norm of a ``residual`` (N, 3) N s, divided by dt x weight."""
        ...


class StepTangent(Protocol[ActiveT]):
    """Factored tangent J of a step: ``Tangent`` of one body, or ``IslandTangent``."""

    @property
    def problem(self) -> StepEquation[ActiveT]:
        """The step."""
        ...

    def solve(self, impulses: np.ndarray) -> np.ndarray:
        """Return J^-1 ``impulses``, m/s, for impulses (3N,) or (3N, m), N s."""
        ...

    def renewed(self, velocities: np.ndarray, tension: ActiveT, /) -> StepTangent[ActiveT]:
        """Return the tangent at ``velocities`` (N, 3) m/s, including the stiffness of the muscles, in the same
        solvers."""
        ...


@dataclass(frozen=True)
class ContactLinearization(Generic[TensionT]):
    """Contact velocities as an affine function of contact forces, for the tangent of one step."""

    tangent: StepTangent[TensionT]
    contacts: ContactSet
    columns: Any
    """(3N, 3n) m/s per newton, dt J^-1 W^T, on the device of the factors."""

    @classmethod
    def of(cls, tangent: StepTangent[TensionT], contacts: ContactSet, columns: np.ndarray | None = None) -> Self:
        """Linearise ``contacts`` with ``tangent``; ``columns`` are computed unless they are passed."""
        if columns is None:
            columns = tangent.solve(contacts.jacobian_transposed())
            columns *= tangent.problem.dt
        return cls(tangent, contacts, columns)

    @cached_property
    def delassus(self) -> np.ndarray:
        """(3n, 3n) m/(N s), the Delassus operator G: contact velocities per newton."""
        return self.contacts.contact_velocities(self.columns)

    @property
    def host_columns(self) -> np.ndarray:
        """``columns`` on the host."""
        return self.columns

    @cached_property
    def _regular(self) -> np.ndarray:
        return regularized(self.delassus, DELASSUS_REGULARIZATION)

    def solve_coulomb(
        self, speeds: np.ndarray, shift: np.ndarray, friction: float, start: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Solve Coulomb's law and complementarity for the contact forces.

        Args:
            speeds: (3n,) m/s, contact velocities without contact forces.
            shift: (n,) m/s, bias of the normal velocities.
            friction: Coulomb coefficient.
            start: (n, 3) newtons, initial forces.

        Returns:
            The forces (n, 3) in newtons, and their violation of Coulomb's law in m/s.
        """
        if self.contacts.count == 0:
            return start, 0.0
        return coulomb_forces(self._regular, speeds, shift, friction, start)

    def with_added_contacts(self, contacts: ContactSet) -> ContactLinearization[TensionT]:
        """Return the linearisation, with the same tangent, of ``contacts``, which begin with the current ones."""
        new = contacts.jacobian_transposed()[:, 3 * self.contacts.count :]
        columns = np.hstack([self.columns, self.tangent.problem.dt * self.tangent.solve(new)])
        return type(self).of(self.tangent, contacts, columns)

    def iterate_at(self, tension: TensionT, velocities: np.ndarray, forces: np.ndarray) -> NewtonIterate[TensionT]:
        """Return the Newton iterate at ``velocities`` (N, 3) m/s and contact ``forces`` (n, 3) newtons, under
        ``tension``."""
        return HostNewtonIterate.at(self, tension, velocities, forces)


class ContactLinearizer:
    """Builder of the contact linearisations of one body or of an island; ``DeviceContactLinearizer`` is the version on
    a GPU."""

    is_on_host = True
    """False if matrices and gaps are on a GPU."""

    def __call__(self, tangent: StepTangent[TensionT], contacts: ContactSet) -> ContactLinearization[TensionT]:
        """Linearise ``contacts`` with ``tangent``."""
        return ContactLinearization.of(tangent, contacts)

    def select_contacts(self, problem: StepProblem, before: np.ndarray, loaded: np.ndarray) -> ContactSet | None:
        """Select the contacts of a step if the gaps are on a GPU.

        Args:
            problem: the step.
            before: (m,) contact points of the previous step.
            loaded: (m,) bool, True for points that carried load.

        Returns:
            The contacts; None if the gaps are on the host.
        """
        return None

    def prefetch_contacts(self, state: BodyState, dt: float, before: np.ndarray, loaded: np.ndarray) -> None:
        """Start ``select_contacts`` for the probable next step if the gaps are on a GPU.

        Args:
            state: start of the next step.
            dt: step size, s.
            before: (m,) contact points of the step before it.
            loaded: (m,) bool, True for points that carried load.
        """

    def predict_velocities(
        self,
        tangent: StepTangent[TensionT],
        contacts: ContactSet,
        tension: TensionT,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> np.ndarray | None:
        """Take one Newton step with fixed contact forces. It needs one solve, while a linearisation needs three for
        each contact.

        Args:
            tangent: factored tangent.
            contacts: n contacts.
            tension: muscle energies.
            velocities: (N, 3) m/s, initial velocities.
            forces: (n, 3) newtons.

        Returns:
            (N, 3) m/s, end velocities; None if the step inverts an element.
        """
        residual = tangent.problem.residual(velocities, tension) - tangent.problem.dt * contacts.nodal_forces(forces)
        end = velocities - tangent.solve(residual.ravel()).reshape(velocities.shape)
        return end if tangent.problem.is_inversion_free(end) else None


@dataclass(frozen=True)
class PenetrationCheck:
    """Penetration test that a GPU evaluates with each trial."""

    is_penetrating: bool
    """True if points outside the contact set penetrate too far (see ``CoupledSolver``)."""
    min_gap: float
    """Minimum gap of all points, m."""
    internal_torque: np.ndarray
    """(3,) N m, torque of the internal gradient about the centre of mass at the end of the step."""
    deepest: ContactSet | None = None
    """Deepest penetrating point of each cell, the deepest first; None if it was not downloaded."""

    @classmethod
    def of(cls, readback: np.ndarray) -> PenetrationCheck:
        """Unpack the read-back (5,)."""
        return cls(readback[0] > 0.0, float(readback[1]), np.array(readback[2:]))


class NewtonIterate(Protocol[TensionT]):
    """Protocol of a Newton iterate: velocities and contact forces, their residual, and the Newton step from them."""

    @property
    def linearization(self) -> ContactLinearization[TensionT]:
        """Linearisation that defines the Newton step."""
        ...

    @property
    def velocities(self) -> np.ndarray:
        """(N, 3) m/s, nodal velocities at the end of the step."""
        ...

    @property
    def forces(self) -> np.ndarray:
        """(n, 3) newtons, contact forces."""
        ...

    @property
    def residual_norm(self) -> float:
        """Norm of the residual with contact forces, divided by dt x weight; not finite where an element is inverted."""
        ...

    @property
    def free_contact_velocities(self) -> np.ndarray:
        """(3n,) m/s, contact velocities after a Newton step without contact forces."""
        ...

    @property
    def penetration(self) -> PenetrationCheck | None:
        """Penetration test at the iterate; None if it was not evaluated."""
        ...

    def line_search_point(self, forces: np.ndarray, length: float = 1.0) -> NewtonIterate[TensionT]:
        """Return the iterate at the fraction ``length`` of the Newton step with contact ``forces`` (n, 3) newtons."""
        ...

    def newton_steps(
        self, shift: np.ndarray, friction: float, progress: NewtonProgress | None = None
    ) -> NewtonStepResult[TensionT]:
        """Take Newton steps. The contact forces of each step satisfy Coulomb's law for the contact-free velocities at
        its start.

        On the host, or without ``progress``, one step is taken. A GPU takes steps until one of them needs a decision of
        the host; all but the last are accepted.

        Args:
            shift: (n,) m/s, bias of the normal velocities.
            friction: Coulomb coefficient.
            progress: progress of the round, which judges the last step.
        """
        ...

    def with_new_tangent(self) -> NewtonIterate[TensionT]:
        """Return the same iterate with the tangent at its own velocities, including the stiffness of the muscles."""
        ...


@dataclass(frozen=True)
class NewtonStepResult(Generic[TensionT]):
    """Result of one or more Newton steps. The caller decides whether to accept the last one."""

    base: NewtonIterate[TensionT]
    """Iterate at the start of the last step."""
    forces: np.ndarray
    """(n, 3) newtons, contact forces of the last step."""
    coulomb_violation: float
    """Violation of Coulomb's law by ``forces``, m/s."""
    trial: NewtonIterate[TensionT]
    """Iterate at the end of the last step."""


@dataclass(frozen=True, eq=False)
class HostNewtonIterate(Generic[TensionT]):
    """``NewtonIterate`` of one body or of an island, evaluated with NumPy."""

    linearization: ContactLinearization[TensionT]
    tension: TensionT
    velocities: np.ndarray
    forces: np.ndarray
    free_residual: np.ndarray
    """(N, 3) N s, residual without contact forces."""
    residual_norm: float

    @classmethod
    def at(
        cls, response: ContactLinearization[TensionT], tension: TensionT, velocities: np.ndarray, forces: np.ndarray
    ) -> Self:
        """Evaluate the iterate at ``velocities`` (N, 3) m/s and ``forces`` (n, 3) newtons."""
        problem, contacts = response.tangent.problem, response.contacts
        free = problem.residual(velocities, tension)
        norm = problem.relative_norm(free - problem.dt * contacts.nodal_forces(forces))
        return cls(response, tension, velocities, forces, free, norm)

    @property
    def penetration(self) -> PenetrationCheck | None:
        return None

    @cached_property
    def _free(self) -> tuple[np.ndarray, np.ndarray]:
        """(3N,) and (3n,) m/s, nodal velocities and contact velocities after a Newton step without contact forces."""
        velocities = self.velocities.ravel() - self.linearization.tangent.solve(self.free_residual.ravel())
        return velocities, self.linearization.contacts.jacobian @ velocities

    @property
    def free_contact_velocities(self) -> np.ndarray:
        return self._free[1]

    def newton_steps(
        self, shift: np.ndarray, friction: float, progress: NewtonProgress | None = None
    ) -> NewtonStepResult[TensionT]:
        """Take one Newton step with the contact forces that satisfy Coulomb's law."""
        forces, violation = self.linearization.solve_coulomb(self.free_contact_velocities, shift, friction, self.forces)
        trial = self.line_search_point(forces)
        if progress is not None:
            progress.begin(self.residual_norm)
            progress.judge(trial.residual_norm, violation)
        return NewtonStepResult(self, forces, violation, trial)

    def line_search_point(self, forces: np.ndarray, length: float = 1.0) -> Self:
        end = (self._free[0] + self.linearization.columns @ forces.ravel()).reshape(-1, 3)
        velocities = self.velocities + length * (end - self.velocities)
        return self.at(self.linearization, self.tension, velocities, self.forces + length * (forces - self.forces))

    def with_new_tangent(self) -> Self:
        tangent = self.linearization.tangent.renewed(self.velocities, self.tension)
        return replace(self, linearization=ContactLinearization.of(tangent, self.linearization.contacts))
