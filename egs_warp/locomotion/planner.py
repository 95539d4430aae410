"""Plan of a step: assemble the QP about the predicted end, search for the best contact modes, and compute the expected
end of the step (Eq. 13).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from egs_warp.fem.body import SoftBody
from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.contact_modes import CoulombProgram, PredictedContact
from egs_warp.locomotion.linear_step import IslandLinearStep, LinearStep, PredictedStep, StepLinearizer
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.other_contacts import OtherContacts, contacts_of_nodes
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.step_cost import EffortModel, QuadraticCost, effort_cost, objectives_cost
from egs_warp.locomotion.strategies import search_program
from egs_warp.locomotion.synergies import Synergies
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import shortening

MIN_STEPS_PER_TIME_UNIT = 19.0
"""Minimum number of steps per sqrt(H / g); with longer steps a body cannot be controlled."""
_REFERENCE_STRENGTH = 4.0
"""Force, in body weights, of the muscle for which ``LocomotionSettings`` gives the activation weights."""
WORK_WEIGHT = 10.0
"""Weight of the squared work of a muscle in a step, in (m g H)^2. Without it, muscles that shorten act against muscles
that they stretch: the jumps of pawn, robot and monkey take 1.64, 1.78 and 1.54 m g H instead of 1.49, 1.34 and 1.40."""
_MAX_ACTIVATION_RATE = 7.0
"""Maximum change of an activation per sqrt(H / g), in units of its bound."""
REGULARIZATION = 1e-7
"""Regularisation that is added to the diagonal of P for the activations."""


@dataclass(frozen=True)
class StepProgram:
    """The QP of one step and the linearisation it was built from."""

    program: CoulombProgram
    predicted: PredictedContact
    linear: LinearStep | IslandLinearStep
    """Unknowns are the activations of the synergies as fractions of their bounds, then contact forces in body
    weights."""
    contact_velocities: np.ndarray
    """(3n, k + 1) m/s, W times the velocities of ``linear`` (Eq. 8)."""
    others: OtherContacts | None = None
    """Contacts that the QP does not contain; None if it contains all contacts."""

    def contact_forces(self, x: np.ndarray) -> np.ndarray:
        """Return the forces (n, 3) of all contacts, body weights, at the solution ``x`` of the QP."""
        return x[self.program.activation_count :].reshape(-1, 3) if self.others is None else self.others.all_forces(x)


@dataclass(frozen=True)
class Plan:
    """Planned activations and the end of the step that the QP expects."""

    activations: np.ndarray
    """(M,) m, planned activations."""
    velocities: np.ndarray
    """(N, 3) m/s, expected velocities at the end of the step."""
    forces: np.ndarray
    """(n, 3) N, expected contact forces."""
    qp_count: int = 0
    """Number of QPs that were solved."""
    qp_infeasible: int = 0
    """Number of QPs without a solution."""

    def counting(self, *plans: Plan) -> Plan:
        """Return this plan with the QP counts of all ``plans`` of the step."""
        return replace(
            self, qp_count=sum(plan.qp_count for plan in plans), qp_infeasible=sum(plan.qp_infeasible for plan in plans)
        )


@dataclass
class StepPlanner:
    """Planner of the steps of one body. It builds the QP and runs the search over contact modes."""

    body: SoftBody
    muscles: MuscleSet
    synergies: Synergies
    friction: float
    settings: LocomotionSettings
    factors: LinearSolver
    """Solver for the matrix of ``EffortModel``."""
    linear_steps: StepLinearizer
    """Builder of the linear step about a predicted end."""

    def plan(
        self, predicted: PredictedStep, last: np.ndarray, objectives: Sequence[AnyObjective], clock: StageClock
    ) -> Plan:
        """Plan the activations of a step.

        The QP is built about ``predicted`` and solved by the strategy of the settings. Only the activations of the
        solution are used. The contact forces are computed again from Coulomb's law for these activations, and the
        expected end from the linear step. If this end inverts an element, the predicted velocities are used instead. If
        no QP has a solution, the plan contains the previous activations.

        Args:
            predicted: predicted end of the step.
            last: (M,) m, activations of the previous step.
            objectives: objectives of the motion.
            clock: timer of the stages.
        """
        problem, settings, m = predicted.linearization.tangent.problem, self.settings, self.synergies.count
        program = self.program(predicted, last, objectives)
        clock.lap("program")
        result = search_program(
            program.program,
            settings.strategy,
            program.predicted,
            directions=settings.directions,
            qp_limit=settings.qp_limit,
            solver=settings.qp_solver_on(self.body.assembly.device),
            device=self.body.assembly.device,
        )
        clock.lap("qp")
        if result.x is None:
            return Plan(last, predicted.velocities, predicted.forces, result.qp_count, result.infeasible)
        activations = (self.synergies.members @ result.x[:m]) * self.muscles.bounds
        contact_free = program.contact_velocities[:, -1] + program.contact_velocities[:, :m] @ result.x[:m]
        qp_forces = self.body.weight * program.contact_forces(result.x)
        forces, _ = predicted.linearization.solve_coulomb(contact_free, predicted.normal_bias, self.friction, qp_forces)
        end = program.linear.end_velocities(np.append(result.x[:m], forces / self.body.weight))
        velocities = end.reshape(predicted.velocities.shape)
        clock.lap("contact")
        if not problem.is_inversion_free(velocities):
            velocities = predicted.velocities
        return Plan(activations, velocities, forces, result.qp_count, result.infeasible)

    def program(self, predicted: PredictedStep, last: np.ndarray, objectives: Sequence[AnyObjective]) -> StepProgram:
        """Build the QP of the step about ``predicted``: objectives, elastic effort and activation costs, contact
        velocities, and bounds of the activations. ``last`` (M,) m are the activations of the previous step."""
        body, predicted_velocities = self.body, predicted.velocities[predicted.nodes]
        problem, contacts = predicted.problem, predicted.linearization.contacts
        weight, speed = body.weight, body.speed_unit
        # ``linearize`` may run concurrently with ``EffortModel.of``. Only the latter uses the elasticity kernels, which
        # are not thread-safe.
        linear, effort_model = self.linear_steps.linearize(
            predicted, lambda: EffortModel.of(problem, predicted_velocities, self.factors)
        )
        velocities = linear.contact_velocities(contacts)
        rows, offset = velocities[:, :-1] / speed, velocities[:, -1] / speed
        offset[::3] += predicted.normal_bias / speed
        slip = contacts.contact_velocities(predicted.velocities.ravel()).reshape(-1, 3) / speed
        forces, others = predicted.forces / weight, None
        if isinstance(linear, IslandLinearStep):
            retained = contacts_of_nodes(contacts, predicted.nodes)
            others = OtherContacts.of(retained, rows, offset, self.friction, forces)
            own = linear.of_body(predicted.coordinates, np.arange(contacts.count) if others is None else retained)
        else:
            own = linear
        if others is not None:
            contacts = contacts.of_entries(others.retained)
            slip, forces = slip[others.retained], forces[others.retained]
            rows, offset = others.contact_rows(rows, offset)
        previous = self.synergies.mean(last / self.muscles.bounds)
        cost = objectives_cost(problem, own, contacts.with_nodes_of(predicted.nodes), objectives)
        cost += effort_cost(problem, own, predicted_velocities.ravel(), effort_model)
        cost += self._activation_cost(problem, predicted_velocities, previous, own.count)
        bounds = self.activation_bounds(previous, problem.dt)
        program = CoulombProgram(cost.P, cost.q, cost.constant, rows, offset, self.friction, *bounds)
        start = self.synergies.mean(predicted.activations / self.muscles.bounds)
        return StepProgram(program, PredictedContact(start, forces, slip), linear, velocities, others)

    def activation_bounds(self, previous: Any, dt: float) -> tuple[Any, Any]:
        """Return lower and upper bounds (..., m) of the activations after ``dt`` s from ``previous`` (..., m), an array
        or a tensor: [-1, 1] and the maximum rate of change."""
        max_change = _MAX_ACTIVATION_RATE * dt / self.body.time_unit
        return (previous - max_change).clip(-1.0, None), (previous + max_change).clip(None, 1.0)

    def _activation_cost(
        self, problem: StepProblem, predicted_velocities: np.ndarray, previous: np.ndarray, count: int
    ) -> QuadraticCost:
        """Return the cost of the size of activations, of the work of their muscles, and of the change of activations.

        Args:
            problem: the step.
            predicted_velocities: (N, 3) m/s, predicted end velocities, from which the muscles' work is computed.
            previous: (m,) activations of the previous step.
            count: number of unknowns, of which the first m are the activations.
        """
        size, change = self.activation_weights(problem.dt)
        shortenings = shortening(self.muscles, problem.state.positions, problem.end_positions(predicted_velocities))
        muscle_works = self.muscles.max_forces * shortenings / (self.body.weight * self.body.height)
        size = size + WORK_WEIGHT * (self.synergies.members.T @ muscle_works**2)
        diagonal, q = np.zeros(count), np.zeros(count)
        diagonal[: len(previous)] = 2.0 * (size + change) + REGULARIZATION
        q[: len(previous)] = -2.0 * change * previous
        return QuadraticCost(np.diag(diagonal), q, float(change @ previous**2))

    def activation_weights(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the weights (m,) of the squared activations and the weights (m,) of their squared changes, for a step
        of ``dt`` seconds."""
        step_fraction = dt * MIN_STEPS_PER_TIME_UNIT / self.body.time_unit
        strengths, squares = self._strengths
        settings = self.settings
        return (
            settings.activation_weight * step_fraction**2 * strengths,
            settings.activation_change_weight * step_fraction * squares,
        )

    @cached_property
    def _strengths(self) -> tuple[np.ndarray, np.ndarray]:
        """Sums over the muscles of each synergy: relative strengths (m,) and squared relative strengths (m,)."""
        strength = self.muscles.max_forces / (_REFERENCE_STRENGTH * self.body.weight)
        members = self.synergies.members
        return members.T @ strength, members.T @ strength**2


@dataclass
class StageClock:
    """Timer of the stages of a step."""

    milliseconds: dict[str, float] = field(default_factory=dict)
    """Time of each stage, ms; the times of repeated stages are summed."""
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, name: str) -> None:
        """Add the time since the previous lap to stage ``name``."""
        now = time.perf_counter()
        self.milliseconds[name] = self.milliseconds.get(name, 0.0) + 1e3 * (now - self._last)
        self._last = now
