"""The stepper in the making: foresee the contact, choose the muscles, solve motion and contact together (Eq. 4, 9, 13).

It replaces ``stepper`` once a whole run shows it no worse; until then nothing but tests and trials uses it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sparse

from egs_warp.contact.coupled_step import ContactResponse, CoupledResult, CoupledSolver
from egs_warp.contact.detection import ContactDetector, ContactGeometry, ContactSet, tangent_directions
from egs_warp.contact.points import ContactPoints
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.sparse_factors import SparseFactors
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.complementarity import SEPARATE, ContactLayout, states_from_prediction
from egs_warp.locomotion.objectives import Objective, SpinObjective, lifted_contacts
from egs_warp.locomotion.program import CostScales, LinearResponse, program_of
from egs_warp.locomotion.stepper import LocomotionSettings, StepMemory, StepReport
from egs_warp.locomotion.strategies import SearchResult, find_states
from egs_warp.locomotion.synergies import find_synergies
from egs_warp.muscles.muscle_set import MuscleColumns, MuscleSet
from egs_warp.muscles.tension import MuscleTension

_ORDINARY_STRENGTH = 4.0
_STEPS_A_UNIT = 19.0
_FASTEST = 5.0
"""Bounds of activations, in their bounds a sqrt(H / g): how fast a muscle is switched on and off."""
_LOADED = 1e-3
"""Body weights on a region, from which its foreseen forces tell how it presses."""


class CoupledStepper:
    """Orchestrates the kernels and the QP for one body."""

    def __init__(
        self,
        body: SoftBody,
        muscles: MuscleSet,
        geometry: ContactGeometry,
        *,
        settings: LocomotionSettings | None = None,
        device: str | None = None,
    ) -> None:
        self.body, self.muscles, self.geometry = body, muscles, geometry
        self.settings = settings or LocomotionSettings()
        self.detector = ContactDetector(geometry, device=device)
        self.points = ContactPoints(
            geometry, near=self.settings.near * body.height, lower=0.1 * self.settings.near * body.height
        )
        self.speed_scale = float(np.sqrt(np.linalg.norm(body.gravity) * body.height))
        self._columns = MuscleColumns(muscles, device=device or "cpu")
        self._factors = SparseFactors(body.assembly.upper_pattern)
        self.solver = CoupledSolver(
            self.detector,
            self.points,
            self._factors,
            push_out_cap=self.settings.push_out_cap * self.speed_scale,
            penetration_tolerance=self.settings.penetration_tolerance * body.height,
        )
        rest = BodyState(body.mesh.nodes, np.zeros_like(body.mesh.nodes))
        problem = StepProblem(body, rest, np.sqrt(body.height / np.linalg.norm(body.gravity)) / _STEPS_A_UNIT)
        tangent = problem.tangent(self._factors, rest.velocities, None)
        full = self._columns.sparse(rest.positions).toarray() * muscles.bounds
        self.synergies = find_synergies(muscles, tangent.solve(full), body.node_mass)

    def initial_memory(self) -> StepMemory:
        """No contacts, muscles at rest."""
        return StepMemory(np.zeros(0, int), np.zeros((0, 3)), np.zeros(self.muscles.segment_count))

    def advance(
        self,
        state: BodyState,
        memory: StepMemory,
        objectives: Sequence[Objective | SpinObjective],
        dt: float,
        *,
        depth: int = 0,
    ) -> tuple[BodyState, StepMemory, list[StepReport]]:
        """One step of ``dt``; a step that does not converge is done again as two halves, at most four times over."""
        end, after, report = self.step(state, memory, objectives, dt)
        if report.converged or depth == 4:
            return end, after, [report]
        middle, between, first = self.advance(state, memory, objectives, dt / 2, depth=depth + 1)
        end, after, second = self.advance(middle, between, objectives, dt / 2, depth=depth + 1)
        return end, after, first + second

    def step(
        self, state: BodyState, memory: StepMemory, objectives: Sequence[Objective | SpinObjective], dt: float
    ) -> tuple[BodyState, StepMemory, StepReport]:
        """Detect, foresee, program, solve, report."""
        clock = _Clock()
        problem = StepProblem(self.body, state, dt, self.settings.drag)
        contacts = self._detect(problem, memory)
        clock.lap("detect")
        before = MuscleTension.of(self.muscles, memory.activations)
        response, foreseen, forces = self._foresee(problem, contacts, memory, before)
        clock.lap("foresee")
        plan = self._program(response, foreseen, forces, before, memory, objectives, clock)
        result = self.solver.solve(
            response,
            MuscleTension.of(self.muscles, plan.activations),
            velocities=plan.velocities,
            forces=plan.forces,
        )
        clock.lap("solve")
        return self._finish(problem, plan, result, clock)

    def _detect(self, problem: StepProblem, memory: StepMemory) -> ContactSet:
        ballistic = problem.state.velocities + problem.dt * self.body.gravity
        gaps, _ = self.detector.gaps(problem.end_positions(ballistic))
        return self.detector.contact_set(
            self.points.choose(memory.points, memory.forces[:, 0] > 0.0, gaps), problem.state.positions
        )

    def _foresee(
        self, problem: StepProblem, contacts: ContactSet, memory: StepMemory, tension: MuscleTension
    ) -> tuple[ContactResponse, np.ndarray, np.ndarray]:
        """Response of the contacts; velocities (N, 3) and contact forces (n, 3) that last step's activations would
        bring.
        """
        start = problem.state.velocities
        if not problem.feasible(start):
            start = np.zeros_like(start)
        tangent = problem.tangent(self._factors, start, tension)
        response = ContactResponse.of(tangent, contacts)
        free = start.ravel() - tangent.solve(problem.residual(start, tension).ravel())
        shift = self.solver.shift(contacts, problem.dt)
        forces = response.forces(
            free, shift, self.geometry.friction, self.points.matched(contacts.points, memory.points, memory.forces)
        )
        foreseen = (free + response.columns @ forces.ravel()).reshape(start.shape)
        return response, foreseen if problem.feasible(foreseen) else start, forces

    def _program(
        self,
        response: ContactResponse,
        foreseen: np.ndarray,
        forces: np.ndarray,
        before: MuscleTension,
        memory: StepMemory,
        objectives: Sequence[Objective | SpinObjective],
        clock: _Clock,
    ) -> _Plan:
        problem, settings, members = response.tangent.problem, self.settings, self.synergies.members
        regions = self._regions(response.contacts, forces)
        count = regions.get_shape()[1]
        layout = ContactLayout(self.synergies.count, count, settings.directions)
        spread = sparse.kron(regions, np.eye(3)).tocsr()
        frame = (spread.T @ response.contacts.frame).tocsr()
        each = self._columns.sparse(problem.end_positions(foreseen)).toarray() * self.muscles.bounds
        actuation = (members.T @ each.T).T
        # Without muscles and contact, in their stiffness at last step's tension.
        free = problem.residual(foreseen, None).ravel()
        solved = response.tangent.solve(np.column_stack([problem.dt * actuation, free]))
        table = tangent_directions(settings.directions)

        def by_unknown(columns: np.ndarray) -> np.ndarray:
            """(rows, variables) from those of the muscles (rows, M) and of the normals and tangents (rows, n, 3)."""
            forces = self.body.weight * (columns @ spread).reshape(len(columns), count, 3)
            tangent = np.einsum("vnt,dt->vnd", forces[:, :, 1:], table).reshape(len(columns), count * len(table))
            return np.hstack([forces[:, :, 0], tangent, np.zeros((len(columns), count))])

        # How the foreseen forces differ from those that regions can make stays as it is.
        totals = np.asarray(regions.astype(bool).astype(float).T @ forces)
        uneven = (forces - regions @ totals).ravel()
        linear = LinearResponse(
            foreseen.ravel() - solved[:, -1] + response.columns @ uneven,
            np.hstack([solved[:, :-1], by_unknown(response.columns)]),
        )
        torques = problem.dt * (problem.turns.T @ response.contacts.frame.T)
        moments = np.hstack([np.zeros((3, layout.activations)), by_unknown(torques)])
        shift = self.solver.shift(response.contacts, problem.dt)
        clock.lap("linearise")
        share = problem.dt * _STEPS_A_UNIT / np.sqrt(self.body.height / np.linalg.norm(self.body.gravity))
        strength = self.muscles.max_forces / (_ORDINARY_STRENGTH * self.body.weight)
        previous = self.synergies.mean(memory.activations / self.muscles.bounds)
        program = program_of(
            problem,
            linear,
            frame,
            regions.T @ shift,
            moments,
            layout,
            objectives,
            previous,
            friction=self.geometry.friction,
            scales=CostScales(
                self.speed_scale,
                settings.activation_weight * share**2 * (members.T @ strength),
                settings.activation_change_weight * share * (members.T @ strength**2),
            ),
        )
        slip = (frame @ foreseen.ravel()).reshape(-1, 3)[:, 1:]
        states = states_from_prediction(totals[:, 0], totals[:, 1:], slip, self.geometry.friction, settings.directions)
        states[regions.T @ lifted_contacts(response.contacts, objectives) > 0.5] = SEPARATE
        reach = _FASTEST * problem.dt / np.sqrt(self.body.height / np.linalg.norm(self.body.gravity))
        program = replace(program, reachable=(np.maximum(previous - reach, -1.0), np.minimum(previous + reach, 1.0)))
        found = find_states(
            program, settings.strategy, states, previous, qp_limit=settings.qp_limit, solver=settings.qp_solver
        )
        clock.lap("qp")
        if found.y is None:
            return _Plan(memory.activations, foreseen, forces, found)
        activations = (members @ np.clip(found.y[: layout.activations], -1.0, 1.0)) * self.muscles.bounds
        moved = linear.base + linear.response[:, : layout.activations] @ found.y[: layout.activations]
        forces = response.forces(moved, shift, self.geometry.friction, forces)
        velocities = (moved + response.columns @ forces.ravel()).reshape(foreseen.shape)
        if not problem.feasible(velocities):
            velocities = foreseen
        return _Plan(activations, velocities, forces, found)

    def _regions(self, contacts: ContactSet, forces: np.ndarray) -> sparse.csr_matrix:
        """(n, regions) share of each contact in the force of the region of the sole that stands for it in the program:
        as the foreseen normal ``forces`` (n, 3) are shared, or alike where there are none.
        """
        _, region = np.unique(
            np.column_stack([self.points.region_from_point[contacts.points], np.round(contacts.axes[:, 0], 6)]),
            axis=0,
            return_inverse=True,
        )
        region = region.ravel()
        totals = np.bincount(region, forces[:, 0])
        loaded = totals > _LOADED * self.body.weight
        shares = np.where(loaded[region], forces[:, 0], 1.0)
        shares = shares / np.bincount(region, shares)[region]
        shape = (contacts.count, len(totals))
        return sparse.csr_matrix((shares, (np.arange(contacts.count), region)), shape=shape)

    def _finish(
        self, problem: StepProblem, plan: _Plan, result: CoupledResult, clock: _Clock
    ) -> tuple[BodyState, StepMemory, StepReport]:
        end = problem.end_positions(result.velocities)
        gaps, _ = self.detector.gaps(end)
        after = BodyState(end, result.velocities, problem.state.time + problem.dt)
        internal = problem.internal_gradient(result.velocities, MuscleTension.of(self.muscles, plan.activations))
        clock.lap("report")
        report = StepReport(
            state=after,
            dt=problem.dt,
            contacts=result.contacts,
            forces=result.forces,
            end_gaps=result.contacts.end_gaps(problem.dt, result.velocities),
            min_gap=float(gaps.min()),
            activations=plan.activations,
            qp_count=plan.search.qp_count,
            qp_infeasible=plan.search.infeasible,
            newton_iterations=result.iterations,
            converged=result.converged,
            added_spin=float(np.linalg.norm(problem.spin(internal))),
            milliseconds=clock.milliseconds,
        )
        return after, StepMemory(result.contacts.points, result.forces, plan.activations), report


@dataclass(frozen=True)
class _Plan:
    activations: np.ndarray
    velocities: np.ndarray
    forces: np.ndarray
    search: SearchResult


@dataclass
class _Clock:
    milliseconds: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.milliseconds[name] = 1e3 * (now - self._last)
        self._last = now
