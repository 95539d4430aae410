"""Cost of the end of a step, quadratic in activations and contact forces: objectives and elastic effort (Eq. 13).

See docs/concepts/locomotion.md#cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.fem.implicit_step import UnsolvableStepError
from egs_warp.fem.linear_solver import FactorStatus, LinearSolver
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.linear_step import LinearStep
from egs_warp.locomotion.objectives import AnyObjective, LoadObjective, Objective

EFFORT_WEIGHT = 1.0
"""Cost of a total of m g H of elastic energy and damping potential."""
EFFORT_HORIZON = 0.16
"""Time in sqrt(H / g) after the start of a step at which the elastic energy is evaluated. A horizon of one step is too
short: a body that holds itself bent gains almost nothing by releasing the strain for one step."""


@dataclass(frozen=True)
class QuadraticCost:
    """Cost 1/2 x^T P x + q^T x + constant."""

    P: np.ndarray
    """(k, k) Hessian."""
    q: np.ndarray
    """(k,) linear term."""
    constant: float

    def __add__(self, other: QuadraticCost) -> QuadraticCost:
        return QuadraticCost(self.P + other.P, self.q + other.q, self.constant + other.constant)


def objectives_cost(
    problem: StepProblem, linear: LinearStep, contacts: ContactSet, objectives: Sequence[AnyObjective]
) -> QuadraticCost:
    """Return the weighted squares of ``objectives``, in units of sqrt(g H), as a function of the unknowns x.

    Args:
        problem: the step.
        linear: end of the step as a function of k unknowns x.
        contacts: contacts whose forces are the last unknowns.
        objectives: objectives of the motion.
    """
    form = linear.objective_quadratic([each for each in objectives if isinstance(each, Objective)])
    form /= problem.body.speed_unit**2
    P, q, constant = form[:-1, :-1], form[:-1, -1], 0.5 * float(form[-1, -1])
    for objective in objectives:
        if isinstance(objective, Objective):
            continue
        rows, residual = objective.affine(problem, contacts, linear.torques)
        P += 2.0 * objective.weight * rows.T @ rows
        q += 2.0 * objective.weight * rows.T @ residual
        constant += objective.weight * float(residual @ residual)
    return QuadraticCost(P, q, constant)


def objectives_value(
    problem: StepProblem, objectives: Sequence[AnyObjective], velocities: np.ndarray, contact_forces: np.ndarray
) -> float:
    """Return the sum of the weighted squares of ``objectives`` at the given end of the step, in units of sqrt(g H).
    Load objectives contribute nothing.

    Args:
        problem: the step.
        objectives: objectives of the motion.
        velocities: (N, 3) m/s, end of the step.
        contact_forces: (N, 3) N, contact forces at the nodes.
    """
    angular_impulse = problem.dt * (problem.rotation_modes.T @ contact_forces.ravel())
    value = 0.0
    for objective in objectives:
        if not isinstance(objective, LoadObjective):
            end = velocities.ravel() if isinstance(objective, Objective) else angular_impulse
            residual = objective.residual(problem, end)
            value += objective.weight * float(residual @ residual)
    return value


@dataclass(frozen=True)
class EffortModel:
    """Quadratic model of elastic energy and damping potential at a time horizon after the start of a step.

    The model is expanded about the predicted end of the step. It assumes that the motion continues after the step as
    one implicit step over the rest of the horizon.
    """

    positions: np.ndarray
    """(N, 3) m, predicted end of the step."""
    duration: float
    """s, time from the start of the step to the horizon."""
    energy: float
    """J, elastic energy and damping potential at ``positions``."""
    gradient: np.ndarray
    """(3N,) N, derivative of the energy with respect to positions."""
    stiffness_entries: Any
    """(nnz,) N/m, upper entries of the projected (positive semidefinite) element Hessian, on the device of
    ``factors``."""
    factors: LinearSolver
    """Factors of M + h^2 K, with h the ``duration``."""

    @classmethod
    def of(
        cls,
        problem: StepProblem,
        predicted_velocities: np.ndarray,
        factors: LinearSolver,
        *,
        horizon: float = EFFORT_HORIZON,
    ) -> EffortModel:
        """Build the model about the predicted end of the step and start its factorisation.

        Args:
            problem: the step.
            predicted_velocities: (N, 3) m/s, predicted end velocities.
            factors: solver that factors the matrix M + h^2 K.
            horizon: time horizon h in units of sqrt(H / g); at least one step is used.
        """
        body = problem.body
        assembly, duration = body.assembly, max(horizon * body.time_unit, problem.dt)
        positions, damping = (
            problem.end_positions(predicted_velocities),
            assembly.damping(problem.state.positions, duration),
        )
        energy, gradient = assembly.energy_and_gradient(positions, damping)
        entries = factors.entries_from(assembly.enqueue_hessian(positions, damping, projected=True))
        # The factorisation is queued last, because a GPU factors asynchronously while the host continues.
        factors.factor(duration**2 * entries, np.repeat(body.node_mass, 3))
        return cls(positions, duration, energy, gradient.ravel(), entries, factors)


def effort_cost(
    problem: StepProblem, linear: LinearStep, predicted_velocities: np.ndarray, model: EffortModel
) -> QuadraticCost:
    """Return ``EFFORT_WEIGHT`` / (m g H) times the elastic energy and damping potential at the horizon of ``model``.

    Among all shapes that meet the objectives, this cost prefers the shape with the least strain, and it rewards the
    release of stored energy. Without it, muscles work against each other. The model lets the motion continue after the
    step as one implicit step over the rest of the horizon, in which stiff modes move only until they are relaxed. If
    the motion continued at constant velocity instead, a released mode would appear to be strained in the opposite
    direction.

    Args:
        problem: the step.
        linear: end velocity of the step as a function of the unknowns x.
        predicted_velocities: (3N,) m/s, end velocities about which the energy is expanded.
        model: energy, gradient and Hessian at the predicted end.
    """
    body, factors = problem.body, model.factors
    quadratic, force = factors.quadratic_form(
        model.stiffness_entries,
        model.gradient,
        np.repeat(body.node_mass, 3),
        linear.velocities,
        dt_now=problem.dt,
        dt_ahead=model.duration - problem.dt,
        reference=problem.dt * predicted_velocities,
    )
    if factors.status is FactorStatus.NONE:
        raise UnsolvableStepError("the effort matrix at the predicted end state could not be factored")
    unit = EFFORT_WEIGHT / (body.weight * body.height)
    return QuadraticCost(
        unit * quadratic[:-1, :-1],
        unit * (force[:-1] + quadratic[:-1, -1]),
        unit * (model.energy + float(force[-1] + 0.5 * quadratic[-1, -1])),
    )
