"""Implicit step of an island, that is, of several bodies that may touch each other (Eq. 4, 6).

The nodes of the bodies are concatenated. Each body has the equations of ``StepProblem``. Only contact forces and joints
couple them, so the tangent without joints is block diagonal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import lu_factor, lu_solve

from egs_warp.fem.body import BodyState
from egs_warp.fem.driven_step import DrivenStep
from egs_warp.fem.joints import JointRows, StepJoints
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
    joint_rows: JointRows | None = None
    """Rows of the joints; None for an island without joints."""

    @property
    def dt(self) -> float:
        """Step size, s."""
        return self.problems[0].dt

    @cached_property
    def node_starts(self) -> np.ndarray:
        """(k + 1,) first node of each body, and N."""
        return np.concatenate([[0], np.cumsum([len(problem.node_mass) for problem in self.problems])])

    @cached_property
    def _bounds(self) -> list[int]:
        """``node_starts`` as a list, whose elements are faster to use."""
        return self.node_starts.tolist()

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
        """(N, 3) m/s, rigid motion of each body with its momenta at the start, changed so that the joints are
        closed."""
        guess = np.concatenate([problem.rigid_guess for problem in self.problems])
        return guess if self.joints is None else self.joints.feasible(guess)

    @cached_property
    def joints(self) -> StepJoints | None:
        """Joints in this step, or None."""
        if self.joint_rows is None:
            return None
        is_driven = [isinstance(problem, DrivenStep) for problem in self.problems]
        return StepJoints(self.joint_rows, self.problems, is_driven, self.dt)

    def nodes_of(self, body: int) -> slice:
        """Return the nodes of a body."""
        return slice(self._bounds[body], self._bounds[body + 1])

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Split nodal values (N, ...) or (3N, ...) by body."""
        per_node = len(values) // self._bounds[-1]
        return [values[per_node * a : per_node * b] for a, b in pairwise(self._bounds)]

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
        """Return the norm of a residual (N, 3) N s without the impulses of joints, in which the part of each body is
        divided by dt times its weight."""
        if self.joints is not None:
            residual = self.joints.without_impulses(residual)
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
    """Inverse of the derivative of an island's residual.

    It is block diagonal without joints. With joints, whose rows are B, it is K = J^-1 - J^-1 B^T (B J^-1 B^T)^-1 B J^-1
    with the block-diagonal inverse J^-1. As B K = 0, Newton steps from velocities that close the joints keep them
    closed, and K B^T = 0, so the impulses of the joints need not be known.
    """

    problem: IslandProblem
    """The step."""
    blocks: tuple[Tangent, ...]
    """Tangent of each body."""

    def renewed(self, velocities: np.ndarray, tensions: Tensions) -> IslandTangent:
        """Return the tangent at ``velocities`` (N, 3) m/s in the same solvers; see ``IslandProblem.tangent``."""
        return self.problem.tangent([block.factors for block in self.blocks], velocities, tensions)

    def solve(self, impulses: np.ndarray) -> np.ndarray:
        """Return K ``impulses``, m/s, for impulses (3N,) or (3N, m), N s."""
        return self._with_closed_joints(self._solve_blocks(impulses))

    def solve_with_base(self, body: int, impulses: np.ndarray, base: np.ndarray) -> np.ndarray:
        """Return K (A, b) (3N, m + 1), m/s, for impulses A on one body and other impulses b.

        Args:
            body: index of the body.
            impulses: (3n, m + 1) N s, for the n nodes of the body: the rows of A, and in the last column those of b.
            base: (3N,) N s, b.
        """
        solved = np.zeros((len(base), impulses.shape[1]))
        parts = zip(self.blocks, self.problem.split(base), self.problem.split(solved), strict=True)
        for index, (block, right, out) in enumerate(parts):
            if index == body:
                out[:] = block.solve(impulses)
            else:
                out[:, -1] = block.solve(right)
        return self._with_closed_joints(solved)

    def _with_closed_joints(self, solved: np.ndarray) -> np.ndarray:
        """Return K times impulses, (3N,) or (3N, m), from the product ``solved`` with J^-1, which is overwritten."""
        if self.problem.joint_rows is not None:
            response, compliance = self._joints
            solved -= response @ lu_solve(compliance, self.problem.joint_rows.matrix @ solved, check_finite=False)
        return solved

    @cached_property
    def _joints(self) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Velocities J^-1 B^T (3N, 3j), m/s per N s, and LU factors of the compliance B J^-1 B^T of the joints."""
        assert self.problem.joint_rows is not None
        matrix = self.problem.joint_rows.matrix
        response = self._solve_blocks(np.ascontiguousarray(matrix.T))
        return response, lu_factor(matrix @ response, check_finite=False)

    def _solve_blocks(self, impulses: np.ndarray) -> np.ndarray:
        """Return J^-1 ``impulses``, block by block. In each block, columns that are zero are skipped."""
        parts = list(zip(self.blocks, self.problem.split(impulses), strict=True))
        if impulses.ndim == 1:
            return np.concatenate([block.solve(right) for block, right in parts])
        solved = np.zeros(impulses.shape)
        for (block, right), out in zip(parts, self.problem.split(solved), strict=True):
            columns = np.flatnonzero(right.any(axis=0))
            if columns.size == right.shape[1]:
                out[:] = block.solve(right)
            elif columns.size:
                out[:, columns] = block.solve(right[:, columns])
        return solved
