"""Steps with contact of many worlds in lockstep on the device (Eq. 4, 8, 9).

Each world follows the algorithm of ``coupled_step``; later iterations skip the worlds that have converged.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import TypeAlias

import torch
import warp as wp

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.coulomb import DELASSUS_REGULARIZATION, coulomb_forces_of_worlds, regularized
from egs_warp.contact.coupled_step import MAX_ACTIVATION_ROUNDS, NewtonOptions
from egs_warp.contact.newton_convergence import MAX_NEWTON_STEPS
from egs_warp.contact.newton_round import run_round
from egs_warp.contact.trial import NewtonDirection, Trial, TrialStep, enqueue_trial
from egs_warp.fem.batch_problem import BatchProblem, apply_inverse
from egs_warp.fem.batched import BatchedRecord, launch_on, nonzero, padded
from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.kernels.contact import newton_convergence as rule
from egs_warp.precision import Vec3, real

StageTimer: TypeAlias = Callable[[str], AbstractContextManager[object]]
"""Timer of the stages of a step: a function that returns a context that measures the stage with the given name."""


@dataclass(frozen=True)
class BatchLinearization(BatchedRecord):
    """Contact linearisations of c worlds (``ContactLinearization``). The factored tangents stay in the slots of the
    ``BatchProblem``."""

    momentum_projection: MomentumProjection[torch.Tensor]
    columns: torch.Tensor
    """(c, 3N, 3K) m/s per newton, dt J^-1 W^T."""
    delassus: torch.Tensor
    """(c, 3K, 3K) m/(N s), the regularised Delassus operator."""


@dataclass(frozen=True)
class BatchInputs(BatchedRecord):
    """Inputs of Newton's method for one step in each of c worlds."""

    problem: BatchProblem
    contacts: ContactSet
    normal_bias: torch.Tensor
    """(c, K) m/s, bias of the normal velocities."""
    tensions: torch.Tensor
    """(c, M) newtons, muscle tensions."""
    frictions: torch.Tensor
    """(c,) Coulomb coefficients."""
    start_gaps: torch.Tensor
    """(c, P) m, gaps of all points at the start of the step."""
    start_faces: torch.Tensor
    """(c, P) int32, index of the nearest contact plane of all points at the start of the step."""

    def trial(self, lengths: torch.Tensor, direction: NewtonDirection) -> Trial:
        """Evaluate the trial at the fractions ``lengths`` (c,) of the Newton steps in ``direction``."""
        problem, trial = self.problem, Trial.empty(direction.velocities, direction.forces)
        step = TrialStep(
            *(problem.dt, problem.inertia_ratio, Vec3(*(float(each) for each in problem.body.gravity))),
            *(problem.node_mass, problem.state.positions, problem.state.velocities, problem.lever_arms),
            *(problem.inverse_inertia, self._enqueue_internal),
        )
        enqueue_trial(step, self.contacts, lengths, direction, trial)
        return trial

    def trial_at(self, velocities: torch.Tensor, forces: torch.Tensor) -> Trial:
        """Evaluate the trial at ``velocities`` (c, N, 3) m/s and contact ``forces`` (c, K, 3) newtons."""
        start = NewtonDirection(velocities, velocities, velocities, forces, forces)
        return self.trial(velocities.new_zeros(len(velocities)), start)

    def _enqueue_internal(self, ends: torch.Tensor, gradient: torch.Tensor, torque: torch.Tensor) -> None:
        self.problem.enqueue_gradient(ends, self.tensions, gradient)
        torch.bmm(self.problem.rotation_modes.mT, gradient.flatten(1)[:, :, None], out=torque[:, :, None])

    def residual_norms(self, trial: Trial) -> torch.Tensor:
        """Return the residual norms (c,) of a ``trial``, divided by dt x weight."""
        return trial.residual.flatten(1).norm(dim=1) / self.problem.residual_scale


@dataclass(frozen=True)
class BatchResult(BatchedRecord):
    """``CoupledResult`` of c worlds."""

    velocities: torch.Tensor
    """(c, N, 3) m/s, at the end of the step."""
    forces: torch.Tensor
    """(c, K, 3) newtons, contact forces."""
    converged: torch.Tensor
    """(c,) bool."""
    iterations: torch.Tensor
    """(c,) int64, number of Newton steps."""
    is_singular: torch.Tensor
    """(c,) bool, True if a tangent could not be factored (``UnsolvableStepError``)."""
    contacts_added: torch.Tensor
    """(c,) bool, True if the round ended because points must be added to the contacts."""


@dataclass(frozen=True)
class BatchSolver(NewtonOptions):
    """``CoupledSolver`` for many worlds."""

    stages: StageTimer = nullcontext
    """Timer of the stages of a step."""

    def linearize(
        self,
        problem: BatchProblem,
        contacts: ContactSet,
        momentum_projection: MomentumProjection[torch.Tensor] | None = None,
    ) -> BatchLinearization:
        """Linearise ``contacts`` with the tangents in the worlds' slots of ``problem``. The momentum projection is
        computed unless it is passed."""
        with self.stages("substitute"):
            impulses = problem.dt * contacts.jacobian_transposed()
            columns, momentum_projection = apply_inverse(problem, impulses, momentum_projection)
        delassus = regularized(contacts.contact_velocities(columns), DELASSUS_REGULARIZATION, contacts.counts)
        return BatchLinearization(momentum_projection, columns, delassus)

    def newton_step(
        self,
        inputs: BatchInputs,
        response: BatchLinearization,
        velocities: torch.Tensor,
        residual: torch.Tensor,
        forces: torch.Tensor,
    ) -> tuple[NewtonDirection, torch.Tensor]:
        """Compute the full Newton step of c worlds. Its contact forces satisfy Coulomb's law in the linearised contact
        model ``response``.

        Args:
            inputs: inputs of the worlds.
            response: linearisation of their contacts.
            velocities: (c, N, 3) m/s, at the start of the Newton step.
            residual: (c, N, 3) N s, residual at ``velocities`` without contact forces.
            forces: (c, K, 3) newtons, initial forces of the Coulomb solve.

        Returns:
            The Newton step, and (c,) m/s, the violation of Coulomb's law by its forces.
        """
        contacts = inputs.contacts
        with self.stages("substitute"):
            solved, _ = apply_inverse(inputs.problem, residual.flatten(1)[:, :, None], response.momentum_projection)
        free = velocities - solved.view_as(velocities)
        with self.stages("coulomb"):
            speeds = contacts.contact_velocities(free.flatten(1))
            operands = response.delassus, speeds, inputs.normal_bias, inputs.frictions, forces
            target_forces, violation = coulomb_forces_of_worlds(contacts.counts, *operands)
        force_velocities = (response.columns @ target_forces.flatten(1)[:, :, None]).view_as(free)
        return NewtonDirection(velocities, free, force_velocities, forces, target_forces), violation

    def solve(
        self, inputs: BatchInputs, response: BatchLinearization, *, velocities: torch.Tensor, forces: torch.Tensor
    ) -> tuple[ContactSet, BatchResult]:
        """Solve the steps with Newton's method.

        Args:
            inputs: the steps of c worlds, with their initial contacts.
            response: linearisation of these contacts.
            velocities: (c, N, 3) m/s, initial velocities.
            forces: (c, K, 3) newtons, initial forces.

        Returns:
            The contacts at the end, and the result.
        """
        problem, contacts, count = inputs.problem, inputs.contacts, len(velocities)
        flags = torch.zeros((3, count), dtype=torch.bool, device=velocities.device)
        iterations = torch.zeros(count, dtype=torch.int64, device=velocities.device)
        result = BatchResult(velocities.clone(), forces.clone(), flags[0], iterations, *flags[1:])
        todo = all_worlds = torch.arange(count, device=velocities.device)
        for number in range(MAX_ACTIVATION_ROUNDS):
            active = contacts.subset(todo)
            bias = self.normal_bias(active, problem.dt)
            part = replace(inputs.subset(todo), contacts=active, normal_bias=bias)
            last = number == MAX_ACTIVATION_ROUNDS - 1
            newton = _BatchRound(self, part, response, result.velocities[todo], result.forces[todo], last=last)
            run_round(newton)
            done = newton.result()
            done = replace(done, iterations=done.iterations + result.iterations[todo])
            result.scatter(todo, done)
            if last:
                break
            with self.stages("detect"):
                added, ends = self.points_to_add(part, done.velocities)
            more = nonzero((added >= 0).any(dim=1) & (done.converged | done.contacts_added))
            if len(more) == 0:
                break
            points, counts = self.points.append_in_worlds(active.gather(more), added[more], ends[more])
            grown = part.gather(more)
            start = grown.start_gaps, grown.start_faces
            grown = self.detector.contact_sets(points, counts, grown.problem.state.positions, start)
            grown = grown.with_capacity(max(grown.capacity, contacts.capacity))
            extra = grown.capacity - contacts.capacity
            # The contacts are copied, because those of the caller must not change.
            contacts = contacts.with_capacity(grown.capacity).gather(all_worlds)
            result = replace(result, forces=padded(result.forces, extra))
            todo = todo[more]
            contacts.scatter(todo, grown)
            result.forces[todo] = padded(done.forces[more], extra)
            response = self.linearize(problem.subset(todo), grown, newton.response.momentum_projection.gather(more))
        return contacts, result

    def points_to_add(self, inputs: BatchInputs, velocities: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Find the points that must be added to the contacts.

        Args:
            inputs: inputs of c worlds.
            velocities: (c, N, 3) m/s, end velocities.

        Returns:
            (c, C), for each cell the deepest point that would be too deep at the end of the step, or -1; and (c, P) m,
            the gaps of all points at the end of the step.
        """
        gaps, _ = self.detector.gaps_of_worlds(inputs.problem.end_positions(velocities))
        tolerance = self.penetration_tolerance
        return self.points.find_penetrating_in_worlds(inputs.contacts, (gaps, inputs.start_gaps), tolerance), gaps


class _BatchRound:
    """Implementation of ``NewtonWorlds`` for c worlds; a set of worlds is a tensor of ascending indices."""

    def __init__(
        self,
        solver: BatchSolver,
        inputs: BatchInputs,
        response: BatchLinearization,
        velocities: torch.Tensor,
        forces: torch.Tensor,
        *,
        last: bool,
    ) -> None:
        """Start a round; the ``last`` round adds no points. ``velocities`` (c, N, 3) m/s, ``forces`` (c, K, 3) newtons
        and the linearisation ``response`` are updated in place."""
        self._solver, self._inputs, self.response = solver, inputs, response
        self._velocities, self._forces = velocities, forces
        with solver.stages("elasticity"):
            start = inputs.trial_at(velocities, forces)
        row = solver.progress(inputs.problem, last=last).row
        self._progress = torch.as_tensor(row, device=forces.device).repeat(len(forces), 1)
        self._progress[:, rule.RESIDUAL] = inputs.residual_norms(start)
        self._free_residual = start.free_residual
        flags = torch.zeros((3, len(forces)), dtype=torch.bool, device=forces.device)
        self._is_active, self._is_singular, self._contacts_added = ~flags[0], *flags[1:]
        likes = velocities, velocities, velocities, forces, forces
        self._direction = NewtonDirection(*map(torch.empty_like, likes))
        self._violation = torch.empty_like(self._progress[:, 0])

    def result(self) -> BatchResult:
        """Return the result of the round."""
        ended, steps = has_outcome(self._progress, rule.ENDED), self._progress[:, rule.STEPS].long()
        return BatchResult(self._velocities, self._forces, ended, steps, self._is_singular, self._contacts_added)

    def running(self) -> torch.Tensor:
        return nonzero(self._is_active & (self._progress[:, rule.STEPS] < MAX_NEWTON_STEPS))

    def active(self, bits: int) -> torch.Tensor:
        return nonzero(self._is_active & has_outcome(self._progress, bits))

    def take_step(self, worlds: torch.Tensor) -> None:
        part = self._inputs.subset(worlds)
        start = self._velocities[worlds], self._free_residual[worlds], self._forces[worlds]
        direction, violation = self._solver.newton_step(part, self.response.subset(worlds), *start)
        self._direction.scatter(worlds, direction)
        self._violation[worlds] = violation
        self._try(worlds, part)

    def halve_step(self, worlds: torch.Tensor) -> None:
        self._try(worlds, self._inputs.subset(worlds))

    def _try(self, worlds: torch.Tensor, part: BatchInputs) -> None:
        progress = self._progress[worlds]
        with self._solver.stages("elasticity"):
            trial = part.trial(progress[:, rule.LENGTH].contiguous(), self._direction.gather(worlds))
        _judge(progress, part.residual_norms(trial), self._violation[worlds])
        self._progress[worlds] = progress
        good = has_outcome(progress, rule.ACCEPTED)
        at = worlds[good]
        self._velocities[at], self._forces[at] = trial.velocities[good], trial.forces[good]
        self._free_residual[at] = trial.free_residual[good]

    def stop(self, bits: int) -> None:
        self._is_active &= ~has_outcome(self._progress, bits)

    def check_penetration(self, worlds: torch.Tensor) -> None:
        with self._solver.stages("detect"):
            added, _ = self._solver.points_to_add(self._inputs.subset(worlds), self._velocities[worlds])
        self._contacts_added[worlds] = (added >= 0).any(dim=1)
        self._is_active &= ~self._contacts_added

    def renew_tangent(self, worlds: torch.Tensor) -> None:
        part = self._inputs.subset(worlds)
        with self._solver.stages("factor"):
            factored = part.problem.factor(self._velocities[worlds], part.tensions)
        self.response.scatter(worlds, self._solver.linearize(part.problem, part.contacts))
        self._progress[worlds, rule.TANGENT_IS_CURRENT] = 1.0
        self._is_singular[worlds], self._is_active[worlds] = ~factored, factored


def _judge(progress: torch.Tensor, sizes: torch.Tensor, violations: torch.Tensor) -> None:
    """Judge the trials of c worlds (see ``NewtonProgress.judge``); ``progress`` (c, ROW_SIZE) is updated in place."""
    running = torch.empty(len(sizes), dtype=torch.int32, device=sizes.device)
    launch_on(
        sizes,
        rule.judge_steps_kernel,
        len(sizes),
        inputs=[torch.inf, (sizes, real), (violations, real), (torch.zeros_like(sizes), real)],
        outputs=[(progress, real), (running, wp.int32)],
    )


def has_outcome(progress: torch.Tensor, bits: int) -> torch.Tensor:
    """Return (c,) bool, True for worlds whose last trial had any of ``bits``; ``progress`` is (c, ROW_SIZE)."""
    return (progress[:, rule.OUTCOME].long() & bits) > 0
