"""Slow reference for a step of several bodies with contact between them: dense matrices, a new tangent in each
iteration, and no line search.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.contact.detection import ContactDetector
from egs_warp.contact.newton import DELASSUS_REGULARIZATION
from egs_warp.contact.pair_contact import PairBody, PairContactDetector
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.fem.step_problem import StepProblem

MAX_ITERATIONS = 40
TOLERANCE = 1e-9
"""Residual of the equations of motion at which a step ends, N s."""

COULOMB_TOLERANCE = 1e-5
"""Maximum violation of Coulomb's law in a step, m/s. A smaller bound cannot be reached, because two flat faces have up
to 24 contacts, whose forces the 12 unknowns of a prop do not determine uniquely.
"""


@dataclass
class ReferenceWorld:
    """Bodies on common ground with one friction coefficient, and their states."""

    bodies: list[SoftBody]
    contact: list[PairBody]
    states: list[BodyState]
    friction: float
    residual: float = np.inf
    """Norm of the residual of the last step, N s."""
    pairs: ContactSet | None = None
    forces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) N, contact forces of ``pairs``."""

    def __post_init__(self) -> None:
        self.detector = PairContactDetector(self.contact, device="cpu")
        self.grounds = [ContactDetector(each.geometry, device="cpu") for each in self.contact]
        self.factors: list[LinearSolver] = [body.assembly.new_solver() for body in self.bodies]

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Split values (3N,) or (3N, m) of all nodes by body."""
        return np.split(values, 3 * self.detector.node_starts[1:-1])

    def advance(self, dt: float) -> None:
        """Advance by one step of ``dt`` s."""
        problems = [StepProblem(body, state, dt) for body, state in zip(self.bodies, self.states, strict=True)]
        ends = [problem.end_positions(problem.state.velocities + dt * problem.body.gravity) for problem in problems]
        loaded = self.forces[:, 0] > 0.0
        previous = np.zeros(0, int) if self.pairs is None else self.pairs.points
        numbers = self.detector.select(np.concatenate(ends), previous, loaded)
        self.pairs = self.detector.contact_set(numbers, np.concatenate([state.positions for state in self.states]))
        rows, gaps = [self.pairs.jacobian.toarray()], [self.pairs.gaps]
        for i, (ground, state, end) in enumerate(zip(self.grounds, self.states, ends, strict=True)):
            selected = self.contact[i].selector.select(np.zeros(0, int), np.zeros(0, bool), ground.gaps(end)[0])
            contacts = ground.contact_set(selected, state.positions)
            first, last = 3 * self.detector.node_starts[i : i + 2]
            embedded = np.zeros((3 * contacts.count, 3 * self.detector.node_starts[-1]))
            embedded[:, first:last] = contacts.jacobian.toarray()
            rows.append(embedded)
            gaps.append(contacts.gaps)
        jacobian, gap = np.concatenate(rows), np.concatenate(gaps)
        height = min(body.height for body in self.bodies)
        # The normal bias pushes deep points out slowly (docs/concepts/contact.md).
        push_out = np.maximum(0.2 * np.minimum(gap + 5e-3 * height, 0.0) / dt, -0.05 * np.sqrt(9.81 * height))
        bias = np.maximum(gap, 0.0) / dt + push_out
        velocities, forces = [problem.rigid_guess for problem in problems], np.zeros((len(bias), 3))
        for iteration in range(MAX_ITERATIONS):
            impulses = self.split(dt * jacobian.T @ forces.ravel())
            residuals = [p.residual(v, None).ravel() for p, v in zip(problems, velocities, strict=True)]
            self.residual = float(
                np.linalg.norm(np.concatenate([r - i for r, i in zip(residuals, impulses, strict=True)]))
            )
            if self.residual < TOLERANCE and (iteration > 0 or len(bias) == 0):
                break
            tangents = [p.tangent(f, v, None) for p, f, v in zip(problems, self.factors, velocities, strict=True)]
            pairs = list(zip(tangents, self.split(np.ascontiguousarray(jacobian.T)), strict=True))
            free = [v.ravel() - tangent.solve(r) for v, tangent, r in zip(velocities, tangents, residuals, strict=True)]
            columns = np.concatenate([dt * tangent.solve(np.ascontiguousarray(part)) for tangent, part in pairs])
            if len(bias):
                delassus = jacobian @ columns
                delassus[np.diag_indices_from(delassus)] += DELASSUS_REGULARIZATION * delassus.diagonal().mean()
                forces, violation = coulomb_forces(
                    delassus, jacobian @ np.concatenate(free), bias, self.friction, forces
                )
                assert violation < COULOMB_TOLERANCE
            new = np.concatenate(free) + columns @ forces.ravel()
            velocities = [part.reshape(-1, 3) for part in self.split(new)]
        self.forces = forces[: self.pairs.count]
        self.states = [
            BodyState(p.end_positions(v), v, p.state.time + dt) for p, v in zip(problems, velocities, strict=True)
        ]
