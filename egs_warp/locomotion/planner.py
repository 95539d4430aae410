"""The activations of a step: what is asked of it, as a program about a foreseen end, and the search (Eq. 13)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from egs_warp.fem.body import SoftBody
from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.contact_modes import CoulombProgram
from egs_warp.locomotion.linear_step import LinearStep, PredictedStep, StepLinearizer
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.step_cost import EffortModel, QuadraticCost, effort_cost, objectives_cost
from egs_warp.locomotion.strategies import PredictedContact, search_program
from egs_warp.locomotion.synergies import Synergies
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import shortening

MIN_STEPS_PER_TIME_UNIT = 19.0
"""Least number of steps in sqrt(H / g) within which a body can be steered."""
_ORDINARY_STRENGTH = 4.0
WORK_WEIGHT = 10.0
"""Cost of the square of what a muscle gives or takes in a step, in m g H: muscles that shorten are else set against
others that they stretch (jumps of pawn, robot and monkey work 1.64, 1.78 and 1.54 m g H in place of 1.49, 1.34, 1.40).
"""
_FASTEST = 7.0
"""Bounds of activations, in their bounds a sqrt(H / g): how fast a muscle is switched on and off."""
REGULARIZATION = 1e-7


@dataclass(frozen=True)
class StepProgram:
    """What is asked of a step, and what it is asked of."""

    program: CoulombProgram
    predicted: PredictedContact
    linear: LinearStep
    """Of the activations of the synergies in their bounds, and of contact forces in body weights."""
    contact_velocities: np.ndarray
    """(3n, k + 1) m/s of the contacts, as its velocities."""


@dataclass(frozen=True)
class Plan:
    """Activations, and the end that the program expects of them."""

    activations: np.ndarray
    """(M,) metres."""
    velocities: np.ndarray
    """(N, 3) m/s."""
    forces: np.ndarray
    """(n, 3) newtons."""
    qp_count: int = 0
    qp_infeasible: int = 0

    def counting(self, *plans: Plan) -> Plan:
        """This plan, with the programs counted that all ``plans`` of the step took."""
        return replace(
            self,
            qp_count=sum(plan.qp_count for plan in plans),
            qp_infeasible=sum(plan.qp_infeasible for plan in plans),
        )


@dataclass
class StepPlanner:
    """Programs of one body's steps."""

    body: SoftBody
    muscles: MuscleSet
    synergies: Synergies
    friction: float
    settings: LocomotionSettings
    factors: LinearSolver
    """Of the effort's horizon."""
    linear_steps: StepLinearizer

    def plan(
        self, prospect: PredictedStep, last: np.ndarray, objectives: Sequence[AnyObjective], clock: StageClock
    ) -> Plan:
        """Activations for what the ``objectives`` ask, after ``last`` (M,) metres of the step before."""
        problem, settings, m = prospect.linearization.tangent.problem, self.settings, self.synergies.count
        program = self.program(prospect, last, objectives)
        clock.lap("program")
        found = search_program(
            program.program,
            settings.strategy,
            program.predicted,
            directions=settings.directions,
            qp_limit=settings.qp_limit,
            solver=settings.qp_solver_on(self.body.assembly.device),
            device=self.body.assembly.device,
        )
        clock.lap("qp")
        if found.x is None:
            return Plan(last, prospect.velocities, prospect.forces, found.qp_count, found.infeasible)
        activations = (self.synergies.members @ found.x[:m]) * self.muscles.bounds
        moved = program.contact_velocities[:, -1] + program.contact_velocities[:, :m] @ found.x[:m]
        asked = self.body.weight * found.x[m:].reshape(-1, 3)
        forces, _ = prospect.linearization.solve_coulomb(moved, prospect.normal_bias, self.friction, asked)
        end = program.linear.end_velocities(np.append(found.x[:m], forces / self.body.weight))
        velocities = end.reshape(prospect.velocities.shape)
        clock.lap("contact")
        if not problem.is_inversion_free(velocities):
            velocities = prospect.velocities
        return Plan(activations, velocities, forces, found.qp_count, found.infeasible)

    def program(self, prospect: PredictedStep, last: np.ndarray, objectives: Sequence[AnyObjective]) -> StepProgram:
        """What is asked of the step, linear about the ``prospect``; ``last`` (M,) are the step before's activations."""
        response, foreseen, body = prospect.linearization, prospect.velocities, self.body
        problem, contacts = response.tangent.problem, response.contacts
        weight, speed = body.weight, body.speed_unit
        # What the kernels of elasticity are needed for goes on in one thread alone.
        linear, horizon = self.linear_steps.linearize(prospect, lambda: EffortModel.of(problem, foreseen, self.factors))
        previous = self.synergies.mean(last / self.muscles.bounds)
        asked = objectives_cost(problem, linear, contacts, objectives, speed)
        activation = self._activation_cost(problem, foreseen, previous, linear.count)
        effort = effort_cost(problem, linear, foreseen.ravel(), horizon)
        cost = asked() + effort + activation
        speeds = linear.contact_velocities(contacts)
        rows, offset = speeds[:, :-1] / speed, speeds[:, -1] / speed
        offset[::3] += prospect.normal_bias / speed
        bounds = self.activation_bounds(previous, problem.dt)
        pieces = CoulombProgram(cost.P, cost.q, cost.constant, rows, offset, self.friction, *bounds)
        slip = contacts.contact_velocities(foreseen.ravel()).reshape(-1, 3) / speed
        start = self.synergies.mean(prospect.activations / self.muscles.bounds)
        return StepProgram(pieces, PredictedContact(start, prospect.forces / weight, slip), linear, speeds)

    def activation_bounds(self, previous: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """(m,) each, how low and how high activations may go in ``dt`` seconds from the ``previous`` (m,)."""
        reach = _FASTEST * dt / self.body.time_unit
        return np.maximum(previous - reach, -1.0), np.minimum(previous + reach, 1.0)

    def _activation_cost(
        self, problem: StepProblem, foreseen: np.ndarray, previous: np.ndarray, count: int
    ) -> QuadraticCost:
        """Of ``count`` unknowns that begin with the activations, how large they are, what their muscles give or take
        on the way to the end of ``foreseen`` (N, 3) m/s, and how they change from ``previous`` (m,)."""
        size, change = self.activation_weights(problem.dt)
        shorter = shortening(self.muscles, problem.state.positions, problem.end_positions(foreseen))
        works = self.muscles.max_forces * shorter / (self.body.weight * self.body.height)
        size = size + WORK_WEIGHT * (self.synergies.members.T @ works**2)
        diagonal, q = np.zeros(count), np.zeros(count)
        diagonal[: len(previous)] = 2.0 * (size + change) + REGULARIZATION
        q[: len(previous)] = -2.0 * change * previous
        return QuadraticCost(np.diag(diagonal), q, float(change @ previous**2))

    def activation_weights(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """(m,) of the squares of activations, and of their changes, in a step of ``dt`` seconds."""
        share = dt * MIN_STEPS_PER_TIME_UNIT / self.body.time_unit
        strengths, squares = self._strengths
        settings = self.settings
        return settings.activation_weight * share**2 * strengths, settings.activation_change_weight * share * squares

    @cached_property
    def _strengths(self) -> tuple[np.ndarray, np.ndarray]:
        """(m,) sums over each synergy's muscles of their strength, in that of ordinary ones, and of its square."""
        strength = self.muscles.max_forces / (_ORDINARY_STRENGTH * self.body.weight)
        members = self.synergies.members
        return members.T @ strength, members.T @ strength**2


@dataclass
class StageClock:
    """Milliseconds of each stage of a step."""

    milliseconds: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, name: str) -> None:
        """Since the lap before was ``name``."""
        now = time.perf_counter()
        self.milliseconds[name] = self.milliseconds.get(name, 0.0) + 1e3 * (now - self._last)
        self._last = now
