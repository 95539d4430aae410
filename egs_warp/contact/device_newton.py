"""Contact responses and iterates on a GPU: matrices stay there, a round of Newton steps is one loop and one look."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from egs_warp.contact.coulomb import FAILURE_TOLERANCE
from egs_warp.contact.detection import ContactSet
from egs_warp.contact.device_newton_workspace import FROM_BASE, FROM_TRIAL, NewtonWorkspace, TrialReadback
from egs_warp.contact.device_selection import DeviceContactSelector
from egs_warp.contact.device_step import SolveEnd, StepWorkspace
from egs_warp.contact.newton import ContactLinearization, NewtonStepResult, PenetrationCheck
from egs_warp.contact.newton_convergence import ConvergenceState
from egs_warp.fem.body import SoftBody
from egs_warp.fem.dense_cholesky import DenseCholesky
from egs_warp.fem.step_problem import Tangent
from egs_warp.kernels.contact.newton_convergence import FIRST_RESIDUAL
from egs_warp.launching import round_up
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleEnergy

_PLACES = 8
"""Contacts are so many at a time: each number of them has memory and graphs of its own."""


class DeviceContactLinearizer(StepWorkspace):
    """Responses by dense factors of one body, where its elements are. The last one is at hand, others are not; of what
    was tried the last two."""

    def __init__(
        self, factors: DenseCholesky, body: SoftBody, muscles: MuscleSet, sight: DeviceContactSelector
    ) -> None:
        super().__init__(factors, body, muscles, sight)
        self._rooms: dict[int, NewtonWorkspace] = {}
        self.current: DeviceContactLinearization | None = None

    def __call__(self, tangent: Tangent, contacts: ContactSet) -> DeviceContactLinearization:
        """The response at hand from now on."""
        assert tangent.factors is self.factors
        room, self.predicted_start = self.workspace_for(contacts), None
        with self.stream:
            self.set_problem(tangent.problem)
            room.linearize(tangent.problem, contacts)
            if not tangent.wait():
                room.linearize(tangent.problem, contacts)
        room.base_iterate = room.trial_iterate = room.pending_iterate = None
        self.current = DeviceContactLinearization.from_workspace(tangent, contacts, self, room)
        return self.current

    def predict_velocities(
        self,
        tangent: Tangent,
        contacts: ContactSet,
        tension: MuscleEnergy | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> np.ndarray | None:
        """See ``Responder``. No response is at hand then."""
        assert tangent.factors is self.factors
        room = self.workspace_for(contacts)
        self.predicted_start = self.current = room.base_iterate = room.trial_iterate = room.pending_iterate = None
        with self.stream:
            self.set_problem(tangent.problem)
        size, ahead = room.predict_velocities(tangent.problem, contacts, tension, velocities, forces)
        if not tangent.wait():
            size, ahead = room.predict_velocities(tangent.problem, contacts, tension, velocities, forces)
        return ahead.reshape(velocities.shape).copy() if np.isfinite(size) else None

    def workspace_for(self, contacts: ContactSet) -> NewtonWorkspace:
        """Memory for them."""
        places = round_up(contacts.count, _PLACES)
        if places not in self._rooms:
            self._rooms[places] = NewtonWorkspace(self, places)
        return self._rooms[places]


@dataclass(frozen=True)
class DeviceContactLinearization(ContactLinearization):
    """``ContactResponse`` whose columns are a tensor on the device."""

    owner: DeviceContactLinearizer
    workspace: NewtonWorkspace

    @classmethod
    def from_workspace(
        cls, tangent: Tangent, contacts: ContactSet, owner: DeviceContactLinearizer, room: NewtonWorkspace
    ) -> DeviceContactLinearization:
        """What the ``room`` has, or will have."""
        return cls(tangent, contacts, room.columns[:, : 3 * contacts.count], owner, room)

    @cached_property
    def delassus(self) -> np.ndarray:
        """See ``ContactResponse``; of the one that is at hand."""
        assert self.owner.current is self
        self.owner.stream.wait()
        width = 3 * self.contacts.count
        return self.workspace.download_delassus()[:width, :width]

    def with_added_contacts(self, contacts: ContactSet) -> DeviceContactLinearization:
        """See ``ContactResponse``."""
        return self.owner(self.tangent, contacts)

    def iterate_at(
        self, tension: MuscleEnergy | None, velocities: np.ndarray, forces: np.ndarray
    ) -> DeviceNewtonIterate:
        """See ``ContactResponse``."""
        for known in (self.workspace.trial_iterate, self.workspace.pending_iterate):
            if known is not None and known.is_at(self, tension, velocities, forces):
                return known
        return self.running_iterate_at(tension, velocities, forces)

    def running_iterate_at(
        self, tension: MuscleEnergy | None, velocities: np.ndarray, forces: np.ndarray
    ) -> DeviceNewtonIterate:
        """``at``, where the room's last trial is then."""
        assert self.owner.current is self
        room = self.workspace
        room.start_trial(self.tangent.problem, tension, velocities, forces)
        room.base_iterate, room.trial_iterate, room.pending_iterate = (
            None,
            DeviceNewtonIterate(self, tension, velocities, forces),
            None,
        )
        return room.trial_iterate

    def parse_iterate(
        self, tension: MuscleEnergy | None, forces: np.ndarray, found: TrialReadback
    ) -> DeviceNewtonIterate:
        """Of what the room has ``found``."""
        return self.iterate(
            tension,
            forces,
            float(found.residual_norm[0]),
            found.free_contact_velocities,
            found.velocities,
            self.parse_penetration(found),
        )

    def parse_penetration(self, found: TrialReadback) -> PenetrationCheck | None:
        """What there is to be seen in what the room has ``found``; None if nobody has looked at the step's start."""
        return PenetrationCheck.of(found.penetration) if self.owner.gaps_of is self.tangent.problem else None

    def iterate(
        self,
        tension: MuscleEnergy | None,
        forces: np.ndarray,
        size: float,
        speeds: np.ndarray,
        velocities: np.ndarray,
        seen: PenetrationCheck | None,
    ) -> DeviceNewtonIterate:
        """At those ``velocities`` (3N,), under ``forces`` (n, 3), where the equation misses ``size`` N s and contacts
        go on at ``speeds`` (3K,)."""
        place = DeviceNewtonIterate(self, tension, velocities.reshape(-1, 3).copy(), forces)
        place.know(size / self.tangent.problem.residual_scale, speeds, seen)
        return place


class DeviceNewtonIterate:
    """``Iterate`` that lies on the device. What it is asked for may be on its way, and its tangent only begun."""

    def __init__(
        self,
        response: DeviceContactLinearization,
        tension: MuscleEnergy | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> None:
        self._response, self.tension, self.velocities, self.forces = response, tension, velocities, forces
        self._size: float | None = None
        self._speeds: np.ndarray | None = None
        self._seen: PenetrationCheck | None = None
        self._begun = False

    def know(self, size: float, speeds: np.ndarray, seen: PenetrationCheck | None) -> None:
        """What has come: of the residual, ``speeds`` (3K,) of the contacts, and what is ``seen``."""
        self._size, self._seen = size, seen
        self._speeds = speeds[: 3 * self._response.contacts.count].copy()

    @property
    def linearization(self) -> DeviceContactLinearization:
        """See ``Iterate``."""
        return self._response

    @property
    def residual_norm(self) -> float:
        """See ``Iterate``."""
        if self._size is None:
            self._wait()
        assert self._size is not None
        return self._size

    @property
    def free_contact_velocities(self) -> np.ndarray:
        """See ``Iterate``."""
        if self._speeds is None:
            self._wait()
        assert self._speeds is not None
        return self._speeds

    @property
    def penetration(self) -> PenetrationCheck | None:
        """See ``Iterate``."""
        if self._size is None:
            self._wait()
        return self._seen

    @property
    def is_inversion_free(self) -> bool:
        """See ``Iterate``."""
        return bool(np.isfinite(self.residual_norm))

    def is_at(
        self,
        response: DeviceContactLinearization,
        tension: MuscleEnergy | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> bool:
        """Whether it is what is asked for: at these very arrays."""
        if self.linearization is not response or self.velocities is not velocities or self.forces is not forces:
            return False
        if tension is None or self.tension is None:
            return tension is self.tension
        return np.array_equal(tension.tensions, self.tension.tensions)

    def line_search_point(self, forces: np.ndarray, length: float = 1.0) -> DeviceNewtonIterate:
        """See ``Iterate``."""
        self._settle()
        room, problem = self.linearization.workspace, self.linearization.tangent.problem
        assert self.linearization.owner.current is self.linearization
        found = room.run_trial(problem, length=length, wanted=forces, base=self._base())
        told = forces if length == 1.0 else self.forces + length * (forces - self.forces)
        room.base_iterate, room.trial_iterate, room.pending_iterate = (
            self,
            self.linearization.parse_iterate(self.tension, told, found),
            None,
        )
        return room.trial_iterate

    def newton_steps(
        self, shift: np.ndarray, friction: float, course: ConvergenceState | None = None
    ) -> NewtonStepResult:
        """See ``Iterate``."""
        response, room = self.linearization, self.linearization.workspace
        owner, problem, count = response.owner, response.tangent.problem, response.contacts.count
        course = course or ConvergenceState(0.0, 0.0, np.inf, max_steps=1)
        assert owner.current is response
        if (
            room.pending_iterate is not self
            or room.convergence != course
            or not room.coulomb.has_uploaded(shift, friction)
        ):
            base = self._base()
            if base == FROM_BASE and room.trial_iterate is not None:
                # The speeds are the trial's.
                room.reevaluate(base=base)
            room.start_newton(problem, shift, friction, course, base=base, size=self._size)
        found = room.wait_newton()
        if self._begun and not owner.factors.is_ready:
            room.base_iterate = room.trial_iterate = room.pending_iterate = None
            self._settle()
            return self.newton_steps(shift, friction, course)
        self._begun = False
        if found.steps_taken == 0:
            # A plan that was not as usual: the device has stayed there.
            room.base_iterate, room.trial_iterate, room.pending_iterate = None, self, None
            return self.newton_steps(shift, friction, course)
        sizes, first = found.step_residuals, self
        if len(sizes) == 1:
            if self._speeds is None:
                self.know(
                    float(found.convergence[FIRST_RESIDUAL]) / problem.residual_scale,
                    found.previous_contact_velocities,
                    self._seen,
                )
        else:
            forces = found.forces_before[: 3 * count].reshape(-1, 3).copy()
            first = response.iterate(
                self.tension, forces, float(sizes[-2]), found.previous_contact_velocities, found.velocities_before, None
            )
        forces, missed = found.forces[: 3 * count].reshape(-1, 3).copy(), float(found.coulomb_violation[0])
        end = response.parse_iterate(self.tension, forces, found)
        if end._seen is not None and end._seen.is_penetrating:
            end._seen = replace(end._seen, deepest=owner.selector.deepest(room.capacity))
        room.base_iterate, room.trial_iterate, room.pending_iterate = first, end, None
        owner.last_solve = SolveEnd(end.velocities, problem.dt, response.contacts.points, room.capacity)
        if missed > FAILURE_TOLERANCE:
            forces, missed = response.solve_coulomb(first.free_contact_velocities, shift, friction, first.forces)
            end = first.line_search_point(forces)
        return NewtonStepResult(tuple(sizes[:-1] / problem.residual_scale), first, forces, missed, end)

    def with_new_tangent(self) -> DeviceNewtonIterate:
        """See ``Iterate``. No response but that is at hand then."""
        old, owner, room = self.linearization, self.linearization.owner, self.linearization.workspace
        assert owner.current is old
        problem = old.tangent.problem
        room.refactor(problem, self.tension, self.velocities, base=self._base())
        response = DeviceContactLinearization.from_workspace(Tangent(problem, owner.factors), old.contacts, owner, room)
        place = DeviceNewtonIterate(response, self.tension, self.velocities, self.forces)
        place._size, place._seen, place._begun = self._size, self._seen, True
        owner.current, room.base_iterate, room.trial_iterate, room.pending_iterate = response, place, None, None
        return place

    def _wait(self) -> None:
        """For what is on its way, which nothing has gone past."""
        self._settle()
        response, room = self.linearization, self.linearization.workspace
        assert room.pending_iterate is None and self is (room.trial_iterate or room.base_iterate)
        response.owner.stream.wait()
        size, seen = self._size, self._seen
        if self is room.trial_iterate:
            size, seen = (
                float(room.readback.residual_norm[0]) / response.tangent.problem.residual_scale,
                response.parse_penetration(room.readback),
            )
        assert size is not None
        self.know(size, room.readback.free_contact_velocities, seen)

    def _settle(self) -> None:
        """Wait for a tangent that is begun; if it is not definite, another is made: a sum may be where its first part
        is not."""
        if not self._begun:
            return
        self._begun = False
        owner, old = self.linearization.owner, self.linearization
        if owner.factors.is_ready:
            return
        problem = old.tangent.problem
        self._response = owner(problem.tangent(owner.factors, self.velocities, self.tension), old.contacts)
        self._speeds = None
        room = self._response.workspace
        room.start_trial(problem, self.tension, self.velocities, self.forces)
        room.trial_iterate = self

    def _base(self) -> float:
        """Where it lies; what the device has left behind is told it again."""
        room = self.linearization.workspace
        if self is room.base_iterate:
            return FROM_BASE
        if self is not room.trial_iterate:
            room.start_trial(self.linearization.tangent.problem, self.tension, self.velocities, self.forces)
            room.base_iterate, room.trial_iterate, room.pending_iterate = None, self, None
        return FROM_TRIAL
