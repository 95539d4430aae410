"""What a step's end costs, as a quadratic over activations and contact forces: objectives and effort (Eq. 13).

See docs/concepts/locomotion.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from egs_warp.contact.detection import ContactSet
from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.fem.step_problem import StepProblem, UnsolvableStepError
from egs_warp.locomotion.linear_step import LinearStep
from egs_warp.locomotion.objectives import AnyObjective, Objective

EFFORT_WEIGHT = 1.0
"""Cost of m g H of elastic and damping energy."""
EFFORT_HORIZON = 0.16
"""Of sqrt(H / g): how far ahead that energy is foreseen. One step ahead, a body that holds itself bent gains next to
nothing by letting go."""


@dataclass(frozen=True)
class QuadraticCost:
    """1/2 x^T P x + q^T x + constant."""

    P: np.ndarray
    """(k, k)."""
    q: np.ndarray
    """(k,)."""
    constant: float

    def __add__(self, other: QuadraticCost) -> QuadraticCost:
        return QuadraticCost(self.P + other.P, self.q + other.q, self.constant + other.constant)


def objectives_cost(
    problem: StepProblem,
    linear: LinearStep,
    contacts: ContactSet,
    objectives: Sequence[AnyObjective],
    speed: float,
) -> Callable[[], QuadraticCost]:
    """Begins what gives the weighted squares that a motion asks for, in units of ``speed`` m/s, sqrt(g H)."""
    squares = linear.objective_quadratic([each for each in objectives if isinstance(each, Objective)])

    def cost() -> QuadraticCost:
        form = squares() / speed**2
        P, q, constant = form[:-1, :-1], form[:-1, -1], 0.5 * float(form[-1, -1])
        for objective in objectives:
            if isinstance(objective, Objective):
                continue
            rows = objective.slopes(problem, contacts, linear.torques, speed)
            gap = objective.residual(problem, contacts, np.zeros(0), np.zeros(3), speed)
            P += 2.0 * objective.weight * rows.T @ rows
            q += 2.0 * objective.weight * rows.T @ gap
            constant += objective.weight * float(gap @ gap)
        return QuadraticCost(P, q, constant)

    return cost


def objectives_value(
    problem: StepProblem,
    contacts: ContactSet,
    objectives: Sequence[AnyObjective],
    velocities: np.ndarray,
    forces: np.ndarray,
    speed: float,
) -> float:
    """The same weighted squares of a step that ends at ``velocities`` (N, 3) under contact ``forces`` (n, 3); loads
    are left out."""
    gained = problem.dt * (problem.rotation_modes.T @ contacts.nodal_forces(forces))
    gaps = [objective.residual(problem, contacts, velocities.ravel(), gained, speed) for objective in objectives]
    return sum(objective.weight * float(gap @ gap) for objective, gap in zip(objectives, gaps, strict=True))


@dataclass(frozen=True)
class EffortModel:
    """A foreseen end of a step, and one implicit step from there on, of which what is stiff is slack."""

    positions: np.ndarray
    """(N, 3) metres."""
    duration: float
    """Seconds after the start of the step."""
    energy: float
    """Elastic, and what damping takes until then, joules."""
    gradient: np.ndarray
    """(3N,) newtons, its derivative by the positions."""
    stiffness_entries: Any
    """(nnz,) upper entries of the elements' stiffness at the end, made semi-definite, where ``factors`` are."""
    factors: LinearSolver
    """Of the step's matrix."""

    @classmethod
    def of(
        cls, problem: StepProblem, foreseen: np.ndarray, factors: LinearSolver, *, horizon: float = EFFORT_HORIZON
    ) -> EffortModel:
        """``horizon`` sqrt(H / g) after the start, from the end of ``foreseen`` (N, 3) m/s; ``factors`` take its
        matrix."""
        body = problem.body
        assembly, time = body.assembly, max(horizon * body.time_unit, problem.dt)
        end, damping = problem.end_positions(foreseen), assembly.damping(problem.state.positions, time)
        energy, slope = assembly.energy_and_gradient(end, damping)
        entries = assembly.entries_for(factors, end, damping, projected=True)
        # Last: what a GPU has begun it goes on with while the host does other things.
        factors.start_update(time**2 * entries, np.repeat(body.node_mass, 3))
        return cls(end, time, energy, slope.ravel(), entries, factors)


def effort_cost(
    problem: StepProblem,
    linear: LinearStep,
    foreseen: np.ndarray,
    horizon: EffortModel,
    *,
    weight: float = EFFORT_WEIGHT,
) -> QuadraticCost:
    """``weight`` / (m g H) times the elastic energy and what damping takes, at the ``horizon`` if the body goes on at
    its end velocity, around ``foreseen`` (3N,) m/s.

    Of all the shapes in which a body does what is asked, it takes the one that strains it least, and gives back what
    it has stored: without this, muscles work against each other. What is stiff goes on only until it is slack, as in
    one implicit step over the horizon: carried on at its speed, what lets go would seem to be strained the other way.
    """
    body, factors = problem.body, horizon.factors
    if factors.is_host:
        _require_factors(factors)
    quadratic, force = factors.effort_quadratic(
        horizon.stiffness_entries,
        horizon.gradient,
        np.repeat(body.node_mass, 3),
        linear.velocities,
        dt_now=problem.dt,
        dt_ahead=horizon.duration - problem.dt,
        reference=problem.dt * foreseen,
    )
    _require_factors(factors)
    unit = weight / (body.weight * body.height)
    return QuadraticCost(
        unit * quadratic[:-1, :-1],
        unit * (force[:-1] + quadratic[:-1, -1]),
        unit * (horizon.energy + float(force[-1] + 0.5 * quadratic[-1, -1])),
    )


def _require_factors(factors: LinearSolver) -> None:
    if not factors.is_ready:
        raise UnsolvableStepError("the matrix of what is foreseen has no factors")
