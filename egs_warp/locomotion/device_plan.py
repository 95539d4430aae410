"""Plan of a step on a GPU: prediction, QP, search and start of the solve, with one read-back (Eq. 4, 7, 8, 9, 12, 13).

In the nominal case the device planner does the work of ``LocomotionStepper.predict`` and ``StepPlanner.plan``, as CUDA
graphs of PyTorch and Warp operations. In other cases it returns None, and the host plans the step. The kernels are in
``egs_warp.kernels.locomotion.step_program``, ``mode_search`` and ``relaxed_contact``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
import warp as wp

from egs_warp.contact.coulomb import FAILURE_TOLERANCE
from egs_warp.contact.device_newton import DeviceContactLinearization, DeviceContactLinearizer
from egs_warp.contact.device_newton_workspace import FROM_BASE, FROM_START, FROM_TRIAL, NewtonWorkspace
from egs_warp.contact.device_step import vectors
from egs_warp.contact.newton import ContactLinearization
from egs_warp.contact.newton_convergence import NewtonProgress
from egs_warp.fem.batched import as_warp, as_world
from egs_warp.fem.cuda_graphs import GraphCache, PinnedUpload
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.fem.tiled_cholesky import TiledCholesky
from egs_warp.kernels.locomotion import step_program as kernels
from egs_warp.kernels.locomotion.active_set import OPTIMUM_FOUND
from egs_warp.kernels.locomotion.mode_search import HEADER_SIZE
from egs_warp.locomotion.contact_modes import ModeSearchResult
from egs_warp.locomotion.device_linear_step import DeviceLinearSteps, StagingBuffer, objective_form
from egs_warp.locomotion.device_restart import DeviceRestart
from egs_warp.locomotion.device_search import ModeSearchWorkspace
from egs_warp.locomotion.linear_step import PREDICTION_ITERATIONS, PredictedStep, StepInputs, torques_of
from egs_warp.locomotion.objectives import AnyObjective, Objective
from egs_warp.locomotion.planner import REGULARIZATION, Plan, StepPlanner
from egs_warp.locomotion.step_cost import EFFORT_HORIZON
from egs_warp.locomotion.step_tensors import add_activation_cost, add_effort
from egs_warp.locomotion.strategies import RESTART_COST, needs_restart
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.precision import Vec3, real

PARALLEL_RESTART_COST = 0.5 * RESTART_COST
"""Objective value of a step from which on a restart runs concurrently with the first search of the next step."""


class DevicePlanner:
    """Planner of the steps of one body on a GPU, for the strategy ``modes``.

    Args:
        planner: planner on the host, with the same settings.
        owner: builder of contact linearisations on the device.
        progress: function that returns the progress of Newton's method at the start of a step's first round.
    """

    def __init__(
        self,
        planner: StepPlanner,
        owner: DeviceContactLinearizer,
        progress: Callable[[StepProblem], NewtonProgress],
    ) -> None:
        assert isinstance(planner.factors, TiledCholesky)
        self.planner, self.owner, self.factors, self.progress = planner, owner, planner.factors, progress
        self.linear = DeviceLinearSteps(owner, planner.muscles, planner.synergies)
        self.objective_staging, self.other_staging = StagingBuffer(owner.stream), StagingBuffer(owner.stream)
        muscles, body = planner.muscles, planner.body
        self.members = owner.tensor(planner.synergies.members.toarray())
        self.group_from_muscle = torch.as_tensor(
            planner.synergies.group_from_muscle, device=owner.factors.device
        ).long()
        self.tensions = owner.tensor(muscles.bounds), owner.tensor(muscles.stiffness)
        self.work_factors = owner.tensor(muscles.max_forces / (body.weight * body.height))
        self.masses = np.repeat(body.node_mass, 3)
        self._workspaces: dict[int, PlanWorkspace] = {}

    def start(self, start: StepInputs) -> None:
        """Start the prediction and the linear step, the part of ``plan`` that does not depend on the objectives,
        asynchronously."""
        self._workspace_for(start).start(start)

    def plan(self, start: StepInputs, objectives: Sequence[AnyObjective]) -> tuple[ContactLinearization, Plan] | None:
        """Plan a step, and start its solve on the device.

        Args:
            start: inputs of the step.
            objectives: objectives of the motion.

        Returns:
            The contact linearisation at the predicted end, and the plan. None if a matrix is not positive definite, an
            element is inverted, or the Coulomb solve failed.
        """
        if self.owner.predicted_start is not start:
            self.start(start)
        return self._workspace_for(start).plan(start, objectives)

    def replan(
        self, predicted: PredictedStep, last: np.ndarray, objectives: Sequence[AnyObjective], friction: float
    ) -> Plan | None:
        """Plan again about the end of a solve.

        Args:
            predicted: end of the solve and its linearisation.
            last: (M,) m, activations of the previous step.
            objectives: objectives of the motion.
            friction: Coulomb coefficient.

        Returns:
            The plan; None in the same cases as ``plan``, or if the device no longer holds the end of the solve.
        """
        response = predicted.linearization
        assert isinstance(response, DeviceContactLinearization)
        for iterate, base in (
            (response.workspace.base_iterate, FROM_BASE),
            (response.workspace.trial_iterate, FROM_TRIAL),
        ):
            if self.owner.current is response and iterate is not None and iterate.velocities is predicted.velocities:
                start = StepInputs.from_prediction(predicted, friction, last)
                return self._workspace_for(start).replan(start, predicted, objectives, base)
        return None

    def _workspace_for(self, start: StepInputs) -> PlanWorkspace:
        """Return the workspace for the contacts of ``start``."""
        newton = self.owner.workspace_for(start.contacts)
        if newton.capacity not in self._workspaces:
            self._workspaces[newton.capacity] = PlanWorkspace(self, newton)
        return self._workspaces[newton.capacity]


class PlanWorkspace:
    """Buffers and CUDA graphs of plans for one contact capacity."""

    def __init__(self, owner: DevicePlanner, newton: NewtonWorkspace) -> None:
        body, zeros = owner.owner, owner.owner.zeros
        self.owner, self.body, self.newton = owner, body, newton
        self.m, size, capacity = owner.planner.synergies.count, len(newton.end_positions), newton.capacity
        m, width = self.m, 3 * capacity
        parts = [3 * m, m, m, 1, width, body.segment_count]
        self._input = PinnedUpload(body.stream, sum(parts))
        bounds, self._diagonal, self._linear_terms, self._constant, self._known, self._tensions = (
            self._input.device.split(parts)
        )
        self._bounds = bounds.view(3, m)
        # Trial inputs that evaluate the iterate in a slot, or make a Newton step from the last trial.
        self._evaluate_input = {
            base: body.tensor(np.array([0.0, 0.0, base])) for base in (FROM_BASE, FROM_TRIAL, FROM_START)
        }
        self._newton_input = body.tensor(np.array([1.0, 1.0, FROM_TRIAL]))
        self._velocities, self._contact_velocities = zeros(size, m + width + 1), zeros(width, m + width + 1)
        self._form = zeros(m + width + 1, m + width + 1)
        self._entries, self._gradient, self._energy = zeros(len(owner.factors.places)), zeros(size), zeros(1)
        # The read-back is one array: checks of the prediction and of the search, result of the search, contact forces,
        # and end of the step.
        checks = [4, PREDICTION_ITERATIONS + 2, PREDICTION_ITERATIONS, 3]
        lengths = [*checks, HEADER_SIZE + m + width, width, width, width, size]
        self._readback, self._host_readback = zeros(sum(lengths)), body.stream.pinned(sum(lengths))
        self._parts = np.split(self._host_readback.numpy(), np.cumsum(lengths)[:-1])
        parts_on_device = self._readback.split(lengths)
        factor_flags, self._residual_norms, self._coulomb_violations, self._plan_check, *results = parts_on_device
        self._search_result, self._predicted_forces, self._forces, *ends = results
        self._end_contact_velocities, self._end_velocities = ends
        self._factor_flags = factor_flags.view(2, 2)
        self._x, self._uploaded_point = zeros(m + width + 1), PinnedUpload(body.stream, m + width + 1)
        alias = str(body.factors.device)
        self._search = ModeSearchWorkspace(m, capacity, alias, restart_cost=RESTART_COST)
        limit = owner.planner.settings.qp_limit
        self._restart = DeviceRestart(
            body, newton, self._search, self._contact_velocities, self._predicted_forces, qp_limit=limit
        )
        self._objective, self._is_restart_parallel = 0.0, False
        # (1,) int32, 1 if the solve starts from the end of the first search.
        self._starts_solve = torch.zeros(1, dtype=torch.int32, device=body.factors.device)
        self._graphs, self._plan_event = GraphCache(body.stream), None

    def start(self, start: StepInputs) -> None:
        """Start prediction and linear step, asynchronously; see ``DevicePlanner.start``."""
        body, newton, problem = self.body, self.newton, start.problem
        if body.predicted_start is not None:
            # The upload for another plan may still be in flight, so block until it is done.
            body.stream.wait()
        body.current = None
        newton.set_iterates()
        with body.stream:
            body.load_start(problem.state, problem.dt)
            newton.set_contacts(start.contacts)
            body.factors.upload_diagonal(problem.inertia_ratio * self.owner.masses)
            self._upload_inputs(start, start.activations)
            self._run(self._enqueue_prediction, problem.dt, problem.inertia_ratio)
        body.factors.mark_started()
        self._start_linear_step(start, FROM_TRIAL)
        body.predicted_start = start

    def plan(self, start: StepInputs, objectives: Sequence[AnyObjective]) -> tuple[ContactLinearization, Plan] | None:
        """Plan the step for which ``start`` was called; see ``DevicePlanner.plan``."""
        body, newton, problem = self.body, self.newton, start.problem
        body.predicted_start = None
        self._start_search(start, objectives)
        factor_flags, residual_norms, coulomb_violation, *_ = self._parts
        if not (
            factor_flags.min() > 0.0
            and np.isfinite(residual_norms).all()
            and coulomb_violation.max() <= FAILURE_TOLERANCE
        ):
            return None
        tangent = Tangent(problem, body.factors)
        body.current = DeviceContactLinearization.from_workspace(tangent, start.contacts, body, newton)
        plan = self._build_plan(start, body.current)
        return None if plan is None else (body.current, plan)

    def replan(
        self, start: StepInputs, predicted: PredictedStep, objectives: Sequence[AnyObjective], base: float
    ) -> Plan | None:
        """Plan again about ``predicted``, which is stored in the slot ``base``; see ``DevicePlanner.replan``."""
        with self.body.stream:
            self._upload_inputs(start, predicted.activations)
            self._input.send()
            self.newton.target_forces.copy_(self._known)
        self.body.predicted_start = None
        self.newton.set_iterates()
        self._start_linear_step(start, base)
        self._start_search(start, objectives)
        assert isinstance(predicted.linearization, DeviceContactLinearization)
        return self._build_plan(start, predicted.linearization)

    def _start_linear_step(self, start: StepInputs, base: float) -> None:
        """Start computing the linear step about the iterate in the slot ``base``, asynchronously."""
        dt, ratio = start.problem.dt, start.problem.inertia_ratio
        with self.body.stream:
            self._run(self._enqueue_linear, dt, ratio, self._horizon(dt), base)
        self.owner.factors.mark_started()

    def _start_search(self, start: StepInputs, objectives: Sequence[AnyObjective]) -> None:
        """Build the QP about the linear step and run the mode search on it. If the result is accepted, the solve starts
        on the device at once."""
        dt, ratio = start.problem.dt, start.problem.inertia_ratio
        with self.body.stream:
            self._write_objectives(start, objectives)
            self._is_restart_parallel = start.contacts.count > 0 and self._objective >= PARALLEL_RESTART_COST
            self._run(self._enqueue_search, dt, ratio, self._horizon(dt), self._is_restart_parallel)
        self._start_solve(start, self._starts_solve)

    def _horizon(self, dt: float) -> float:
        """Return the time horizon of ``EffortModel``, s."""
        return max(EFFORT_HORIZON * self.body.body.time_unit, dt)

    def _build_plan(self, start: StepInputs, response: DeviceContactLinearization) -> Plan | None:
        """Build the plan from the result of the search; if its objective is high, from the better of this result and
        the result of a restart. Return None if a check failed."""
        *_, (definite, residual_norm, coulomb_violation), search_result, _, forces, contact_velocities, velocities = (
            self._parts
        )
        status, count, infeasible, objective, has_point = search_result[:5]
        if not definite > 0.0:
            return None
        contacts = start.contacts.count
        self._objective = float(objective)
        if status != OPTIMUM_FOUND or has_point != 1.0 or needs_restart(objective, contacts):
            x = search_result[HEADER_SIZE : HEADER_SIZE + self.m + 3 * contacts].copy() if has_point == 1.0 else None
            first = ModeSearchResult(x, objective, int(count), int(infeasible))
            if status != OPTIMUM_FOUND:
                first = self._restart.search_on_host(self._search)
            final = self._restart.improve(first, contacts, self._run, is_done=self._is_restart_parallel)
            if final.x is None:
                return None
            count, infeasible = final.qp_count, final.infeasible
            # The device already holds the end of the first search.
            if final.x is not x:
                self._replace_end(final.x, start)
                *_, (_, residual_norm, coulomb_violation), _, _, forces, contact_velocities, velocities = self._parts
                search_result[HEADER_SIZE : HEADER_SIZE + self.m] = final.x[: self.m]
        if coulomb_violation > FAILURE_TOLERANCE or not np.isfinite(residual_norm):
            return None
        planner, newton = self.owner.planner, self.newton
        activations = (
            planner.synergies.members @ search_result[HEADER_SIZE : HEADER_SIZE + self.m]
        ) * planner.muscles.bounds
        tension = MuscleEnergy.of(planner.muscles, activations)
        forces = forces[: 3 * contacts].reshape(-1, 3).copy()
        end = response.iterate(tension, forces, float(residual_norm), contact_velocities, velocities, None)
        newton.set_iterates(pending=end)
        return Plan(activations, end.velocities, end.forces, int(count), int(infeasible))

    def _replace_end(self, x: np.ndarray, start: StepInputs) -> None:
        """Replace the expected end of the step by the end for ``x`` (m + 3n,), the result of another search, and start
        the solve from the new end."""
        body, problem = self.body, start.problem
        with body.stream:
            self._uploaded_point.set(x, np.zeros(len(self._x) - 1 - len(x)), np.ones(1))
            self._x.copy_(self._uploaded_point.device)
            self._run(self._enqueue_end, problem.dt, problem.inertia_ratio)
        self._start_solve(start)

    def _start_solve(self, start: StepInputs, enabled: torch.Tensor | None = None) -> None:
        """Queue the solve, and block until the plan, which was queued before it, is finished. If ``enabled`` (1,) int32
        on the device is 0, the solve is skipped."""
        with self.body.stream:
            self._plan_event = self.body.stream.record_event(self._plan_event)
        progress = self.owner.progress(start.problem)
        self.newton.start_newton(
            start.problem, start.normal_bias, start.friction, progress, base=FROM_TRIAL, enabled=enabled
        )
        if self._plan_event is not None:
            self._plan_event.synchronize()

    def _run(self, work: Callable[..., None], *arguments: float) -> None:
        """Run ``work`` as a CUDA graph, which is recorded under its name and its arguments."""
        self._graphs.run((work.__name__, *arguments), lambda: work(*arguments))

    def _upload_inputs(self, start: StepInputs, activations: np.ndarray) -> None:
        """Write all data that are known at the start of a step to the uploads. The search begins at ``activations``
        (M,) m."""
        problem, planner, newton = start.problem, self.owner.planner, self.newton
        newton.coulomb.upload(start.normal_bias, start.friction)
        self.owner.factors.upload_diagonal(self.owner.masses)
        bounds = planner.muscles.bounds
        previous = planner.synergies.mean(start.activations / bounds)
        size, change = planner.activation_weights(problem.dt)
        self._input.write(
            *(*planner.activation_bounds(previous, problem.dt), planner.synergies.mean(activations / bounds)),
            *(
                2.0 * (size + change) + REGULARIZATION,
                -2.0 * change * previous,
                np.array([2.0 * (change @ previous**2)]),
            ),
            *(start.forces, np.zeros(3 * (newton.capacity - start.contacts.count))),
            MuscleEnergy.of(planner.muscles, start.activations).tensions,
        )

    def _enqueue_prediction(self, dt: float, ratio: float) -> None:
        """Queue the prediction: a Newton step with the contact forces of the previous step, and then
        ``PREDICTION_ITERATIONS`` Newton steps that solve Coulomb's law."""
        body, newton = self.body, self.newton
        self._input.send()
        velocities, _, _, forces = newton.parts(newton.start_buffer)
        velocities.copy_(body.rigid_guess)
        for each in (forces, newton.target_forces):
            each.copy_(self._known)
        newton.tensions.copy_(self._tensions)
        newton.trial_input.copy_(self._evaluate_input[FROM_START])
        torch.add(body.positions, body.rigid_guess, alpha=dt, out=newton.end_positions)
        self._enqueue_factors(dt, 0)
        newton.enqueue_prediction(dt, ratio)
        self._residual_norms[0].copy_(newton.residual_norm[0])
        self._enqueue_factors(dt, 1)
        newton.enqueue_linearization(dt, ratio)
        velocities.copy_(newton.velocities)
        newton.enqueue_trial(dt, ratio)
        self._residual_norms[1].copy_(newton.residual_norm[0])
        for iteration in range(PREDICTION_ITERATIONS):
            newton.trial_input.copy_(self._newton_input)
            newton.enqueue_newton(dt, ratio)
            self._residual_norms[2 + iteration].copy_(newton.residual_norm[0])
            self._coulomb_violations[iteration].copy_(newton.coulomb_violation[0])

    def _enqueue_factors(self, dt: float, which: int) -> None:
        """Queue the factorisation of the system matrix at the end of the last trial; ``which`` is the slot of its
        status flags."""
        self.body.enqueue_factors(vectors(self.newton.end_positions), dt)
        self._factor_flags[which].copy_(self.body.factors.status_flags)

    def _enqueue_linear(self, dt: float, ratio: float, time: float, base: float) -> None:
        """Queue the linear step about the iterate in the slot ``base``, and the energy, gradient and factors of
        ``EffortModel``."""
        body, newton, owner = self.body, self.newton, self.owner
        newton.tensions.zero_()
        newton.trial_input.copy_(self._evaluate_input[base])
        newton.enqueue_residual(dt, ratio)
        segment_forces, ends = owner.linear.segment_forces(newton), vectors(newton.end_positions)
        energies, _ = body.elements.enqueue_energies(ends, body.gradients, time)
        torch.sum(wp.to_torch(energies)[0], dim=0, out=self._energy[0])
        body.elements.enqueue_gradient(ends, body.gradients, time, None, vectors(self._gradient))
        entries = body.elements.enqueue_entries(ends, body.gradients, time, factor=1.0, projected=True)
        self._entries.copy_(wp.to_torch(entries)[0])
        body.stream.fork_join(
            [
                lambda: owner.factors.enqueue_factor(time**2 * self._entries),
                lambda: owner.linear.write(newton, segment_forces, dt, self._velocities),
            ]
        )
        torch.amin(owner.factors.status_flags, dim=0, out=self._plan_check[0])
        self._contact_velocities.copy_(newton.contact_velocities(self._velocities))

    def _write_objectives(self, start: StepInputs, objectives: Sequence[AnyObjective]) -> None:
        """Write the quadratic form of the ``objectives`` in (x, 1) to ``_form``, see ``objectives_cost``."""
        problem, m, speed = start.problem, self.m, self.body.body.speed_unit
        plain = [each for each in objectives if isinstance(each, Objective)]
        torch.mul(objective_form(self._velocities, plain, self.owner.objective_staging), 1.0 / speed**2, out=self._form)
        other_objectives = [each for each in objectives if not isinstance(each, Objective)]
        torques = torques_of(problem, start.contacts, m)
        weighted_rows = [np.zeros((0, len(self._form)))]
        for objective in other_objectives:
            slopes, residual = objective.affine(problem, start.contacts, torques)
            rows = np.zeros((len(residual), len(self._form)))
            rows[:, : slopes.shape[1]], rows[:, -1] = slopes, residual
            weighted_rows.append(np.sqrt(2.0 * objective.weight) * rows)
        if sum(map(len, weighted_rows)) > 0:
            rows = self.owner.other_staging.upload(*weighted_rows).view(-1, len(self._form))
            self._form.addmm_(rows.T, rows)

    def _enqueue_search(self, dt: float, ratio: float, time: float, is_parallel: bool) -> None:
        """Queue the QP, the search, and the residual of the step at the expected end. If ``is_parallel``, a restart
        runs concurrently with the search."""
        body, newton, planner = self.body, self.newton, self.owner.planner
        width, coulomb = 3 * newton.capacity, newton.coulomb
        self._predicted_forces.copy_(newton.target_forces)
        self._enqueue_cost(dt, time)
        target = body.body.assembly.device
        wp.launch(
            kernels.assemble_qp_kernel,
            (1, len(self._form) + width, len(self._form)),
            inputs=[
                *(planner.settings.qp_limit, body.body.speed_unit, body.body.weight),
                *(as_warp(coulomb.counts, wp.int32), as_warp(coulomb.friction, real)),
                *(as_warp(each[None], real) for each in (self._form, self._contact_velocities)),
                *(as_warp(each[None], real) for each in (coulomb.normal_bias.view(-1), self._bounds)),
                as_warp(newton.target_forces.view(1, -1, 3), Vec3),
            ],
            outputs=[as_world(self._search.packed_qp)],
            device=target,
        )
        self._search.is_accepted.zero_()
        body.stream.fork_join([self._search.enqueue, *([self._restart.enqueue_restart] if is_parallel else [])])
        wp.launch(
            kernels.scatter_solution_kernel,
            (1, len(self._x)),
            inputs=[as_warp(coulomb.counts, wp.int32), as_world(self._search.packed_result), self.m],
            outputs=[as_warp(self._x[None], real)],
            device=target,
        )
        wp.launch(
            kernels.accept_search_kernel,
            1,
            inputs=[as_warp(coulomb.counts, wp.int32), self._search.packed_result, RESTART_COST],
            outputs=[as_warp(self._starts_solve, wp.int32)],
            device=target,
        )
        self._search_result.copy_(wp.to_torch(self._search.packed_result))
        self._enqueue_end(dt, ratio)

    def _enqueue_end(self, dt: float, ratio: float) -> None:
        """Queue the contact forces for the activations in x, the expected end of the step, and its residual."""
        body, newton, owner = self.body, self.newton, self.owner
        activations = self._x[: self.m]
        contact_free = torch.addmv(self._contact_velocities[:, -1], self._contact_velocities[:, : self.m], activations)
        torch.mul(self._x[self.m : -1], body.body.weight, out=newton.target_forces)
        newton.coulomb.enqueue_forces(contact_free, newton.target_forces, self._plan_check[2:])
        torch.mul(newton.target_forces, 1.0 / body.body.weight, out=self._x[self.m : -1])
        velocities, _, _, forces = newton.parts(newton.start_buffer)
        torch.mv(self._velocities, self._x, out=velocities)
        forces.copy_(newton.target_forces)
        self._forces.copy_(newton.target_forces)
        bounds, stiffness = owner.tensions
        torch.mul(activations[owner.group_from_muscle] * bounds, stiffness, out=newton.tensions)
        newton.trial_input.copy_(self._evaluate_input[FROM_START])
        newton.enqueue_trial(dt, ratio)
        self._plan_check[1].copy_(newton.residual_norm[0])
        self._end_contact_velocities.copy_(newton.free_contact_velocities)
        self._end_velocities.copy_(newton.velocities)
        self._host_readback.copy_(self._readback, non_blocking=True)

    def _enqueue_cost(self, dt: float, time: float) -> None:
        """Queue the addition of effort and activation costs to ``_form``, see ``effort_cost`` and ``StepPlanner``."""
        body, newton, owner, form = self.body, self.newton, self.owner, self._form
        reference = dt * newton.trial_parts()[0]
        masses = body.masses.repeat_interleave(3)
        quadratic, linear_terms = owner.factors.enqueue_quadratic_form(
            self._entries, self._gradient, masses, self._velocities, dt, time - dt, reference
        )
        add_effort(form, quadratic, linear_terms, self._energy[0], body.body)
        shortenings = owner.linear.lengths(body.positions) - owner.linear.lengths(newton.end_positions)
        squared_work = (owner.work_factors * shortenings).square() @ owner.members
        add_activation_cost(form, self._diagonal, self._linear_terms, self._constant[0], squared_work)
