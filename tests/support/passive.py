"""Body without muscle control, stepped as in the engine by contact selection and the coupled solve."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from egs_warp.contact.coupled_step import CoupledResult, CoupledSolver
from egs_warp.contact.detection import ContactDetector, ContactGeometry
from egs_warp.contact.newton import ContactLinearizer
from egs_warp.contact.selection import ContactSelector
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.step_problem import StepProblem
from egs_warp.geometry.plane import Plane
from egs_warp.muscles.tension import MuscleEnergy

ABYSS = Plane(np.array([0.0, 0.0, 1.0]), 1e9)
"""Ground plane far below every body."""


@dataclass
class PassiveBody:
    """Body whose state and contacts are passed from step to step."""

    body: SoftBody
    solver: CoupledSolver
    factors: MultifrontalLdl
    state: BodyState
    points: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """(n,) contact points of the last step."""
    forces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) N, contact forces of the last step."""

    def advance(
        self, dt: float, tension: MuscleEnergy | None = None, *, drag: float = 0.0
    ) -> tuple[StepProblem, CoupledResult]:
        """Advance by one step of ``dt`` s."""
        body, state, solver = self.body, self.state, self.solver
        problem = StepProblem(body, state, dt, drag)
        gaps, _ = solver.detector.gaps(problem.ballistic_positions)
        chosen = solver.points.select(self.points, self.forces[:, 0] > 0.0, gaps)
        contacts = solver.detector.contact_set(chosen, state.positions)
        start = contacts.transferred_forces(self.points, self.forces)
        response = ContactLinearizer()(problem.tangent(self.factors, problem.rigid_guess, tension), contacts)
        result = solver.solve(response, tension, velocities=problem.rigid_guess, forces=start)
        self.state = BodyState(problem.end_positions(result.velocities), result.velocities, state.time + dt)
        self.points, self.forces = result.contacts.points, result.forces
        return problem, result


def passive_body(
    body: SoftBody,
    places: np.ndarray | None = None,
    *,
    plane: Plane = ABYSS,
    friction: float = 0.5,
    state: BodyState | None = None,
    tolerance: float = 1e-8,
    device: str = "cpu",
) -> PassiveBody:
    """Place ``body`` over ``plane``, at rest unless ``state`` is given.

    Contact points are at ``places`` (P, 3), m, in its rest shape; by default there is a single one at its middle, for a
    body in flight.
    """
    nodes = body.mesh.nodes
    middle = body.mesh.nodes[body.mesh.tets[len(body.mesh.tets) // 2]].mean(axis=0)
    soles = embed_points(body.mesh, middle[None] if places is None else places, device=device)
    geometry = ContactGeometry(body.mesh, (plane,), friction, soles.tets.numpy(), soles.weights.numpy(), 0, 0.0)
    height = body.height
    solver = CoupledSolver(
        ContactDetector(geometry, device=device),
        ContactSelector(geometry, activation_distance=0.01 * height, hysteresis=1e-3 * height),
        push_out_cap=0.05 * float(np.sqrt(np.linalg.norm(body.gravity) * height)),
        penetration_tolerance=5e-3 * height,
        tolerance=tolerance,
    )
    factors = MultifrontalLdl(body.assembly.upper_pattern)
    return PassiveBody(body, solver, factors, state or BodyState(nodes, np.zeros_like(nodes)))


def base_places(body: SoftBody, count: int = 5) -> np.ndarray:
    """Return a grid (count^2, 3), m, of points on the base of a box that stands on z = 0."""
    (x, y, _), (left, front, _) = body.mesh.nodes.max(axis=0), body.mesh.nodes.min(axis=0)
    return np.array([[a, b, 0.0] for a in np.linspace(left, x, count) for b in np.linspace(front, y, count)])
