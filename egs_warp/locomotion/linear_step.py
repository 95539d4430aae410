"""A step's end, linear in activations and contact forces about one that is foreseen (Eq. 7, 8, 13)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from egs_warp.contact.detection import ContactSet
from egs_warp.contact.newton import ContactLinearization
from egs_warp.fem.step_problem import StepProblem
from egs_warp.launching import run_concurrently
from egs_warp.locomotion.objectives import Objective
from egs_warp.locomotion.synergies import Synergies
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import SynergyColumns

PREDICTION_ITERATIONS = 2
"""Newton steps with contact in which a step is foreseen."""


@dataclass(frozen=True)
class PredictedStep:
    """Where a step would end under some activations, and the tangent there."""

    linearization: ContactLinearization
    normal_bias: np.ndarray
    """(n,) m/s, the constants of the contacts' normal measures."""
    activations: np.ndarray
    """(M,) metres."""
    velocities: np.ndarray
    """(N, 3) m/s."""
    forces: np.ndarray
    """(n, 3) newtons."""


@dataclass(frozen=True)
class StepInputs:
    """What a step begins with."""

    problem: StepProblem
    contacts: ContactSet
    normal_bias: np.ndarray
    """(n,) m/s, see ``Prospect``."""
    friction: float
    activations: np.ndarray
    """(M,) metres of the step before."""
    forces: np.ndarray
    """(n, 3) newtons of the step before, as far as these contacts were there."""

    @classmethod
    def from_prediction(cls, prospect: PredictedStep, friction: float, activations: np.ndarray) -> StepInputs:
        """Of the step of the ``prospect``, with its forces."""
        response = prospect.linearization
        return cls(
            response.tangent.problem, response.contacts, prospect.normal_bias, friction, activations, prospect.forces
        )


@dataclass(frozen=True)
class LinearStep:
    """End velocity and change of angular momentum of a step, linear in x = (activations, contact forces)."""

    velocities: Any
    """(3N, k + 1) m/s for each of x, and without muscles and contact."""
    torques: np.ndarray
    """(3, k) kg m^2/s for each of x."""

    @property
    def count(self) -> int:
        """k."""
        return self.torques.shape[1]

    @property
    def columns(self) -> np.ndarray:
        """(3N, k) m/s for each of x."""
        return self.velocities[:, :-1]

    @property
    def base(self) -> np.ndarray:
        """(3N,) m/s without muscles and contact."""
        return self.velocities[:, -1]

    def end_velocities(self, x: np.ndarray) -> np.ndarray:
        """(3N,) m/s for ``x`` (k,)."""
        return self.base + self.columns @ x

    def contact_velocities(self, contacts: ContactSet) -> np.ndarray:
        """(3n, k + 1) m/s of ``contacts`` along their axes, as ``velocities``."""
        return contacts.contact_velocities(self.velocities)

    def objective_quadratic(self, objectives: Sequence[Objective]) -> Callable[[], np.ndarray]:
        """Begins what gives (k + 1, k + 1) G with (x, 1) G (x, 1) / 2 the weighted squares of what ``objectives`` ask,
        (m/s)^2."""
        form = np.zeros((self.count + 1, self.count + 1))
        for objective in objectives:
            missed = objective.rows @ self.velocities
            missed[:, -1] -= objective.target
            form += 2.0 * objective.weight * (missed.T @ missed)
        return lambda: form


class StepLinearizer(Protocol):
    """Linear steps of one body, about one prospect after the other."""

    def linearize(self, prospect: PredictedStep, other: Callable[[], Any]) -> tuple[LinearStep, Any]:
        """The step about ``prospect``, of the groups' activations in their bounds and contact forces in body weights.
        And what ``other`` gives, which may be called meanwhile."""
        ...


class HostStepLinearizer:
    """``LinearSteps`` in arrays of the host."""

    def __init__(self, muscles: MuscleSet, synergies: Synergies) -> None:
        self._impulses = SynergyColumns(muscles, synergies.group_from_muscle)
        self._count = synergies.count

    def linearize(self, prospect: PredictedStep, other: Callable[[], Any]) -> tuple[LinearStep, Any]:
        """See ``LinearSteps``."""
        response, foreseen, m = prospect.linearization, prospect.velocities, self._count
        problem, contacts = response.tangent.problem, response.contacts
        weight = problem.body.weight
        # Without muscles and contact.
        free = problem.residual(foreseen, None).ravel()
        impulses = self._impulses.with_base(free, problem.end_positions(foreseen), problem.dt)
        solved, given = run_concurrently(lambda: response.tangent.solve(impulses), other)
        velocities = np.empty((free.size, m + 3 * contacts.count + 1))
        velocities[:, :m] = solved[:, :-1]
        np.multiply(weight, response.columns, out=velocities[:, m:-1])
        np.subtract(foreseen.ravel(), solved[:, -1], out=velocities[:, -1])
        return LinearStep(velocities, torques_of(problem, contacts, m)), given


def torques_of(problem: StepProblem, contacts: ContactSet, m: int) -> np.ndarray:
    """(3, m + 3n) kg m^2/s of a step: none of ``m`` activations, of each contact force of a body weight."""
    torques = problem.dt * problem.body.weight * contacts.contact_velocities(problem.rotation_modes).T
    return np.hstack([np.zeros((3, m)), torques])
