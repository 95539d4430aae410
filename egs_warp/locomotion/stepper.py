"""The stepper: foresee the contact, choose the muscles, solve motion and contact together (Eq. 4, 9, 12, 13)."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from egs_warp.contact.coupled_step import CoupledResult, CoupledSolver
from egs_warp.contact.detection import ContactDetector, ContactGeometry, ContactSet
from egs_warp.contact.newton import ContactLinearization, ContactLinearizer, HostContactLinearizer
from egs_warp.contact.selection import ContactSelector
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.linear_solver import LinearSolver, linear_solver_on
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.linear_step import (
    PREDICTION_ITERATIONS,
    HostStepLinearizer,
    PredictedStep,
    StepInputs,
    StepLinearizer,
)
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.planner import MIN_STEPS_PER_TIME_UNIT, Plan, StageClock, StepPlanner
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.step_cost import objectives_value
from egs_warp.locomotion.strategies import Strategy
from egs_warp.locomotion.synergies import Synergies, find_synergies
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleEnergy, activation_jacobian

MAX_HALVINGS = 4
_REPLAN_FACTOR, _REPLAN_MARGIN = 1.2, 0.01
"""A step whose end costs more than this factor of what its program expected, and this much more, is asked for again."""


@dataclass(frozen=True)
class WarmStart:
    """What a step hands to the next."""

    points: np.ndarray
    """(n,) contact points in use."""
    forces: np.ndarray
    """(n, 3) newtons."""
    activations: np.ndarray
    """(M,) metres."""

    @classmethod
    def from_report(cls, report: StepReport) -> WarmStart:
        """What the step of ``report`` hands on."""
        return cls(report.contacts.points, report.forces, report.activations)

    def is_identical(self, other: WarmStart) -> bool:
        """Whether it has the very arrays of the ``other``."""
        return self.points is other.points and self.forces is other.forces and self.activations is other.activations


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
        self.points = ContactSelector(
            geometry,
            near=self.settings.activation_distance * body.height,
            lower=0.1 * self.settings.activation_distance * body.height,
        )
        self.solver = CoupledSolver(
            self.detector,
            self.points,
            push_out_cap=self.settings.push_out_cap * body.speed_unit,
            penetration_tolerance=self.settings.penetration_tolerance * body.height,
        )
        self.factors = linear_solver_on(body.assembly.device, body.assembly.upper_pattern)
        self.linearizer = _make_linearizer(self.factors, body, muscles, self.solver)
        rest = BodyState(body.mesh.nodes, np.zeros_like(body.mesh.nodes))
        # On one thread: what is found here must not hang on how many there are.
        with one_blas_thread():
            problem = StepProblem(body, rest, body.time_unit / MIN_STEPS_PER_TIME_UNIT)
            tangent = problem.tangent(self.factors, rest.velocities, None)
            full = activation_jacobian(muscles, rest.positions).toarray() * muscles.bounds
            synergies = find_synergies(muscles, tangent.solve(full), body.node_mass)
        self.planner = StepPlanner(
            body,
            muscles,
            synergies,
            geometry.friction,
            self.settings,
            linear_solver_on(body.assembly.device, body.assembly.upper_pattern),
            make_step_linearizer(self.linearizer, muscles, synergies),
        )
        # By this planner; and how the step begins that comes next, likely.
        self._device_planner = _make_device_planner(self.planner, self.linearizer, self.solver)
        self._prefetched: tuple[WarmStart, StepInputs] | None = None

    def with_friction(self, friction: float) -> LocomotionStepper:
        """The same on ground of another Coulomb coefficient, for nothing: it shares what this one works with, so the
        two are for one thread."""
        # Not by ``copy``, which makes one anew.
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other.geometry = replace(self.geometry, friction=friction)
        other.detector = copy(self.detector)
        other.detector.geometry = other.geometry
        other.solver = replace(self.solver, detector=other.detector)
        other.planner = replace(self.planner, friction=friction)
        other._prefetched = None
        return other

    def __reduce__(self) -> tuple[Any, ...]:
        """It is made anew wherever a copy of it is read: its arrays lie on a device."""
        device = str(self.body.assembly.device)
        made = partial(LocomotionStepper, settings=self.settings, device=device)
        return made, (self.body, self.muscles, self.geometry)

    def initial_memory(self) -> WarmStart:
        """No contacts, muscles at rest."""
        return WarmStart(np.zeros(0, int), np.zeros((0, 3)), np.zeros(self.muscles.segment_count))

    def passive_step(self, state: BodyState, memory: WarmStart, dt: float) -> CoupledResult:
        """A step of ``dt`` s without muscles."""
        problem = StepProblem(self.body, state, dt)
        contacts = self._detect(problem, memory)
        response = self.linearizer(problem.tangent(self.factors, problem.rigid_guess, None), contacts)
        forces = self.points.transfer_forces(contacts.points, memory.points, memory.forces)
        return self.solver.solve(response, None, velocities=problem.rigid_guess, forces=forces)

    def advance(
        self,
        state: BodyState,
        memory: WarmStart,
        objectives: Sequence[AnyObjective],
        dt: float,
    ) -> tuple[BodyState, WarmStart, list[StepReport]]:
        """One step of ``dt``; one that does not converge is done again in halves, since what is asked is asked for the
        whole of it: under the same activations, and under those of the step before. Of the two ends the one that costs
        the objectives less: where muscles go so far that no end is found, nobody has seen what they do.
        """
        with one_blas_thread(), self.factors.stream:
            end, after, report = self.step(state, memory, objectives, dt)
            if report.converged:
                return end, after, [report]
            ends = [
                self._in_halves(state, memory, activations, dt, MAX_HALVINGS)
                for activations in (report.activations, memory.activations)
            ]
            return min(ends, key=lambda end: self._cost_of_halves(state, end[2], objectives))

    def _cost_of_halves(
        self, state: BodyState, reports: Sequence[StepReport], objectives: Sequence[AnyObjective]
    ) -> tuple[bool, float]:
        """Whether any of the ``reports`` from ``state`` on has not converged, and what their end costs."""
        before, last = (reports[-2].state if len(reports) > 1 else state), reports[-1]
        problem = StepProblem(self.body, before, last.dt, self.settings.drag)
        missed = objectives_value(
            problem, last.contacts, objectives, last.state.velocities, last.forces, self.body.speed_unit
        )
        return not all(report.converged for report in reports), missed

    def advance_with_activations(
        self, state: BodyState, memory: WarmStart, activations: np.ndarray, dt: float
    ) -> tuple[BodyState, WarmStart, list[StepReport]]:
        """As ``advance``, under given ``activations`` (M,) metres."""
        with one_blas_thread(), self.factors.stream:
            end, after, report = self.step_with_activations(state, memory, activations, dt)
            if report.converged:
                return end, after, [report]
            return self._in_halves(state, memory, activations, dt, MAX_HALVINGS)

    def _in_halves(
        self, state: BodyState, memory: WarmStart, activations: np.ndarray, dt: float, left: int
    ) -> tuple[BodyState, WarmStart, list[StepReport]]:
        reports: list[StepReport] = []
        for _ in range(2):
            end, after, report = self.step_with_activations(state, memory, activations, 0.5 * dt)
            done = [report]
            if not report.converged and left > 1:
                end, after, done = self._in_halves(state, memory, activations, 0.5 * dt, left - 1)
            state, memory = end, after
            reports += done
        return state, memory, reports

    def step_with_activations(
        self, state: BodyState, memory: WarmStart, activations: np.ndarray, dt: float
    ) -> tuple[BodyState, WarmStart, StepReport]:
        """A step of ``dt`` s under given ``activations`` (M,) metres."""
        clock = StageClock()
        problem = StepProblem(self.body, state, dt, self.settings.drag)
        start = self.step_inputs(problem, self._detect(problem, memory), memory)
        prospect = self.predict(replace(start, activations=activations))
        clock.lap("foresee")
        plan = Plan(activations, prospect.velocities, prospect.forces)
        result = self._solve(prospect.linearization, plan)
        clock.lap("solve")
        return self._finish(problem, plan, result, clock)

    def step(
        self, state: BodyState, memory: WarmStart, objectives: Sequence[AnyObjective], dt: float
    ) -> tuple[BodyState, WarmStart, StepReport]:
        """Detect, foresee, plan, solve, report, and begin the next."""
        clock = StageClock()
        start = self._start(state, memory, dt)
        problem = start.problem
        clock.lap("detect")
        response, plan = self._plan(start, objectives, clock)
        # A GPU is on its way to the end meanwhile.
        expected = self._objective_value(problem, objectives, response.contacts, plan)
        result = self._solve(response, plan)
        clock.lap("solve")
        if (
            result.converged
            and self._objective_value(problem, objectives, result.contacts, result)
            > _REPLAN_FACTOR * expected + _REPLAN_MARGIN
        ):
            plan, result = self._replan(problem, plan, result, memory, objectives, clock)
        end, after, report = self._finish(problem, plan, result, clock)
        if self._device_planner is not None and report.converged:
            # A GPU foresees the next one while the motion is asked what that is to do.
            start = self._start(end, after, dt)
            self._device_planner.start(start)
            self._prefetched = after, start
            clock.lap("begin")
        return end, after, report

    def _start(self, state: BodyState, memory: WarmStart, dt: float) -> StepInputs:
        """How a step begins, as it was begun when the one before had ended, if it goes on from there."""
        ahead, self._prefetched = self._prefetched, None
        if ahead is not None and ahead[0].is_identical(memory) and ahead[1].problem.starts_from(state, dt):
            return ahead[1]
        problem = StepProblem(self.body, state, dt, self.settings.drag)
        return self.step_inputs(problem, self._detect(problem, memory), memory)

    def step_inputs(self, problem: StepProblem, contacts: ContactSet, memory: WarmStart) -> StepInputs:
        """How a step with these ``contacts`` begins after that of the ``memory``."""
        known = self.points.transfer_forces(contacts.points, memory.points, memory.forces)
        shift = self.solver.normal_bias(contacts, problem.dt)
        return StepInputs(problem, contacts, shift, self.geometry.friction, memory.activations, known)

    def _plan(
        self, start: StepInputs, objectives: Sequence[AnyObjective], clock: StageClock
    ) -> tuple[ContactLinearization, Plan]:
        """What is foreseen, and the plan about it: on a GPU at once, if all goes as usual."""
        if self._device_planner is not None:
            found = self._device_planner.plan(start, objectives)
            clock.lap("plan")
            if found is not None:
                return found
        prospect = self.predict(start)
        clock.lap("foresee")
        return prospect.linearization, self.planner.plan(prospect, start.activations, objectives, clock)

    def _replan(
        self,
        problem: StepProblem,
        plan: Plan,
        result: CoupledResult,
        memory: WarmStart,
        objectives: Sequence[AnyObjective],
        clock: StageClock,
    ) -> tuple[Plan, CoupledResult]:
        """The muscles went further than the tangent knows the way: asked again from where they have brought it. Of the
        two ends the one that costs the objectives less."""
        response = result.linearization
        shift = self.solver.normal_bias(result.contacts, problem.dt)
        prospect = PredictedStep(response, shift, plan.activations, result.velocities, result.forces)
        other = None
        if self._device_planner is not None:
            other = self._device_planner.replan(prospect, memory.activations, objectives, self.geometry.friction)
        if other is None:
            other = self.planner.plan(prospect, memory.activations, objectives, clock)
        end = self._solve(response, other)
        clock.lap("again")
        costs = [self._objective_value(problem, objectives, one.contacts, one) for one in (result, end)]
        if end.converged and costs[1] < costs[0]:
            return other.counting(plan, other), end
        return plan.counting(plan, other), result

    def _solve(self, response: ContactLinearization, plan: Plan) -> CoupledResult:
        tension = MuscleEnergy.of(self.muscles, plan.activations)
        return self.solver.solve(response, tension, velocities=plan.velocities, forces=plan.forces)

    def _objective_value(
        self,
        problem: StepProblem,
        objectives: Sequence[AnyObjective],
        contacts: ContactSet,
        end: Plan | CoupledResult,
    ) -> float:
        return objectives_value(problem, contacts, objectives, end.velocities, end.forces, self.body.speed_unit)

    def _detect(self, problem: StepProblem, memory: WarmStart) -> ContactSet:
        loaded = memory.forces[:, 0] > 0.0
        contacts = self.linearizer.select_contacts(problem, memory.points, loaded)
        if contacts is not None:
            return contacts
        ballistic = problem.state.velocities + problem.dt * self.body.gravity
        gaps, _ = self.detector.gaps(problem.end_positions(ballistic))
        return self.detector.contact_set(self.points.select(memory.points, loaded, gaps), problem.state.positions)

    def predict(self, start: StepInputs) -> PredictedStep:
        """What its activations, those of the step before, would bring."""
        problem, contacts, known = start.problem, start.contacts, start.forces
        velocities, tension = problem.rigid_guess, MuscleEnergy.of(self.muscles, start.activations)
        # What tension adds to the stiffness is left to the solve: what is foreseen serves no better with it.
        tangent = problem.tangent(self.factors, velocities, None)
        ahead = self.linearizer.predict_velocities(tangent, contacts, tension, velocities, known)
        if ahead is not None:
            velocities = ahead
            tangent = problem.tangent(self.factors, velocities, None)
        response = self.linearizer(tangent, contacts)
        now = response.iterate_at(tension, velocities, known)
        forces = known
        for _ in range(PREDICTION_ITERATIONS):
            stretch = now.newton_steps(start.normal_bias, start.friction)
            forces = stretch.forces
            if not stretch.trial.is_inversion_free:
                break
            now = stretch.trial
        return PredictedStep(response, start.normal_bias, start.activations, now.velocities, forces)

    def _finish(
        self, problem: StepProblem, plan: Plan, result: CoupledResult, clock: StageClock
    ) -> tuple[BodyState, WarmStart, StepReport]:
        end = problem.end_positions(result.velocities)
        after = BodyState(end, result.velocities, problem.state.time + problem.dt)
        if result.converged:
            self.linearizer.prefetch_contacts(after, problem.dt, result.contacts.points)
        if result.penetration is None:
            least_gap = float(self.detector.gaps(end)[0].min())
            internal = problem.internal_gradient(result.velocities, MuscleEnergy.of(self.muscles, plan.activations))
            spin = problem.momentum_correction(internal)
        else:
            least_gap, spin = (
                result.penetration.min_gap,
                problem.momentum_correction_from_torque(result.penetration.internal_torque),
            )
        clock.lap("report")
        report = StepReport(
            state=after,
            dt=problem.dt,
            contacts=result.contacts,
            forces=result.forces,
            end_gaps=result.contacts.end_gaps(problem.dt, result.velocities),
            min_gap=least_gap,
            activations=plan.activations,
            qp_count=plan.qp_count,
            qp_infeasible=plan.qp_infeasible,
            newton_iterations=result.iterations,
            converged=result.converged,
            added_spin=float(np.linalg.norm(spin)),
            milliseconds=clock.milliseconds,
        )
        return after, WarmStart.from_report(report), report


def _make_linearizer(
    factors: LinearSolver, body: SoftBody, muscles: MuscleSet, solver: CoupledSolver
) -> ContactLinearizer:
    """Of tangents of ``body`` by ``factors``, for the ``solver``: on the host, or where these are."""
    if isinstance(factors, MultifrontalLdl):
        return HostContactLinearizer()
    from egs_warp.contact.device_newton import DeviceContactLinearizer
    from egs_warp.contact.device_selection import DeviceContactSelector
    from egs_warp.fem.dense_cholesky import DenseCholesky

    assert isinstance(factors, DenseCholesky)
    sight = DeviceContactSelector(solver.detector, solver.points, factors.stream, solver.penetration_tolerance)
    return DeviceContactLinearizer(factors, body, muscles, sight)


def make_step_linearizer(respond: ContactLinearizer, muscles: MuscleSet, synergies: Synergies) -> StepLinearizer:
    """Where the responses of contact are."""
    if isinstance(respond, HostContactLinearizer):
        return HostStepLinearizer(muscles, synergies)
    from egs_warp.contact.device_newton import DeviceContactLinearizer
    from egs_warp.locomotion.device_linear_step import DeviceLinearSteps

    assert isinstance(respond, DeviceContactLinearizer)
    return DeviceLinearSteps(respond, muscles, synergies)


def _make_device_planner(planner: StepPlanner, respond: ContactLinearizer, solver: CoupledSolver) -> Any:
    """Plans where the matrices are, if they are not on the host, and the search is a kernel; else None."""
    settings, device = planner.settings, planner.body.assembly.device
    if isinstance(respond, HostContactLinearizer) or Strategy(settings.strategy) is not Strategy.MODES:
        return None
    if settings.qp_solver_on(device) is not QpSolver.ADMM:
        return None
    from egs_warp.contact.device_newton import DeviceContactLinearizer
    from egs_warp.locomotion.device_linear_step import DeviceLinearSteps
    from egs_warp.locomotion.device_plan import DevicePlanner

    assert isinstance(respond, DeviceContactLinearizer) and isinstance(planner.linear_steps, DeviceLinearSteps)
    return DevicePlanner(planner, respond, planner.linear_steps, solver.convergence_state)
