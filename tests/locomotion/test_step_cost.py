"""Quadratic cost of a step (Eq. 13), compared with direct evaluation and finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.detection import ContactDetector, ContactGeometry
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.body import BodyState, make_body
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.step_problem import StepProblem
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.linear_step import LinearStep
from egs_warp.locomotion.objectives import AngularMomentumObjective, LoadObjective, centre_of_mass_velocity
from egs_warp.locomotion.step_cost import EffortModel, QuadraticCost, effort_cost, objectives_cost
from tests.support.meshes import block_mesh

BODY = make_body(block_mesh(), Plane(np.array([0.0, 0.0, 1.0]), 0.0), device="cpu")
DT = 1 / 60


def two_contacts() -> ContactSet:
    """Return the contacts of two corners of the block."""
    soles = embed_points(BODY.mesh, BODY.mesh.nodes[BODY.mesh.nodes[:, 2] == 0.0][[0, -1]], device="cpu")
    floor = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
    geometry = ContactGeometry(BODY.mesh, (floor,), 0.8, soles.tets.numpy(), soles.weights.numpy(), 0, 0.0)
    return ContactDetector(geometry, device="cpu").contact_set(np.arange(2), BODY.mesh.nodes)


def example(unknowns: int = 4) -> tuple[StepProblem, LinearStep, np.ndarray]:
    rng = np.random.default_rng(0)
    nodes = BODY.mesh.nodes
    state = BodyState(nodes + 0.005 * rng.standard_normal(nodes.shape), 0.1 * rng.standard_normal(nodes.shape))
    base, columns = 0.1 * rng.standard_normal(nodes.size), 0.1 * rng.standard_normal((nodes.size, unknowns))
    linear = LinearStep(np.column_stack([columns, base]), rng.standard_normal((3, unknowns)))
    return StepProblem(BODY, state, DT), linear, 0.1 * rng.standard_normal(nodes.size)


def value(cost: QuadraticCost, x: np.ndarray) -> float:
    return float(0.5 * x @ cost.P @ x + cost.q @ x + cost.constant)


def test_objectives_are_weighted_squared_errors() -> None:
    problem, linear, _ = example(7)
    rng = np.random.default_rng(1)
    x, target, momentum = rng.standard_normal(7), rng.standard_normal(3), rng.standard_normal(3)
    contacts = two_contacts()
    lifted = LoadObjective(contacts.nodes[1, [int(np.argmax(contacts.weights[1]))]], 7.0)
    objectives = [centre_of_mass_velocity(BODY, target, 2.0), AngularMomentumObjective(momentum, 5.0), lifted]
    speed = float(np.sqrt(9.81 * BODY.height))
    velocities = (linear.base + linear.columns @ x).reshape(-1, 3)
    missed = (BODY.centre_of_mass(velocities) - target) / speed
    after = BODY.angular_momentum(problem.state.positions, problem.state.velocities) + linear.torques @ x
    gyration = np.sqrt(0.5 * np.trace(BODY.inertia(problem.state.positions)) / BODY.mass)
    turned = (after - momentum) / (BODY.mass * gyration * speed)
    # The first entry of x is an activation; the others are the forces of two contacts.
    expected = 2.0 * missed @ missed + 5.0 * turned @ turned + 7.0 * x[4] ** 2
    asked = objectives_cost(problem, linear, contacts, objectives)
    assert value(asked, x) == pytest.approx(expected, rel=1e-10)


def moved_on(problem: StepProblem, linear: LinearStep, foreseen: np.ndarray, time: float, x: np.ndarray) -> np.ndarray:
    """Return the positions (N, 3), m, of the body ``time`` s after the start of the step, if it continued from the end
    of the step with one implicit step."""
    end = problem.end_positions(foreseen.reshape(-1, 3))
    entries = BODY.assembly.hessian_entries(
        end, BODY.assembly.damping(problem.state.positions, time), factor=time**2, projected=True
    )
    upper = BODY.assembly.matrix(entries).toarray()
    implicit = upper + np.triu(upper, 1).T + np.diag(np.repeat(BODY.node_mass, 3))
    speeds = linear.base + linear.columns @ x
    further = np.linalg.solve(implicit, np.repeat(BODY.node_mass, 3) * speeds)
    return problem.state.positions + (DT * speeds + (time - DT) * further).reshape(-1, 3)


def test_effort_is_the_future_energy_and_convex() -> None:
    """The value and the gradient of the effort equal the energy at the future positions and its finite differences; the
    model is convex and accurate near the predicted end."""
    problem, linear, foreseen = example()
    horizon = 0.16
    time = horizon * np.sqrt(BODY.height / 9.81)
    factors = MultifrontalLdl(BODY.assembly.upper_pattern)
    damping = BODY.assembly.damping(problem.state.positions, time)
    unit = 1.0 / (BODY.weight * BODY.height)
    ahead = EffortModel.of(problem, foreseen.reshape(-1, 3), factors, horizon=horizon)
    cost = effort_cost(problem, linear, foreseen, ahead)
    assert np.linalg.eigvalsh(cost.P).min() >= -1e-12 * np.abs(cost.P).max()
    # About the predicted end the model equals the energy to second order.
    assert np.linalg.norm(cost.P) > 0.0
    still = LinearStep(np.column_stack([1e-2 * linear.columns, 0.0 * foreseen]), linear.torques)
    rest = np.zeros_like(foreseen)
    ahead = EffortModel.of(problem, rest.reshape(-1, 3), factors, horizon=horizon)
    modelled = effort_cost(problem, still, rest, ahead)

    def energy(x: np.ndarray) -> float:
        return unit * BODY.assembly.energy(moved_on(problem, still, rest, time, x), damping)

    assert modelled.constant == pytest.approx(energy(np.zeros(4)), rel=1e-9)
    step = 1e-3
    for k in range(4):
        along = step * np.eye(4)[k]
        assert modelled.q[k] == pytest.approx((energy(along) - energy(-along)) / (2.0 * step), rel=1e-5)
    x = 1e-2 * np.ones(4)
    assert value(modelled, x) == pytest.approx(energy(x), rel=1e-6)


def test_a_relaxing_body_is_predicted_without_reversed_strain() -> None:
    """A stretched body reaches its rest shape at the end of the step. With constant velocity, it would be compressed by
    twice the initial stretch at the end of the horizon of three steps. The predicted effort is less than half of the
    energy of that compression."""
    nodes = BODY.mesh.nodes
    stretch = 0.02 * (nodes - nodes.mean(axis=0)) * [0.0, 0.0, 1.0]
    problem = StepProblem(BODY, BodyState(nodes + stretch, np.zeros_like(nodes)), DT)
    back = (-stretch / DT).ravel()
    linear = LinearStep(np.column_stack([np.zeros(back.size), back]), np.zeros((3, 1)))
    factors = MultifrontalLdl(BODY.assembly.upper_pattern)
    horizon = 3.0 * DT / np.sqrt(BODY.height / 9.81)
    ahead = EffortModel.of(problem, back.reshape(-1, 3), factors, horizon=horizon)
    effort = effort_cost(problem, linear, back, ahead).constant
    carried_on = nodes - 2.0 * stretch
    assert effort < 0.5 * BODY.assembly.energy(carried_on) / (BODY.weight * BODY.height)
