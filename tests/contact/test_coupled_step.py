"""Velocities and contact forces sought together (Eq. 4, 8, 9): what contact, friction and both momenta ask for."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.contact.coupled_step import ContactResponse, CoupledResult, CoupledSolver
from egs_warp.contact.detection import ContactDetector, ContactGeometry
from egs_warp.contact.points import ContactPoints
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.fem.sparse_factors import SparseFactors
from egs_warp.fem.step_problem import StepProblem
from egs_warp.geometry.plane import Plane
from tests.support.meshes import block_mesh

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
DT, FRICTION = 1 / 60, 0.5


class Block:
    """A soft block with a grid of contact points under its base."""

    def __init__(self) -> None:
        mesh = block_mesh()
        self.body: SoftBody = make_body(mesh, FLOOR, device="cpu")
        side = np.linspace(-mesh.nodes[:, 0].max(), mesh.nodes[:, 0].max(), 5)
        soles = embed_points(mesh, np.array([[x, y, 0.0] for x in side for y in side]), device="cpu")
        geometry = ContactGeometry(mesh, (FLOOR,), FRICTION, soles.tets.numpy(), soles.weights.numpy(), 0, 0.0)
        height = self.body.height
        self.points = ContactPoints(geometry, near=0.01 * height, lower=1e-3 * height)
        self.solver = CoupledSolver(
            ContactDetector(geometry, device="cpu"),
            self.points,
            SparseFactors(self.body.assembly.upper_pattern),
            push_out_cap=0.05,
            penetration_tolerance=5e-3 * height,
        )
        self.before, self.forces = np.zeros(0, int), np.zeros((0, 3))

    def step(self, state: BodyState) -> tuple[StepProblem, CoupledResult]:
        problem, detector = StepProblem(self.body, state, DT), self.solver.detector
        gaps, _ = detector.gaps(problem.end_positions(state.velocities + DT * self.body.gravity))
        chosen = self.points.choose(self.before, self.forces[:, 0] > 0.0, gaps)
        contacts = detector.contact_set(chosen, state.positions)
        tangent = problem.tangent(self.solver.factors, state.velocities, None)
        start = self.points.matched(chosen, self.before, self.forces)
        result = self.solver.solve(
            ContactResponse.of(tangent, contacts), None, velocities=state.velocities, forces=start
        )
        self.before, self.forces = result.contacts.points, result.forces
        return problem, result


@pytest.mark.parametrize("push", [0.0, 0.5])
def test_a_block_comes_to_rest_and_every_step_obeys(push: float) -> None:
    """Dropped by 2 %, pushed sideways or not: contact and Coulomb's law with the stored velocities, both momenta."""
    block = Block()
    body = block.body
    nodes = body.mesh.nodes + [0.0, 0.0, 0.02 * body.height]
    state = BodyState(nodes, np.tile([push, 0.3 * push, 0.0], (len(nodes), 1)))
    for _ in range(60):
        problem, result = block.step(state)
        assert result.converged and result.residual < 1e-8
        contacts, forces = result.contacts, result.forces
        speed = (contacts.frame @ result.velocities.ravel()).reshape(-1, 3)
        measure = speed[:, 0] + block.solver.shift(contacts, DT)
        scale = np.sqrt(9.81 * body.height)
        if contacts.count:
            assert measure.min() > -1e-6 * scale and forces[:, 0].min() >= 0.0
            assert np.abs(np.minimum(measure / scale, forces[:, 0] / body.weight)).max() < 1e-6
            slip, friction = np.linalg.norm(speed[:, 1:], axis=1), np.linalg.norm(forces[:, 1:], axis=1)
            assert (friction <= FRICTION * forces[:, 0] * (1 + 1e-9) + 1e-12).all()
            sliding = slip > 1e-4 * scale
            assert np.allclose(friction[sliding], FRICTION * forces[sliding, 0], atol=1e-6 * body.weight)
            # Friction does no work on what slides.
            assert ((forces[:, 1:] * speed[:, 1:]).sum(axis=1) <= 1e-7 * body.weight * scale).all()
        nodal = (contacts.frame.T @ forces.ravel()).reshape(-1, 3)
        gained = body.mass * (body.centre_of_mass(result.velocities) - body.centre_of_mass(state.velocities))
        assert np.abs(gained - DT * (nodal.sum(axis=0) + body.mass * body.gravity)).max() < 1e-7 * problem.unit
        arms = state.positions - body.centre_of_mass(state.positions)
        after = BodyState(problem.end_positions(result.velocities), result.velocities, state.time + DT)
        turned = body.angular_momentum(after.positions, after.velocities)
        turned = turned - body.angular_momentum(state.positions, state.velocities)
        torque = DT * np.cross(arms, nodal).sum(axis=0)
        assert np.abs(turned - torque).max() < 1e-7 * problem.unit * body.height
        state = after
    # The pushed block still sways when its base has come to rest.
    assert np.abs(speed[:, 1:]).max() < 5e-3 * scale
    if push == 0.0:
        assert forces[:, 0].sum() == pytest.approx(body.weight, rel=3e-3)
        assert np.abs(state.velocities).max() < 5e-3 * scale
