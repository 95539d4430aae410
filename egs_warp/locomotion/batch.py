"""Steps of many worlds of one body in lockstep on one device, with planned or with prescribed activations.

In each world, ``BatchStepper`` solves the same equations and makes the same decisions as ``LocomotionStepper`` with the
QP solver ``admm``. Kernels and batched matrix products process all worlds at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from egs_warp.contact.batch_step import BatchInputs, BatchLinearization, BatchResult, BatchSolver, StageTimer
from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.detection import ContactDetector, ContactGeometry
from egs_warp.contact.selection import ContactSelector
from egs_warp.errors import ArgumentError
from egs_warp.fem.batch_problem import BatchBody, BatchProblem, apply_inverse
from egs_warp.fem.batched import nonzero, padded
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.panel_cholesky import CHUNK_BYTES, PANEL
from egs_warp.locomotion.batch_objectives import BatchObjectives
from egs_warp.locomotion.batch_plan import BatchPlan, BatchPlanner, BatchPrediction
from egs_warp.locomotion.batch_state import BatchState, BatchStep, merged
from egs_warp.locomotion.linear_step import PREDICTION_ITERATIONS
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.planner import StepPlanner
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.settling import SETTLING_STEP, SETTLING_STEPS, has_settled
from egs_warp.locomotion.stepper import MAX_HALVINGS, REPLAN_FACTOR, REPLAN_MARGIN, StepReport, WarmStart
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.render.autograd import torch_stream


class BatchStepper:
    """Stepper of many worlds with the same body, muscles and ground. Each world has its own friction.

    The stepper runs on the device of the body's ``assembly``: a GPU that PyTorch supports, or a CPU in tests.
    """

    def __init__(
        self,
        body: SoftBody,
        muscles: MuscleSet,
        geometry: ContactGeometry,
        frictions: Sequence[float] | np.ndarray,
        *,
        settings: LocomotionSettings | None = None,
        panel: int = PANEL,
        chunk_bytes: int = CHUNK_BYTES,
        stages: StageTimer = nullcontext,
        planner: StepPlanner | None = None,
    ) -> None:
        """Allocate the buffers that all steps share. The factors take 72 N^2 bytes for each world.

        Args:
            body: the body.
            muscles: its muscles.
            geometry: ground and contact points; its friction is not used.
            frictions: (B,) Coulomb coefficient of each world.
            settings: options of the stepper.
            panel: number of columns that are factored at a time.
            chunk_bytes: maximum total size, in bytes, of the matrices that are factored at a time. The temporary memory
                takes several times as much in addition.
            stages: timer of the stages of a step.
            planner: planner of a single world of the same body and settings (``LocomotionStepper.planner``); only
                ``advance`` requires it.

        Raises:
            UserError: ``planner`` has a strategy that does not run in batches.
        """
        self.settings = settings or LocomotionSettings()
        self.device = torch.device(str(body.assembly.device))
        count = len(frictions)
        self.body, self.muscles = body, muscles
        near = self.settings.activation_distance * body.height
        device = str(self.device)
        self.detector = ContactDetector(geometry, device=device)
        self.selector = ContactSelector(geometry, activation_distance=near, hysteresis=0.1 * near, device=device)
        self.common = BatchBody(body, muscles, count, panel=panel, chunk_bytes=chunk_bytes)
        self.solver = BatchSolver(
            self.detector,
            self.selector,
            push_out_cap=self.settings.push_out_cap * body.speed_unit,
            penetration_tolerance=self.settings.penetration_tolerance * body.height,
            stages=stages,
        )
        self._stages = stages
        self._frictions, self._stiffness = self._tensor(frictions), self._tensor(muscles.stiffness)
        self._planner = BatchPlanner(planner, self.common, count, stages) if planner is not None else None

    def _tensor(self, values: Sequence[float] | np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values, dtype=np.float64), device=self.device)

    def start(self, states: Sequence[BodyState], memories: Sequence[WarmStart] | None = None) -> BatchState:
        """Return the state of all worlds at the start.

        Args:
            states: state of each world.
            memories: warm start of each world; None starts without contacts.
        """
        count = len(self._frictions)
        capacity = max((len(memory.points) for memory in memories or ()), default=0)
        points, forces = np.zeros((count, capacity), np.int32), np.zeros((count, capacity, 3))
        counts, activations = np.zeros(count, np.int32), np.zeros((count, self.muscles.segment_count))
        for world, memory in enumerate(memories or ()):
            counts[world], activations[world] = len(memory.points), memory.activations
            points[world, : counts[world]], forces[world, : counts[world]] = memory.points, memory.forces
        return BatchState(
            torch.arange(count, device=self.device),
            self._tensor(np.stack([state.positions for state in states])),
            self._tensor(np.stack([state.velocities for state in states])),
            self._tensor([state.time for state in states]),
            torch.as_tensor(points, device=self.device),
            torch.as_tensor(counts, device=self.device),
            self._tensor(forces),
            self._tensor(activations),
        )

    def settle(self) -> tuple[list[BodyState], torch.Tensor]:
        """Let the body come to rest in every world, as ``settling.settle`` does in one.

        Returns:
            The state of each world at rest on its ground, and (B,) bool, True for worlds whose steps could not be
            solved.
        """
        body, nodes = self.body, self.body.mesh.nodes
        with torch.no_grad(), torch_stream(self.device):
            state = self.start([BodyState(nodes, np.zeros_like(nodes))] * len(self._frictions))
            ends, start_centre = state.positions.clone(), self._tensor(body.centre_of_mass(nodes))
            any_failed = torch.zeros(len(ends), dtype=torch.bool, device=self.device)
            for _ in range(SETTLING_STEPS):
                if len(state.worlds) == 0:
                    break
                state, moved, failed = self._passive_step(state, SETTLING_STEP * body.time_unit)
                ends[state.worlds], any_failed[state.worlds] = state.positions, failed
                centre_moved = (self.common.centre(state.positions)[:, 0] - start_centre).norm(dim=1)
                state = state.subset(nonzero(~has_settled(body, moved, centre_moved) & ~failed))
        return [BodyState(end, np.zeros_like(end)) for end in ends.cpu().numpy()], any_failed

    def _passive_step(self, state: BatchState, dt: float) -> tuple[BatchState, torch.Tensor, torch.Tensor]:
        """Make a step without muscles and drag, and set the velocities at its end to zero.

        Returns:
            The state; (c,) m, largest displacement of a node along an axis; and (c,) bool, True where a tangent could
            not be factored.
        """
        tensions = self._stiffness.new_zeros((len(state.worlds), len(self._stiffness)))
        inputs, previous_forces = self._start(state, tensions, dt, 0.0)
        problem, velocities = inputs.problem, inputs.problem.rigid_guess
        failed = ~problem.factor(velocities, None)
        response = self.solver.linearize(problem, inputs.contacts)
        contacts, result = self.solver.solve(inputs, response, velocities=velocities, forces=previous_forces)
        after = BatchState(
            *(state.worlds, problem.end_positions(result.velocities), torch.zeros_like(velocities), state.time),
            *(contacts.points, contacts.counts, result.forces, state.activations),
        )
        return after, dt * result.velocities.abs().flatten(1).amax(dim=1), failed | result.is_singular

    def advance(
        self, state: BatchState, objectives: Sequence[Sequence[AnyObjective]] | BatchObjectives, dt: float
    ) -> tuple[BatchState, list[BatchStep], torch.Tensor]:
        """Make one step of ``dt`` seconds with planned activations; see ``LocomotionStepper.advance``.

        Args:
            state: worlds to step.
            objectives: objectives of each of these worlds on the end of the step.
            dt: step size, s.

        Returns:
            The same values as ``advance_with_activations``.
        """
        with torch.no_grad(), torch_stream(self.device):
            if not isinstance(objectives, BatchObjectives):
                objectives = BatchObjectives.stack(objectives, len(self.common.mass), self.device)
            step, failed = self._planned_step(state, objectives, dt)
            repeated = nonzero(~step.report.converged & ~failed)
            if len(repeated) == 0:
                solved = nonzero(~failed)
                return self._solved(state, step.after.subset(solved), [step.subset(solved)], failed)
            solved = nonzero(step.report.converged & ~failed)
            start = state.gather(repeated)
            planned = torch.as_tensor(step.report.activations)[repeated]
            after, done, half_failed = self._best_half_steps(start, planned, objectives.subset(repeated), dt)
            failed[repeated[half_failed]] = True
            return self._solved(state, merged(step.after.subset(solved), after), [step.subset(solved), *done], failed)

    def advance_with_activations(
        self, state: BatchState, activations: np.ndarray | torch.Tensor, dt: float
    ) -> tuple[BatchState, list[BatchStep], torch.Tensor]:
        """Make one step of ``dt`` seconds. Where it does not converge, make shorter steps instead.

        Args:
            state: worlds to step.
            activations: (c, M) m, muscle activations.
            dt: step size, s.

        Returns:
            The state of the solved worlds; their steps in chronological order; and (c,) bool, True for failed worlds of
            ``state``: a matrix could not be factored, or no part of the step converged.
        """
        with torch.no_grad(), torch_stream(self.device):
            on_device = torch.as_tensor(activations, dtype=torch.float64, device=self.device)
            return self._solved(state, *self._parts(state, on_device, dt, MAX_HALVINGS))

    def _solved(
        self, state: BatchState, after: BatchState, done: list[BatchStep], failed: torch.Tensor
    ) -> tuple[BatchState, list[BatchStep], torch.Tensor]:
        """Return the result of ``advance_with_activations``, without the worlds in which no part of the step converged.

        Args:
            state: worlds at the start.
            after: state of the worlds that have not failed.
            done: their steps.
            failed: (c,) bool, True for failed worlds.
        """
        solved = torch.zeros(len(self._frictions), dtype=torch.bool, device=self.device)
        for step in done:
            solved[step.worlds] |= step.report.converged
        failed = failed | ~solved[state.worlds]
        solved[state.worlds[failed]] = False
        solved_steps = [step.subset(nonzero(solved[step.worlds])) for step in done]
        return (
            after.subset(nonzero(solved[after.worlds])),
            [step for step in solved_steps if len(step.worlds) > 0],
            failed,
        )

    def _parts(
        self, state: BatchState, activations: torch.Tensor, dt: float, max_halvings: int
    ) -> tuple[BatchState, list[BatchStep], torch.Tensor]:
        """Make a step of ``dt`` seconds. In worlds in which the step does not converge, make two half steps instead. A
        step is halved up to ``max_halvings`` times.

        Returns:
            State of the solved worlds, their steps, and (c,) bool, True for failed worlds.
        """
        step, failed = self._step(state, activations, dt)
        converged = step.report.converged
        repeated = nonzero(~converged & ~failed)
        if max_halvings == 0 or len(repeated) == 0:
            solved = nonzero(~failed)
            return step.after.subset(solved), [step.subset(solved)], failed
        solved = nonzero(converged & ~failed)
        half, done, half_failed = self._half_steps(state.gather(repeated), activations[repeated], dt, max_halvings)
        failed[repeated[half_failed]] = True
        return merged(step.after.subset(solved), half), [step.subset(solved), *done], failed

    def _half_steps(
        self, state: BatchState, activations: torch.Tensor, dt: float, max_halvings: int
    ) -> tuple[BatchState, list[BatchStep], torch.Tensor]:
        """Make two steps of ``dt`` / 2 seconds, and halve them again where they do not converge. The return values are
        those of ``_parts``."""
        done: list[BatchStep] = []
        failed = torch.zeros(len(state.worlds), dtype=torch.bool, device=self.device)
        rows = torch.arange(len(state.worlds), device=self.device)
        for _ in range(2):
            state, parts, part_failed = self._parts(state, activations, 0.5 * dt, max_halvings - 1)
            done += parts
            failed[rows[part_failed]] = True
            rows, activations = rows[~part_failed], activations[~part_failed]
        return state, done, failed

    def _best_half_steps(
        self, state: BatchState, planned: torch.Tensor, objectives: BatchObjectives, dt: float
    ) -> tuple[BatchState, list[BatchStep], torch.Tensor]:
        """Make half steps twice: with the ``planned`` activations (c, M), m, and with those of the last step. Return
        the better result of each world, as ``LocomotionStepper.advance`` does. A world fails if it fails in either."""
        results = [
            self._half_steps(state, activations, dt, MAX_HALVINGS) for activations in (planned, state.activations)
        ]
        (unconverged, value), (other_unconverged, other_value) = (
            self._rank_half_steps(state, done, objectives) for _, done, _ in results
        )
        failed = results[0][2] | results[1][2]
        is_second = torch.where(unconverged == other_unconverged, other_value < value, unconverged)
        parts: list[tuple[BatchState, list[BatchStep]]] = []
        for choice, (after, done, _) in zip((~is_second, is_second), results, strict=True):
            chosen = state.worlds[choice & ~failed]
            steps = [step.subset(nonzero(torch.isin(step.worlds, chosen))) for step in done]
            parts.append((after.subset(nonzero(torch.isin(after.worlds, chosen))), steps))
        (one, steps), (other, other_steps) = parts
        return merged(one, other), [step for step in [*steps, *other_steps] if len(step.worlds) > 0], failed

    def _rank_half_steps(
        self, state: BatchState, done: list[BatchStep], objectives: BatchObjectives
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (c,) bool, True where a step of ``done`` did not converge, and the objective values (c,) at the end of
        the last step. ``state`` is the state before these steps."""
        positions, velocities = state.positions.clone(), state.velocities.clone()
        unconverged = torch.zeros(len(state.worlds), dtype=torch.bool, device=self.device)
        value = torch.zeros(len(state.worlds), dtype=torch.float64, device=self.device)
        for step in done:
            rows, after, dt = torch.searchsorted(state.worlds, step.worlds), step.after, step.report.dt
            problem = BatchProblem.at(self.common, step.worlds, positions[rows], velocities[rows], dt=dt)
            ends = after.velocities, after.forces
            value[rows] = objectives.subset(rows).value(problem, step.report.contacts, *ends)
            unconverged[rows] |= ~torch.as_tensor(step.report.converged)
            positions[rows], velocities[rows] = after.positions, after.velocities
        return unconverged, value

    def _step(self, state: BatchState, activations: torch.Tensor, dt: float) -> tuple[BatchStep, torch.Tensor]:
        """Make one step in all worlds, as ``LocomotionStepper.step_with_activations`` does. Also return (c,) bool, True
        where a tangent could not be factored."""
        with self._stages("detect"):
            inputs, previous_forces = self._start(state, self._stiffness * activations, dt, self.settings.drag)
        response, velocities, forces, failed = self._predict(inputs, previous_forces)
        contacts, result = self.solver.solve(inputs, response, velocities=velocities, forces=forces)
        failed |= result.is_singular
        result = replace(result, converged=result.converged & ~failed)
        return self._finish(inputs, contacts, result, state, activations), failed

    def _planned_step(
        self, state: BatchState, objectives: BatchObjectives, dt: float
    ) -> tuple[BatchStep, torch.Tensor]:
        """Make one step in all worlds with planned activations, as ``LocomotionStepper.step`` does. Also return (c,)
        bool, True where a matrix could not be factored."""
        if self._planner is None:
            raise ArgumentError("planner", "give BatchStepper the planner of a LocomotionStepper to plan activations")
        with self._stages("detect"):
            inputs, previous_forces = self._start(state, self._stiffness * state.activations, dt, self.settings.drag)
        response, velocities, forces, failed = self._predict(inputs, previous_forces)
        predicted = BatchPrediction(response, state.activations, velocities, forces)
        plan = self._planner.plan(inputs, predicted, state.activations, objectives)
        expected = objectives.value(inputs.problem, inputs.contacts, plan.velocities, plan.forces)
        contacts, result = self._solve_plan(inputs, response, plan)
        failed |= plan.failed | result.is_singular
        value = objectives.value(inputs.problem, contacts, result.velocities, result.forces)
        worlds = nonzero(result.converged & ~failed & (value > REPLAN_FACTOR * expected + REPLAN_MARGIN))
        if len(worlds) > 0:
            contacts, result, plan = self._replan(
                worlds, inputs, (contacts, result, plan), state.activations, objectives, value
            )
            failed |= plan.failed | result.is_singular
        result = replace(result, converged=result.converged & ~failed)
        return self._finish(inputs, contacts, result, state, plan.activations, plan), failed

    def _solve_plan(
        self, inputs: BatchInputs, response: BatchLinearization, plan: BatchPlan
    ) -> tuple[ContactSet, BatchResult]:
        """Solve motion and contact with the planned activations, starting at the end that the plan expects."""
        inputs = replace(inputs, tensions=self._stiffness * plan.activations)
        return self.solver.solve(inputs, response, velocities=plan.velocities, forces=plan.forces)

    def _replan(
        self,
        worlds: torch.Tensor,
        inputs: BatchInputs,
        solved: tuple[ContactSet, BatchResult, BatchPlan],
        last: torch.Tensor,
        objectives: BatchObjectives,
        value: torch.Tensor,
    ) -> tuple[ContactSet, BatchResult, BatchPlan]:
        """Plan some worlds again about their solved ends, as ``LocomotionStepper.step`` does, and solve them again.

        Args:
            worlds: (k,) the worlds.
            inputs: steps of all worlds.
            solved: contacts, result and plan of all worlds.
            last: (c, M) m, activations of the previous step.
            objectives: objectives of all worlds.
            value: (c,) their value at the solved ends.

        Returns:
            ``solved``, with the better of both results in each of the ``worlds``.
        """
        assert self._planner is not None
        contacts, result, plan = solved
        old, old_result = contacts.subset(worlds), result.subset(worlds)
        part = replace(inputs.subset(worlds), contacts=old, normal_bias=self.solver.normal_bias(old, inputs.problem.dt))
        response = self.solver.linearize(part.problem, old)
        ends = old_result.velocities, old_result.forces
        predicted = BatchPrediction(response, plan.activations[worlds], *ends)
        other = self._planner.plan(part, predicted, last[worlds], objectives.subset(worlds))
        grown, end = self._solve_plan(part, response, other)
        cost = objectives.subset(worlds).value(part.problem, grown, end.velocities, end.forces)
        capacity, every = grown.capacity, torch.arange(len(value), device=self.device)
        contacts = contacts.with_capacity(capacity).gather(every)
        result = replace(result, forces=padded(result.forces, capacity - result.forces.shape[1])).gather(every)
        plan = plan.gather(every)
        plan.qp_count[worlds] += other.qp_count
        plan.qp_infeasible[worlds] += other.qp_infeasible
        plan.failed[worlds] |= other.failed
        result.is_singular[worlds] |= end.is_singular
        better = nonzero(end.converged & (cost < value[worlds]))
        contacts.scatter(worlds[better], grown.gather(better))
        result.scatter(worlds[better], end.gather(better))
        plan.activations[worlds[better]] = other.activations[better]
        return contacts, result, plan

    def _start(
        self, state: BatchState, tensions: torch.Tensor, dt: float, drag: float
    ) -> tuple[BatchInputs, torch.Tensor]:
        """Detect the contacts of a step of ``dt`` seconds under muscle ``tensions`` (c, M) N.

        Returns:
            Inputs of the solve, and (c, K, 3) N, the forces that these contacts had in the previous step.
        """
        problem = BatchProblem.at(self.common, state.worlds, state.positions, state.velocities, dt=dt, drag=drag)
        gaps, _ = self.detector.gaps_of_worlds(problem.ballistic_positions)
        previous = state.points, state.counts, (state.forces[:, :, 0] > 0.0).int()
        start = self.detector.gaps_of_worlds(state.positions)
        contacts = self.detector.contact_sets(*self.selector.select_in_worlds(previous, gaps), state.positions, start)
        bias, frictions = self.solver.normal_bias(contacts, dt), self._frictions[state.worlds]
        inputs = BatchInputs(problem, contacts, bias, tensions, frictions, *start)
        return inputs, contacts.transferred_forces(state.points, state.forces, state.counts)

    def _predict(
        self, inputs: BatchInputs, previous_forces: torch.Tensor
    ) -> tuple[BatchLinearization, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Predict the end of the step in all worlds, as ``LocomotionStepper.predict`` does.

        Returns:
            Contact linearisation, velocities (c, N, 3) m/s, forces (c, K, 3) N, and (c,) bool, True where a tangent
            could not be factored.
        """
        solver, stages, problem = self.solver, self._stages, inputs.problem
        velocities = problem.rigid_guess.clone()
        with stages("factor"):
            failed = ~problem.factor(velocities, None)
        with stages("elasticity"):
            residual = inputs.trial_at(velocities, previous_forces).residual
        with stages("substitute"):
            newton_step, _ = apply_inverse(problem, residual.flatten(1)[:, :, None])
        trial = velocities - newton_step.view_as(velocities)
        accepted = nonzero(problem.is_inversion_free(trial) & ~failed)
        velocities[accepted] = trial[accepted]
        if len(accepted) > 0:
            with stages("factor"):
                failed[accepted] = ~problem.subset(accepted).factor(velocities[accepted], None)
        response = solver.linearize(problem, inputs.contacts)
        active, forces = nonzero(~failed), previous_forces.clone()
        for _ in range(PREDICTION_ITERATIONS):
            if len(active) == 0:
                break
            part = inputs.subset(active)
            with stages("elasticity"):
                start = part.trial_at(velocities[active], previous_forces[active])
            operands = start.velocities, start.free_residual, start.forces
            step, _ = solver.newton_step(part, response.subset(active), *operands)
            forces[active] = step.target_forces
            ends = step.free_velocities + step.force_velocities
            solved = part.problem.is_inversion_free(ends)
            active = active[solved]
            velocities[active], previous_forces[active] = ends[solved], step.target_forces[solved]
        return response, velocities, forces, failed

    def _finish(
        self,
        inputs: BatchInputs,
        contacts: ContactSet,
        result: BatchResult,
        state: BatchState,
        activations: torch.Tensor,
        plan: BatchPlan | None = None,
    ) -> BatchStep:
        problem = inputs.problem
        end = problem.end_positions(result.velocities)
        with self._stages("detect"):
            gaps, _ = self.detector.gaps_of_worlds(end)
        internal = problem.internal_gradient(result.velocities, self._stiffness * activations)
        after = BatchState(
            *(state.worlds, end, result.velocities, state.time + problem.dt),
            *(contacts.points, contacts.counts, result.forces, activations),
        )
        values: Any = after.positions, after.velocities, after.time
        report: Any = {
            "state": BodyState(*values),
            "dt": problem.dt,
            "contacts": contacts,
            "forces": result.forces,
            "end_gaps": contacts.end_gaps(problem.dt, result.velocities),
            "min_gap": gaps.amin(dim=1),
            "activations": activations,
            "qp_count": 0 if plan is None else plan.qp_count,
            "qp_infeasible": 0 if plan is None else plan.qp_infeasible,
            "newton_iterations": result.iterations,
            "converged": result.converged,
            "added_spin": problem.momentum_correction(internal).norm(dim=1),
        }
        return BatchStep(after, StepReport(**report))
