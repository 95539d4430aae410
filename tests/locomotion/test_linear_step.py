"""Linear steps: end velocities, objectives and contact velocities compared with direct evaluation."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse

from egs_warp.contact.newton import ContactLinearization
from egs_warp.fem.body import BodyState
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.linear_step import IslandLinearStep, LinearStep, PredictedStep
from egs_warp.locomotion.objectives import Objective
from egs_warp.locomotion.other_contacts import contacts_of_nodes
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.locomotion.world_stepper import WorldBody, WorldStepper
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.pipelines.creature import Creature
from tests.support.creatures import coarse_creature, coarse_pawn
from tests.support.device_steps import on_device
from tests.support.meshes import u_bar
from tests.support.props import box_body, soft_body


@pytest.fixture(scope="module")
def creature() -> Creature:
    return coarse_pawn()


def about_a_fall(stepper: LocomotionStepper, creature: Creature, seed: int = 0) -> tuple[PredictedStep, LinearStep]:
    """Return the prediction for a body that falls and vibrates on seven contacts, and the linear step about it."""
    nodes, random = creature.start.positions, np.random.default_rng(seed)
    state = BodyState(nodes, np.array([0.1, 0.0, -0.3]) + 0.02 * random.standard_normal(nodes.shape))
    problem = StepProblem(stepper.body, state, 0.01, 0.1)
    contacts = creature.stepper.solver.detector.contact_set(np.arange(0, 49, 7), nodes)
    response = stepper.linearizer(problem.tangent(stepper.factors, problem.rigid_guess, None), contacts)
    forces = random.standard_normal((contacts.count, 3))
    velocities = problem.rigid_guess + 0.01 * random.standard_normal(nodes.shape)
    prospect = PredictedStep(response, np.zeros(7), np.zeros(creature.muscles.segment_count), velocities, forces)
    linear, other = stepper.planner.linear_steps.linearize(prospect, lambda: "meanwhile")
    assert other == "meanwhile" and isinstance(linear, LinearStep)
    return prospect, linear


def test_the_end_is_that_of_the_newton_step(creature: Creature) -> None:
    """The linear step equals the solution of the tangent for the nodal forces of activations and contacts (Eq. 7,
    8)."""
    stepper = creature.stepper
    prospect, linear = about_a_fall(stepper, creature)
    problem, contacts = prospect.linearization.tangent.problem, prospect.linearization.contacts
    x = np.random.default_rng(1).standard_normal(linear.count)
    m = stepper.planner.synergies.count
    activations = (stepper.planner.synergies.members @ x[:m]) * creature.muscles.bounds
    tension = MuscleEnergy.of(creature.muscles, activations)
    missing = problem.residual(prospect.velocities, None).ravel()
    ends = problem.end_positions(prospect.velocities)
    missing += problem.dt * tension.gradient(ends).ravel()
    missing -= problem.dt * contacts.nodal_forces(creature.body.weight * x[m:].reshape(-1, 3)).ravel()
    expected = prospect.velocities.ravel() - prospect.linearization.tangent.solve(missing)
    np.testing.assert_allclose(linear.end_velocities(x), expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    speeds = contacts.contact_velocities(linear.velocities)
    np.testing.assert_allclose(speeds @ np.append(x, 1.0), contacts.jacobian @ expected, rtol=0, atol=1e-9)


def test_the_end_of_an_island_is_that_of_the_newton_step() -> None:
    """As above, for a creature between a box that it touches and another box that only the first box touches."""
    made = coarse_creature(u_bar(), forward=np.array([0.0, 1.0, 0.0]), all_round=True)
    shape, body, width = soft_body(u_bar()), made.stepper.body, float(np.ptp(made.start.positions[:, 0]))
    creature = WorldBody(made.stepper, shape.level_set, shape.rest_positions)
    world = WorldStepper([box_body((0.2, 0.2, 0.2)), creature, box_body((0.2, 0.2, 0.2))])
    starts = [0.5 * width + 0.1, 0.0, 0.5 * width + 0.3]
    states = [
        BodyState(each.stepper.body.mesh.nodes + [shift, 0.0, 0.0], np.zeros((len(each.rest_positions), 3)))
        for each, shift in zip(world.bodies, starts, strict=True)
    ]
    island = world.island((0, 1, 2))
    start = island._start(states, np.zeros(0, int), np.zeros((0, 3)), 0.01)
    problem, contacts, random = start.problem, start.contacts, np.random.default_rng(5)
    velocities = problem.rigid_guess + 0.01 * random.standard_normal(problem.rigid_guess.shape)
    tangent = problem.tangent(island._factors, velocities, None)
    prospect = PredictedStep(
        ContactLinearization.of(tangent, contacts),
        *(start.normal_bias, np.zeros(len(made.stepper.muscles.bounds)), velocities, np.zeros((contacts.count, 3))),
        body=1,
    )
    linear, _ = made.stepper.planner.linear_steps.linearize(prospect, lambda: None)
    assert isinstance(linear, IslandLinearStep)
    m, own = made.stepper.planner.synergies.count, contacts_of_nodes(contacts, prospect.nodes)
    assert 0 < len(own) < contacts.count and (contacts.faces < 0).sum() >= 2
    x = random.standard_normal(m + 3 * contacts.count)
    muscles = made.stepper.muscles
    tension = MuscleEnergy.of(muscles, (made.stepper.planner.synergies.members @ x[:m]) * muscles.bounds)
    missing = problem.residual(velocities, None)
    missing[prospect.nodes] += 0.01 * tension.gradient(problem.end_positions(velocities)[prospect.nodes])
    missing -= 0.01 * contacts.nodal_forces(body.weight * x[m:].reshape(-1, 3))
    expected = velocities.ravel() - tangent.solve(missing.ravel())
    tolerance = {"rtol": 0, "atol": 1e-10 * np.abs(expected).max()}
    np.testing.assert_allclose(linear.end_velocities(x), expected, **tolerance)
    speeds = linear.contact_velocities(contacts) @ np.append(x, 1.0)
    np.testing.assert_allclose(speeds, contacts.jacobian @ expected, rtol=0, atol=1e-9 * np.abs(speeds).max())
    # The forces of the other contacts do not move the creature.
    part = linear.of_body(prospect.coordinates, own)
    chosen = np.concatenate([x[:m], x[m:].reshape(-1, 3)[own].ravel()])
    np.testing.assert_allclose(part.end_velocities(chosen), expected[prospect.coordinates], **tolerance)
    np.testing.assert_allclose(part.torques @ chosen, linear.torques @ x, rtol=1e-9, atol=1e-12)


def objectives_of(count: int) -> list[Objective]:
    """Return objectives with few rows, with one entry in each row, and with several."""
    random = np.random.default_rng(2)
    some = sparse.csr_matrix(random.standard_normal((9, count)) * (random.random((9, count)) < 0.2))
    shares = sparse.csr_matrix(sparse.diags(random.random(count)))
    return [
        Objective("few", random.standard_normal((3, count)), random.standard_normal(3), 2.0),
        Objective("pose", shares, random.standard_normal(count), 0.3),
        Objective("few", random.standard_normal((1, count)), random.standard_normal(1), 5.0),
        Objective("some", some, random.standard_normal(9), 7.0),
    ]


def test_objective_values_are_squared_errors(creature: Creature) -> None:
    _, linear = about_a_fall(creature.stepper, creature)
    asked = objectives_of(creature.start.positions.size)
    x = np.append(np.random.default_rng(4).standard_normal(linear.count), 1.0)
    missed = [each.weight * np.sum((each.rows @ linear.end_velocities(x[:-1]) - each.target) ** 2) for each in asked]
    assert 0.5 * x @ linear.objective_quadratic(asked) @ x == pytest.approx(sum(missed), rel=1e-11)
    assert np.array_equal(linear.objective_quadratic([]), np.zeros((len(x), len(x))))


def test_the_step_with_matrices_on_a_device_equals_that_of_the_host(
    creature: Creature, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Several predictions are compared, because a GPU records a graph in the first step and replays it in the
    others."""
    pytest.importorskip("torch")
    expected = [about_a_fall(creature.stepper, creature, seed)[1] for seed in range(3)]
    stepper = on_device(creature, device, monkeypatch)
    for seed, host in enumerate(expected):
        _, linear = about_a_fall(stepper, creature, seed)
        for got, wanted in ((linear.torques, host.torques), (linear.velocities, host.velocities)):
            np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())
