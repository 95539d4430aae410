"""Steps with contact of many worlds in lockstep on the device (Eq. 4, 8, 9).

Every world makes the decisions of ``coupled_step``; converged worlds are left out of later iterations.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Protocol

import torch

from egs_warp.contact.batch_contacts import BatchContacts, BatchDetector, coulomb_forces_batch, padded
from egs_warp.contact.coupled_step import (
    ACTIVATION_DEPTH,
    ACTIVATION_RESIDUAL,
    COULOMB_TOLERANCE,
    MAX_ACTIVATION_ROUNDS,
    MAX_COULOMB_FAILURES,
    MAX_CREEP,
    MAX_SINK,
    MIN_STEP_LENGTH,
    PUSH_OUT_FRACTION,
)
from egs_warp.contact.newton import DELASSUS_REGULARIZATION
from egs_warp.contact.newton_convergence import MAX_NEWTON_STEPS
from egs_warp.fem.batch_problem import BatchMomentumProjection, BatchProblem, apply_inverse
from egs_warp.fem.batched import BatchedRecord, nonzero
from egs_warp.kernels.contact.newton_convergence import REFACTOR_RATIO, RESIDUAL_WINDOW


class StageTimer(Protocol):
    """Protocol of a timer for the stages of a step."""

    def __call__(self, name: str) -> AbstractContextManager[object]:
        """Return a context that measures the stage ``name``."""
        ...


def no_timer(name: str) -> AbstractContextManager[object]:
    """Return an empty context: a ``StageTimer`` that measures nothing."""
    return nullcontext()


@dataclass(frozen=True)
class BatchLinearization(BatchedRecord):
    """``ContactLinearization`` of c worlds, with the tangents in their slots."""

    momentum_projection: BatchMomentumProjection
    columns: torch.Tensor
    """(c, 3N, 3K) m/s per newton, dt J^-1 W^T."""
    delassus: torch.Tensor
    """(c, 3K, 3K) m/(N s), the regularised Delassus operator."""


@dataclass(frozen=True)
class BatchResult(BatchedRecord):
    """``CoupledResult`` of c worlds."""

    velocities: torch.Tensor
    """(c, N, 3) m/s."""
    forces: torch.Tensor
    """(c, K, 3) newtons."""
    converged: torch.Tensor
    """(c,) bool."""
    iterations: torch.Tensor
    """(c,) int64."""
    is_singular: torch.Tensor
    """(c,) bool, True if a tangent could not be factored (``UnsolvableStepError``)."""
    contacts_added: torch.Tensor
    """(c,) bool, True if the round ended because points must be added."""


@dataclass(frozen=True)
class BatchSolver:
    """``CoupledSolver`` for many worlds."""

    detector: BatchDetector
    push_out_cap: float
    """Maximum push-out speed, m/s."""
    penetration_tolerance: float
    """Depth up to which a point is not pushed out, m."""
    tolerance: float
    """Residual divided by dt x weight at which a world has converged."""
    stages: StageTimer = no_timer

    def normal_bias(self, contacts: BatchContacts, dt: float) -> torch.Tensor:
        """Return (c, K) m/s, the velocity bias of ``push_out_speeds``."""
        gaps = contacts.gaps
        deep = ((gaps + self.penetration_tolerance).clamp(max=0.0) * PUSH_OUT_FRACTION / dt).clamp(
            min=-self.push_out_cap
        )
        return (gaps.clamp(min=0.0) / dt + deep) * contacts.valid

    def linearize(
        self, problem: BatchProblem, contacts: BatchContacts, momentum_projection: BatchMomentumProjection | None = None
    ) -> BatchLinearization:
        """Linearise ``contacts`` with the tangents in the worlds' slots; the momentum projection is computed unless it
        is passed.
        """
        with self.stages("substitute"):
            columns, momentum_projection = apply_inverse(
                problem, problem.dt * contacts.jacobian_transposed(problem.positions.shape[1]), momentum_projection
            )
        delassus = contacts.contact_velocities(columns)
        diagonal = delassus.diagonal(dim1=1, dim2=2)
        mean = diagonal.sum(dim=1, keepdim=True) / (3 * contacts.counts[:, None]).clamp(min=1)
        diagonal += DELASSUS_REGULARIZATION * mean
        return BatchLinearization(momentum_projection, columns, delassus)

    def solve_coulomb(
        self,
        contacts: BatchContacts,
        response: BatchLinearization,
        free: torch.Tensor,
        shift: torch.Tensor,
        frictions: torch.Tensor,
        start: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Solve Coulomb's law and complementarity for the contact forces.

        Args:
            contacts: contacts of c worlds.
            response: their linearisation.
            free: (c, N, 3) m/s, nodal velocities without contact forces.
            shift: (c, K) m/s, bias of the normal velocities.
            frictions: (c,) Coulomb coefficients.
            start: (c, K, 3) newtons, initial forces.

        Returns:
            (c, K, 3) newtons, and their violation of the law (c,) in m/s.
        """
        with self.stages("coulomb"):
            speeds = contacts.contact_velocities(free.flatten(1)[:, :, None])[:, :, 0]
            return coulomb_forces_batch(contacts.counts, response.delassus, speeds, shift, frictions, start)

    def solve(
        self,
        problem: BatchProblem,
        contacts: BatchContacts,
        response: BatchLinearization,
        tensions: torch.Tensor,
        frictions: torch.Tensor,
        *,
        velocities: torch.Tensor,
        forces: torch.Tensor,
        start_gaps: tuple[torch.Tensor, torch.Tensor],
    ) -> tuple[BatchContacts, BatchResult]:
        """Solve the steps with Newton's method.

        Args:
            problem: the steps of c worlds.
            contacts: initial contacts.
            response: their linearisation.
            tensions: (c, M) newtons, muscle tensions.
            frictions: (c,) Coulomb coefficients.
            velocities: (c, N, 3) m/s, initial velocities.
            forces: (c, K, 3) newtons, initial forces.
            start_gaps: (c, P) m, gaps at the start of the step, and (c, P), their faces.

        Returns:
            The contacts at the end, and the result.
        """
        count = len(velocities)
        result = BatchResult(
            velocities.clone(),
            forces.clone(),
            torch.zeros(count, dtype=torch.bool, device=velocities.device),
            torch.zeros(count, dtype=torch.int64, device=velocities.device),
            *torch.zeros((2, count), dtype=torch.bool, device=velocities.device),
        )
        todo = all_worlds = torch.arange(count, device=velocities.device)
        for number in range(MAX_ACTIVATION_ROUNDS):
            part, active_contacts = problem.subset(todo), contacts.subset(todo)
            shift, gaps = self.normal_bias(active_contacts, problem.dt), start_gaps[0][todo]
            task = _RoundInputs(part, active_contacts, shift, tensions[todo], frictions[todo], gaps)
            last = number == MAX_ACTIVATION_ROUNDS - 1
            done, left = self._round(task, response, result.velocities[todo], result.forces[todo], last=last)
            done = replace(done, iterations=done.iterations + result.iterations[todo])
            result.scatter(todo, done)
            if last:
                break
            with self.stages("detect"):
                added, ends = self._points_to_add(task, done.velocities)
            more = nonzero(added.any(dim=1) & (done.converged | done.contacts_added))
            if len(more) == 0:
                break
            new = self.detector.contacts(added[more], *(each[todo[more]] for each in start_gaps), order=ends[more])
            grown, forces = self.detector.append_contacts(active_contacts.gather(more), done.forces[more], new)
            extra = grown.capacity - contacts.capacity
            # Copy, since the caller's contacts must not change.
            contacts = contacts.with_capacity(grown.capacity).gather(all_worlds)
            result = replace(result, forces=padded(result.forces, extra))
            todo = todo[more]
            contacts.scatter(todo, grown)
            result.forces[todo] = forces
            response = self.linearize(problem.subset(todo), grown, left.momentum_projection.gather(more))
        return contacts, result

    def _points_to_add(self, task: _RoundInputs, velocities: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (c, P) bool, the points that would be too deep at the end of the step with ``velocities`` (c, N, 3),
        and (c, P) m, all gaps at the end.
        """
        gaps, _ = self.detector.gaps(task.problem.end_positions(velocities))
        tolerance = self.penetration_tolerance
        allowed = torch.where(gaps < -tolerance, MAX_CREEP * tolerance, MAX_SINK * tolerance)
        sinking = torch.where(gaps < task.start_gaps - allowed, gaps, 0.0)
        return self.detector.find_deeper(task.contacts, sinking, ACTIVATION_DEPTH * tolerance), gaps

    def _round(
        self,
        task: _RoundInputs,
        response: BatchLinearization,
        velocities: torch.Tensor,
        forces: torch.Tensor,
        *,
        last: bool,
    ) -> tuple[BatchResult, BatchLinearization]:
        """Run Newton's method with the contacts of ``task`` until points must be added, which never happens in the
        ``last`` round. Return the result and the last linearisations.
        """
        with self.stages("elasticity"):
            state = _NewtonState.begin(velocities, forces, *task.contact_free_residual(velocities, forces))
        for iteration in range(1, MAX_NEWTON_STEPS + 1):
            active = nonzero(state.active)
            if len(active) == 0:
                break
            part, search = task.subset(active), state.subset(active)
            search.iterations.fill_(iteration)
            slow = self._newton_step(part, search, response.subset(active), first=iteration == 1)
            to_check = nonzero(search.is_near_end)
            if len(to_check) > 0 and not last:
                self._check_penetration(part.subset(to_check), search, to_check)
            fresh = nonzero(slow & search.active)
            if len(fresh) > 0:
                again = part.subset(fresh)
                with self.stages("factor"):
                    factored = again.problem.factor(search.velocities[fresh], again.tensions)
                response.scatter(active[fresh], self.linearize(again.problem, again.contacts))
                search.tangent_is_current[fresh] = True
                search.is_singular[fresh] = ~factored
                search.active[fresh] = factored
            if search is not state:
                state.scatter(active, search)
        ends = (
            state.velocities,
            state.forces,
            state.converged,
            state.iterations,
            state.is_singular,
            state.contacts_added,
        )
        return BatchResult(*ends), response

    def _check_penetration(self, task: _RoundInputs, search: _NewtonState, rows: torch.Tensor) -> None:
        """Find points to add in the worlds of ``task``, which are the rows ``rows`` of ``search``, and end the round of
        worlds in which there are some.
        """
        with self.stages("detect"):
            added, _ = self._points_to_add(task, search.velocities[rows])
        joined = added.any(dim=1)
        search.contacts_added[rows], search.active[rows] = joined, ~joined

    def _newton_step(
        self, task: _RoundInputs, search: _NewtonState, response: BatchLinearization, *, first: bool
    ) -> torch.Tensor:
        """Take one Newton step in each world of ``search``, in place. Return (c,) bool, True where the tangent must
        be updated.
        """
        problem = task.problem
        coulomb_tolerance = COULOMB_TOLERANCE * problem.residual_scale / problem.body.body.mass
        with self.stages("substitute"):
            solved, _ = apply_inverse(
                problem, search.contact_free_residual.flatten(1)[:, :, None], response.momentum_projection
            )
        free_velocities = search.velocities - solved.view_as(search.velocities)
        target_forces, violation = self.solve_coulomb(
            task.contacts, response, free_velocities, task.normal_bias, task.frictions, search.forces
        )
        violated = violation > coulomb_tolerance
        search.coulomb_failures.add_(violated)
        force_velocities = (response.columns @ target_forces.flatten(1)[:, :, None]).view_as(free_velocities)
        change, force_change = free_velocities + force_velocities - search.velocities, target_forces - search.forces
        before = search.residual_norm.clone()
        better, whole = torch.zeros((2, len(before)), dtype=torch.bool, device=before.device)
        maximum = search.recent_residuals.amax(dim=1)
        maximum = torch.where(maximum >= 0.0, maximum, torch.inf)
        waiting, length = torch.arange(len(before), device=before.device), 1.0
        while length > MIN_STEP_LENGTH and len(waiting) > 0:
            trial = search.velocities[waiting] + length * change[waiting]
            trial_forces = search.forces[waiting] + length * force_change[waiting]
            with self.stages("elasticity"):
                free, size = task.subset(waiting).contact_free_residual(trial, trial_forces)
            limit = ((1.0 - 1e-4 * length) * maximum[waiting]).clamp(min=self.tolerance)
            good = size.isfinite() & (size < limit) if not first else size.isfinite()
            at = waiting[good]
            better[at] = True
            whole[at] = length == 1.0
            search.velocities[at], search.forces[at] = trial[good], trial_forces[good]
            search.contact_free_residual[at], search.residual_norm[at] = free[good], size[good]
            waiting, length = waiting[~good], 0.5 * length
        recent = torch.cat([search.recent_residuals[:, 1:], search.residual_norm[:, None]], dim=1)
        search.recent_residuals.copy_(torch.where(better[:, None], recent, search.recent_residuals))
        search.converged.copy_(whole & (search.residual_norm <= self.tolerance) & ~violated)
        search.is_near_end.copy_(
            whole
            & (before > ACTIVATION_RESIDUAL)
            & (search.residual_norm <= ACTIVATION_RESIDUAL)
            & ~violated
            & ~search.converged
        )
        failed = (~better & search.tangent_is_current) | (search.coulomb_failures > MAX_COULOMB_FAILURES)
        search.active.copy_(~search.converged & ~failed)
        search.tangent_is_current.fill_(False)
        slow = ~better | ~whole | violated
        return slow if first else slow | (search.residual_norm > REFACTOR_RATIO * before)


@dataclass(frozen=True)
class _RoundInputs(BatchedRecord):
    """Inputs of a round of c worlds."""

    problem: BatchProblem
    contacts: BatchContacts
    normal_bias: torch.Tensor
    """(c, K) m/s."""
    tensions: torch.Tensor
    """(c, M) newtons."""
    frictions: torch.Tensor
    """(c,) Coulomb coefficients."""
    start_gaps: torch.Tensor
    """(c, P) m, gaps at the start of the step."""

    def contact_free_residual(
        self, velocities: torch.Tensor, forces: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (c, N, 3) N s, the residual without contact forces at ``velocities`` (c, N, 3), and (c,) the norm of
        the residual with ``forces`` (c, K, 3), divided by dt x weight.
        """
        problem = self.problem
        free = problem.residual(velocities, self.tensions)
        rest = free - problem.dt * self.contacts.nodal_forces(forces, velocities.shape[1])
        return free, rest.flatten(1).norm(dim=1) / problem.residual_scale


@dataclass(frozen=True)
class _NewtonState(BatchedRecord):
    """State of Newton's method in c worlds, written in place."""

    velocities: torch.Tensor
    """(c, N, 3) m/s."""
    forces: torch.Tensor
    """(c, K, 3) newtons."""
    contact_free_residual: torch.Tensor
    """(c, N, 3) N s, residual without contact forces."""
    residual_norm: torch.Tensor
    """(c,) norm of the residual with contact forces, divided by dt x weight."""
    recent_residuals: torch.Tensor
    """(c, RESIDUAL_WINDOW) residuals after the last steps; unused entries are -1."""
    coulomb_failures: torch.Tensor
    """(c,) int64, number of steps whose forces violated Coulomb's law."""
    iterations: torch.Tensor
    """(c,) int64."""
    active: torch.Tensor
    """(c,) bool, True while the world is being solved."""
    tangent_is_current: torch.Tensor
    """(c,) bool, True if the tangent is that of the present velocities."""
    converged: torch.Tensor
    """(c,) bool."""
    is_singular: torch.Tensor
    """(c,) bool, True if a tangent could not be factored."""
    is_near_end: torch.Tensor
    """(c,) bool, True if the last step came near enough to the solution to search for points to add."""
    contacts_added: torch.Tensor
    """(c,) bool, True if that search found points to add."""

    @classmethod
    def begin(
        cls, velocities: torch.Tensor, forces: torch.Tensor, free: torch.Tensor, size: torch.Tensor
    ) -> _NewtonState:
        """Create the state at the start of a round, with all worlds active."""
        count, device = len(size), size.device
        numbers = torch.zeros((2, count), dtype=torch.int64, device=device)
        flags = torch.zeros((6, count), dtype=torch.bool, device=device)
        flags[0] = True
        return cls(velocities, forces, free, size, size.new_full((count, RESIDUAL_WINDOW), -1.0), *numbers, *flags)
