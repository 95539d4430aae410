"""The stepper: foresee the contact, choose the muscles, solve motion and contact together (Eq. 4, 9, 12, 13)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from egs_warp.contact.coupled_step import ContactResponse, CoupledResult, CoupledSolver
from egs_warp.contact.detection import ContactDetector, ContactGeometry, ContactSet
from egs_warp.contact.points import ContactPoints
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.sparse_factors import SparseFactors
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.contact_pieces import ContactPieces
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.step_cost import LinearStep, QuadraticCost, effort_cost, objectives_cost, objectives_missed
from egs_warp.locomotion.strategies import Foreseen, Strategy, search_program
from egs_warp.locomotion.synergies import find_synergies
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleTension, muscle_columns

_ORDINARY_STRENGTH = 4.0
STEPS_A_UNIT = 19.0
"""Least number of steps in sqrt(H / g) within which a body can be steered."""
_FASTEST = 7.0
"""Bounds of activations, in their bounds a sqrt(H / g): how fast a muscle is switched on and off."""
_REGULAR = 1e-7
_MOST_HALVINGS = 4
_AMISS, _LITTLE = 1.2, 0.01
"""A step whose end costs more than this factor of what its program expected, and this much more, is asked for again."""
_LOOKS = 3
"""Newton steps in which a step is foreseen: the first starts from afar."""


@dataclass(frozen=True)
class LocomotionSettings:
    """Numbers of the stepper; lengths are in body heights, forces in body weights, speeds in sqrt(g H)."""

    near: float = 0.01
    """A point takes part if the step may bring it this near to a plane."""
    penetration_tolerance: float = 5e-3
    push_out_cap: float = 0.05
    qp_limit: int = 12
    """QPs a step at most; in doubt ``strategies.PATIENCE`` times as many for all strategies but ``pieces``."""
    qp_solver: QpSolver | str = QpSolver.OSQP
    strategy: Strategy | str = Strategy.PIECES
    directions: int = 4
    """n_d, edges of the friction pyramid of all strategies but ``pieces``, which has the cone."""
    activation_weight: float = 2e-4
    """For a step of sqrt(H / g) / 19 and a muscle of 4 body weights. Shorter steps change speeds by less, so they weigh
    activations less: by the square of their share. Stronger muscles weigh more, as their force."""
    activation_change_weight: float = 3e-3
    """Likewise, by the step's share, and by the square of the force: the strong muscles of a stiff body would else play
    full strokes against each other from step to step, further than the linearised program knows the way."""
    drag: float = 0.0
    """alpha, 1/s."""

    def __post_init__(self) -> None:
        # Names that are not known are refused here, not in the first step.
        QpSolver(self.qp_solver)
        Strategy(self.strategy)


@dataclass(frozen=True)
class StepMemory:
    """What a step hands to the next."""

    points: np.ndarray
    """(n,) contact points in use."""
    forces: np.ndarray
    """(n, 3) newtons."""
    activations: np.ndarray
    """(M,) metres."""


@dataclass(frozen=True)
class StepReport:
    """What happened in one step."""

    state: BodyState
    dt: float
    contacts: ContactSet
    forces: np.ndarray
    """(n, 3) newtons in each contact's frame."""
    end_gaps: np.ndarray
    """(n,) metres."""
    min_gap: float
    """Smallest gap of all contact points at the end of the step, metres."""
    activations: np.ndarray
    """(M,) metres."""
    qp_count: int
    qp_infeasible: int
    newton_iterations: int
    converged: bool
    added_spin: float
    """rad/s that implicit Euler would have eaten, see ``StepProblem``."""
    milliseconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class StepProgram:
    """What is asked of a step, and what it is asked of."""

    pieces: ContactPieces
    foreseen: Foreseen
    linear: LinearStep
    """Of the activations of the synergies in their bounds, and of contact forces in body weights."""


class LocomotionStepper:
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
        self.time_unit = float(np.sqrt(body.height / np.linalg.norm(body.gravity)))
        self.speed_scale = float(np.sqrt(np.linalg.norm(body.gravity) * body.height))
        self._factors = SparseFactors(body.assembly.upper_pattern)
        self._horizon_factors = SparseFactors(body.assembly.upper_pattern)
        self.solver = CoupledSolver(
            self.detector,
            self.points,
            self._factors,
            push_out_cap=self.settings.push_out_cap * self.speed_scale,
            penetration_tolerance=self.settings.penetration_tolerance * body.height,
        )
        rest = BodyState(body.mesh.nodes, np.zeros_like(body.mesh.nodes))
        problem = StepProblem(body, rest, self.time_unit / STEPS_A_UNIT)
        tangent = problem.tangent(self._factors, rest.velocities, None)
        full = muscle_columns(muscles, rest.positions).toarray() * muscles.bounds
        self.synergies = find_synergies(muscles, tangent.solve(full), body.node_mass)

    def initial_memory(self) -> StepMemory:
        """No contacts, muscles at rest."""
        return StepMemory(np.zeros(0, int), np.zeros((0, 3)), np.zeros(self.muscles.segment_count))

    def passive_step(self, state: BodyState, memory: StepMemory, dt: float) -> CoupledResult:
        """A step of ``dt`` s without muscles."""
        problem = StepProblem(self.body, state, dt)
        contacts = self._detect(problem, memory)
        response = ContactResponse.of(problem.tangent(self._factors, problem.start, None), contacts)
        forces = self.points.matched(contacts.points, memory.points, memory.forces)
        return self.solver.solve(response, None, velocities=problem.start, forces=forces)

    def advance(
        self,
        state: BodyState,
        memory: StepMemory,
        objectives: Sequence[AnyObjective],
        dt: float,
    ) -> tuple[BodyState, StepMemory, list[StepReport]]:
        """One step of ``dt``; one that does not converge is done again in halves under the same activations, since what
        is asked is asked for the whole of it.
        """
        end, after, report = self.step(state, memory, objectives, dt)
        if report.converged:
            return end, after, [report]
        return self._in_halves(state, memory, report.activations, dt, _MOST_HALVINGS)

    def _in_halves(
        self, state: BodyState, memory: StepMemory, activations: np.ndarray, dt: float, left: int
    ) -> tuple[BodyState, StepMemory, list[StepReport]]:
        reports: list[StepReport] = []
        for _ in range(2):
            end, after, report = self.held_step(state, memory, activations, 0.5 * dt)
            done = [report]
            if not report.converged and left > 1:
                end, after, done = self._in_halves(state, memory, activations, 0.5 * dt, left - 1)
            state, memory = end, after
            reports += done
        return state, memory, reports

    def held_step(
        self, state: BodyState, memory: StepMemory, activations: np.ndarray, dt: float
    ) -> tuple[BodyState, StepMemory, StepReport]:
        """A step of ``dt`` s under given ``activations`` (M,) metres."""
        clock = _Clock()
        problem = StepProblem(self.body, state, dt, self.settings.drag)
        tension = MuscleTension.of(self.muscles, activations)
        response, foreseen, forces = self.foresee(problem, self._detect(problem, memory), memory, tension)
        clock.lap("foresee")
        result = self.solver.solve(response, tension, velocities=foreseen, forces=forces)
        clock.lap("solve")
        return self._finish(problem, _Plan(activations, foreseen, forces, 0, 0), result, clock)

    def step(
        self, state: BodyState, memory: StepMemory, objectives: Sequence[AnyObjective], dt: float
    ) -> tuple[BodyState, StepMemory, StepReport]:
        """Detect, foresee, program, solve, report."""
        clock = _Clock()
        problem = StepProblem(self.body, state, dt, self.settings.drag)
        contacts = self._detect(problem, memory)
        clock.lap("detect")
        before = MuscleTension.of(self.muscles, memory.activations)
        response, foreseen, forces = self.foresee(problem, contacts, memory, before)
        clock.lap("foresee")
        plan = self._program(response, foreseen, forces, memory, memory.activations, objectives, clock)
        result = self._solve(response, plan)
        clock.lap("solve")
        expected = self._missed(problem, objectives, response.contacts, plan.velocities, plan.forces)
        got = self._missed(problem, objectives, result.contacts, result.velocities, result.forces)
        if result.converged and got > _AMISS * expected + _LITTLE:
            # The muscles went further than the tangent knows the way: asked again from where they have brought it.
            tangent = problem.tangent(
                self._factors, result.velocities, MuscleTension.of(self.muscles, plan.activations)
            )
            response = ContactResponse.of(tangent, result.contacts)
            again = self._program(
                response, result.velocities, result.forces, memory, plan.activations, objectives, clock
            )
            other = self._solve(response, again)
            clock.lap("again")
            better = self._missed(problem, objectives, other.contacts, other.velocities, other.forces) < got
            chosen = again if other.converged and better else plan
            result = other if chosen is again else result
            plan = chosen.counting(plan, again)
        return self._finish(problem, plan, result, clock)

    def _solve(self, response: ContactResponse, plan: _Plan) -> CoupledResult:
        tension = MuscleTension.of(self.muscles, plan.activations)
        return self.solver.solve(response, tension, velocities=plan.velocities, forces=plan.forces)

    def _missed(
        self,
        problem: StepProblem,
        objectives: Sequence[AnyObjective],
        contacts: ContactSet,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> float:
        """What the objectives cost at an end of the step, of ``velocities`` (N, 3) and contact ``forces`` (n, 3)."""
        torque = problem.turns.T @ (contacts.frame.T @ forces.ravel())
        return objectives_missed(problem, objectives, velocities, torque, self.speed_scale)

    def _detect(self, problem: StepProblem, memory: StepMemory) -> ContactSet:
        ballistic = problem.state.velocities + problem.dt * self.body.gravity
        gaps, _ = self.detector.gaps(problem.end_positions(ballistic))
        return self.detector.contact_set(
            self.points.choose(memory.points, memory.forces[:, 0] > 0.0, gaps), problem.state.positions
        )

    def foresee(
        self, problem: StepProblem, contacts: ContactSet, memory: StepMemory, tension: MuscleTension
    ) -> tuple[ContactResponse, np.ndarray, np.ndarray]:
        """Response of the contacts; velocities (N, 3) and contact forces (n, 3) that last step's activations would
        bring.
        """
        velocities, known = problem.start, self.points.matched(contacts.points, memory.points, memory.forces)
        shift = self.solver.shift(contacts, problem.dt)
        for _ in range(_LOOKS):
            tangent = problem.tangent(self._factors, velocities, tension)
            response = ContactResponse.of(tangent, contacts)
            free = velocities.ravel() - tangent.solve(problem.residual(velocities, tension).ravel())
            forces = response.forces(free, shift, self.geometry.friction, known)
            ahead = (free + response.columns @ forces.ravel()).reshape(velocities.shape)
            if not problem.feasible(ahead):
                break
            velocities, known = ahead, forces
        return response, velocities, forces

    def _program(
        self,
        response: ContactResponse,
        foreseen: np.ndarray,
        forces: np.ndarray,
        memory: StepMemory,
        under: np.ndarray,
        objectives: Sequence[AnyObjective],
        clock: _Clock,
    ) -> _Plan:
        """Activations, and what the step's tangent makes of them; ``foreseen`` and ``forces`` are those ``under``
        (M,).
        """
        problem, settings, m = response.tangent.problem, self.settings, self.synergies.count
        program = self.program(response, foreseen, forces, memory.activations, under, objectives)
        clock.lap("program")
        found = search_program(
            program.pieces,
            settings.strategy,
            program.foreseen,
            directions=settings.directions,
            qp_limit=settings.qp_limit,
            solver=settings.qp_solver,
        )
        clock.lap("qp")
        if found.x is None:
            return _Plan(memory.activations, foreseen, forces, found.qp_count, found.infeasible)
        activations = (self.synergies.members @ found.x[:m]) * self.muscles.bounds
        moved = program.linear.base + program.linear.columns[:, :m] @ found.x[:m]
        shift = self.solver.shift(response.contacts, problem.dt)
        forces = response.forces(moved, shift, self.geometry.friction, self.body.weight * found.x[m:].reshape(-1, 3))
        velocities = (moved + response.columns @ forces.ravel()).reshape(foreseen.shape)
        clock.lap("contact")
        if not problem.feasible(velocities):
            velocities = foreseen
        return _Plan(activations, velocities, forces, found.qp_count, found.infeasible)

    def program(
        self,
        response: ContactResponse,
        foreseen: np.ndarray,
        forces: np.ndarray,
        activations: np.ndarray,
        under: np.ndarray,
        objectives: Sequence[AnyObjective],
    ) -> StepProgram:
        """What is asked of the step, linear about the ``foreseen`` velocities (N, 3) and contact ``forces`` (n, 3) that
        the activations ``under`` (M,) would bring; ``activations`` (M,) are last step's.
        """
        problem, members = response.tangent.problem, self.synergies.members
        contacts, weight, m = response.contacts, self.body.weight, self.synergies.count
        each = muscle_columns(self.muscles, problem.end_positions(foreseen)).toarray() * self.muscles.bounds
        # Without muscles and contact, in their stiffness at last step's tension.
        free = problem.residual(foreseen, None).ravel()
        solved = response.tangent.solve(np.column_stack([problem.dt * (members.T @ each.T).T, free]))
        torques = problem.dt * weight * (contacts.frame @ problem.turns).T
        linear = LinearStep(
            foreseen.ravel() - solved[:, -1],
            np.hstack([solved[:, :-1], weight * response.columns]),
            np.hstack([np.zeros((3, m)), torques]),
        )
        previous = self.synergies.mean(activations / self.muscles.bounds)
        cost = (
            objectives_cost(problem, linear, contacts, objectives, self.speed_scale)
            + effort_cost(problem, linear, foreseen.ravel(), self._horizon_factors)
            + self._activation_cost(problem.dt, previous, linear.columns.shape[1])
        )
        rows = np.hstack([contacts.frame @ solved[:, :-1], weight * response.delassus]) / self.speed_scale
        offset = contacts.frame @ linear.base / self.speed_scale
        offset[::3] += self.solver.shift(contacts, problem.dt) / self.speed_scale
        reach = _FASTEST * problem.dt / self.time_unit
        pieces = ContactPieces(
            *(cost.P, cost.q, cost.constant, rows, offset, self.geometry.friction),
            *(np.maximum(previous - reach, -1.0), np.minimum(previous + reach, 1.0)),
        )
        slip = (contacts.frame @ foreseen.ravel()).reshape(-1, 3) / self.speed_scale
        start = self.synergies.mean(under / self.muscles.bounds)
        return StepProgram(pieces, Foreseen(start, forces / weight, slip), linear)

    def _activation_cost(self, dt: float, previous: np.ndarray, count: int) -> QuadraticCost:
        """Of ``count`` unknowns that begin with the activations, how large they are and how they change from
        ``previous`` (m,)."""
        settings, members = self.settings, self.synergies.members
        share = dt * STEPS_A_UNIT / self.time_unit
        strength = self.muscles.max_forces / (_ORDINARY_STRENGTH * self.body.weight)
        size = settings.activation_weight * share**2 * (members.T @ strength)
        change = settings.activation_change_weight * share * (members.T @ strength**2)
        diagonal, q = np.zeros(count), np.zeros(count)
        diagonal[: len(previous)] = 2.0 * (size + change) + _REGULAR
        q[: len(previous)] = -2.0 * change * previous
        return QuadraticCost(np.diag(diagonal), q, float(change @ previous**2))

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
            qp_count=plan.qp_count,
            qp_infeasible=plan.qp_infeasible,
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
    qp_count: int
    qp_infeasible: int

    def counting(self, *plans: _Plan) -> _Plan:
        """This plan, with the programs counted that all ``plans`` of the step took."""
        return replace(
            self,
            qp_count=sum(plan.qp_count for plan in plans),
            qp_infeasible=sum(plan.qp_infeasible for plan in plans),
        )


@dataclass
class _Clock:
    milliseconds: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.milliseconds[name] = self.milliseconds.get(name, 0.0) + 1e3 * (now - self._last)
        self._last = now
