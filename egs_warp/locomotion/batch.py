"""Steps of many worlds of one body in lockstep on one device, each under prescribed activations.

For each world, ``BatchStepper.advance`` solves the same equations and makes the same decisions as
``LocomotionStepper.advance_with_activations``, with kernels over all worlds and batched matrix products.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch

from egs_warp.contact.batch_step import BatchInputs, BatchLinearization, BatchResult, BatchSolver, StageTimer, no_timer
from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.detection import ContactDetector, ContactGeometry
from egs_warp.contact.selection import ContactSelector
from egs_warp.fem.batch_problem import BatchBody, BatchProblem, apply_inverse
from egs_warp.fem.batched import BatchedRecord, nonzero, padded
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.panel_cholesky import CHUNK_BYTES, PANEL
from egs_warp.locomotion.linear_step import PREDICTION_ITERATIONS
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.settling import SETTLING_STEP, SETTLING_STEPS, has_settled
from egs_warp.locomotion.stepper import MAX_HALVINGS, StepReport, WarmStart
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.render.autograd import torch_stream


@dataclass(frozen=True)
class BatchState(BatchedRecord):
    """State of c worlds and the warm start of their next step."""

    worlds: torch.Tensor
    """(c,) int64, ascending indices of these worlds among all worlds of the stepper."""
    positions: torch.Tensor
    """(c, N, 3) m, nodal positions."""
    velocities: torch.Tensor
    """(c, N, 3) m/s, nodal velocities."""
    time: torch.Tensor
    """(c,) s, time since the start of the simulation."""
    points: torch.Tensor
    """(c, K) int32, contact points in use; each world uses the first ``counts`` of the K slots."""
    counts: torch.Tensor
    """(c,) int32, number of contact points in use."""
    forces: torch.Tensor
    """(c, K, 3) N, contact forces in the axes of each contact."""


@dataclass(frozen=True)
class BatchStep(BatchedRecord):
    """Result of one step of c worlds, on the device."""

    after: BatchState
    """State at the end of the step."""
    report: StepReport
    """Report of all worlds, with tensors that have a leading world axis, and without timings."""

    @property
    def worlds(self) -> torch.Tensor:
        """(c,) int64, ascending, worlds that made this step."""
        return self.after.worlds

    def reports(self) -> list[StepReport]:
        """Download the step; return one report for each of ``worlds``, in the form of ``LocomotionStepper``."""
        reports, counts = self.report.download(), self.after.counts.tolist()
        return [
            replace(report, forces=report.forces[:count], end_gaps=report.end_gaps[:count])
            for report, count in zip(reports, counts, strict=True)
        ]


class BatchStepper:
    """Stepper of many worlds with the same body, muscles and ground. Each world has its own friction.

    It runs on the device of the body's ``assembly``: a GPU that PyTorch supports, or a CPU in tests.
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
        stages: StageTimer = no_timer,
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
        counts = np.zeros(count, np.int32)
        for world, memory in enumerate(memories or ()):
            counts[world] = len(memory.points)
            points[world, : counts[world]], forces[world, : counts[world]] = memory.points, memory.forces
        return BatchState(
            torch.arange(count, device=self.device),
            self._tensor(np.stack([state.positions for state in states])),
            self._tensor(np.stack([state.velocities for state in states])),
            self._tensor([state.time for state in states]),
            torch.as_tensor(points, device=self.device),
            torch.as_tensor(counts, device=self.device),
            self._tensor(forces),
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
            *(contacts.points, contacts.counts, result.forces),
        )
        return after, dt * result.velocities.abs().flatten(1).amax(dim=1), failed | result.is_singular

    def advance(
        self, state: BatchState, activations: np.ndarray | torch.Tensor, dt: float
    ) -> tuple[BatchState, list[BatchStep], torch.Tensor]:
        """Make one step of ``dt`` seconds. Where it does not converge, make shorter steps instead.

        Args:
            state: worlds to step.
            activations: (c, M) m, muscle activations.
            dt: step size, s.

        Returns:
            The state of the solved worlds; their steps in chronological order; and (c,) bool, True for failed worlds of
            ``state``: a tangent could not be factored, or no part of the step converged.
        """
        with torch.no_grad(), torch_stream(self.device):
            on_device = torch.as_tensor(activations, dtype=torch.float64, device=self.device)
            after, done, failed = self._parts(state, on_device, dt, MAX_HALVINGS)
            solved = torch.zeros(len(self._frictions), dtype=torch.bool, device=self.device)
            for step in done:
                solved[step.worlds] |= step.report.converged
            failed |= ~solved[state.worlds]
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
        """Make a step of ``dt`` seconds. In worlds in which it does not converge, make two half steps instead. A step
        is halved up to ``max_halvings`` times.

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
        done, after = [step.subset(solved)], step.after.subset(solved)
        half, rows, half_activations = state.gather(repeated), repeated, activations[repeated]
        for _ in range(2):
            half, parts, half_failed = self._parts(half, half_activations, 0.5 * dt, max_halvings - 1)
            done += parts
            failed[rows[half_failed]] = True
            rows, half_activations = rows[~half_failed], half_activations[~half_failed]
        return _merged(after, half), done, failed

    def _step(self, state: BatchState, activations: torch.Tensor, dt: float) -> tuple[BatchStep, torch.Tensor]:
        """Make one step of all worlds, as ``LocomotionStepper.step_with_activations`` does. Also return (c,) bool, True
        where a tangent could not be factored."""
        with self._stages("detect"):
            inputs, previous_forces = self._start(state, self._stiffness * activations, dt, self.settings.drag)
        response, velocities, forces, failed = self._predict(inputs, previous_forces)
        contacts, result = self.solver.solve(inputs, response, velocities=velocities, forces=forces)
        failed |= result.is_singular
        result = replace(result, converged=result.converged & ~failed)
        return self._finish(inputs, contacts, result, state, activations), failed

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
    ) -> BatchStep:
        problem = inputs.problem
        end = problem.end_positions(result.velocities)
        with self._stages("detect"):
            gaps, _ = self.detector.gaps_of_worlds(end)
        internal = problem.internal_gradient(result.velocities, inputs.tensions)
        after = BatchState(
            *(state.worlds, end, result.velocities, state.time + problem.dt),
            *(contacts.points, contacts.counts, result.forces),
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
            "qp_count": 0,
            "qp_infeasible": 0,
            "newton_iterations": result.iterations,
            "converged": result.converged,
            "added_spin": problem.momentum_correction(internal).norm(dim=1),
        }
        return BatchStep(after, StepReport(**report))


def _merged(one: BatchState, other: BatchState) -> BatchState:
    """Return the worlds of both states, which are disjoint, in ascending order."""
    capacity = max(one.points.shape[1], other.points.shape[1])
    one, other = (
        replace(each, points=padded(each.points, more), forces=padded(each.forces, more))
        for each, more in ((each, capacity - each.points.shape[1]) for each in (one, other))
    )
    values = {
        field.name: torch.cat([getattr(one, field.name), getattr(other, field.name)]) for field in fields(BatchState)
    }
    both = BatchState(**values)
    return both.gather(torch.argsort(both.worlds))
