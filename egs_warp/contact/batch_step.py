"""Steps with contact of many worlds in lockstep on the device (Eq. 4, 8, 9).

Every world makes the decisions of ``coupled_step``; converged worlds are left out of later iterations.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Protocol

import torch
import warp as wp

from egs_warp.contact.contact_set import ContactSet, push_out_speeds
from egs_warp.contact.coupled_step import (
    ACTIVATION_RESIDUAL,
    COULOMB_TOLERANCE,
    MAX_ACTIVATION_ROUNDS,
    PUSH_OUT_FRACTION,
)
from egs_warp.contact.detection import ContactDetector
from egs_warp.contact.device_coulomb import coulomb_forces_batch
from egs_warp.contact.newton import DELASSUS_REGULARIZATION
from egs_warp.contact.newton_convergence import MAX_NEWTON_STEPS, NewtonProgress
from egs_warp.contact.selection import ContactSelector
from egs_warp.fem.batch_problem import BatchMomentumProjection, BatchProblem, apply_inverse
from egs_warp.fem.batched import BatchedRecord, launch_on, nonzero, padded
from egs_warp.kernels.contact import newton_convergence as rule
from egs_warp.precision import real


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

    detector: ContactDetector
    points: ContactSelector
    push_out_cap: float
    """Maximum push-out speed, m/s."""
    penetration_tolerance: float
    """Depth up to which a point is not pushed out, m."""
    tolerance: float
    """Residual divided by dt x weight at which a world has converged."""
    stages: StageTimer = no_timer

    def normal_bias(self, contacts: ContactSet, dt: float) -> torch.Tensor:
        """Return (c, K) m/s, the velocity bias of ``push_out_speeds``."""
        slop = self.penetration_tolerance
        return push_out_speeds(contacts.gaps, dt, self.push_out_cap, PUSH_OUT_FRACTION, slop) * contacts.valid

    def linearize(
        self, problem: BatchProblem, contacts: ContactSet, momentum_projection: BatchMomentumProjection | None = None
    ) -> BatchLinearization:
        """Linearise ``contacts`` with the tangents in the worlds' slots; the momentum projection is computed unless it
        is passed.
        """
        with self.stages("substitute"):
            columns, momentum_projection = apply_inverse(
                problem, problem.dt * contacts.jacobian_transposed(), momentum_projection
            )
        delassus = contacts.contact_velocities(columns)
        diagonal = delassus.diagonal(dim1=1, dim2=2)
        mean = diagonal.sum(dim=1, keepdim=True) / (3 * contacts.counts[:, None]).clamp(min=1)
        diagonal += DELASSUS_REGULARIZATION * mean
        return BatchLinearization(momentum_projection, columns, delassus)

    def solve_coulomb(
        self,
        contacts: ContactSet,
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
            speeds = contacts.contact_velocities(free.flatten(1))
            return coulomb_forces_batch(contacts.counts, response.delassus, speeds, shift, frictions, start)

    def solve(
        self,
        problem: BatchProblem,
        contacts: ContactSet,
        response: BatchLinearization,
        tensions: torch.Tensor,
        frictions: torch.Tensor,
        *,
        velocities: torch.Tensor,
        forces: torch.Tensor,
        start_gaps: tuple[torch.Tensor, torch.Tensor],
    ) -> tuple[ContactSet, BatchResult]:
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
            more = nonzero((added >= 0).any(dim=1) & (done.converged | done.contacts_added))
            if len(more) == 0:
                break
            positions, *gaps_there = (each[todo[more]] for each in (problem.positions, *start_gaps))
            points, counts = self.points.append_in_worlds(active_contacts.gather(more), added[more], ends[more])
            grown = self.detector.contact_sets(points, counts, positions, gaps_there)
            grown = grown.with_capacity(max(grown.capacity, contacts.capacity))
            extra = grown.capacity - contacts.capacity
            forces = padded(done.forces[more], extra)
            # Copy, since the caller's contacts must not change.
            contacts = contacts.with_capacity(grown.capacity).gather(all_worlds)
            result = replace(result, forces=padded(result.forces, extra))
            todo = todo[more]
            contacts.scatter(todo, grown)
            result.forces[todo] = forces
            response = self.linearize(problem.subset(todo), grown, left.momentum_projection.gather(more))
        return contacts, result

    def _points_to_add(self, task: _RoundInputs, velocities: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (c, C), the points of each cell that would be too deep at the end of the step with ``velocities`` (c,
        N, 3), or -1, and (c, P) m, all gaps at the end.
        """
        gaps, _ = self.detector.gaps_of_worlds(task.problem.end_positions(velocities))
        tolerance = self.penetration_tolerance
        return self.points.find_penetrating_in_worlds(task.contacts, (gaps, task.start_gaps), tolerance), gaps

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
            free, size = task.contact_free_residual(velocities, forces)
        state = _NewtonState.begin(velocities, forces, free, self._progress(task.problem, size, last=last))
        for _ in range(MAX_NEWTON_STEPS):
            active = nonzero(state.active)
            if len(active) == 0:
                break
            part, search = task.subset(active), state.subset(active)
            self._newton_step(part, search, response.subset(active))
            search.active.copy_(~search.had(rule.ENDED | rule.FAILED))
            to_check = nonzero(search.had(rule.NEAR_END) & ~search.had(rule.ENDED))
            if len(to_check) > 0:
                self._check_penetration(part.subset(to_check), search, to_check)
            fresh = nonzero(search.had(rule.NEEDS_TANGENT) & search.active)
            if len(fresh) > 0:
                again = part.subset(fresh)
                with self.stages("factor"):
                    factored = again.problem.factor(search.velocities[fresh], again.tensions)
                response.scatter(active[fresh], self.linearize(again.problem, again.contacts))
                search.progress[fresh, rule.TANGENT_IS_CURRENT] = 1.0
                search.is_singular[fresh] = ~factored
                search.active[fresh] = factored
            if search is not state:
                state.scatter(active, search)
        ends = (
            state.velocities,
            state.forces,
            state.had(rule.ENDED),
            state.progress[:, rule.STEPS].long(),
            state.is_singular,
            state.contacts_added,
        )
        return BatchResult(*ends), response

    def _progress(self, problem: BatchProblem, size: torch.Tensor, *, last: bool) -> torch.Tensor:
        """Return (c, ROW_SIZE), the progress at the start of a round with residuals ``size`` (c,)."""
        coulomb_tolerance = COULOMB_TOLERANCE * problem.residual_scale / problem.body.body.mass
        first = NewtonProgress(self.tolerance, -1.0 if last else ACTIVATION_RESIDUAL, coulomb_tolerance)
        progress = torch.as_tensor(first.row, device=size.device).repeat(len(size), 1)
        progress[:, rule.RESIDUAL] = size
        return progress

    def _check_penetration(self, task: _RoundInputs, search: _NewtonState, rows: torch.Tensor) -> None:
        """Find points to add in the worlds of ``task``, which are the rows ``rows`` of ``search``, and end the round of
        worlds in which there are some.
        """
        with self.stages("detect"):
            added, _ = self._points_to_add(task, search.velocities[rows])
        joined = (added >= 0).any(dim=1)
        search.contacts_added[rows], search.active[rows] = joined, ~joined

    def _newton_step(self, task: _RoundInputs, search: _NewtonState, response: BatchLinearization) -> None:
        """Take one Newton step in each world of ``search``, in place."""
        problem = task.problem
        with self.stages("substitute"):
            solved, _ = apply_inverse(
                problem, search.contact_free_residual.flatten(1)[:, :, None], response.momentum_projection
            )
        free_velocities = search.velocities - solved.view_as(search.velocities)
        target_forces, violation = self.solve_coulomb(
            task.contacts, response, free_velocities, task.normal_bias, task.frictions, search.forces
        )
        force_velocities = (response.columns @ target_forces.flatten(1)[:, :, None]).view_as(free_velocities)
        change, force_change = free_velocities + force_velocities - search.velocities, target_forces - search.forces
        waiting, length = torch.arange(len(violation), device=violation.device), 1.0
        while len(waiting) > 0:
            trial = search.velocities[waiting] + length * change[waiting]
            trial_forces = search.forces[waiting] + length * force_change[waiting]
            with self.stages("elasticity"):
                free, size = task.subset(waiting).contact_free_residual(trial, trial_forces)
            progress = search.progress[waiting]
            _judge(progress, size, violation[waiting])
            search.progress[waiting] = progress
            good = has_outcome(progress, rule.ACCEPTED)
            at = waiting[good]
            search.velocities[at], search.forces[at] = trial[good], trial_forces[good]
            search.contact_free_residual[at] = free[good]
            waiting, length = waiting[has_outcome(progress, rule.SHORTEN)], 0.5 * length


def _judge(progress: torch.Tensor, sizes: torch.Tensor, violations: torch.Tensor) -> None:
    """Judge the trials of c worlds (see ``NewtonProgress.judge``); ``progress`` (c, ROW_SIZE) is updated in place."""
    running = torch.empty(len(sizes), dtype=torch.int32, device=sizes.device)
    launch_on(
        sizes.device,
        rule.judge_steps_kernel,
        len(sizes),
        inputs=[torch.inf, (sizes, real), (violations, real), (torch.zeros_like(sizes), real)],
        outputs=[(progress, real), (running, wp.int32)],
    )


def has_outcome(progress: torch.Tensor, bits: int) -> torch.Tensor:
    """Return (c,) bool, True for worlds whose last trial had any of ``bits``; ``progress`` is (c, ROW_SIZE)."""
    return (progress[:, rule.OUTCOME].long() & bits) > 0


@dataclass(frozen=True)
class _RoundInputs(BatchedRecord):
    """Inputs of a round of c worlds."""

    problem: BatchProblem
    contacts: ContactSet
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
        rest = free - problem.dt * self.contacts.nodal_forces(forces)
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
    progress: torch.Tensor
    """(c, ROW_SIZE) progress of the round (``NewtonProgress``)."""
    active: torch.Tensor
    """(c,) bool, True while the world is being solved."""
    is_singular: torch.Tensor
    """(c,) bool, True if a tangent could not be factored."""
    contacts_added: torch.Tensor
    """(c,) bool, True if points must be added before the next step."""

    @classmethod
    def begin(
        cls, velocities: torch.Tensor, forces: torch.Tensor, free: torch.Tensor, progress: torch.Tensor
    ) -> _NewtonState:
        """Create the state at the start of a round, with all worlds active."""
        flags = torch.zeros((3, len(progress)), dtype=torch.bool, device=progress.device)
        flags[0] = True
        return cls(velocities, forces, free, progress, *flags)

    def had(self, bits: int) -> torch.Tensor:
        """Return (c,) bool, True for worlds whose last trial had any of ``bits`` as its outcome."""
        return has_outcome(self.progress, bits)
