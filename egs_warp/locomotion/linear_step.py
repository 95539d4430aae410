"""End of a step as an affine function of activations and contact forces, linearised about a predicted end (Eq. 7, 8,
13).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.newton import ContactLinearization
from egs_warp.fem.island_problem import IslandTangent
from egs_warp.fem.step_problem import StepProblem
from egs_warp.launching import run_concurrently
from egs_warp.locomotion.objectives import Objective
from egs_warp.locomotion.synergies import Synergies
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import SynergyColumns

PREDICTION_ITERATIONS = 2
"""Number of Newton steps with contact forces that predict the end of a step."""


@dataclass(frozen=True)
class PredictedStep:
    """Predicted end of a step under given activations, and the linearisation at this end."""

    linearization: ContactLinearization
    normal_bias: np.ndarray
    """(n,) m/s, velocity bias of each contact in the normal direction, see ``CoupledSolver.normal_bias``."""
    activations: np.ndarray
    """(M,) m, muscle activations."""
    velocities: np.ndarray
    """(N, 3) m/s, at the end of the step."""
    forces: np.ndarray
    """(n, 3) N, contact forces in the axes of each contact."""
    body: int | None = None
    """Index of the planned body in its island; None if there are no other bodies."""
    other_tensions: Any = None
    """Muscle energies of the other bodies of the island (``fem.island_problem.Tensions``), or None."""

    @property
    def problem(self) -> StepProblem:
        """Step of the planned body."""
        joint: Any = self.linearization.tangent.problem
        return joint if self.body is None else joint.problems[self.body]

    @property
    def nodes(self) -> slice:
        """Nodes of the planned body."""
        joint: Any = self.linearization.tangent.problem
        return slice(None) if self.body is None else joint.nodes_of(self.body)

    @property
    def coordinates(self) -> slice:
        """Coordinates of the planned body among those of all nodes."""
        return slice(None) if self.body is None else slice(3 * self.nodes.start, 3 * self.nodes.stop)


@dataclass(frozen=True)
class SolveInputs:
    """Inputs of a step of one body or of an island that are known before its activations are planned."""

    problem: Any
    """``StepProblem`` or ``IslandProblem``."""
    contacts: ContactSet
    normal_bias: np.ndarray
    """(n,) m/s, velocity bias of each contact in the normal direction."""
    friction: float
    forces: np.ndarray
    """(n, 3) N, contact forces of the previous step; zero for contacts that are new in this step."""


@dataclass(frozen=True)
class StepInputs(SolveInputs):
    """Inputs of a step of one body."""

    problem: StepProblem
    activations: np.ndarray
    """(M,) m, activations of the previous step."""

    @classmethod
    def from_prediction(cls, predicted: PredictedStep, friction: float, activations: np.ndarray) -> StepInputs:
        """Return the inputs of the step of ``predicted``, with its contact forces, and ``activations`` (M,) m as the
        activations of the previous step."""
        contacts = predicted.linearization.contacts
        return cls(predicted.problem, contacts, predicted.normal_bias, friction, predicted.forces, activations)


@dataclass(frozen=True)
class LinearStep:
    """End velocity v(x) and change of angular momentum of a step, as affine functions of the k unknowns x =
    (activations, contact forces)."""

    velocities: np.ndarray
    """(3N, k + 1) m/s: derivative of the end velocity with respect to x, and in the last column v(0), without muscles
    and contact."""
    torques: np.ndarray
    """(3, k) kg m^2/s: derivative of the angular momentum with respect to x."""

    @property
    def count(self) -> int:
        """Number of unknowns k."""
        return self.torques.shape[1]

    @property
    def columns(self) -> np.ndarray:
        """(3N, k) m/s, derivative of the end velocity with respect to x."""
        return self.velocities[:, :-1]

    @property
    def base(self) -> np.ndarray:
        """(3N,) m/s, end velocity without muscles and contact."""
        return self.velocities[:, -1]

    def end_velocities(self, x: np.ndarray) -> np.ndarray:
        """Return v(x), (3N,) m/s, for ``x`` (k,)."""
        return self.base + self.columns @ x

    def contact_velocities(self, contacts: ContactSet) -> np.ndarray:
        """Return W times ``velocities``, (3n, k + 1) m/s, for the contacts of the step."""
        return contacts.contact_velocities(self.velocities)

    def objective_quadratic(self, objectives: Sequence[Objective]) -> np.ndarray:
        """Return the quadratic form G, (k + 1, k + 1) (m/s)^2, of the weighted squares of ``objectives``, which are 1/2
        (x, 1)^T G (x, 1)."""
        form = np.zeros((self.count + 1, self.count + 1))
        for objective in objectives:
            residual = objective.rows @ self.velocities
            residual[:, -1] -= objective.target
            form += 2.0 * objective.weight * (residual.T @ residual)
        return form


@dataclass(frozen=True)
class IslandLinearStep:
    """End of the step of an island as an affine function of the m activations of one body and of the forces of all n
    contacts. The columns of the forces are those of the contact linearisation and are not copied."""

    without_contact: np.ndarray
    """(3N, m + 1) m/s: derivative of the end velocity with respect to the activations, and in the last column the end
    velocity without the muscles of the body and without contact."""
    linearization: ContactLinearization
    unit_force: float
    """Unit of the contact forces, N."""
    torques: np.ndarray
    """(3, m + 3n) kg m^2/s: derivative of the angular momentum of the body with respect to x."""

    def end_velocities(self, x: np.ndarray) -> np.ndarray:
        """Return v(x), (3N,) m/s, for ``x`` (m + 3n,)."""
        m = self.without_contact.shape[1] - 1
        free = self.without_contact @ np.append(x[:m], 1.0)
        return free + self.linearization.columns @ (self.unit_force * x[m:])

    def contact_velocities(self, contacts: ContactSet) -> np.ndarray:
        """Return the velocities (3n, m + 3n + 1) m/s of the contacts, as in ``LinearStep.contact_velocities``."""
        free = contacts.contact_velocities(self.without_contact)
        return np.hstack([free[:, :-1], self.unit_force * self.linearization.delassus, free[:, -1:]])

    def of_body(self, coordinates: slice, contacts: np.ndarray) -> LinearStep:
        """Return the linear step of the ``coordinates`` of the body as a function of its activations and of the forces
        of the ``contacts`` (p,); the other forces are zero."""
        m = self.without_contact.shape[1] - 1
        own, components = self.without_contact[coordinates], (3 * contacts[:, None] + np.arange(3)).ravel()
        velocities = np.empty((len(own), m + len(components) + 1))
        velocities[:, :m], velocities[:, -1] = own[:, :m], own[:, m]
        np.multiply(self.unit_force, self.linearization.columns[coordinates, components], out=velocities[:, m:-1])
        return LinearStep(velocities, np.hstack([self.torques[:, :m], self.torques[:, m + components]]))


class StepLinearizer:
    """Builder of linear steps of one body on the host."""

    def __init__(self, muscles: MuscleSet, synergies: Synergies) -> None:
        self._impulses = SynergyColumns(muscles, synergies.group_from_muscle)
        self._count = synergies.count

    def linearize(
        self, predicted: PredictedStep, other: Callable[[], Any]
    ) -> tuple[LinearStep | IslandLinearStep, Any]:
        """Linearise the step about a predicted end v^: v = v^ - J^-1 r0(v^) + dt J^-1 (A a + W^T f), Eq. (7).

        Args:
            predicted: end of the step about which to linearise.
            other: independent work, which runs at the same time if the matrices are on the host.

        Returns:
            The linear step, and the result of ``other``. Unknowns are the activations of the synergies as fractions of
            their bounds, then the contact forces in body weights.
        """
        response, m = predicted.linearization, self._count
        problem, contacts = predicted.problem, response.contacts
        weight = problem.body.weight
        # Residual without contact and without the muscles of the planned body.
        free = response.tangent.problem.residual(predicted.velocities, predicted.other_tensions).ravel()
        own, ends = predicted.coordinates, problem.end_positions(predicted.velocities[predicted.nodes])
        impulses = self._impulses.with_base(free[own], ends, problem.dt)
        columns, tangent = response.host_columns, response.tangent

        def solve() -> np.ndarray:
            if predicted.body is None:
                return tangent.solve(impulses)
            return cast(IslandTangent, tangent).solve_with_base(predicted.body, impulses, free)

        if columns is response.columns:
            solved, other_result = run_concurrently(solve, other)
        else:
            # Both use the same stream of a GPU.
            solved, other_result = solve(), other()
        torques = torques_of(problem, contacts, m, own)
        if predicted.body is not None:
            np.subtract(predicted.velocities.ravel(), solved[:, -1], out=solved[:, -1])
            return IslandLinearStep(solved, response, weight, torques), other_result
        velocities = np.empty((free.size, m + 3 * contacts.count + 1))
        velocities[:, :m] = solved[:, :-1]
        np.multiply(weight, columns, out=velocities[:, m:-1])
        np.subtract(predicted.velocities.ravel(), solved[:, -1], out=velocities[:, -1])
        return LinearStep(velocities, torques), other_result


def torques_of(problem: StepProblem, contacts: ContactSet, m: int, own: slice = slice(None)) -> np.ndarray:
    """Return (3, m + 3n) kg m^2/s, derivative of the angular momentum with respect to x: zero for the ``m``
    activations, and the angular impulse of one body weight along each axis of each contact. ``own`` are the coordinates
    of the body among those of all nodes."""
    modes = problem.rotation_modes
    if own != slice(None):
        modes = np.zeros((3 * contacts.node_count, 3))
        modes[own] = problem.rotation_modes
    torques = problem.dt * problem.body.weight * contacts.contact_velocities(modes).T
    return np.hstack([np.zeros((3, m)), torques])
