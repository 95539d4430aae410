"""The step's equation (Eq. 4, 6): its tangent is its derivative, and both momenta are kept to rounding."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.fem.sparse_factors import SparseFactors
from egs_warp.fem.step_problem import StepProblem
from egs_warp.geometry.plane import Plane
from egs_warp.muscles.muscle_set import automatic_muscles
from egs_warp.muscles.tension import MuscleTension
from tests.support.meshes import block_mesh

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
DT = 1 / 60


@pytest.fixture(scope="module")
def body() -> SoftBody:
    return make_body(block_mesh(), FLOOR, device="cpu")


@pytest.fixture(scope="module")
def tension(body: SoftBody) -> MuscleTension:
    muscles = automatic_muscles(body.mesh, FLOOR.normal, body_weight=body.weight, height=body.height)
    share = np.random.default_rng(5).uniform(-0.05, 0.3, muscles.segment_count)
    return MuscleTension.of(muscles, share * muscles.bounds)


def spinning_state(body: SoftBody) -> BodyState:
    random = np.random.default_rng(0)
    x = body.mesh.nodes * [1.03, 0.97, 0.95]
    x = x @ Rotation.from_rotvec([0.2, -0.4, 0.9]).as_matrix().T + 0.002 * random.standard_normal(x.shape)
    arms = x - body.centre_of_mass(x)
    return BodyState(x, np.cross([0.5, -1.0, 4.0], arms) + 0.05 * random.standard_normal(x.shape) + [1.0, 0.0, 2.0])


@pytest.mark.parametrize("drag", [0.0, 0.7])
def test_the_tangent_inverts_the_derivative(body: SoftBody, tension: MuscleTension, drag: float) -> None:
    """Central differences of the residual along J^-1 b give b, with muscles and the kept angular momentum."""
    problem = StepProblem(body, spinning_state(body), DT, drag)
    v = problem.state.velocities + DT * body.gravity
    tangent = problem.tangent(SparseFactors(body.assembly.upper_pattern), v, tension)
    for seed in range(3):
        impulse = np.random.default_rng(seed).standard_normal(v.size) * problem.unit
        along = tangent.solve(impulse).reshape(v.shape)
        h = 1e-4 / np.abs(along).max()
        change = (problem.residual(v + h * along, tension) - problem.residual(v - h * along, tension)) / (2 * h)
        # What Woodbury leaves out are muscles of less than a thousandth of the largest stiffness.
        assert np.abs(change.ravel() - impulse).max() < 2e-3 * np.abs(impulse).max()


def test_every_column_has_the_momenta_of_its_impulse(body: SoftBody, tension: MuscleTension) -> None:
    problem = StepProblem(body, spinning_state(body), DT)
    tangent = problem.tangent(SparseFactors(body.assembly.upper_pattern), problem.state.velocities, tension)
    impulses = np.random.default_rng(6).standard_normal((problem.state.velocities.size, 5))
    columns = tangent.solve(impulses)
    assert np.abs(problem.momenta @ columns - problem.turns.T @ impulses).max() < 1e-10
    linear = (np.repeat(body.node_mass, 3)[:, None] * columns).reshape(-1, 3, 5).sum(axis=0)
    assert np.abs(linear - impulses.reshape(-1, 3, 5).sum(axis=0)).max() < 1e-10


def test_a_free_flight_keeps_its_spin(body: SoftBody, tension: MuscleTension) -> None:
    """Newton's method with this tangent: L+ = L to rounding, m dv = m g dt, where implicit Euler alone loses spin."""
    state, factors = spinning_state(body), SparseFactors(body.assembly.upper_pattern)
    start = body.angular_momentum(state.positions, state.velocities)
    given_back = 0.0
    for _ in range(10):
        problem = StepProblem(body, state, DT)
        v = state.velocities
        for _ in range(12):
            residual = problem.residual(v, tension)
            if np.linalg.norm(residual) < 1e-11 * problem.unit:
                break
            v = v - problem.tangent(factors, v, tension).solve(residual.ravel()).reshape(v.shape)
        assert np.linalg.norm(problem.residual(v, tension)) < 1e-9 * problem.unit
        gained = body.centre_of_mass(v) - body.centre_of_mass(state.velocities)
        assert np.allclose(gained, DT * body.gravity, atol=1e-12)
        given_back += float(np.linalg.norm(problem.spin(problem.internal_gradient(v, tension))))
        state = BodyState(problem.end_positions(v), v, state.time + DT)
    end = body.angular_momentum(state.positions, state.velocities)
    assert np.abs(end - start).max() < 1e-10 * np.abs(start).max()
    assert given_back > 1e-3
