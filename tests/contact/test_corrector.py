"""The corrector (Eq. 4, 8, 9): a dropped body comes to rest, and a step obeys contact,
friction and the balance of momentum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from egs_warp.contact.corrector import ContactStepResult, contact_step
from egs_warp.contact.detection import ContactDetector, ContactGeometry, independent_contacts
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.fem.factorisation import Factorisation
from egs_warp.fem.implicit_step import ImplicitStep, NewtonStatus, conserve_angular_momentum
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from tests.support.meshes import block_mesh

DT = 1 / 60


def block_on(
    plane: Plane, friction: float = 0.8, *, sag: float = 0.05, mesh: TetMesh | None = None
) -> tuple[SoftBody, ContactDetector]:
    """A soft block with 25 contact points under its base and four at its top."""
    mesh = mesh or block_mesh()
    body = make_body(mesh, Plane(plane.normal, 0.0), sag=sag, device="cpu")
    half, top = mesh.nodes[:, 0].max(), mesh.nodes[:, 2].max()
    side = np.linspace(-half, half, 5)
    points = np.array([[x, y, 0.0] for x in side for y in side] + [[x, y, top] for x in side[::4] for y in side[::4]])
    embedding = embed_points(mesh, points, device="cpu")
    geometry = ContactGeometry(mesh, (plane,), friction, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0)
    return body, ContactDetector(geometry, device="cpu")


@dataclass
class PassiveBody:
    """Steps a body without muscles, choosing contacts as the stepper does."""

    body: SoftBody
    detector: ContactDetector
    state: BodyState
    points: np.ndarray
    forces: np.ndarray

    def advance(self, dt: float = DT) -> ContactStepResult:
        body, state = self.body, self.state
        step = ImplicitStep(body, state, dt, self.factorisation)
        gaps, _ = self.detector.gaps(step.end_positions(state.velocities + dt * body.gravity))
        candidates = self.detector.candidates(self.points, gaps, 0.01 * body.height)
        if len(candidates) > 1:
            step.factor(0 * state.velocities, projected=True)
            normals = self.detector.contact_set(candidates, state.positions).frame[0::3]
            compliance = normals @ step.factorisation.solve(normals.T.toarray())
            kept = int(np.isin(candidates, self.points).sum())
            candidates = candidates[independent_contacts(compliance, kept, 32, 1e-3)]
        start = np.array([self.forces[self.points == p].sum(axis=0) for p in candidates]).reshape(-1, 3)
        weight = body.node_mass[:, None] * body.gravity
        scale = np.sqrt(9.81 * body.height)
        result = contact_step(
            step,
            self.detector,
            candidates,
            weight,
            start_velocities=state.velocities,
            start_forces=start,
            push_out_cap=0.05 * scale,
            penetration_tolerance=2e-3 * body.height,
        )
        assert result.converged and result.status is NewtonStatus.CONVERGED
        end = step.end_positions(result.velocities)
        v, _ = conserve_angular_momentum(body, state, end, result.velocities, result.nodal_forces, dt)
        self.state = BodyState(end, v, state.time + dt)
        self.points, self.forces = result.contacts.points, result.forces
        return result

    def __post_init__(self) -> None:
        self.factorisation = Factorisation(self.body)


def passive(body: SoftBody, detector: ContactDetector, lift: float = 0.0) -> PassiveBody:
    x = body.mesh.nodes + lift * detector.geometry.planes[0].normal
    return PassiveBody(body, detector, BodyState(x, np.zeros_like(x)), np.zeros(0, int), np.zeros((0, 3)))


def test_dropped_body_comes_to_rest_without_gaining_energy() -> None:
    """Eq. (4), Eq. (9): dropped from H/2 with muscles off, no step adds more than 1e-7 m g H,
    and it ends at rest on its base.
    """
    body, detector = block_on(Plane(np.array([0.0, 0.0, 1.0]), 0.0))
    falling = passive(body, detector, 0.5 * body.height)
    unit = body.weight * body.height
    energies, deepest = [body.mechanical_energy(falling.state.positions, falling.state.velocities)], 0.0
    for _ in range(150):
        result = falling.advance()
        state = falling.state
        energies.append(body.mechanical_energy(state.positions, state.velocities))
        gaps, _ = detector.gaps(state.positions)
        deepest = min(deepest, gaps.min())
        gap = np.maximum(gaps[result.contacts.points], 0.0)
        assert (result.forces[:, 0] * gap).max(initial=0.0) <= 1e-4 * unit
    gains = np.diff(energies) / unit
    assert gains.max() < 1e-7
    assert deepest > -1e-3 * body.height
    assert energies[-1] < energies[0] - 0.45 * unit
    assert np.abs(falling.state.velocities).max() < 1e-2
    assert falling.forces[:, 0].sum() == pytest.approx(body.weight, rel=0.02)
    up = body.best_fit_rotation(falling.state.positions)[:, 2]
    assert up[2] > np.cos(np.radians(2.0))


@pytest.mark.parametrize("degrees", [15.0, 30.0])
def test_block_on_an_incline_sticks_or_slides(degrees: float) -> None:
    """Eq. (9), closed form: with mu = 0.4 it sticks at 15 degrees and at 30 slides with a = g (sin - mu cos), to 2 %.

    Gravity is turned instead of the floor; the block is stiff and flat (it must not tip), starts at rest, and its mean
    over 20 steps is taken.
    """
    angle, friction = np.radians(degrees), 0.4
    body, detector = block_on(
        Plane(np.array([0.0, 0.0, 1.0]), 0.0), friction, sag=0.002, mesh=block_mesh(4, 4, 3, (0.8, 0.8, 0.3))
    )
    tilted = SoftBody(
        body.mesh, body.assembly, body.node_mass, 9.81 * np.array([np.sin(angle), 0, -np.cos(angle)]), 1.0
    )
    moving = passive(tilted, detector)
    speeds = []
    for _ in range(40):
        result = moving.advance()
        speeds.append(body.centre_of_mass(moving.state.velocities)[0])
        force = result.forces
        slack = np.linalg.norm(force[:, 1:], axis=1) - friction * force[:, 0]
        assert slack.max() <= 1e-9 * body.weight and force[:, 0].min() >= 0.0
    measured = (speeds[-1] - speeds[19]) / (20 * DT)
    expected = max(9.81 * (np.sin(angle) - friction * np.cos(angle)), 0.0)
    assert measured == pytest.approx(expected, rel=0.02, abs=0.02)


def test_step_balances_momentum_with_its_contact_forces() -> None:
    """Eq. (4): |m dv_com - dt (m g + sum f)| <= 1e-5 dt m g through an oblique, spinning impact."""
    body, detector = block_on(Plane(np.array([0.0, 0.0, 1.0]), 0.0))
    thrown = passive(body, detector, 0.03)
    x = thrown.state.positions
    v = np.array([1.5, 0.3, -1.0]) + np.cross([0.5, -1.0, 2.0], x - body.centre_of_mass(x))
    thrown.state, touched = BodyState(x, v), 0
    for _ in range(15):
        before = body.centre_of_mass(thrown.state.velocities)
        result = thrown.advance()
        total = body.mass * body.gravity + result.nodal_forces.sum(0)
        gained = body.mass * (body.centre_of_mass(thrown.state.velocities) - before)
        assert np.linalg.norm(gained - DT * total) <= 1e-5 * DT * body.weight
        touched += result.forces[:, 0].max(initial=0.0) > 0.1 * body.weight
        speed = (result.contacts.frame @ result.velocities.ravel()).reshape(-1, 3)
        for f, u in zip(result.forces, speed, strict=True):
            if np.linalg.norm(u[1:]) > 1e-3 and f[0] > 1e-3 * body.weight:
                assert f[1:] @ u[1:] == pytest.approx(-0.8 * f[0] * np.linalg.norm(u[1:]), rel=1e-3)
    assert touched >= 3


def test_points_that_would_sink_join_the_set() -> None:
    """A step that starts with one corner in its set ends with every point above the tolerance."""
    body, detector = block_on(Plane(np.array([0.0, 0.0, 1.0]), 0.0))
    x = body.mesh.nodes
    step = ImplicitStep(body, BodyState(x, np.tile([0.0, 0.0, -1.0], (len(x), 1))), DT, Factorisation(body))
    result = contact_step(
        step,
        detector,
        np.array([0]),
        body.node_mass[:, None] * body.gravity,
        start_velocities=step.state.velocities,
        start_forces=np.zeros((1, 3)),
        push_out_cap=0.1,
        penetration_tolerance=2e-3,
    )
    assert result.converged and result.contacts.count > 4 and result.contacts.points[0] == 0
    assert len(set(result.contacts.points)) == result.contacts.count
    assert detector.gaps(step.end_positions(result.velocities))[0].min() >= -2e-3
