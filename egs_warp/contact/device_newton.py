"""Contact linearisations and Newton iterates on a GPU (Eq. 4, 8, 9).

``DeviceContactLinearizer`` queues a linearisation in the buffers of a ``NewtonWorkspace``.
``DeviceNewtonIterate.newton_steps`` then runs a whole Newton loop on the device and synchronises once, at the end of
the loop. Matrices stay on the device. The workspace has two slots of iterates, ``base`` and ``trial``; an iterate that
is in neither is uploaded again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.device_newton_workspace import FROM_BASE, FROM_TRIAL, NewtonWorkspace
from egs_warp.contact.device_step import SolveEnd, StepWorkspace
from egs_warp.contact.newton import (
    ContactLinearization,
    ContactLinearizer,
    NewtonStepResult,
    PenetrationCheck,
    StepTangent,
)
from egs_warp.contact.newton_convergence import NewtonProgress
from egs_warp.contact.prefetch import ContactPrefetch
from egs_warp.contact.trial_readback import TrialReadback
from egs_warp.fem.body import SoftBody
from egs_warp.fem.linear_solver import FactorStatus
from egs_warp.fem.step_problem import Tangent
from egs_warp.fem.tiled_cholesky import TiledCholesky
from egs_warp.kernels.contact.newton_convergence import OUTCOME, REPEAT
from egs_warp.launching import round_up
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleEnergy

_CAPACITY_STEP = 8
"""Multiple to which contact capacities are rounded up. Each capacity has separate buffers and graphs."""


class DeviceContactLinearizer(StepWorkspace, ContactLinearizer):
    """Builder of the contact linearisations of one body with dense factors, on the device that holds its elements. Only
    the last linearisation, ``current``, can be used."""

    is_on_host = False

    def __init__(self, factors: TiledCholesky, body: SoftBody, muscles: MuscleSet, prefetch: ContactPrefetch) -> None:
        super().__init__(factors, body, muscles, prefetch)
        self._workspaces: dict[int, NewtonWorkspace] = {}
        self.current: DeviceContactLinearization | None = None

    def __call__(self, tangent: StepTangent[Any], contacts: ContactSet) -> DeviceContactLinearization:
        """Linearise ``contacts`` with ``tangent`` and make the result ``current``. The call blocks only if the factors
        are still being computed."""
        assert isinstance(tangent, Tangent) and tangent.factors is self.factors
        workspace, self.predicted_start = self.workspace_for(contacts), None
        with self.stream:
            self.load_start(tangent.problem.state, tangent.problem.dt)
            workspace.linearize(tangent.problem, contacts)
            if not tangent.wait():
                workspace.linearize(tangent.problem, contacts)
        workspace.set_iterates()
        self.current = DeviceContactLinearization.from_workspace(tangent, contacts, self, workspace)
        return self.current

    def predict_velocities(self, *args: Any, **kwargs: Any) -> np.ndarray | None:
        """Take one Newton step with fixed contact forces; ``current`` becomes None."""
        self.predicted_start = self.current = None
        return super().predict_velocities(*args, **kwargs)

    def workspace_for(self, contacts: ContactSet) -> NewtonWorkspace:
        """Return the workspace with enough capacity for ``contacts``."""
        capacity = round_up(contacts.count, _CAPACITY_STEP)
        if capacity not in self._workspaces:
            self._workspaces[capacity] = NewtonWorkspace(self, capacity)
        return self._workspaces[capacity]


@dataclass(frozen=True)
class DeviceContactLinearization(ContactLinearization[MuscleEnergy | None]):
    """``ContactLinearization`` whose columns are a tensor on the device."""

    tangent: Tangent
    owner: DeviceContactLinearizer
    workspace: NewtonWorkspace

    @classmethod
    def from_workspace(
        cls, tangent: Tangent, contacts: ContactSet, owner: DeviceContactLinearizer, workspace: NewtonWorkspace
    ) -> DeviceContactLinearization:
        """Create the linearisation whose arrays ``workspace`` holds, or whose computation is queued on it."""
        return cls(tangent, contacts, workspace.columns[:, : 3 * contacts.count], owner, workspace)

    @cached_property
    def delassus(self) -> np.ndarray:
        """(3n, 3n) m/(N s), the Delassus operator. Blocks until it is downloaded; valid for the current
        linearisation only."""
        assert self.owner.current is self
        self.owner.stream.wait()
        width = 3 * self.contacts.count
        return self.workspace.download_delassus()[:width, :width]

    @property
    def host_columns(self) -> np.ndarray:
        """``columns``, downloaded; valid for the current linearisation only."""
        assert self.owner.current is self
        with self.owner.stream:
            return self.columns.cpu().numpy()

    def with_added_contacts(self, contacts: ContactSet) -> DeviceContactLinearization:
        """Return the linearisation of ``contacts``, which begin with the current ones, with the same tangent."""
        return self.owner(self.tangent, contacts)

    def iterate_at(
        self, tension: MuscleEnergy | None, velocities: np.ndarray, forces: np.ndarray
    ) -> DeviceNewtonIterate:
        """Return the Newton iterate at ``velocities`` (N, 3) m/s and contact ``forces`` (n, 3) newtons, under
        ``tension``. An iterate of the same array objects that the workspace already holds is reused."""
        for iterate in (self.workspace.trial_iterate, self.workspace.pending_iterate):
            if iterate is not None and iterate.is_at(self, tension, velocities, forces):
                return iterate
        return self.running_iterate_at(tension, velocities, forces)

    def running_iterate_at(
        self, tension: MuscleEnergy | None, velocities: np.ndarray, forces: np.ndarray
    ) -> DeviceNewtonIterate:
        """Start a trial at ``velocities`` (N, 3) m/s and ``forces`` (n, 3) newtons, asynchronously, and return its
        iterate, which is then in the ``trial`` slot."""
        assert self.owner.current is self
        workspace = self.workspace
        workspace.start_trial(self.tangent.problem, tension, velocities, forces)
        iterate = DeviceNewtonIterate(self, tension, velocities, forces)
        workspace.set_iterates(trial=iterate)
        return iterate

    def parse_iterate(
        self, tension: MuscleEnergy | None, forces: np.ndarray, readback: TrialReadback[np.ndarray]
    ) -> DeviceNewtonIterate:
        """Create an iterate from the read-back of its trial."""
        size, speeds = float(readback.residual_norm[0]), readback.free_contact_velocities
        return self.iterate(tension, forces, size, speeds, readback.velocities, self.parse_penetration(readback))

    def parse_penetration(self, readback: TrialReadback[np.ndarray]) -> PenetrationCheck | None:
        """Return the penetration test in the read-back; None if the gaps at the start of the step were not
        evaluated."""
        return PenetrationCheck.of(readback.penetration) if self.owner.gaps_of is self.tangent.problem else None

    def iterate(
        self,
        tension: MuscleEnergy | None,
        forces: np.ndarray,
        size: float,
        speeds: np.ndarray,
        velocities: np.ndarray,
        penetration: PenetrationCheck | None,
    ) -> DeviceNewtonIterate:
        """Create an iterate at ``velocities`` (3N,) m/s and ``forces`` (n, 3) newtons, whose values are known: the norm
        ``size`` of its residual, N s, and the others as in ``DeviceNewtonIterate.set_values``."""
        iterate = DeviceNewtonIterate(self, tension, velocities.reshape(-1, 3).copy(), forces)
        iterate.set_values(size / self.tangent.problem.residual_scale, speeds, penetration)
        return iterate


class DeviceNewtonIterate:
    """``NewtonIterate`` on the device. Its values may still be in flight, and its tangent only queued; the properties
    block until they are available."""

    def __init__(
        self,
        response: DeviceContactLinearization,
        tension: MuscleEnergy | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> None:
        self._linearization, self.tension, self.velocities, self.forces = response, tension, velocities, forces
        self._residual_norm: float | None = None
        self._contact_velocities: np.ndarray | None = None
        self._penetration: PenetrationCheck | None = None
        self._tangent_pending = False

    def set_values(self, size: float, speeds: np.ndarray, penetration: PenetrationCheck | None) -> None:
        """Set the downloaded values.

        Args:
            size: norm of the residual, divided by dt x weight.
            speeds: (3K,) m/s, contact velocities after a Newton step without contact forces.
            penetration: penetration test, or None.
        """
        self._residual_norm, self._penetration = size, penetration
        self._contact_velocities = speeds[: 3 * self._linearization.contacts.count].copy()

    @property
    def linearization(self) -> DeviceContactLinearization:
        return self._linearization

    @property
    def residual_norm(self) -> float:
        if self._residual_norm is None:
            self._wait_values()
        assert self._residual_norm is not None
        return self._residual_norm

    @property
    def free_contact_velocities(self) -> np.ndarray:
        if self._contact_velocities is None:
            self._wait_values()
        assert self._contact_velocities is not None
        return self._contact_velocities

    @property
    def penetration(self) -> PenetrationCheck | None:
        if self._residual_norm is None:
            self._wait_values()
        return self._penetration

    def is_at(
        self,
        response: DeviceContactLinearization,
        tension: MuscleEnergy | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> bool:
        """Return True if this iterate was computed from the same array objects and equal tensions."""
        if self.linearization is not response or self.velocities is not velocities or self.forces is not forces:
            return False
        if tension is None or self.tension is None:
            return tension is self.tension
        return np.array_equal(tension.tensions, self.tension.tensions)

    def line_search_point(self, forces: np.ndarray, length: float = 1.0) -> DeviceNewtonIterate:
        self._wait_tangent()
        workspace, problem = self.linearization.workspace, self.linearization.tangent.problem
        assert self.linearization.owner.current is self.linearization
        readback = workspace.run_trial(problem, length=length, target_forces=forces, base=self._slot())
        trial_forces = forces if length == 1.0 else self.forces + length * (forces - self.forces)
        trial = self.linearization.parse_iterate(self.tension, trial_forces, readback)
        workspace.set_iterates(base=self, trial=trial)
        return trial

    def newton_steps(
        self, shift: np.ndarray, friction: float, progress: NewtonProgress | None = None
    ) -> NewtonStepResult[MuscleEnergy | None]:
        """Run the Newton loop on the device and block until it ends (arguments as in ``NewtonIterate``).

        If a loop from this iterate with the same parameters is already queued, its result is used. Without
        ``progress``, one step is taken. If the Coulomb solve of the last step failed, it is repeated on the host.
        """
        response, workspace = self.linearization, self.linearization.workspace
        owner, problem, count = response.owner, response.tangent.problem, response.contacts.count
        progress = progress or NewtonProgress(0.0, -1.0, np.inf, max_steps=1)
        assert owner.current is response
        if (
            workspace.pending_iterate is not self
            or not np.array_equal(workspace.started, progress.row)
            or not workspace.coulomb.has_uploaded(shift, friction)
        ):
            base = self._slot()
            if base == FROM_BASE and workspace.trial_iterate is not None:
                # This buffer holds the contact velocities of the trial.
                workspace.reevaluate(base=base)
            if self._residual_norm is not None:
                progress.begin(self._residual_norm)
            workspace.start_newton(problem, shift, friction, progress, base=base)
        readback = workspace.wait_newton()
        if self._tangent_pending and owner.factors.status is not FactorStatus.DEFINITE:
            workspace.set_iterates()
            self._wait_tangent()
            return self.newton_steps(shift, friction, progress)
        self._tangent_pending = False
        if readback.progress[OUTCOME] == 0.0:
            # The plan was rejected, so the loop has not run. The device still holds this iterate as its trial.
            workspace.set_iterates(trial=self)
            return self.newton_steps(shift, friction, progress)
        is_one_step = progress.take(readback.progress)
        first, before = self, progress.previous_residual
        if not is_one_step:
            forces = readback.forces_before[: 3 * count].reshape(-1, 3).copy()
            velocities = readback.velocities_before.reshape(-1, 3).copy()
            first = DeviceNewtonIterate(response, self.tension, velocities, forces)
        if first._contact_velocities is None:
            first.set_values(before, readback.previous_contact_velocities, first._penetration)
        forces, violation = readback.forces[: 3 * count].reshape(-1, 3).copy(), float(readback.coulomb_violation[0])
        end = response.parse_iterate(self.tension, forces, readback)
        if end._penetration is not None and end._penetration.is_penetrating:
            end._penetration = replace(end._penetration, deepest=owner.prefetch.deepest(workspace.capacity))
        workspace.set_iterates(base=first, trial=end)
        owner.last_solve = SolveEnd(
            *(end.velocities, problem.dt, response.contacts.points, end.forces[:, 0] > 0.0, workspace.capacity)
        )
        if progress.has(REPEAT):
            forces, violation = response.solve_coulomb(first.free_contact_velocities, shift, friction, first.forces)
            end = first.line_search_point(forces)
            progress.judge(end.residual_norm, violation)
        return NewtonStepResult(first, forces, violation, end)

    def with_new_tangent(self) -> DeviceNewtonIterate:
        """Return the same iterate with the tangent at its own velocities, including the stiffness of the muscles. The
        tangent is queued asynchronously, and its linearisation becomes ``current``."""
        old, owner, workspace = self.linearization, self.linearization.owner, self.linearization.workspace
        assert owner.current is old
        problem = old.tangent.problem
        workspace.refactor(problem, self.tension, self.velocities, base=self._slot())
        response = DeviceContactLinearization.from_workspace(
            Tangent(problem, owner.factors), old.contacts, owner, workspace
        )
        iterate = DeviceNewtonIterate(response, self.tension, self.velocities, self.forces)
        iterate._residual_norm, iterate._penetration = self._residual_norm, self._penetration
        iterate._tangent_pending, owner.current = True, response
        workspace.set_iterates(base=iterate)
        return iterate

    def _wait_values(self) -> None:
        """Block until residual, contact velocities and penetration test have been downloaded. No trial may have been
        started after the one that this iterate evaluates."""
        self._wait_tangent()
        response, workspace = self.linearization, self.linearization.workspace
        assert workspace.pending_iterate is None and self is (workspace.trial_iterate or workspace.base_iterate)
        response.owner.stream.wait()
        size, penetration = self._residual_norm, self._penetration
        if self is workspace.trial_iterate:
            size = float(workspace.readback.residual_norm[0]) / response.tangent.problem.residual_scale
            penetration = response.parse_penetration(workspace.readback)
        assert size is not None
        self.set_values(size, workspace.readback.free_contact_velocities, penetration)

    def _wait_tangent(self) -> None:
        """Block until a queued tangent is factored. If it is not positive definite, compute the tangent again with
        ``StepProblem.tangent``, which falls back to a positive definite approximation."""
        if not self._tangent_pending:
            return
        self._tangent_pending = False
        owner, old = self.linearization.owner, self.linearization
        if owner.factors.status is FactorStatus.DEFINITE:
            return
        problem = old.tangent.problem
        self._linearization = owner(problem.tangent(owner.factors, self.velocities, self.tension), old.contacts)
        self._contact_velocities = None
        workspace = self._linearization.workspace
        workspace.start_trial(problem, self.tension, self.velocities, self.forces)
        workspace.trial_iterate = self

    def _slot(self) -> float:
        """Return the slot of the iterate, ``FROM_BASE`` or ``FROM_TRIAL``. An iterate that is in neither slot is
        uploaded first."""
        workspace = self.linearization.workspace
        if self is workspace.base_iterate:
            return FROM_BASE
        if self is not workspace.trial_iterate:
            workspace.start_trial(self.linearization.tangent.problem, self.tension, self.velocities, self.forces)
            workspace.set_iterates(trial=self)
        return FROM_TRIAL
