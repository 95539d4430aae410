"""Plans of many worlds of one body on a device: linear step, QP, search and expected end (Eq. 7, 8, 9, 12, 13).

The plan of each world is that of ``StepPlanner.plan`` with the strategy ``modes`` and the QP solver ``admm``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.contact.batch_step import BatchInputs, BatchLinearization, StageTimer
from egs_warp.errors import UserError
from egs_warp.fem.batch_problem import BatchBody, BatchProblem, apply_inverse
from egs_warp.fem.batched import BatchedRecord, as_warp
from egs_warp.fem.linear_solver import FactorStatus, energy_moves
from egs_warp.fem.panel_cholesky import PanelCholesky
from egs_warp.kernels.locomotion.active_set import NUMERICAL_FAILURE
from egs_warp.locomotion.batch_objectives import BatchObjectives
from egs_warp.locomotion.batch_search import BatchModeSearch, BatchProgram, points_of
from egs_warp.locomotion.planner import REGULARIZATION, StepPlanner
from egs_warp.locomotion.step_cost import EFFORT_HORIZON
from egs_warp.locomotion.step_tensors import add_activation_cost, add_effort, synergy_impulses, write_linear_step
from egs_warp.locomotion.strategies import Strategy
from egs_warp.precision import Mat33, Vec3, real


@dataclass(frozen=True)
class BatchPrediction(BatchedRecord):
    """Predicted end of a step of c worlds, and the contact linearisation at this end (``PredictedStep``)."""

    response: BatchLinearization
    activations: torch.Tensor
    """(c, M) m, muscle activations under which the end was predicted."""
    velocities: torch.Tensor
    """(c, N, 3) m/s, at the end of the step."""
    forces: torch.Tensor
    """(c, K, 3) N, contact forces in the axes of each contact."""


@dataclass(frozen=True)
class BatchPlan(BatchedRecord):
    """``Plan`` of c worlds."""

    activations: torch.Tensor
    """(c, M) m, planned activations."""
    velocities: torch.Tensor
    """(c, N, 3) m/s, expected velocities at the end of the step."""
    forces: torch.Tensor
    """(c, K, 3) N, expected contact forces."""
    qp_count: torch.Tensor
    """(c,) int64, number of QPs that were solved."""
    qp_infeasible: torch.Tensor
    """(c,) int64, number of QPs without a solution."""
    failed: torch.Tensor
    """(c,) bool, True where the effort matrix could not be factored or the QP is not finite."""


class BatchPlanner:
    """Planner of the steps of many worlds of one body."""

    def __init__(self, planner: StepPlanner, common: BatchBody, count: int, stages: StageTimer) -> None:
        """Prepare the planner.

        Args:
            planner: planner of one world of the same body; its friction is not used.
            common: shared data of the worlds.
            count: maximum number of worlds.
            stages: timer of the stages of a step.

        Raises:
            UserError: The strategy of ``planner`` is not ``modes``.
        """
        if Strategy(planner.settings.strategy) is not Strategy.MODES:
            strategy = Strategy(planner.settings.strategy).value
            raise UserError(f"strategy {strategy!r} does not run in batches; set worlds=0, or use the strategy modes")
        self._planner, self._common, self._stages = planner, common, stages
        muscles, body = planner.muscles, planner.body
        self._members, self._bounds, self._work_factors = map(
            self._tensor,
            (planner.synergies.members.toarray(), muscles.bounds, muscles.max_forces / (body.weight * body.height)),
        )
        self._max_forces = self._tensor(muscles.max_forces)
        self._means = self._members / self._members.sum(dim=0)
        self._groups = torch.as_tensor(planner.synergies.group_from_muscle, device=common.device).long()
        factors = common.factors
        self._chunk = min(count, factors.chunk)
        self._horizon = PanelCholesky(
            *(body.assembly.upper_pattern, self._chunk, common.device),
            panel=factors.panel,
            chunk_bytes=8 * self._chunk * factors.size**2,
        )
        m, limit = self._members.shape[1], planner.settings.qp_limit
        self._search = BatchModeSearch(m, count, common.device, qp_limit=limit, weight=body.weight)

    def _tensor(self, values: Any) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values, dtype=np.float64), device=self._common.device)

    def plan(
        self, inputs: BatchInputs, predicted: BatchPrediction, last: torch.Tensor, objectives: BatchObjectives
    ) -> BatchPlan:
        """Plan the activations of c worlds; see ``StepPlanner.plan``.

        Args:
            inputs: the steps and their contacts.
            predicted: predicted end of each step.
            last: (c, M) m, activations of the previous step.
            objectives: objectives of each world.
        """
        body, contacts, m = self._planner.body, inputs.contacts, self._members.shape[1]
        size = m + 3 * contacts.capacity + 1
        velocities = last.new_empty(len(last), 3 * len(self._common.mass), size)
        form = last.new_empty(len(last), size, size)
        is_definite = torch.ones(len(last), dtype=torch.bool, device=last.device)
        with self._stages("program"):
            for first in range(0, len(last), self._chunk):
                part = torch.arange(first, min(first + self._chunk, len(last)), device=last.device)
                terms = inputs.subset(part), predicted.subset(part), objectives.subset(part)
                at = slice(first, first + len(part))
                is_definite[at] = self._write_program(*terms, last[at], velocities[at], form[at])
            previous, start = ((each / self._bounds) @ self._means for each in (last, predicted.activations))
            bounds = *self._planner.activation_bounds(previous, inputs.problem.dt), start
            program = BatchProgram.pack(
                form,
                torch.stack(bounds, dim=1),
                speed=body.speed_unit,
                weight=body.weight,
                qp_limit=self._planner.settings.qp_limit,
                contact_velocities=contacts.contact_velocities(velocities),
                delassus=predicted.response.delassus,
                counts=contacts.counts,
                normal_bias=inputs.normal_bias,
                frictions=inputs.frictions,
                forces=predicted.forces,
            )
        with self._stages("search"):
            result = self._search.search(program)
        with self._stages("program"):
            return self._build_plan(inputs, predicted, last, velocities, program, result, ~is_definite)

    def _write_program(
        self,
        inputs: BatchInputs,
        predicted: BatchPrediction,
        objectives: BatchObjectives,
        last: torch.Tensor,
        velocities: torch.Tensor,
        form: torch.Tensor,
    ) -> torch.Tensor:
        """Write the linear step and the quadratic form of the cost of some worlds.

        Args:
            inputs: the steps and their contacts.
            predicted: predicted end of each step.
            objectives: objectives of each world.
            last: (c, M) m, activations of the previous step.
            velocities: (c, 3N, k + 1) m/s, output, ``LinearStep.velocities``.
            form: (c, k + 1, k + 1), output, quadratic form of the cost in (x, 1).

        Returns:
            (c,) bool, True where the effort matrix is positive definite.
        """
        problem, planner, common = inputs.problem, self._planner, self._common
        body, ends = planner.body, problem.end_positions(predicted.velocities)
        pulls = wp.to_torch(
            common.segments.enqueue_segment_forces(
                as_warp(self._max_forces.expand(len(ends), -1).contiguous(), real), as_warp(ends, Vec3)
            )
        )[: len(ends)]
        impulses = synergy_impulses(common.difference_rows, self._members, pulls, problem.dt)
        free = problem.residual(predicted.velocities, None).flatten(1)
        solved, _ = apply_inverse(
            problem, torch.cat([impulses, free[:, :, None]], dim=2), predicted.response.momentum_projection
        )
        columns = predicted.response.columns
        write_linear_step(solved, columns, predicted.velocities.flatten(1), body.weight, velocities)
        form[:] = objectives.form(problem, inputs.contacts, velocities, self._members.shape[1])
        is_definite = self._add_effort(problem, predicted.velocities, velocities, form)
        previous = (last / self._bounds) @ self._means
        size, change = map(self._tensor, planner.activation_weights(problem.dt))
        shortenings = self._lengths(problem.state.positions) - self._lengths(ends)
        add_activation_cost(
            form,
            2.0 * (size + change) + REGULARIZATION,
            -2.0 * change * previous,
            2.0 * (previous.square() @ change),
            (self._work_factors * shortenings).square() @ self._members,
        )
        return is_definite

    def _add_effort(
        self, problem: BatchProblem, predicted: torch.Tensor, velocities: torch.Tensor, form: torch.Tensor
    ) -> torch.Tensor:
        """Add the elastic effort (``EffortModel``, ``effort_cost``) to ``form``. ``predicted`` (c, N, 3) m/s are the
        predicted end velocities; the other arguments and the result are those of ``_write_program``."""
        body, elements, count = self._planner.body, self._common.elements, len(predicted)
        duration = max(EFFORT_HORIZON * body.time_unit, problem.dt)
        ends, gradient = problem.end_positions(predicted), torch.empty_like(predicted)
        state = as_warp(ends, Vec3), as_warp(problem.start_gradients, Mat33), duration
        energies = wp.to_torch(elements.enqueue_energies(*state)[0])[:count].sum(dim=1)
        elements.enqueue_gradient(*state, None, as_warp(gradient, Vec3))
        entries = wp.to_torch(elements.enqueue_entries(*state, factor=1.0, projected=True))[:count]
        slots = torch.arange(count, device=form.device)
        self._horizon.factor(duration**2 * entries, problem.coordinate_mass, slots)
        moves = energy_moves(
            lambda right: self._horizon.solve(right, slots),
            *(problem.coordinate_mass, velocities, problem.dt, duration - problem.dt),
            problem.dt * predicted.flatten(1),
        )
        quadratic = moves.mT @ (self._horizon.dense(entries) @ moves)
        add_effort(form, quadratic, (gradient.flatten(1)[:, None] @ moves)[:, 0], energies, body)
        return self._horizon.status[slots] == FactorStatus.DEFINITE

    def _lengths(self, positions: torch.Tensor) -> torch.Tensor:
        """Return (c, M) m, lengths of the segments at node ``positions`` (c, N, 3)."""
        return (self._common.difference_rows @ positions).norm(dim=2)

    def _build_plan(
        self,
        inputs: BatchInputs,
        predicted: BatchPrediction,
        last: torch.Tensor,
        velocities: torch.Tensor,
        program: BatchProgram,
        result: torch.Tensor,
        failed: torch.Tensor,
    ) -> BatchPlan:
        """Build the plans from the packed results of the search.

        The contact forces are computed again from Coulomb's law for the activations of the result. If an element is
        inverted at the expected end, the predicted velocities are used instead. If no QP of a world has a solution, its
        plan consists of the previous activations and the predicted end.
        """
        status, counts, infeasible, _, has_point = result[:, :5].T
        weight, m = self._planner.body.weight, self._members.shape[1]
        x = points_of(result, program.counts, m, inputs.contacts.capacity)
        forces = program.contact_forces(x[:, :m], (weight * x[:, m:-1]).reshape_as(predicted.forces))
        x[:, m:-1] = forces.flatten(1) / weight
        ends = (velocities @ x[:, :, None]).view_as(predicted.velocities)
        is_planned = (has_point == 1.0)[:, None]
        is_used = is_planned[:, 0] & inputs.problem.is_inversion_free(ends)
        return BatchPlan(
            activations=torch.where(is_planned, x[:, self._groups] * self._bounds, last),
            velocities=torch.where(is_used[:, None, None], ends, predicted.velocities),
            forces=torch.where(is_planned[:, :, None], forces, predicted.forces),
            qp_count=counts.long(),
            qp_infeasible=infeasible.long(),
            failed=failed | (status == NUMERICAL_FAILURE),
        )
