"""Steps with contact of many worlds side by side: ``coupled_step`` in lockstep, on the device (Eq. 4, 8, 9).

Every world takes the decisions that it would take alone; those that are done wait for the others.
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
    """Whoever wants to know where the time goes."""

    def __call__(self, name: str) -> AbstractContextManager[object]:
        """Around the work of the stage ``name``."""
        ...


def no_timer(name: str) -> AbstractContextManager[object]:
    """``Stages`` of nobody."""
    return nullcontext()


@dataclass(frozen=True)
class BatchLinearization(BatchedRecord):
    """``ContactResponse`` of c worlds, by the tangents in their slots."""

    momentum_projection: BatchMomentumProjection
    columns: torch.Tensor
    """(c, 3N, 3K)."""
    delassus: torch.Tensor
    """(c, 3K, 3K), made regular."""


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
    """(c,) bool: a tangent had no factors, ``UnsolvableStepError``."""
    contacts_added: torch.Tensor
    """(c,) bool: it ended where points were found that are to join."""


@dataclass(frozen=True)
class BatchSolver:
    """``CoupledSolver`` of many worlds."""

    detector: BatchDetector
    push_out_cap: float
    """m/s."""
    penetration_tolerance: float
    """Metres."""
    tolerance: float
    """Residual over dt x weight."""
    stages: StageTimer = no_timer

    def normal_bias(self, contacts: BatchContacts, dt: float) -> torch.Tensor:
        """(c, K) m/s: ``push_out_speeds``."""
        gaps = contacts.gaps
        deep = ((gaps + self.penetration_tolerance).clamp(max=0.0) * PUSH_OUT_FRACTION / dt).clamp(
            min=-self.push_out_cap
        )
        return (gaps.clamp(min=0.0) / dt + deep) * contacts.valid

    def linearize(
        self, problem: BatchProblem, contacts: BatchContacts, turning: BatchMomentumProjection | None = None
    ) -> BatchLinearization:
        """By the tangents in the worlds' slots, with their ``turning`` if it is known."""
        with self.stages("substitute"):
            columns, turning = apply_inverse(
                problem, problem.dt * contacts.jacobian_transposed(problem.positions.shape[1]), turning
            )
        delassus = contacts.contact_velocities(columns)
        diagonal = delassus.diagonal(dim1=1, dim2=2)
        mean = diagonal.sum(dim=1, keepdim=True) / (3 * contacts.counts[:, None]).clamp(min=1)
        diagonal += DELASSUS_REGULARIZATION * mean
        return BatchLinearization(turning, columns, delassus)

    def solve_coulomb(
        self,
        contacts: BatchContacts,
        response: BatchLinearization,
        free: torch.Tensor,
        shift: torch.Tensor,
        frictions: torch.Tensor,
        start: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """``ContactResponse.forces``: (c, K, 3) newtons where the bodies move at ``free`` (c, N, 3) without, and (c,)
        m/s by which they miss the laws."""
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
        """The steps from a start of ``velocities`` (c, N, 3) and ``forces`` (c, K, 3) under muscles' ``tensions``
        (c, M) newtons; ``start_gaps`` are gaps and faces at the start of the step."""
        count = len(velocities)
        whole = BatchResult(
            velocities.clone(),
            forces.clone(),
            torch.zeros(count, dtype=torch.bool, device=velocities.device),
            torch.zeros(count, dtype=torch.int64, device=velocities.device),
            *torch.zeros((2, count), dtype=torch.bool, device=velocities.device),
        )
        todo = every = torch.arange(count, device=velocities.device)
        for number in range(MAX_ACTIVATION_ROUNDS):
            part, touched = problem.subset(todo), contacts.subset(todo)
            shift, gaps = self.normal_bias(touched, problem.dt), start_gaps[0][todo]
            task = _RoundInputs(part, touched, shift, tensions[todo], frictions[todo], gaps)
            last = number == MAX_ACTIVATION_ROUNDS - 1
            done, left = self._round(task, response, whole.velocities[todo], whole.forces[todo], last=last)
            done = replace(done, iterations=done.iterations + whole.iterations[todo])
            whole.scatter(todo, done)
            if last:
                break
            with self.stages("detect"):
                added, ends = self._points_to_add(task, done.velocities)
            more = nonzero(added.any(dim=1) & (done.converged | done.contacts_added))
            if len(more) == 0:
                break
            new = self.detector.contacts(added[more], *(each[todo[more]] for each in start_gaps), order=ends[more])
            grown, forces = self.detector.append_contacts(touched.gather(more), done.forces[more], new)
            wider = grown.capacity - contacts.capacity
            # A copy: those that were given stay as they are.
            contacts = contacts.with_capacity(grown.capacity).gather(every)
            whole = replace(whole, forces=padded(whole.forces, wider))
            todo = todo[more]
            contacts.scatter(todo, grown)
            whole.forces[todo] = forces
            response = self.linearize(problem.subset(todo), grown, left.momentum_projection.gather(more))
        return contacts, whole

    def _points_to_add(self, task: _RoundInputs, velocities: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(c, P) bool: the points that would end too deep by ``velocities`` (c, N, 3); (c, P) metres, the gaps of all
        at the end."""
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
        """Newton's method with the task's contacts, until points are found that are to join, but in the ``last`` round;
        the last tangents' response comes along."""
        with self.stages("elasticity"):
            every = _NewtonState.begin(velocities, forces, *task.contact_free_residual(velocities, forces))
        for iteration in range(1, MAX_NEWTON_STEPS + 1):
            active = nonzero(every.active)
            if len(active) == 0:
                break
            part, search = task.subset(active), every.subset(active)
            search.iterations.fill_(iteration)
            slow = self._newton_step(part, search, response.subset(active), first=iteration == 1)
            looking = nonzero(search.is_near_end)
            if len(looking) > 0 and not last:
                self._check_penetration(part.subset(looking), search, looking)
            fresh = nonzero(slow & search.active)
            if len(fresh) > 0:
                again = part.subset(fresh)
                with self.stages("factor"):
                    factored = again.problem.factor(search.velocities[fresh], again.tensions)
                response.scatter(active[fresh], self.linearize(again.problem, again.contacts))
                search.tangent_is_current[fresh] = True
                search.is_singular[fresh] = ~factored
                search.active[fresh] = factored
            if search is not every:
                every.scatter(active, search)
        ends = (
            every.velocities,
            every.forces,
            every.converged,
            every.iterations,
            every.is_singular,
            every.contacts_added,
        )
        return BatchResult(*ends), response

    def _check_penetration(self, task: _RoundInputs, search: _NewtonState, places: torch.Tensor) -> None:
        """Whether points are to join in the worlds of the ``task``, which are at ``places`` of the ``search``."""
        with self.stages("detect"):
            added, _ = self._points_to_add(task, search.velocities[places])
        joined = added.any(dim=1)
        search.contacts_added[places], search.active[places] = joined, ~joined

    def _newton_step(
        self, task: _RoundInputs, search: _NewtonState, response: BatchLinearization, *, first: bool
    ) -> torch.Tensor:
        """One Newton step of each world in ``search``, which has it then; (c,) bool, where the tangent is to be made
        anew."""
        problem = task.problem
        answered = COULOMB_TOLERANCE * problem.residual_scale / problem.body.body.mass
        with self.stages("substitute"):
            moved, _ = apply_inverse(
                problem, search.contact_free_residual.flatten(1)[:, :, None], response.momentum_projection
            )
        loose = search.velocities - moved.view_as(search.velocities)
        wanted, missed = self.solve_coulomb(
            task.contacts, response, loose, task.normal_bias, task.frictions, search.forces
        )
        unanswered = missed > answered
        search.coulomb_failures.add_(unanswered)
        pushed = (response.columns @ wanted.flatten(1)[:, :, None]).view_as(loose)
        change, turned = loose + pushed - search.velocities, wanted - search.forces
        before = search.residual_norm.clone()
        better, whole = torch.zeros((2, len(before)), dtype=torch.bool, device=before.device)
        most = search.recent_residuals.amax(dim=1)
        most = torch.where(most >= 0.0, most, torch.inf)
        waiting, length = torch.arange(len(before), device=before.device), 1.0
        while length > MIN_STEP_LENGTH and len(waiting) > 0:
            trial = search.velocities[waiting] + length * change[waiting]
            trial_forces = search.forces[waiting] + length * turned[waiting]
            with self.stages("elasticity"):
                free, size = task.subset(waiting).contact_free_residual(trial, trial_forces)
            least = ((1.0 - 1e-4 * length) * most[waiting]).clamp(min=self.tolerance)
            good = size.isfinite() & (size < least) if not first else size.isfinite()
            at = waiting[good]
            better[at] = True
            whole[at] = length == 1.0
            search.velocities[at], search.forces[at] = trial[good], trial_forces[good]
            search.contact_free_residual[at], search.residual_norm[at] = free[good], size[good]
            waiting, length = waiting[~good], 0.5 * length
        recent = torch.cat([search.recent_residuals[:, 1:], search.residual_norm[:, None]], dim=1)
        search.recent_residuals.copy_(torch.where(better[:, None], recent, search.recent_residuals))
        search.converged.copy_(whole & (search.residual_norm <= self.tolerance) & ~unanswered)
        search.is_near_end.copy_(
            whole
            & (before > ACTIVATION_RESIDUAL)
            & (search.residual_norm <= ACTIVATION_RESIDUAL)
            & ~unanswered
            & ~search.converged
        )
        given_up = (~better & search.tangent_is_current) | (search.coulomb_failures > MAX_COULOMB_FAILURES)
        search.active.copy_(~search.converged & ~given_up)
        search.tangent_is_current.fill_(False)
        slow = ~better | ~whole | unanswered
        return slow if first else slow | (search.residual_norm > REFACTOR_RATIO * before)


@dataclass(frozen=True)
class _RoundInputs(BatchedRecord):
    """What a round of c worlds is asked."""

    problem: BatchProblem
    contacts: BatchContacts
    normal_bias: torch.Tensor
    """(c, K) m/s."""
    tensions: torch.Tensor
    """(c, M) newtons."""
    frictions: torch.Tensor
    """(c,)."""
    start_gaps: torch.Tensor
    """(c, P) metres."""

    def contact_free_residual(
        self, velocities: torch.Tensor, forces: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(c, N, 3) N s, the residual without contact at ``velocities`` (c, N, 3), and (c,) the size of that with
        ``forces`` (c, K, 3), over dt x weight."""
        problem = self.problem
        free = problem.residual(velocities, self.tensions)
        rest = free - problem.dt * self.contacts.nodal_forces(forces, velocities.shape[1])
        return free, rest.flatten(1).norm(dim=1) / problem.residual_scale


@dataclass(frozen=True)
class _NewtonState(BatchedRecord):
    """Where Newton's method is in each of c worlds; written in place."""

    velocities: torch.Tensor
    """(c, N, 3) m/s."""
    forces: torch.Tensor
    """(c, K, 3) newtons."""
    contact_free_residual: torch.Tensor
    """(c, N, 3) N s, the residual without contact."""
    residual_norm: torch.Tensor
    """(c,) of the residual with it, over dt x weight."""
    recent_residuals: torch.Tensor
    """(c, MEMORY) sizes of the last steps; -1 where there was none."""
    coulomb_failures: torch.Tensor
    """(c,) int64: how often forces missed their laws."""
    iterations: torch.Tensor
    """(c,) int64."""
    active: torch.Tensor
    """(c,) bool."""
    tangent_is_current: torch.Tensor
    """(c,) bool: the tangent is that of the velocities."""
    converged: torch.Tensor
    """(c,) bool."""
    is_singular: torch.Tensor
    """(c,) bool."""
    is_near_end: torch.Tensor
    """(c,) bool: by its last step the end is known well enough to look for points that are to join."""
    contacts_added: torch.Tensor
    """(c,) bool: there were some."""

    @classmethod
    def begin(
        cls, velocities: torch.Tensor, forces: torch.Tensor, free: torch.Tensor, size: torch.Tensor
    ) -> _NewtonState:
        """All worlds are to go."""
        count, device = len(size), size.device
        numbers = torch.zeros((2, count), dtype=torch.int64, device=device)
        flags = torch.zeros((6, count), dtype=torch.bool, device=device)
        flags[0] = True
        return cls(velocities, forces, free, size, size.new_full((count, RESIDUAL_WINDOW), -1.0), *numbers, *flags)
