"""Step of a body that follows a prescribed path: forces do not change the positions at its end."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.geometry.rigid_path import RigidPath
from egs_warp.muscles.tension import MuscleEnergy


@dataclass(frozen=True)
class DrivenStep(StepProblem):
    """Step of a driven body. Its residual and its inverse tangent are zero, so impulses do not move the body."""

    end: np.ndarray = field(kw_only=True)
    """(N, 3) m, prescribed positions at the end of the step."""

    @property
    def ballistic_positions(self) -> np.ndarray:
        """(N, 3) m, the prescribed end."""
        return self.end

    @property
    def rigid_guess(self) -> np.ndarray:
        """(N, 3) m/s, velocities that lead to the prescribed end."""
        return (self.end - self.state.positions) / self.dt

    def residual(self, velocities: np.ndarray, tension: MuscleEnergy | None) -> np.ndarray:
        """Return zeros (N, 3)."""
        return np.zeros_like(velocities)

    def relative_norm(self, residual: np.ndarray) -> float:
        """Return 0: contact forces on the body are balanced by its drive."""
        return 0.0

    def tangent(self, factors: LinearSolver, velocities: np.ndarray, tension: MuscleEnergy | None) -> DrivenTangent:
        """Return the tangent, which needs no factors."""
        return DrivenTangent(self, factors)

    def drive(self, contact_forces: np.ndarray) -> np.ndarray:
        """Return the velocities (N, 3) m/s that the drive adds to the nodes. With them, the prescribed end satisfies
        the equation of a step without a drive, with ``contact_forces`` (N, 3) N."""
        left = super().residual(self.rigid_guess, None) - self.dt * contact_forces
        return left / self.node_mass[:, None]


@dataclass(frozen=True)
class PathDrive:
    """Drive that moves a body along a path."""

    path: RigidPath
    start: np.ndarray
    """(N, 3) m, positions of the nodes at time 0. The nodes have equal masses, as in a prop."""

    def step(self, body: SoftBody, state: BodyState, dt: float, drag: float) -> DrivenStep:
        """Return the step of ``dt`` s from ``state``; arguments as for ``StepProblem``."""
        return DrivenStep(body, state, dt, drag, end=self.path.moved(self.start, state.time + dt))


@dataclass(frozen=True)
class FixedDrive:
    """Drive that keeps a body at rest where it is."""

    def step(self, body: SoftBody, state: BodyState, dt: float, drag: float) -> DrivenStep:
        """Return the step of ``dt`` s from ``state``; arguments as for ``StepProblem``."""
        return DrivenStep(body, state, dt, drag, end=state.positions)


Drive: TypeAlias = PathDrive | FixedDrive


def step_of(body: SoftBody, state: BodyState, dt: float, drag: float, drive: Drive | None) -> StepProblem:
    """Return the step of a body, driven or not; arguments as for ``StepProblem``."""
    return StepProblem(body, state, dt, drag) if drive is None else drive.step(body, state, dt, drag)


@dataclass(frozen=True)
class DrivenTangent(Tangent):
    """Inverse tangent of a driven body: zero."""

    def solve(self, impulses: np.ndarray) -> np.ndarray:
        """Return zeros of the shape of ``impulses``."""
        return np.zeros_like(impulses)
