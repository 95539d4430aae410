"""Stage 1's penalty contact (Eq. 10, 11): derivatives, Coulomb's limit, and the creep of a resting body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sparse

from egs_warp.contact.detection import ContactDetector, ContactGeometry, ContactSet, push_out_speeds
from egs_warp.contact.penalty import PenaltyContact, predict
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.fem.factorisation import Factorisation
from egs_warp.fem.implicit_step import ImplicitStep, NewtonStatus
from egs_warp.geometry.plane import Plane
from tests.support.meshes import block_mesh

SLOPE = Plane.from_coefficients(0.0, 0.0, 1.0, 0.0)


@pytest.fixture(scope="module")
def body() -> SoftBody:
    return make_body(block_mesh(), SLOPE, damping_ratio=0.5, device="cpu")


def contacts_at(body: SoftBody, points: np.ndarray, plane: Plane = SLOPE) -> ContactSet:
    embedding = embed_points(body.mesh, points, device="cpu")
    geometry = ContactGeometry(body.mesh, (plane,), 0.8, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0)
    return ContactDetector(geometry, device="cpu").contact_set(np.arange(len(points)), body.mesh.nodes)


def random_penalty(body: SoftBody) -> tuple[PenaltyContact, np.ndarray]:
    """Contacts inside one tetrahedron and on shared nodes; some pressed, some free, some sticking, some sliding."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.3], (12, 3))
    contacts = contacts_at(body, points, Plane.from_coefficients(0.3, -0.2, 1.0, 0.0))
    step = ImplicitStep(body, BodyState(body.mesh.nodes, 0 * body.mesh.nodes), 1 / 60, Factorisation(body))
    velocities = rng.standard_normal(body.mesh.nodes.shape)
    local = (contacts.frame @ velocities.ravel()).reshape(-1, 3)
    penalty = PenaltyContact(contacts, step, 40.0, rng.uniform(-0.5, 0.5, 12), rng.uniform(1.0, 40.0, 12))
    pressed = local[:, 0] + penalty.shift < 0
    sliding = 40.0 * np.linalg.norm(local[:, 1:], axis=1) > penalty.friction_cap
    assert 0 < pressed.sum() < 12 and 0 < sliding.sum() < 12
    return penalty, velocities


def test_penalty_derivatives(body: SoftBody) -> None:
    """Eq. (10), Eq. (11): gradient and Hessian by central differences, away from the kinks;
    the matrix is what is added.
    """
    penalty, v = random_penalty(body)
    assembly = body.assembly
    entries = np.zeros(assembly.upper_pattern.nnz)
    penalty.add_hessian(v, entries)
    upper = assembly.matrix(entries)
    full = upper + sparse.triu(upper, 1).T
    assert np.linalg.eigvalsh(full.toarray()).min() > -1e-10
    rng = np.random.default_rng(1)
    for _ in range(4):
        along, h = rng.standard_normal(v.shape), 1e-6
        slope = (penalty.energy(v + h * along) - penalty.energy(v - h * along)) / (2 * h)
        assert slope == pytest.approx(np.sum(penalty.gradient(v) * along), rel=1e-6)
        change = (penalty.gradient(v + h * along) - penalty.gradient(v - h * along)) / (2 * h)
        assert np.abs(full @ along.ravel() - change.ravel()).max() < 1e-6 * np.abs(change).max()


def test_friction_never_exceeds_coulomb(body: SoftBody) -> None:
    """Eq. (11) as corrected: one two-dimensional tangential velocity, so |f_t| = min(k |u_t|, cap),
    straight against it.
    """
    penalty, v = random_penalty(body)
    for speed in (1e-3, 1.0, 1e3):
        force = penalty.forces(speed * v)
        local = (penalty.contacts.frame @ (speed * v).ravel()).reshape(-1, 3)
        slip = np.linalg.norm(local[:, 1:], axis=1)
        assert np.allclose(np.linalg.norm(force[:, 1:], axis=1), np.minimum(40.0 * slip, penalty.friction_cap))
        assert np.allclose(np.sum(force[:, 1:] * local[:, 1:], axis=1), -np.linalg.norm(force[:, 1:], axis=1) * slip)
        assert np.allclose(force[:, 0], -40.0 * np.minimum(local[:, 0] + penalty.shift, 0.0))


def test_resting_body_creeps_at_the_chosen_speed(body: SoftBody) -> None:
    """Eq. (10): the penalty is a dashpot, so a resting body sinks at weight / sum k_n = 5e-3 H/s and its forces hold
    the weight.
    """
    base = np.array([[x, y, 0.0] for x in (-0.2, 0.0, 0.2) for y in (-0.2, 0.0, 0.2)])
    contacts = contacts_at(body, base)
    assert np.abs(contacts.gaps).max() < 1e-12
    weight = body.node_mass[:, None] * body.gravity
    state, factorisation, forces = BodyState(body.mesh.nodes, 0 * weight), Factorisation(body), np.zeros(9)
    for _ in range(300):
        step = ImplicitStep(body, state, 1 / 60, factorisation)
        prediction = predict(
            step, contacts, weight, state.velocities, normal_forces=forces, friction=0.8, push_out_cap=0.1
        )
        assert prediction.newton.status is NewtonStatus.CONVERGED
        forces = prediction.normal_forces
        state = BodyState(step.end_positions(prediction.velocities), prediction.velocities)
    assert forces.sum() == pytest.approx(body.weight, rel=0.01)
    assert body.centre_of_mass(state.velocities)[2] == pytest.approx(-5e-3 * body.height, rel=0.05)


def test_prediction_pushes_out_of_the_plane_and_balances_momentum(body: SoftBody) -> None:
    """Eq. (4), Eq. (10): m dv_com = dt (m g + sum f) to Newton's tolerance;
    a point in the plane gets b phi / dt of push-out.
    """
    base = np.array([[x, y, 0.0] for x in (-0.2, 0.2) for y in (-0.2, 0.2)])
    contacts = contacts_at(body, base)
    sunk = replace(contacts, gaps=np.full(4, -0.01))
    weight, dt = body.node_mass[:, None] * body.gravity, 1 / 60
    state = BodyState(body.mesh.nodes, np.zeros_like(weight))
    step = ImplicitStep(body, state, dt, Factorisation(body))
    options = {"normal_forces": np.zeros(4), "friction": 0.8, "push_out_cap": 10.0}
    results = [predict(step, c, weight, state.velocities, **options) for c in (contacts, sunk)]
    for c, result in zip((contacts, sunk), results, strict=True):
        local = np.column_stack([result.normal_forces, result.tangential_forces])
        total = weight.sum(0) + (c.frame.T @ local.ravel()).reshape(-1, 3).sum(0)
        gained = body.mass * body.centre_of_mass(result.velocities)
        assert np.linalg.norm(gained - dt * total) < np.sqrt(len(weight)) * 1e-3 * dt * body.weight
    assert push_out_speeds(sunk.gaps, dt, 10.0)[0] == pytest.approx(-0.5 * 0.01 / dt)
    rise = (contacts.frame @ results[1].velocities.ravel())[0::3]
    assert np.all(rise > 0.5 * 0.5 * 0.01 / dt) and results[1].normal_forces.min() > results[0].normal_forces.max()
