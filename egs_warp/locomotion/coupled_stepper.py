"""The stepper in the making: foresee the contact, choose the muscles, solve motion and contact together (Eq. 4, 9, 13).

It replaces ``stepper`` once a whole run shows it no worse; until then nothing but tests and trials uses it.
"""

from __future__ import annotations

import os
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
from egs_warp.locomotion.contact_pieces import ContactModes, ContactPieces, search_pieces
from egs_warp.locomotion.objectives import Objective, SpinObjective
from egs_warp.locomotion.stepper import LocomotionSettings, StepMemory, StepReport
from egs_warp.locomotion.strategies import SearchResult
from egs_warp.locomotion.synergies import find_synergies
from egs_warp.muscles.muscle_set import MuscleColumns, MuscleSet
from egs_warp.muscles.tension import MuscleTension

_ORDINARY_STRENGTH = 4.0
_STEPS_A_UNIT = 19.0
_FASTEST = float(os.environ.get("FAST", "5.0"))
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

    def passive_step(self, state: BodyState, memory: StepMemory, dt: float) -> CoupledResult:
        """A step of ``dt`` s without muscles."""
        problem = StepProblem(self.body, state, dt)
        contacts = self._detect(problem, memory)
        response = ContactResponse.of(problem.tangent(self._factors, state.velocities, None), contacts)
        forces = self.points.matched(contacts.points, memory.points, memory.forces)
        return self.solver.solve(response, None, velocities=state.velocities, forces=forces)

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
        contacts, weight = response.contacts, self.body.weight
        each = self._columns.sparse(problem.end_positions(foreseen)).toarray() * self.muscles.bounds
        actuation = (members.T @ each.T).T
        m = self.synergies.count
        # Without muscles and contact, in their stiffness at last step's tension.
        free = problem.residual(foreseen, None).ravel()
        solved = response.tangent.solve(np.column_stack([problem.dt * actuation, free]))
        base = foreseen.ravel() - solved[:, -1]
        to_velocity = np.hstack([solved[:, :-1], weight * response.columns])
        torques = np.hstack(
            [np.zeros((3, m)), problem.dt * weight * (problem.turns.T @ contacts.frame.T.toarray())]
        )
        shift = self.solver.shift(contacts, problem.dt)
        clock.lap("linearise")
        share = problem.dt * _STEPS_A_UNIT / np.sqrt(self.body.height / np.linalg.norm(self.body.gravity))
        strength = self.muscles.max_forces / (_ORDINARY_STRENGTH * weight)
        previous = self.synergies.mean(memory.activations / self.muscles.bounds)
        effort = settings.activation_weight * share**2 * (members.T @ strength)
        change = settings.activation_change_weight * share * (members.T @ strength**2)
        P, q, constant = self._cost(problem, base, to_velocity, torques, objectives, foreseen)
        k = np.arange(m)
        P[k, k] += 2.0 * (effort + change) + 1e-7
        q[:m] -= 2.0 * change * previous
        constant += float(change @ previous**2)
        rows = np.hstack([contacts.frame @ solved[:, :-1], weight * response.delassus]) / self.speed_scale
        offset = contacts.frame @ base / self.speed_scale
        offset[::3] += shift / self.speed_scale
        reach = _FASTEST * problem.dt / np.sqrt(self.body.height / np.linalg.norm(self.body.gravity))
        program = ContactPieces(
            P,
            q,
            constant,
            rows,
            offset,
            self.geometry.friction,
            np.maximum(previous - reach, -1.0),
            np.minimum(previous + reach, 1.0),
        )
        start = np.concatenate([previous, forces.ravel() / weight])
        modes = ContactModes.of(forces, (contacts.frame @ foreseen.ravel()).reshape(-1, 3), self.geometry.friction)
        clock.lap("program")
        found = search_pieces(program, start, modes, qp_limit=settings.qp_limit, solver=settings.qp_solver)
        clock.lap("qp")
        search = SearchResult(found.x, False, modes.kind, found.objective, found.qp_count, found.infeasible)
        if found.x is None:
            return _Plan(memory.activations, foreseen, forces, search)
        activations = (members @ np.clip(found.x[:m], -1.0, 1.0)) * self.muscles.bounds
        moved = base + solved[:, :-1] @ found.x[:m]
        planned = weight * found.x[m:].reshape(-1, 3)
        forces = response.forces(moved, shift, self.geometry.friction, planned)
        if os.environ.get("DBG"):
            vq = base + to_velocity @ found.x
            parts = []
            for o in objectives:
                if isinstance(o, SpinObjective):
                    gy = np.sqrt(0.5 * np.trace(self.body.inertia(problem.state.positions)) / self.body.mass)
                    un = self.body.mass * gy * self.speed_scale
                    e = (torques @ found.x + self.body.angular_momentum(problem.state.positions, problem.state.velocities) - o.target) / un
                else:
                    e = (o.rows @ vq - o.target) / self.speed_scale
                parts.append("%s %.3f (%s)" % (getattr(o, "name", "spin"), o.weight * (e @ e), " ".join("%.3f" % z for z in e[:3])))
            print("     ", "; ".join(parts))
            self.dbg = dict(foreseen=start[m::3].sum(), planned=planned[:, 0].sum() / weight, vq=self.body.centre_of_mass(vq.reshape(-1,3))[2]/self.speed_scale, obj=found.objective, relaxed=found.infeasible, n=found.qp_count, act=np.abs(found.x[:m]).max(), sat=int((np.abs(found.x[:m]-previous)>reach-1e-4).sum()))
        velocities = (moved + response.columns @ forces.ravel()).reshape(foreseen.shape)
        if not problem.feasible(velocities):
            velocities = foreseen
        clock.lap("contact")
        return _Plan(activations, velocities, forces, search)

    def _cost(
        self,
        problem: StepProblem,
        base: np.ndarray,
        to_velocity: np.ndarray,
        torques: np.ndarray,
        objectives: Sequence[Objective | SpinObjective],
        foreseen: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """P, q and constant of the objectives over activations and forces."""
        body, state = self.body, problem.state
        count = to_velocity.shape[1]
        P, q, constant = np.zeros((count, count)), np.zeros(count), 0.0
        for objective in objectives:
            if isinstance(objective, SpinObjective):
                gyration = np.sqrt(0.5 * np.trace(body.inertia(state.positions)) / body.mass)
                unit = body.mass * gyration * self.speed_scale
                rows = torques / unit
                gap = (body.angular_momentum(state.positions, state.velocities) - objective.target) / unit
            else:
                rows = (objective.rows @ to_velocity) / self.speed_scale
                gap = (objective.rows @ base - objective.target) / self.speed_scale
            P += 2.0 * objective.weight * rows.T @ rows
            q += 2.0 * objective.weight * rows.T @ gap
            constant += objective.weight * float(gap @ gap)
        we = float(os.environ.get("WE", "0.1"))
        if we > 0:
            assembly, end = body.assembly, problem.end_positions(foreseen)
            damping = problem.damping if os.environ.get('DMP', '1') == '1' else None
            K = assembly.matrix(assembly.matrix_entries(end, damping, projected=True))
            K = (K + sparse.triu(K, 1).T).tocsr()
            tau = max(float(os.environ.get("TAU", "0")) * np.sqrt(body.height / 9.81), problem.dt)
            moved = np.column_stack([tau * to_velocity, tau * base - problem.dt * foreseen.ravel()])
            stiff = K @ moved
            force = assembly.gradient(end, damping).ravel()
            unit = we / (body.weight * body.height)
            quadratic = moved.T @ stiff
            P += unit * quadratic[:-1, :-1]
            q += unit * (force @ moved[:, :-1] + quadratic[:-1, -1])
            constant += unit * (assembly.energy(end, damping) + force @ moved[:, -1] + 0.5 * quadratic[-1, -1])
        return P, q, constant

    def _finish(
        self, problem: StepProblem, plan: _Plan, result: CoupledResult, clock: _Clock
    ) -> tuple[BodyState, StepMemory, StepReport]:
        if os.environ.get("DBG"):
            w = self.body.weight; d = self.dbg
            lin = plan.forces[:, 0].sum()/w
            print("   fore %.2f planned %.2f lin %.2f got %.2f | com planned %.4f got %.4f before %.4f | obj %.2e relaxed %d n %d act %.2f sat %d newt %d tang %d" % (d["foreseen"], d["planned"], lin, result.forces[:,0].sum()/w, d["vq"], self.body.centre_of_mass(result.velocities)[2]/self.speed_scale, self.body.centre_of_mass(problem.state.velocities)[2]/self.speed_scale, d["obj"], d["relaxed"], d["n"], d["act"], d["sat"], result.iterations, result.tangents))
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
