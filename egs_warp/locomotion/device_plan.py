"""The plan of a step where a GPU has its matrices: foreseen, programmed, searched and begun, with one look at the end
(Eq. 4, 7, 8, 9, 12, 13).

What ``LocomotionStepper.foresee`` and ``StepPlanner.plan`` do one after the other, as far as all goes the usual way.
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
from egs_warp.contact.newton_convergence import ConvergenceState
from egs_warp.fem.batched import as_warp
from egs_warp.fem.cuda_graphs import GraphCache, PinnedUpload
from egs_warp.fem.dense_cholesky import DenseCholesky
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.kernels.locomotion import step_program as kernels
from egs_warp.kernels.locomotion.active_set import FOUND
from egs_warp.kernels.locomotion.mode_search import HEADER_SIZE
from egs_warp.kernels.locomotion.relaxed_contact import pack_search_kernel
from egs_warp.locomotion.contact_modes import ModeSearchResult, search_modes, solve_relaxed
from egs_warp.locomotion.device_linear_step import DeviceLinearSteps, StagingBuffer, squares_of
from egs_warp.locomotion.device_search import ModeSearchWorkspace, RelaxationWorkspace
from egs_warp.locomotion.linear_step import PREDICTION_ITERATIONS, PredictedStep, StepInputs, torques_of
from egs_warp.locomotion.objectives import AnyObjective, Objective
from egs_warp.locomotion.planner import REGULARIZATION, WORK_WEIGHT, Plan, StepPlanner
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.step_cost import EFFORT_HORIZON, EFFORT_WEIGHT
from egs_warp.locomotion.strategies import RESTART_COST, needs_restart, restart_from_relaxation
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.precision import real

PARALLEL_RESTART_COST = 0.5 * RESTART_COST
"""After a step that costs as much the next has its second search beside the first."""


class DevicePlanner:
    """Plans of one body's steps, of the strategy ``pieces``."""

    def __init__(
        self,
        planner: StepPlanner,
        owner: DeviceContactLinearizer,
        linear: DeviceLinearSteps,
        course: Callable[[StepProblem], ConvergenceState],
    ) -> None:
        """``course``: of the first round of a step's solve."""
        assert isinstance(planner.factors, DenseCholesky)
        self.planner, self.owner, self.linear, self.factors = planner, owner, linear, planner.factors
        self.course = course
        self.asked, self.others = StagingBuffer(owner.stream), StagingBuffer(owner.stream)
        muscles, body = planner.muscles, planner.body
        self.members = owner.tensor(planner.synergies.members.toarray())
        self.group_from_muscle = torch.as_tensor(
            planner.synergies.group_from_muscle, device=owner.factors.device
        ).long()
        self.tensions = owner.tensor(muscles.bounds), owner.tensor(muscles.stiffness)
        self.works = owner.tensor(muscles.max_forces / (body.weight * body.height))
        self.masses = np.repeat(body.node_mass, 3)
        self._rooms: dict[int, PlanWorkspace] = {}

    def start(self, start: StepInputs) -> None:
        """What of a ``plan`` hangs on nothing that is asked; nobody waits for it."""
        self._room_for(start).start(start)

    def plan(self, start: StepInputs, objectives: Sequence[AnyObjective]) -> tuple[ContactLinearization, Plan] | None:
        """The response that is at hand then, and the plan for what the ``objectives`` ask, at whose end the solve goes
        on; None where something is not as usual: a matrix that is not definite, an element that is inverted, or forces
        that are not found."""
        if self.owner.predicted_start is not start:
            self.start(start)
        return self._room_for(start).plan(start, objectives)

    def replan(
        self, prospect: PredictedStep, last: np.ndarray, objectives: Sequence[AnyObjective], friction: float
    ) -> Plan | None:
        """The same about a ``prospect`` that is where a solve has ended, after ``last`` (M,) metres of the step before;
        None, too, where the device has left that behind."""
        response = prospect.linearization
        assert isinstance(response, DeviceContactLinearization)
        for at, base in ((response.workspace.base_iterate, FROM_BASE), (response.workspace.trial_iterate, FROM_TRIAL)):
            if self.owner.current is response and at is not None and at.velocities is prospect.velocities:
                start = StepInputs.from_prediction(prospect, friction, last)
                return self._room_for(start).replan(start, prospect, objectives, base)
        return None

    def _room_for(self, start: StepInputs) -> PlanWorkspace:
        room = self.owner.workspace_for(start.contacts)
        if room.capacity not in self._rooms:
            self._rooms[room.capacity] = PlanWorkspace(self, room)
        return self._rooms[room.capacity]


class PlanWorkspace:
    """Memory and graphs for so many contacts."""

    def __init__(self, owner: DevicePlanner, room: NewtonWorkspace) -> None:
        body, zeros = owner.owner, owner.owner.zeros
        self.owner, self.body, self.room = owner, body, room
        self.m, size, places = owner.planner.synergies.count, len(room.ends), room.capacity
        m, width = self.m, 3 * places
        parts = [3 * m, m, m, 1, width, body.segment_count]
        self._told = PinnedUpload(body.stream, sum(parts))
        bounds, self._diagonal, self._slopes, self._constant, self._known, self._tensions = self._told.device.split(
            parts
        )
        self._bounds = bounds.view(3, m)
        # To stay where that is, and to go from the last trial to the end of a Newton step.
        self._stay = {base: body.tensor(np.array([0.0, 0.0, base])) for base in (FROM_BASE, FROM_TRIAL, FROM_START)}
        self._forward = body.tensor(np.array([1.0, 1.0, FROM_TRIAL]))
        self._velocities, self._speeds = zeros(size, m + width + 1), zeros(width, m + width + 1)
        self._form = zeros(m + width + 1, m + width + 1)
        self._entries, self._slope, self._energy = zeros(len(owner.factors.places)), zeros(size), zeros(1)
        # In one piece, as it comes back: what tells whether all went as usual, the answer, and forces.
        lengths = [
            4,
            PREDICTION_ITERATIONS + 2,
            PREDICTION_ITERATIONS,
            3,
            HEADER_SIZE + m + width,
            width,
            width,
            width,
            size,
        ]
        self._made, self._made_here = zeros(sum(lengths)), body.stream.pinned(sum(lengths))
        self._parts = np.split(self._made_here.numpy(), np.cumsum(lengths)[:-1])
        verdicts, self._sizes, self._missed, self._usual, *others = self._made.split(lengths)
        self._answer, self._looked, self._forces, self._speeds_after, self._end = others
        self._verdicts = verdicts.view(2, 2)
        self._x, self._point = zeros(m + width + 1), PinnedUpload(body.stream, m + width + 1)
        alias = str(body.factors.device)
        self._search = ModeSearchWorkspace(m, places, alias, costly=RESTART_COST)
        self._relaxed = RelaxationWorkspace(m, places, self._search)
        self._second = ModeSearchWorkspace(m, places, alias, beside=self._search)
        self._objective, self._beside = 0.0, False
        # What contact answers where a second search begins, and by how much that misses its laws: it is only a start.
        self._answered, self._answered_missed = zeros(width), zeros(1)
        # Whether the solve goes on from the first search's end.
        self._goes_on = torch.zeros(1, dtype=torch.int32, device=body.factors.device)
        self._works, self._arrived = GraphCache(body.stream), None

    def start(self, start: StepInputs) -> None:
        """See ``DevicePlanner``."""
        body, room, problem = self.body, self.room, start.problem
        if body.predicted_start is not None:
            # What was told for another plan may still be on its way.
            body.stream.wait()
        body.current = room.base_iterate = room.trial_iterate = room.pending_iterate = None
        with body.stream:
            body.set_problem(problem)
            room.set_contacts(start.contacts)
            body.factors.upload_diagonal((1.0 + problem.dt * problem.drag) * self.owner.masses)
            self._tell(start, start.activations)
            self._do(self._enqueue_foresight, problem.dt, 1.0 + problem.dt * problem.drag)
        body.factors.mark_started()
        self._begin_linear(start, FROM_TRIAL)
        body.predicted_start = start

    def plan(self, start: StepInputs, objectives: Sequence[AnyObjective]) -> tuple[ContactLinearization, Plan] | None:
        """See ``DevicePlanner``; it has begun."""
        body, room, problem = self.body, self.room, start.problem
        body.predicted_start = None
        self._search_for(start, objectives)
        verdicts, sizes, missed, *_ = self._parts
        if not (verdicts.min() > 0.0 and np.isfinite(sizes).all() and missed.max() <= FAILURE_TOLERANCE):
            return None
        tangent = Tangent(problem, body.factors)
        body.current = DeviceContactLinearization.from_workspace(tangent, start.contacts, body, room)
        plan = self._found(start, body.current)
        return None if plan is None else (body.current, plan)

    def replan(
        self, start: StepInputs, prospect: PredictedStep, objectives: Sequence[AnyObjective], base: float
    ) -> Plan | None:
        """See ``DevicePlanner``; the prospect lies at the ``base``."""
        with self.body.stream:
            self._tell(start, prospect.activations)
            self._told.send()
            self.room.target_forces.copy_(self._known)
        self.body.predicted_start = self.room.base_iterate = self.room.trial_iterate = self.room.pending_iterate = None
        self._begin_linear(start, base)
        self._search_for(start, objectives)
        assert isinstance(prospect.linearization, DeviceContactLinearization)
        return self._found(start, prospect.linearization)

    def _begin_linear(self, start: StepInputs, base: float) -> None:
        """The linear step about what lies at the ``base``, for which nobody waits."""
        dt, ratio = start.problem.dt, 1.0 + start.problem.dt * start.problem.drag
        with self.body.stream:
            self._do(self._enqueue_linear, dt, ratio, self._horizon(dt), base)
        self.owner.factors.mark_started()

    def _search_for(self, start: StepInputs, objectives: Sequence[AnyObjective]) -> None:
        """The program about the linear step, and its search; the solve, for which nobody waits, if that is settled."""
        dt, ratio = start.problem.dt, 1.0 + start.problem.dt * start.problem.drag
        with self.body.stream:
            self._ask(start, objectives)
            self._beside = start.contacts.count > 0 and self._objective >= PARALLEL_RESTART_COST
            self._do(self._enqueue_search, dt, ratio, self._horizon(dt), self._beside)
        self._begin_solve(start, self._goes_on)

    def _horizon(self, dt: float) -> float:
        """Seconds."""
        return max(EFFORT_HORIZON * self.body.body.time_unit, dt)

    def _found(self, start: StepInputs, response: DeviceContactLinearization) -> Plan | None:
        """What the search has found, or a second one if that is doubted; None if anything is not as usual."""
        *_, (definite, size, missed), answer, _, forces, speeds, velocities = self._parts
        ended, count, infeasible, objective, there = answer[:5]
        if not definite > 0.0:
            return None
        contacts = start.contacts.count
        self._objective = float(objective)
        if ended != FOUND or there != 1.0 or needs_restart(objective, contacts):
            x = answer[HEADER_SIZE : HEADER_SIZE + self.m + 3 * contacts].copy() if there == 1.0 else None
            first = ModeSearchResult(x, objective, int(count), int(infeasible))
            if ended != FOUND:
                first = self._by_host(self._search)
            found = self._searched_on(first, contacts)
            if found.x is None:
                return None
            count, infeasible = found.qp_count, found.infeasible
            # What the kernel has found first is where the device is.
            if found.x is not x:
                self._end_at(found.x, start)
                *_, (_, size, missed), _, _, forces, speeds, velocities = self._parts
                answer[HEADER_SIZE : HEADER_SIZE + self.m] = found.x[: self.m]
        if missed > FAILURE_TOLERANCE or not np.isfinite(size):
            return None
        planner, room = self.owner.planner, self.room
        activations = (planner.synergies.members @ answer[HEADER_SIZE : HEADER_SIZE + self.m]) * planner.muscles.bounds
        tension = MuscleEnergy.of(planner.muscles, activations)
        forces = forces[: 3 * contacts].reshape(-1, 3).copy()
        end = response.iterate(tension, forces, float(size), speeds, velocities, None)
        room.base_iterate, room.trial_iterate, room.pending_iterate = None, None, end
        return Plan(activations, end.velocities, end.forces, int(count), int(infeasible))

    def _searched_on(self, found: ModeSearchResult, contacts: int) -> ModeSearchResult:
        """``found``, or better if that costs so much that it is doubted."""
        if not needs_restart(found.objective, contacts):
            return found
        there = self._relaxed.found() if self._beside else None
        if there is None:
            with self.body.stream:
                self._search.settled.zero_()
                self._do(self._enqueue_elsewhere)
            there = self._relaxed.found()
        relaxed = there or solve_relaxed(self._search.parse_input()[0], QpSolver.OSQP)

        def search(activations: np.ndarray) -> ModeSearchResult:
            if there is None:
                with self.body.stream:
                    self._point.set(activations)
                    self._do(self._enqueue_from_point)
            return self._second.parse_result(self.m + 3 * contacts) or self._by_host(self._second)

        return restart_from_relaxation(found, relaxed, search)

    def _by_host(self, search: ModeSearchWorkspace) -> ModeSearchResult:
        """The ``search`` that was told, where rounding has led the kernel astray."""
        program, start, modes = search.parse_input()
        limit = self.owner.planner.settings.qp_limit
        return search_modes(program, start, modes, qp_limit=limit, solver=QpSolver.OSQP)

    def _enqueue_elsewhere(self) -> None:
        """The optimum without complementarity, and a search from there."""
        # Warp, too, works where torch does.
        with wp.ScopedStream(self.body.stream.current(), sync_enter=False):
            self._relaxed.enqueue()
            self._enqueue_from(wp.to_torch(self._relaxed.answer)[HEADER_SIZE:])

    def _enqueue_from_point(self) -> None:
        self._enqueue_from(self._point.device[: self.m])

    def _enqueue_from(self, activations: torch.Tensor) -> None:
        """A second search, from these ``activations`` (m,) and what contact answers to them."""
        body, room = self.body, self.room
        moved = torch.addmv(self._speeds[:, -1], self._speeds[:, : self.m], activations)
        self._answered.copy_(self._looked)
        room.coulomb.enqueue_forces(moved, self._answered, self._answered_missed)
        wp.to_torch(self._second.packed_qp).copy_(wp.to_torch(self._search.packed_qp))
        wp.launch(
            pack_search_kernel,
            self.m + room.capacity,
            inputs=[body.body.weight, as_warp(activations, real), vectors(self._answered), self._search.settled],
            outputs=[self._second.packed_qp],
            device=body.body.assembly.device,
        )
        self._second.enqueue()

    def _end_at(self, x: np.ndarray, start: StepInputs) -> None:
        """The end of another search than the first, ``x`` (m + 3n,), and the solve from there."""
        body, problem = self.body, start.problem
        with body.stream:
            self._point.set(x, np.zeros(len(self._x) - 1 - len(x)), np.ones(1))
            self._x.copy_(self._point.device)
            self._do(self._enqueue_end, problem.dt, 1.0 + problem.dt * problem.drag)
        self._begin_solve(start)

    def _begin_solve(self, start: StepInputs, usual: torch.Tensor | None = None) -> None:
        """Wait for the plan, while its solve goes on if all is as ``usual``."""
        with self.body.stream:
            self._arrived = self.body.stream.record_event(self._arrived)
        course = self.owner.course(start.problem)
        self.room.start_newton(start.problem, start.normal_bias, start.friction, course, base=FROM_TRIAL, usual=usual)
        if self._arrived is not None:
            self._arrived.synchronize()

    def _do(self, work: Callable[..., None], *given: float) -> None:
        self._works.run((work.__name__, *given), lambda: work(*given))

    def _tell(self, start: StepInputs, activations: np.ndarray) -> None:
        """All that is known at the start, from whose ``activations`` (M,) metres the search begins."""
        problem, planner, room = start.problem, self.owner.planner, self.room
        room.coulomb.upload(start.normal_bias, start.friction)
        self.owner.factors.upload_diagonal(self.owner.masses)
        bounds = planner.muscles.bounds
        previous = planner.synergies.mean(start.activations / bounds)
        size, change = planner.activation_weights(problem.dt)
        self._told.write(
            *(*planner.activation_bounds(previous, problem.dt), planner.synergies.mean(activations / bounds)),
            *(
                2.0 * (size + change) + REGULARIZATION,
                -2.0 * change * previous,
                np.array([2.0 * (change @ previous**2)]),
            ),
            *(start.forces, np.zeros(3 * (room.capacity - start.contacts.count))),
            MuscleEnergy.of(planner.muscles, start.activations).tensions,
        )

    def _enqueue_foresight(self, dt: float, ratio: float) -> None:
        """A Newton step ahead under the forces that are known, and from there ``LOOKS`` with contact."""
        body, room = self.body, self.room
        self._told.send()
        velocities, _, _, forces = room.parts(room.start_buffer)
        velocities.copy_(body.rigid_guess)
        for each in (forces, room.target_forces):
            each.copy_(self._known)
        room.tensions.copy_(self._tensions)
        room.trial_input.copy_(self._stay[FROM_START])
        torch.add(body.positions, body.rigid_guess, alpha=dt, out=room.ends)
        self._enqueue_factors(dt, 0)
        room.enqueue_prediction(dt, ratio)
        self._sizes[0].copy_(room.size[0])
        self._enqueue_factors(dt, 1)
        room.enqueue_linearization(dt, ratio)
        velocities.copy_(room.velocities)
        room.enqueue_trial(dt, ratio)
        self._sizes[1].copy_(room.size[0])
        for look in range(PREDICTION_ITERATIONS):
            room.trial_input.copy_(self._forward)
            room.enqueue_newton(dt, ratio)
            self._sizes[2 + look].copy_(room.size[0])
            self._missed[look].copy_(room.coulomb_violation[0])

    def _enqueue_factors(self, dt: float, which: int) -> None:
        """Of the step's matrix where the last trial ends."""
        self.body.enqueue_factors(vectors(self.room.ends), dt)
        self._verdicts[which].copy_(self.body.factors.verdict)

    def _enqueue_linear(self, dt: float, ratio: float, time: float, base: float) -> None:
        """The linear step about what is foreseen, and factors of its horizon, see ``Horizon``."""
        body, room, owner = self.body, self.room, self.owner
        room.tensions.zero_()
        room.trial_input.copy_(self._stay[base])
        room.enqueue_residual(dt, ratio)
        pulls, ends = owner.linear.segment_forces(room), vectors(room.ends)
        torch.sum(wp.to_torch(body.elements.enqueue_energies(ends, body.gradients, time)), dim=0, out=self._energy[0])
        body.elements.enqueue_gradient(ends, body.gradients, time, None, body.no_tensions, vectors(self._slope))
        made = body.elements.enqueue_entries(ends, body.gradients, time, factor=1.0, projected=True)
        self._entries.copy_(wp.to_torch(made))
        body.stream.fork_join(
            [
                lambda: owner.factors.enqueue(time**2 * self._entries),
                lambda: owner.linear.write(room, pulls, dt, self._velocities),
            ]
        )
        torch.amin(owner.factors.verdict, dim=0, out=self._usual[0])
        self._speeds.copy_(room.contact_velocities(self._velocities))

    def _ask(self, start: StepInputs, objectives: Sequence[AnyObjective]) -> None:
        """The form (m + 3K + 1, ...) of what the ``objectives`` ask, see ``objectives_cost``."""
        problem, m, speed = start.problem, self.m, self.body.body.speed_unit
        plain = [each for each in objectives if isinstance(each, Objective)]
        torch.mul(squares_of(self._velocities, plain, self.owner.asked), 1.0 / speed**2, out=self._form)
        others = [each for each in objectives if not isinstance(each, Objective)]
        torques = torques_of(problem, start.contacts, m)
        told = [np.zeros((0, len(self._form)))]
        for objective in others:
            slopes = objective.slopes(problem, start.contacts, torques, speed)
            gap = objective.residual(problem, start.contacts, np.zeros(0), np.zeros(3), speed)
            rows = np.zeros((len(gap), len(self._form)))
            rows[:, : slopes.shape[1]], rows[:, -1] = slopes, gap
            told.append(np.sqrt(2.0 * objective.weight) * rows)
        if sum(map(len, told)) > 0:
            rows = self.owner.others.upload(*told).view(-1, len(self._form))
            self._form.addmm_(rows.T, rows)

    def _enqueue_search(self, dt: float, ratio: float, time: float, beside: bool) -> None:
        """The program, its search, a second one ``beside`` that, and the step's equation at the end that it expects."""
        body, room, planner = self.body, self.room, self.owner.planner
        width, laws = 3 * room.capacity, room.coulomb
        self._looked.copy_(room.target_forces)
        self._enqueue_cost(dt, time)
        target = body.body.assembly.device
        wp.launch(
            kernels.assemble_qp_kernel,
            (len(self._form) + width, len(self._form)),
            inputs=[
                *(planner.settings.qp_limit, body.body.speed_unit, body.body.weight),
                *(as_warp(laws.counts, wp.int32), as_warp(laws.friction, real), as_warp(self._form, real)),
                *(as_warp(self._speeds, real), as_warp(laws.shifts, real), as_warp(self._bounds, real)),
                vectors(room.target_forces),
            ],
            outputs=[self._search.packed_qp],
            device=target,
        )
        self._search.settled.zero_()
        body.stream.fork_join([self._search.enqueue, *([self._enqueue_elsewhere] if beside else [])])
        wp.launch(
            kernels.scatter_solution_kernel,
            len(self._x),
            inputs=[as_warp(laws.counts, wp.int32), self._search.packed_result, self.m],
            outputs=[as_warp(self._x, real)],
            device=target,
        )
        wp.launch(
            kernels.accept_search_kernel,
            1,
            inputs=[as_warp(laws.counts, wp.int32), self._search.packed_result, RESTART_COST],
            outputs=[as_warp(self._goes_on, wp.int32)],
            device=target,
        )
        self._answer.copy_(wp.to_torch(self._search.packed_result))
        self._enqueue_end(dt, ratio)

    def _enqueue_end(self, dt: float, ratio: float) -> None:
        """What contact makes of the point that was found, and the step's equation there."""
        body, room, owner = self.body, self.room, self.owner
        activations = self._x[: self.m]
        moved = torch.addmv(self._speeds[:, -1], self._speeds[:, : self.m], activations)
        torch.mul(self._x[self.m : -1], body.body.weight, out=room.target_forces)
        room.coulomb.enqueue_forces(moved, room.target_forces, self._usual[2:])
        torch.mul(room.target_forces, 1.0 / body.body.weight, out=self._x[self.m : -1])
        velocities, _, _, forces = room.parts(room.start_buffer)
        torch.mv(self._velocities, self._x, out=velocities)
        forces.copy_(room.target_forces)
        self._forces.copy_(room.target_forces)
        bounds, stiffness = owner.tensions
        torch.mul(activations[owner.group_from_muscle] * bounds, stiffness, out=room.tensions)
        room.trial_input.copy_(self._stay[FROM_START])
        room.enqueue_trial(dt, ratio)
        self._usual[1].copy_(room.size[0])
        self._speeds_after.copy_(room.speeds_after)
        self._end.copy_(room.velocities)
        self._made_here.copy_(self._made, non_blocking=True)

    def _enqueue_cost(self, dt: float, time: float) -> None:
        """Added to the form: effort and activations, see ``effort_cost`` and ``StepPlanner``."""
        body, room, owner, form = self.body, self.room, self.owner, self._form
        unit = EFFORT_WEIGHT / (body.body.weight * body.body.height)
        away = dt * room.trial_parts()[0]
        masses = body.masses.repeat_interleave(3)
        strain, along = owner.factors.enqueue_effort_quadratic(
            self._entries, self._slope, masses, self._velocities, dt, time - dt, away
        )
        form.add_(strain, alpha=unit)
        form[:, -1].add_(along, alpha=unit)
        form[-1, -1].add_(unit * (along[-1] + 2.0 * self._energy[0]) + self._constant[0])
        shorter = owner.linear.lengths(body.positions) - owner.linear.lengths(room.ends)
        works = owner.members.T @ (owner.works * shorter).square()
        form.diagonal()[: self.m].add_(self._diagonal + (2.0 * WORK_WEIGHT) * works)
        form[: self.m, -1].add_(self._slopes)
