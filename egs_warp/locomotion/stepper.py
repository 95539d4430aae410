"""Stepper: predict the end of a step, plan the activations, solve motion and contact together (Eq. 4, 9, 12, 13).

``LocomotionStepper.step`` makes one step; ``LocomotionStepper.advance`` also repeats a step that does not converge. The
stages are in ``contact.selection`` (contact points), ``linear_step`` and ``planner`` (plan) and
``contact.coupled_step`` (solve). On a GPU with the strategy ``modes``, ``device_plan`` replaces prediction and plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.coupled_step import CoupledResult, CoupledSolver
from egs_warp.contact.detection import ContactDetector, ContactGeometry
from egs_warp.contact.newton import ContactLinearization
from egs_warp.contact.selection import ContactSelector
from egs_warp.fem.batched import BatchedRecord
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.joints import JointForces
from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.linear_step import PredictedStep, StepInputs, StepLinearizer
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.planner import MIN_STEPS_PER_TIME_UNIT, Plan, StageClock, StepPlanner
from egs_warp.locomotion.prediction import predict_end
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.step_cost import objectives_value
from egs_warp.locomotion.stepper_parts import make_device_planner, make_linearizer
from egs_warp.locomotion.strategies import RESTART_COST
from egs_warp.locomotion.synergies import find_synergies
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleEnergy, activation_jacobian
from egs_warp.short_repr import short_repr

MAX_HALVINGS = 4
"""Maximum number of successive halvings of a step that does not converge."""
REPLAN_FACTOR, REPLAN_MARGIN = 1.2, 0.01
"""Factor and margin of a replan: a step is replanned if its objectives cost more than the first value times the cost
that the plan expects, plus the second value."""


@dataclass(frozen=True)
class WarmStart:
    """Data that a step passes to the next step, in addition to its state."""

    points: np.ndarray
    """(n,) indices of the contact points in use."""
    forces: np.ndarray
    """(n, 3) N, contact forces in the axes of each contact."""
    activations: np.ndarray
    """(M,) m, muscle activations."""

    @classmethod
    def from_report(cls, report: StepReport) -> WarmStart:
        """Return the warm start of the step that follows the step of ``report``."""
        return cls(report.contacts.points, report.forces, report.activations)

    def is_identical(self, other: WarmStart) -> bool:
        """Return True if the arrays are the same objects as the arrays of ``other``."""
        return self.points is other.points and self.forces is other.forces and self.activations is other.activations


@dataclass(frozen=True)
class StepReport(BatchedRecord):
    """Result of one step."""

    __repr__ = short_repr

    state: BodyState
    """State at the end of the step."""
    dt: float
    """Step size, s."""
    contacts: ContactSet
    forces: np.ndarray
    """(n, 3) N, contact forces: normal and two tangential components in the axes of each contact."""
    end_gaps: np.ndarray
    """(n,) m, gaps of the contacts at the end of the step."""
    min_gap: float
    """Minimum gap of all points of the body at the end of the step, m."""
    activations: np.ndarray
    """(M,) m, muscle activations."""
    qp_count: int
    """Number of QPs that were solved."""
    qp_infeasible: int
    """Number of QPs without a solution."""
    newton_iterations: int
    """Number of Newton steps of the solve."""
    converged: bool
    """True if the solve converged."""
    added_spin: float
    """Magnitude of ``ImplicitStep.momentum_correction``, rad/s."""
    drive: np.ndarray | None = None
    """(N, 3) m/s, velocities added by the drive of a body that follows a path (``DrivenStep``); None for others."""
    joints: JointForces | None = None
    """Forces of joints on the body; None if it has none."""
    milliseconds: dict[str, float] = field(default_factory=dict)
    """Wall-clock time of each stage, ms."""


class LocomotionStepper:
    """Stepper of one body with its muscles and its ground.

    Attributes that other packages use: ``detector`` and ``selector`` detect gaps and select contacts, ``solver`` solves
    motion and contact, ``planner`` plans activations.
    """

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
        self.selector = ContactSelector(
            geometry,
            activation_distance=self.settings.activation_distance * body.height,
            hysteresis=0.1 * self.settings.activation_distance * body.height,
            device=device,
        )
        self.solver = CoupledSolver(
            self.detector,
            self.selector,
            push_out_cap=self.settings.push_out_cap * body.speed_unit,
            penetration_tolerance=self.settings.penetration_tolerance * body.height,
        )
        self.factors = body.assembly.new_solver()
        self._make_planners(body.assembly.new_solver())

    def __repr__(self) -> str:
        return f"LocomotionStepper({self.body.mesh.nodes.shape[0]} nodes, friction {self.geometry.friction:g})"

    def _make_planners(self, planning_factors: LinearSolver) -> None:
        """Build the objects that depend on the elasticity of the body: linearizer, synergies and planners."""
        body, muscles = self.body, self.muscles
        self.linearizer = make_linearizer(self.factors, body, muscles, self.solver)
        rest = BodyState(body.mesh.nodes, np.zeros_like(body.mesh.nodes))
        # Only one thread is used, so that the synergies do not depend on the number of threads.
        with one_blas_thread():
            problem = StepProblem(body, rest, body.time_unit / MIN_STEPS_PER_TIME_UNIT)
            tangent = problem.tangent(self.factors, rest.velocities, None)
            full = activation_jacobian(muscles, rest.positions).toarray() * muscles.bounds
            synergies = find_synergies(muscles, tangent.solve(full), body.node_mass)
        self.planner = StepPlanner(
            body,
            muscles,
            synergies,
            self.geometry.friction,
            self.settings,
            planning_factors,
            StepLinearizer(muscles, synergies),
        )
        self._device_planner = make_device_planner(self.planner, self.linearizer, self.solver)
        # The prefetched inputs of the next step, with the warm start for which they are valid.
        self._prefetched: tuple[WarmStart, StepInputs] | None = None

    def with_unloaded_shape(self, nodes: np.ndarray) -> LocomotionStepper:
        """Return a stepper of the same body with the unloaded positions ``nodes`` (N, 3) m. Both steppers share factors
        and buffers, so they must be used in the same thread."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other.body = replace(self.body, assembly=self.body.assembly.with_rest_shape(nodes))
        other._make_planners(self.planner.factors)
        return other

    def with_friction(self, friction: float) -> LocomotionStepper:
        """Return a stepper for the same ground with another Coulomb coefficient. Both steppers share factors and
        buffers, so the call is cheap, and they must be used in the same thread."""
        # ``copy.copy`` would call ``__reduce__`` and build a new stepper.
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
        """Pickle as the constructor call, because the arrays are on a device."""
        device = str(self.body.assembly.device)
        constructor = partial(LocomotionStepper, settings=self.settings, device=device)
        return constructor, (self.body, self.muscles, self.geometry)

    def initial_memory(self) -> WarmStart:
        """Return the warm start of a first step: no contacts and zero activations."""
        return WarmStart(np.zeros(0, int), np.zeros((0, 3)), np.zeros(self.muscles.segment_count))

    def passive_step(self, state: BodyState, memory: WarmStart, dt: float) -> CoupledResult:
        """Solve a step of ``dt`` s without muscles; Newton's method starts at the rigid motion of the body."""
        problem = StepProblem(self.body, state, dt)
        contacts = self._detect(problem, memory)
        response = self.linearizer(problem.tangent(self.factors, problem.rigid_guess, None), contacts)
        forces = contacts.transferred_forces(memory.points, memory.forces)
        return self.solver.solve(response, None, velocities=problem.rigid_guess, forces=forces)

    def advance(
        self, state: BodyState, memory: WarmStart, objectives: Sequence[AnyObjective], dt: float
    ) -> tuple[BodyState, WarmStart, list[StepReport]]:
        """Make one step of ``dt`` s; if it does not converge, repeat it as half steps.

        The half steps are not planned, because the objectives apply to the whole step. The planned activations may be
        the cause of the failure, so the half steps are computed twice, with the planned and with the previous
        activations. A result that converged is preferred; otherwise the result with the lower objective value is used.

        Args:
            state: state at the start.
            memory: warm start from the previous step.
            objectives: objectives on the end of the step.
            dt: step size, s.

        Returns:
            State at the end, warm start of the next step, and the report of each step that was made, in order.
        """
        if self.muscles.segment_count == 0:
            return self.advance_with_activations(state, memory, memory.activations, dt)
        with one_blas_thread(), self.factors.stream:
            report = self.step(state, memory, objectives, dt)
            if report.converged:
                return _ended([report])
            candidates = [
                self._half_steps(state, memory, activations, dt, MAX_HALVINGS)
                for activations in (report.activations, memory.activations)
            ]
            return _ended(min(candidates, key=lambda done: rank_half_steps([self.body], [state], [done], [objectives])))

    def advance_with_activations(
        self, state: BodyState, memory: WarmStart, activations: np.ndarray, dt: float
    ) -> tuple[BodyState, WarmStart, list[StepReport]]:
        """Make one step of ``dt`` seconds with prescribed ``activations`` (M,) m; if it does not converge, repeat it as
        half steps. Other arguments and results are described at ``advance``."""
        with one_blas_thread(), self.factors.stream:
            report = self.step_with_activations(state, memory, activations, dt)
            if report.converged:
                return _ended([report])
            return _ended(self._half_steps(state, memory, activations, dt, MAX_HALVINGS))

    def _half_steps(
        self, state: BodyState, memory: WarmStart, activations: np.ndarray, dt: float, max_halvings: int
    ) -> list[StepReport]:
        """Make two steps of ``dt`` / 2 seconds with ``activations`` (M,) m. A step that does not converge is halved
        again, up to ``max_halvings`` - 1 times."""
        done: list[StepReport] = []
        for _ in range(2):
            reports = [self.step_with_activations(state, memory, activations, 0.5 * dt)]
            if not reports[0].converged and max_halvings > 1:
                reports = self._half_steps(state, memory, activations, 0.5 * dt, max_halvings - 1)
            state, memory, _ = _ended(reports)
            done += reports
        return done

    def step_with_activations(
        self, state: BodyState, memory: WarmStart, activations: np.ndarray, dt: float
    ) -> StepReport:
        """Make one step of ``dt`` s with prescribed ``activations`` (M,) m: detect, predict, solve, report. The caller
        must check ``converged``."""
        clock = StageClock()
        problem = StepProblem(self.body, state, dt, self.settings.drag)
        start = self.step_inputs(problem, self._detect(problem, memory), memory)
        plan, result = self._solve_with(start, activations, clock)
        return self._finish(problem, plan, result, clock)

    def step(self, state: BodyState, memory: WarmStart, objectives: Sequence[AnyObjective], dt: float) -> StepReport:
        """Make one step of ``dt`` s: detect, predict, plan, solve, replan if the plan was inaccurate, report.

        1. Detect (``_start``): select the contact points that the step may bring to the ground, and transfer their
           previous forces.
        2. Predict and plan (``_plan``): predict the end of the step under the previous activations, linearise the step
           there, and find the activations that minimise the cost subject to Coulomb contact.
        3. Solve (``_solve``): solve the equation of motion and contact together, nonlinearly, with the planned
           activations fixed (``CoupledSolver``).
        4. Replan (``_replan``): if the objectives cost clearly more than the plan expects, plan about the solved end
           and solve again. If they still cost much and a QP had no solution, plan about the end that the previous
           activations cause.
        5. Report (``_finish``). On a GPU, also start the prediction of the next step asynchronously.

        Args:
            state: state at the start.
            memory: warm start from the previous step.
            objectives: objectives on the end of the step.
            dt: step size, s.

        Returns:
            The report, whose ``converged`` the caller must check.
        """
        clock = StageClock()
        start = self._start(state, memory, dt)
        problem = start.problem
        clock.lap("detect")
        response, plan = self._plan(start, objectives, clock)
        # Meanwhile a GPU already runs the solve.
        expected = self._objective_value(problem, objectives, response.contacts, plan)
        result = self._solve(response, plan)
        clock.lap("solve")
        if (
            result.converged
            and self._objective_value(problem, objectives, result.contacts, result)
            > REPLAN_FACTOR * expected + REPLAN_MARGIN
        ):
            plan, result = self._replan(problem, plan, result, memory, objectives, clock)
        if (
            result.converged
            and plan.qp_infeasible > 0
            and self._objective_value(problem, objectives, result.contacts, result) > RESTART_COST
        ):
            # In a step with large changes, such as a take-off, the prediction may end so far from the solution that a
            # plan about it is useless. The end with the previous activations is therefore solved.
            _, solved = self._solve_with(start, memory.activations, clock)
            if solved.converged:
                about = solved, memory.activations
                plan, result = self._replan(problem, plan, result, memory, objectives, clock, about=about)
        report = self._finish(problem, plan, result, clock)
        if self._device_planner is not None and report.converged:
            # A GPU predicts the next step while the motion computes its objectives.
            after = WarmStart.from_report(report)
            start = self._start(report.state, after, dt)
            self._device_planner.start(start)
            self._prefetched = after, start
            clock.lap("prefetch")
        return report

    def _start(self, state: BodyState, memory: WarmStart, dt: float) -> StepInputs:
        """Detect the contacts of a step and collect its inputs. If the step continues from the previous step, its
        prefetched inputs are returned."""
        prefetched, self._prefetched = self._prefetched, None
        if (
            prefetched is not None
            and prefetched[0].is_identical(memory)
            and prefetched[1].problem.starts_from(state, dt)
        ):
            return prefetched[1]
        problem = StepProblem(self.body, state, dt, self.settings.drag)
        return self.step_inputs(problem, self._detect(problem, memory), memory)

    def step_inputs(self, problem: StepProblem, contacts: ContactSet, memory: WarmStart) -> StepInputs:
        """Collect the inputs of a step with these ``contacts``: velocity bias, and the previous activations and contact
        forces of ``memory``."""
        previous_forces = contacts.transferred_forces(memory.points, memory.forces)
        bias = self.solver.normal_bias(contacts, problem.dt)
        return StepInputs(problem, contacts, bias, self.geometry.friction, previous_forces, memory.activations)

    def _plan(
        self, start: StepInputs, objectives: Sequence[AnyObjective], clock: StageClock
    ) -> tuple[ContactLinearization, Plan]:
        """Predict the end of the step and plan its activations about this end. On a GPU the device planner does both at
        once. On a CPU, or if the device planner returns None, prediction and plan are separate stages.

        Returns:
            The contact linearisation at the predicted end, and the plan.
        """
        if self._device_planner is not None:
            planned = self._device_planner.plan(start, objectives)
            clock.lap("plan")
            if planned is not None:
                return planned
        predicted = self.predict(start)
        clock.lap("predict")
        return predicted.linearization, self.planner.plan(predicted, start.activations, objectives, clock)

    def _replan(
        self,
        problem: StepProblem,
        plan: Plan,
        result: CoupledResult,
        memory: WarmStart,
        objectives: Sequence[AnyObjective],
        clock: StageClock,
        *,
        about: tuple[CoupledResult, np.ndarray] | None = None,
    ) -> tuple[Plan, CoupledResult]:
        """Plan again about a solved end, with its tangent, and solve again. Strong muscles can move the body beyond the
        range in which the linearisation about the predicted end is accurate.

        ``plan`` and its ``result`` are those of the step so far. ``about`` is the solved end about which to plan, with
        its activations (M,) m; None plans about ``result``.

        Returns:
            Plan and result with the lower objective value; the QP counts of the plan include both plans.
        """
        centre, activations = about or (result, plan.activations)
        response = centre.linearization
        bias = self.solver.normal_bias(centre.contacts, problem.dt)
        predicted = PredictedStep(response, bias, activations, centre.velocities, centre.forces)
        other = None
        if self._device_planner is not None:
            other = self._device_planner.replan(predicted, memory.activations, objectives, self.geometry.friction)
        if other is None:
            other = self.planner.plan(predicted, memory.activations, objectives, clock)
        end = self._solve(response, other)
        clock.lap("replan")
        costs = [self._objective_value(problem, objectives, one.contacts, one) for one in (result, end)]
        if end.converged and costs[1] < costs[0]:
            return other.counting(plan, other), end
        return plan.counting(plan, other), result

    def _solve_with(self, start: StepInputs, activations: np.ndarray, clock: StageClock) -> tuple[Plan, CoupledResult]:
        """Predict and solve the step with prescribed ``activations`` (M,) m; return them as a plan, and the result."""
        predicted = self.predict(replace(start, activations=activations))
        clock.lap("predict")
        plan = Plan(activations, predicted.velocities, predicted.forces)
        result = self._solve(predicted.linearization, plan)
        clock.lap("solve")
        return plan, result

    def _solve(self, response: ContactLinearization, plan: Plan) -> CoupledResult:
        """Solve motion and contact with the planned activations, starting at the end that the plan expects."""
        tension = MuscleEnergy.of(self.muscles, plan.activations)
        return self.solver.solve(response, tension, velocities=plan.velocities, forces=plan.forces)

    def _objective_value(
        self, problem: StepProblem, objectives: Sequence[AnyObjective], contacts: ContactSet, end: Plan | CoupledResult
    ) -> float:
        """Return the objective value at ``end``, the expected end of a plan or the end of a solve."""
        pushes = contacts.nodal_forces(end.forces)
        return objectives_value(problem, objectives, end.velocities, pushes)

    def _detect(self, problem: StepProblem, memory: WarmStart) -> ContactSet:
        """Select the contacts of the step: points in use, and points that ballistic motion brings close to the ground.
        If the linearizer has prefetched a selection, it is used."""
        loaded = memory.forces[:, 0] > 0.0
        contacts = self.linearizer.select_contacts(problem, memory.points, loaded)
        if contacts is not None:
            return contacts
        gaps, _ = self.detector.gaps(problem.ballistic_positions)
        return self.detector.contact_set(self.selector.select(memory.points, loaded, gaps), problem.state.positions)

    def predict(self, start: StepInputs) -> PredictedStep:
        """Predict the end of the step under the activations of the previous step, which ``start`` contains (Eq. 12);
        see ``predict_end``."""
        tension = MuscleEnergy.of(self.muscles, start.activations)
        response, velocities, forces = predict_end(self.linearizer, self.factors, start, tension)
        return PredictedStep(response, start.normal_bias, start.activations, velocities, forces)

    def _finish(self, problem: StepProblem, plan: Plan, result: CoupledResult, clock: StageClock) -> StepReport:
        """Build the report at the end of a solve, and prefetch the contacts of the next step."""
        end = problem.end_positions(result.velocities)
        after = BodyState(end, result.velocities, problem.state.time + problem.dt)
        if result.converged:
            loaded = result.forces[:, 0] > 0.0
            self.linearizer.prefetch_contacts(after, problem.dt, result.contacts.points, loaded)
        if result.penetration is None:
            min_gap = float(self.detector.gaps(end)[0].min())
            internal = problem.internal_gradient(result.velocities, MuscleEnergy.of(self.muscles, plan.activations))
            spin = problem.momentum_correction(internal)
        else:
            min_gap = result.penetration.min_gap
            spin = problem.momentum_correction_from_torque(result.penetration.internal_torque)
        clock.lap("report")
        return StepReport(
            state=after,
            dt=problem.dt,
            contacts=result.contacts,
            forces=result.forces,
            end_gaps=result.contacts.end_gaps(problem.dt, result.velocities),
            min_gap=min_gap,
            activations=plan.activations,
            qp_count=plan.qp_count,
            qp_infeasible=plan.qp_infeasible,
            newton_iterations=result.iterations,
            converged=result.converged,
            added_spin=float(np.linalg.norm(spin)),
            milliseconds=clock.milliseconds,
        )


def rank_half_steps(
    bodies: Sequence[SoftBody],
    states: Sequence[BodyState],
    done: Sequence[Sequence[StepReport]],
    objectives: Sequence[Sequence[AnyObjective]],
) -> tuple[bool, float]:
    """Return the sort key of half steps for ``LocomotionStepper.advance``: True if any of them did not converge, and
    the objective value at their end. The arguments contain, for each body, its state at the start, the reports of the
    steps and the objectives."""
    value = 0.0
    for body, state, reports, targets in zip(bodies, states, done, objectives, strict=True):
        before, last = (reports[-2].state if len(reports) > 1 else state), reports[-1]
        pushes = last.contacts.nodal_forces(last.forces)
        value += objectives_value(StepProblem(body, before, last.dt), targets, last.state.velocities, pushes)
    return not all(report.converged for reports in done for report in reports), value


def _ended(reports: list[StepReport]) -> tuple[BodyState, WarmStart, list[StepReport]]:
    """Return the state at the end of the steps of ``reports``, the warm start of the next step, and ``reports``."""
    return reports[-1].state, WarmStart.from_report(reports[-1]), reports
