"""Many worlds of one body side by side on one device, each under activations that are given.

``BatchStepper.advance`` is ``LocomotionStepper.advance_held`` of all of them in lockstep: the same equations, the same
decisions, in kernels over all worlds and products of their matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from egs_warp.contact.batch_contacts import BatchContacts, BatchDetector, padded
from egs_warp.contact.batch_step import BatchLinearization, BatchResult, BatchSolver, StageTimer, no_timer
from egs_warp.contact.coupled_step import CoupledSolver
from egs_warp.contact.detection import ContactGeometry, ContactSet
from egs_warp.contact.selection import ContactSelector
from egs_warp.fem.batch_factors import CHUNK_BYTES, PANEL
from egs_warp.fem.batch_problem import BatchBody, BatchProblem, apply_inverse
from egs_warp.fem.batched import BatchedRecord, nonzero
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.locomotion.rollout import SETTLING_STEP, SETTLING_STEPS, has_settled
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.stepper import MAX_HALVINGS, PREDICTION_ITERATIONS, StepReport, WarmStart
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.render.autograd import torch_stream


@dataclass(frozen=True)
class BatchState(BatchedRecord):
    """Where c worlds are, and what their last steps hand on."""

    worlds: torch.Tensor
    """(c,) int64, ascending: which of the stepper's worlds these are."""
    positions: torch.Tensor
    """(c, N, 3) metres."""
    velocities: torch.Tensor
    """(c, N, 3) m/s."""
    time: torch.Tensor
    """(c,) seconds."""
    points: torch.Tensor
    """(c, K) int64, contact points in use, in each world the first of the K places."""
    counts: torch.Tensor
    """(c,) int32."""
    forces: torch.Tensor
    """(c, K, 3) newtons."""

    @property
    def valid(self) -> torch.Tensor:
        """(c, K) bool: the places that are taken."""
        return torch.arange(self.points.shape[1], device=self.counts.device) < self.counts[:, None]


@dataclass(frozen=True)
class BatchStep(BatchedRecord):
    """What happened in one step of c worlds; on the device until it is asked for."""

    dt: float
    """Seconds."""
    after: BatchState
    contacts: BatchContacts
    forces: torch.Tensor
    """(c, K, 3) newtons."""
    end_gaps: torch.Tensor
    """(c, K) metres."""
    min_gap: torch.Tensor
    """(c,) metres."""
    activations: torch.Tensor
    """(c, M) metres."""
    iterations: torch.Tensor
    """(c,) int64, of Newton's method."""
    converged: torch.Tensor
    """(c,) bool."""
    added_spin: torch.Tensor
    """(c,) rad/s."""

    @property
    def worlds(self) -> torch.Tensor:
        """(c,) int64, ascending: those that made this step."""
        return self.after.worlds

    def reports(self) -> list[StepReport]:
        """One for each of ``worlds``, as the step alone makes it, but that it has no milliseconds."""
        state, contacts = self.after, self.contacts
        host = [
            each.cpu().numpy()
            for each in (state.positions, state.velocities, state.time, contacts.counts, contacts.points)
        ]
        positions, velocities, times, counts, points = host
        nodes, weights, axes, gaps, faces, forces, end_gaps = (
            each.cpu().numpy()
            for each in (
                *(contacts.nodes, contacts.weights, contacts.axes, contacts.gaps, contacts.faces),
                *(self.forces, self.end_gaps),
            )
        )
        min_gap, activations, iterations, converged, spins = (
            each.cpu().numpy()
            for each in (self.min_gap, self.activations, self.iterations, self.converged, self.added_spin)
        )
        made = []
        for world, count in enumerate(counts.tolist()):
            there = slice(0, count)
            touched = ContactSet(
                *(points[world, there], nodes[world, there], weights[world, there], axes[world, there]),
                *(gaps[world, there], faces[world, there].astype(np.int32), positions.shape[1]),
            )
            report = StepReport(
                state=BodyState(positions[world], velocities[world], float(times[world])),
                dt=self.dt,
                contacts=touched,
                forces=forces[world, there],
                end_gaps=end_gaps[world, there],
                min_gap=float(min_gap[world]),
                activations=activations[world],
                qp_count=0,
                qp_infeasible=0,
                newton_iterations=int(iterations[world]),
                converged=bool(converged[world]),
                added_spin=float(spins[world]),
            )
            made.append(report)
        return made


class BatchStepper:
    """Steps of many worlds with one body and one set of muscles, on ground of one shape and of each world's own
    friction.

    It works where the body's assembly lies: on a GPU, where torch sees that too, or on a CPU, which has no use for it
    but to be checked against.
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
        """``frictions`` (B,): Coulomb coefficient of each world's ground, in place of the ``geometry``'s. Factors take
        72 N^2 bytes for each world; ``chunk_bytes`` bounds the matrices that are worked on at a time, beside which some
        times as much is needed. ``panel``: columns that are factored at a time. ``stages`` is told what is being done.

        Raises ``ArgumentError`` for ground that is not flat.
        """
        self.settings = settings or LocomotionSettings()
        self.device = torch.device(str(body.assembly.device))
        count = len(frictions)
        self.body, self.muscles = body, muscles
        near = self.settings.activation_distance * body.height
        points = ContactSelector(geometry, near=near, lower=0.1 * near)
        self.common = BatchBody(body, muscles, count, panel=panel, chunk_bytes=chunk_bytes)
        self.detector = BatchDetector(geometry, points, count, device=self.device)
        self.solver = BatchSolver(
            self.detector,
            push_out_cap=self.settings.push_out_cap * body.speed_unit,
            penetration_tolerance=self.settings.penetration_tolerance * body.height,
            tolerance=CoupledSolver.tolerance,
            stages=stages,
        )
        self._stages = stages
        self._frictions, self._stiffness = self._tensor(frictions), self._tensor(muscles.stiffness)

    def _tensor(self, values: Sequence[float] | np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values, dtype=np.float64), device=self.device)

    def start(self, states: Sequence[BodyState], memories: Sequence[WarmStart] | None = None) -> BatchState:
        """Each world at one of ``states``; what their last steps handed on is in ``memories``, nothing if None."""
        count = len(self._frictions)
        most = max((len(memory.points) for memory in memories or ()), default=0)
        points, forces = np.zeros((count, most), np.int64), np.zeros((count, most, 3))
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
        """``settle`` of every world: at rest on its ground, and (B,) bool, for which that cannot be solved."""
        body, nodes = self.body, self.body.mesh.nodes
        with torch.no_grad(), torch_stream(self.device):
            state = self.start([BodyState(nodes, np.zeros_like(nodes))] * len(self._frictions))
            ends, begun = state.positions.clone(), self._tensor(body.centre_of_mass(nodes))
            lost = torch.zeros(len(ends), dtype=torch.bool, device=self.device)
            for _ in range(SETTLING_STEPS):
                if len(state.worlds) == 0:
                    break
                state, moved, failed = self._passive_step(state, SETTLING_STEP * body.time_unit)
                ends[state.worlds], lost[state.worlds] = state.positions, failed
                gone = (self.common.centre(state.positions)[:, 0] - begun).norm(dim=1)
                state = state.subset(nonzero(~has_settled(body, moved, gone) & ~failed))
        return [BodyState(end, np.zeros_like(end)) for end in ends.cpu().numpy()], lost

    def _passive_step(self, state: BatchState, dt: float) -> tuple[BatchState, torch.Tensor, torch.Tensor]:
        """Without muscles and drag, its end at rest; (c,) metres that a coordinate of a node has moved at most, and
        (c,) bool, for which a tangent had no factors."""
        problem = self._problem(state, dt, 0.0)
        contacts, known, start_gaps = self._detect(problem, state)
        velocities = problem.rigid_guess()
        lost = ~problem.factor(velocities, None)
        contacts, result = self.solver.solve(
            *(problem, contacts, self.solver.linearize(problem, contacts)),
            *(self._stiffness.new_zeros((len(velocities), len(self._stiffness))), self._frictions[state.worlds]),
            velocities=velocities,
            forces=known,
            start_gaps=start_gaps,
        )
        after = BatchState(
            *(state.worlds, problem.end_positions(result.velocities), torch.zeros_like(velocities), state.time),
            *(contacts.points, contacts.counts, result.forces),
        )
        return after, dt * result.velocities.abs().flatten(1).amax(dim=1), lost | result.is_singular

    def advance(
        self, state: BatchState, activations: np.ndarray | torch.Tensor, dt: float
    ) -> tuple[BatchState, list[BatchStep], torch.Tensor]:
        """A step of ``dt`` s of the worlds in ``state`` under ``activations`` (c, M) metres: where those are that it
        can be solved for, what each of them did, in the order of time, and (c,) bool which of ``state`` could not be
        solved, not even in part. Those whose step does not converge make it again in halves."""
        with torch.no_grad(), torch_stream(self.device):
            given = torch.as_tensor(activations, dtype=torch.float64, device=self.device)
            after, done, lost = self._parts(state, given, dt, MAX_HALVINGS)
            fine = torch.zeros(len(self._frictions), dtype=torch.bool, device=self.device)
            for step in done:
                fine[step.worlds] |= step.converged
            lost |= ~fine[state.worlds]
            fine[state.worlds[lost]] = False
            told = [step.subset(nonzero(fine[step.worlds])) for step in done]
            return after.subset(nonzero(fine[after.worlds])), [step for step in told if len(step.worlds) > 0], lost

    def _parts(
        self, state: BatchState, activations: torch.Tensor, dt: float, left: int
    ) -> tuple[BatchState, list[BatchStep], torch.Tensor]:
        """Steps of ``dt``, those that do not converge in halves, so many times over as are ``left``; (c,) bool, which
        worlds were lost on the way."""
        step, lost = self._step(state, activations, dt)
        again = nonzero(~step.converged & ~lost)
        if left == 0 or len(again) == 0:
            fine = nonzero(~lost)
            return step.after.subset(fine), [step.subset(fine)], lost
        fine = nonzero(step.converged & ~lost)
        done, after = [step.subset(fine)], step.after.subset(fine)
        half, rows, given = state.gather(again), again, activations[again]
        for _ in range(2):
            half, parts, gone = self._parts(half, given, 0.5 * dt, left - 1)
            done += parts
            lost[rows[gone]] = True
            rows, given = rows[~gone], given[~gone]
        return _merged(after, half), done, lost

    def _step(self, state: BatchState, activations: torch.Tensor, dt: float) -> tuple[BatchStep, torch.Tensor]:
        """``LocomotionStepper.held_step`` of the worlds in ``state``; (c,) bool, for which a tangent had no factors."""
        frictions, tensions = self._frictions[state.worlds], self._stiffness * activations
        with self._stages("detect"):
            problem = self._problem(state, dt, self.settings.drag)
            contacts, known, start_gaps = self._detect(problem, state)
        response, velocities, forces, lost = self._predict(problem, contacts, known, tensions, frictions)
        contacts, result = self.solver.solve(
            *(problem, contacts, response, tensions, frictions),
            velocities=velocities,
            forces=forces,
            start_gaps=start_gaps,
        )
        step = self._finish(problem, contacts, result, state, activations)
        lost |= result.is_singular
        return replace(step, converged=step.converged & ~lost), lost

    def _problem(self, state: BatchState, dt: float, drag: float) -> BatchProblem:
        return BatchProblem.at(self.common, state.worlds, state.positions, state.velocities, dt=dt, drag=drag)

    def _detect(
        self, problem: BatchProblem, state: BatchState
    ) -> tuple[BatchContacts, torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        """Contacts, the forces (c, K, 3) newtons that they had in the last step, and gaps and faces at the start."""
        ballistic = state.velocities + problem.dt * self.common.gravity
        gaps, _ = self.detector.gaps(problem.end_positions(ballistic))
        chosen = self.detector.select(state.points, state.valid, state.forces[:, :, 0] > 0.0, gaps)
        start_gaps = self.detector.gaps(state.positions)
        contacts = self.detector.contacts(chosen, *start_gaps)
        return contacts, self.detector.transfer_forces(contacts, state.points, state.valid, state.forces), start_gaps

    def _predict(
        self,
        problem: BatchProblem,
        contacts: BatchContacts,
        known: torch.Tensor,
        tensions: torch.Tensor,
        frictions: torch.Tensor,
    ) -> tuple[BatchLinearization, torch.Tensor, torch.Tensor, torch.Tensor]:
        """``LocomotionStepper.foresee``: response, velocities (c, N, 3), forces (c, K, 3), and (c,) bool, for which a
        tangent had no factors."""
        solver, stages = self.solver, self._stages
        velocities, shift = problem.rigid_guess(), solver.normal_bias(contacts, problem.dt)
        with stages("factor"):
            lost = ~problem.factor(velocities, None)
        with stages("elasticity"):
            missing = problem.residual(velocities, tensions)
        missing = missing - problem.dt * contacts.nodal_forces(known, velocities.shape[1])
        with stages("substitute"):
            moved, _ = apply_inverse(problem, missing.flatten(1)[:, :, None])
        ahead = velocities - moved.view_as(velocities)
        taken = nonzero(problem.is_inversion_free(ahead) & ~lost)
        velocities[taken] = ahead[taken]
        if len(taken) > 0:
            with stages("factor"):
                lost[taken] = ~problem.subset(taken).factor(velocities[taken], None)
        response = solver.linearize(problem, contacts)
        looking, forces = nonzero(~lost), known.clone()
        for _ in range(PREDICTION_ITERATIONS):
            if len(looking) == 0:
                break
            part, touched, answer = problem.subset(looking), contacts.subset(looking), response.subset(looking)
            with stages("elasticity"):
                missing = part.residual(velocities[looking], tensions[looking])
            with stages("substitute"):
                moved, _ = apply_inverse(part, missing.flatten(1)[:, :, None], answer.momentum_projection)
            free = velocities[looking] - moved.view_as(missing)
            found, _ = solver.solve_coulomb(touched, answer, free, shift[looking], frictions[looking], known[looking])
            ahead = free + (answer.columns @ found.flatten(1)[:, :, None]).view_as(free)
            fine = part.is_inversion_free(ahead)
            forces[looking] = found
            looking = looking[fine]
            velocities[looking], known[looking] = ahead[fine], found[fine]
        return response, velocities, forces, lost

    def _finish(
        self,
        problem: BatchProblem,
        contacts: BatchContacts,
        result: BatchResult,
        state: BatchState,
        activations: torch.Tensor,
    ) -> BatchStep:
        end = problem.end_positions(result.velocities)
        with self._stages("detect"):
            gaps, _ = self.detector.gaps(end)
        internal = problem.internal_gradient(result.velocities, self._stiffness * activations)
        after = BatchState(
            *(state.worlds, end, result.velocities, state.time + problem.dt),
            *(contacts.points, contacts.counts, result.forces),
        )
        return BatchStep(
            dt=problem.dt,
            after=after,
            contacts=contacts,
            forces=result.forces,
            end_gaps=contacts.end_gaps(problem.dt, result.velocities),
            min_gap=gaps.amin(dim=1),
            activations=activations,
            iterations=result.iterations,
            converged=result.converged,
            added_spin=problem.momentum_correction(internal).norm(dim=1),
        )


def _merged(one: BatchState, other: BatchState) -> BatchState:
    """The worlds of both, which are others, in ascending order."""
    most = max(one.points.shape[1], other.points.shape[1])
    one, other = (
        replace(each, points=padded(each.points, more), forces=padded(each.forces, more))
        for each, more in ((each, most - each.points.shape[1]) for each in (one, other))
    )
    values = {
        field.name: torch.cat([getattr(one, field.name), getattr(other, field.name)]) for field in fields(BatchState)
    }
    both = BatchState(**values)
    return both.gather(torch.argsort(both.worlds))
