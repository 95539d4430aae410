"""Implicit step of an island, that is, of several bodies that may touch each other (Eq. 4, 6).

The nodes of the bodies are concatenated. Each body has the equations of ``StepProblem``. Only contact forces couple
them, so the tangent is block diagonal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.muscles.tension import MuscleEnergy

Tensions = Sequence[MuscleEnergy | None] | None
"""Muscle energy of each body of an island, None for bodies without muscles; None if no body has muscles."""


@dataclass(frozen=True)
class IslandProblem:
    """Implicit step of k bodies with N nodes in total; all have the same step size."""

    problems: tuple[StepProblem, ...]
    """The step of each body."""

    @property
    def dt(self) -> float:
        """Step size, s."""
        return self.problems[0].dt

    @cached_property
    def node_starts(self) -> np.ndarray:
        """(k + 1,) first node of each body, and N."""
        return np.concatenate([[0], np.cumsum([len(problem.node_mass) for problem in self.problems])])

    @property
    def free_fall_speed(self) -> float:
        """Speed that free fall gains in the step, m/s."""
        return self.problems[0].free_fall_speed

    @cached_property
    def state(self) -> BodyState:
        """State at the start of the step, with arrays (N, 3)."""
        states = [problem.state for problem in self.problems]
        positions, velocities = ([getattr(state, name) for state in states] for name in ("positions", "velocities"))
        return BodyState(np.concatenate(positions), np.concatenate(velocities), states[0].time)

    @cached_property
    def ballistic_positions(self) -> np.ndarray:
        """(N, 3) m, end positions of the nodes without internal and contact forces."""
        return np.concatenate([problem.ballistic_positions for problem in self.problems])

    @cached_property
    def rigid_guess(self) -> np.ndarray:
        """(N, 3) m/s, rigid motion of each body with its momenta at the start."""
        return np.concatenate([problem.rigid_guess for problem in self.problems])

    def nodes_of(self, body: int) -> slice:
        """Return the nodes of a body."""
        return slice(int(self.node_starts[body]), int(self.node_starts[body + 1]))

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Split nodal values (N, ...) or (3N, ...) by body."""
        per_node = len(values) // int(self.node_starts[-1])
        return np.split(values, per_node * self.node_starts[1:-1])

    def end_positions(self, velocities: np.ndarray) -> np.ndarray:
        """Return x + dt v (N, 3), m."""
        return self.state.positions + self.dt * velocities

    def is_inversion_free(self, velocities: np.ndarray) -> bool:
        """Return True if no element is inverted at the end positions for ``velocities`` (N, 3) m/s."""
        return all(p.is_inversion_free(part) for p, part in zip(self.problems, self.split(velocities), strict=True))

    def residual(self, velocities: np.ndarray, tensions: Tensions) -> np.ndarray:
        """Return the residual (N, 3) N s without contact forces; see ``ImplicitStep.residual``."""
        parts = zip(self.problems, self.split(velocities), self._each(tensions), strict=True)
        return np.concatenate([problem.residual(part, tension) for problem, part, tension in parts])

    def relative_norm(self, residual: np.ndarray) -> float:
        """Return the norm of a residual (N, 3) N s, in which the part of each body is divided by dt times its
        weight."""
        parts = zip(self.problems, self.split(residual), strict=True)
        return float(np.linalg.norm([problem.relative_norm(part) for problem, part in parts]))

    def _each(self, tensions: Tensions) -> Sequence[MuscleEnergy | None]:
        return [None] * len(self.problems) if tensions is None else tensions

    def tangent(self, factors: Sequence[LinearSolver], velocities: np.ndarray, tensions: Tensions) -> IslandTangent:
        """Factor the tangent of each body; see ``StepProblem.tangent``.

        Args:
            factors: solver of each body.
            velocities: (N, 3) m/s, linearisation point.
            tensions: muscles of each body.
        """
        parts = zip(self.problems, factors, self.split(velocities), self._each(tensions), strict=True)
        return IslandTangent(self, tuple(p.tangent(solver, part, tension) for p, solver, part, tension in parts))


@dataclass(frozen=True)
class IslandTangent:
    """Block-diagonal inverse of the derivative of an island's residual."""

    problem: IslandProblem
    """The step."""
    blocks: tuple[Tangent, ...]
    """Tangent of each body."""

    @property
    def factors(self) -> tuple[LinearSolver, ...]:
        """Factors of each body."""
        return tuple(block.factors for block in self.blocks)

    def solve(self, impulses: np.ndarray) -> np.ndarray:
        """Return J^-1 ``impulses``, m/s, for impulses (3N,) or (3N, m), N s. In each block, columns that are zero are
        skipped."""
        solved = np.zeros(impulses.shape)
        for block, right, out in zip(
            self.blocks, self.problem.split(impulses), self.problem.split(solved), strict=True
        ):
            if impulses.ndim == 1:
                out[:] = block.solve(np.ascontiguousarray(right))
            elif (columns := np.flatnonzero(right.any(axis=0))).size:
                out[:, columns] = block.solve(np.ascontiguousarray(right[:, columns]))
        return solved
