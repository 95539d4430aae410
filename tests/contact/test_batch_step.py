"""Steps with contact of many worlds in one batch, which equal the steps of each world alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from egs_warp.contact.batch_step import BatchInputs, BatchResult, BatchSolver
from egs_warp.contact.contact_set import ContactSet, push_out_speeds
from egs_warp.contact.coupled_step import ContactLinearization, CoupledResult, CoupledSolver
from egs_warp.contact.detection import ContactDetector
from egs_warp.contact.selection import ContactSelector
from egs_warp.fem.batch_problem import BatchBody, BatchProblem
from egs_warp.fem.body import BodyState
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.step_problem import StepProblem
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.pipelines.creature import Creature
from tests.support.creatures import coarse_pawn, sagging

FRICTIONS = (0.8, 0.2, 0.6, 1.0, 0.5)
DRAG = 0.3


@pytest.fixture(scope="module")
def creature() -> Creature:
    return sagging(coarse_pawn())


@pytest.fixture(scope="module")
def states(creature: Creature) -> list[BodyState]:
    """Return states in which a body stands, slides, falls on its base, falls on an edge of its base, and flies."""
    nodes, unit = creature.start.positions, creature.body.speed_unit
    still = np.zeros_like(nodes)
    leaning = nodes + 0.25 * nodes[:, 2:] * np.array([1.0, 0.3, 0.0])
    leaning = leaning + np.array([0.0, 0.0, 0.01])
    return [
        BodyState(nodes, still),
        BodyState(nodes, still + unit * np.array([0.5, -0.3, 0.0])),
        BodyState(nodes + np.array([0.0, 0.0, 0.01]), still - unit * np.array([0.0, 0.1, 0.8])),
        BodyState(leaning, still - unit * np.array([0.3, 0.0, 0.9])),
        BodyState(nodes + np.array([0.0, 0.0, 1.0]), still + unit * np.array([0.0, 0.2, 0.1])),
    ]


@pytest.fixture(scope="module")
def activations(creature: Creature) -> np.ndarray:
    """Return random activations (5, M), m: contractions and extensions."""
    shares = np.random.default_rng(1).uniform(-0.2, 0.6, (len(FRICTIONS), creature.muscles.segment_count))
    return shares * creature.muscles.bounds


def solved_alone(
    creature: Creature, friction: float, problem: StepProblem, chosen: np.ndarray, activations: np.ndarray
) -> CoupledResult:
    solver = creature.stepper.with_friction(friction).solver
    contacts = solver.detector.contact_set(chosen, problem.state.positions)
    tangent = problem.tangent(MultifrontalLdl(creature.body.assembly.upper_pattern), problem.rigid_guess, None)
    tension = MuscleEnergy.of(creature.muscles, activations)
    forces = np.zeros((len(chosen), 3))
    return solver.solve(
        ContactLinearization.of(tangent, contacts), tension, velocities=problem.rigid_guess, forces=forces
    )


def lowest_points(points: ContactSelector, gaps: np.ndarray) -> np.ndarray:
    """Return the indices, in ascending order, of the lowest point of each cell, if it is below the ground."""
    high = np.full_like(gaps, np.inf)
    return np.sort(points.find_penetrating(np.zeros(0, int), gaps, high, 1e-12))


def solved_together(
    creature: Creature, states: list[BodyState], activations: np.ndarray, dt: float, *, few: bool = False
) -> tuple[ContactSet, ContactSet, BatchResult]:
    """Return the contacts at the start and at the end, and the result. The contacts at the start are the points that
    would touch the ground in a ballistic step; with ``few``, only a third of them."""
    one, count = creature.stepper.solver, len(states)
    detector = ContactDetector(creature.geometry, device="cpu")
    beside = BatchSolver(
        detector,
        one.points,
        push_out_cap=one.push_out_cap,
        penetration_tolerance=one.penetration_tolerance,
        tolerance=CoupledSolver.tolerance,
    )
    positions, velocities = (
        torch.from_numpy(np.stack([getattr(state, name) for state in states])) for name in ("positions", "velocities")
    )
    common = BatchBody(creature.body, creature.muscles, count)
    problem = BatchProblem.at(common, torch.arange(count), positions, velocities, dt=dt, drag=DRAG)
    begun = detector.gaps_of_worlds(positions)
    ends, _ = detector.gaps_of_worlds(problem.ballistic_positions)
    near = [lowest_points(one.points, gaps.numpy()) for gaps in ends]
    near = [each[each % 3 == 0] if few else each for each in near]
    counts = torch.tensor([len(each) for each in near], dtype=torch.int32)
    points = torch.zeros((count, int(counts.max())), dtype=torch.int32)
    for row, each in zip(points, near, strict=True):
        row[: len(each)] = torch.from_numpy(each)
    contacts = detector.contact_sets(points, counts, positions, begun)
    assert problem.factor(problem.rigid_guess, None).all()
    tensions = torch.from_numpy(creature.muscles.stiffness * activations)
    frictions = torch.tensor(FRICTIONS, dtype=torch.float64)
    inputs = BatchInputs(problem, contacts, beside.normal_bias(contacts, dt), tensions, frictions, *begun)
    forces = torch.zeros((count, contacts.capacity, 3), dtype=torch.float64)
    response = beside.linearize(problem, contacts)
    touched, made = beside.solve(inputs, response, velocities=problem.rigid_guess, forces=forces)
    assert torch.equal(contacts.counts, counts)
    return contacts, touched, made


@pytest.mark.parametrize("few", [False, True])
def test_results_equal_those_of_each_world_alone(
    creature: Creature, states: list[BodyState], activations: np.ndarray, few: bool
) -> None:
    """The velocities, the points in their order, the nodal forces and the iteration count are equal. The solve starts
    from all points that touch the ground in a ballistic step, or from a third of them, so that many are added."""
    body = creature.body
    dt = body.time_unit / 20.0
    contacts, touched, made = solved_together(creature, states, activations, dt, few=few)
    joined = 0
    for world, (state, friction) in enumerate(zip(states, FRICTIONS, strict=True)):
        chosen = contacts.points[world, : int(contacts.counts[world])].numpy()
        alone = solved_alone(creature, friction, StepProblem(body, state, dt, DRAG), chosen, activations[world])
        n = int(touched.counts[world])
        assert np.array_equal(touched.points[world, :n].numpy(), alone.contacts.points)
        assert (bool(made.converged[world]), int(made.iterations[world])) == (alone.converged, alone.iterations)
        assert alone.converged and not made.is_singular[world]
        np.testing.assert_allclose(made.velocities[world].numpy(), alone.velocities, atol=1e-9 * body.speed_unit)
        forces = made.forces[world, :n].numpy()
        # Nodal forces are compared, because the distribution of a load over redundant points is not unique.
        nodal = [alone.contacts.nodal_forces(each) for each in (forces, alone.forces)]
        np.testing.assert_allclose(*nodal, rtol=0, atol=1e-6 * body.weight)
        joined += n - len(chosen)
        if world < 4:
            assert forces[:, 0].sum() > 0.1 * body.weight
    assert joined > (20 if few else 3)


@pytest.mark.slow
def test_barely_converging_steps_equal_those_of_each_world_alone(creature: Creature) -> None:
    """Bodies are crushed, thrown at the ground, and torn by opposing muscles, in time steps four times as long as those
    of a run. Step lengths and tangents are chosen as for a single world, so even unconverged results at the iteration
    limit are equal.
    """
    body, nodes = creature.body, creature.start.positions
    up, still, random = np.array([0.0, 0.0, 1.0]), np.zeros_like(nodes), np.random.default_rng(0)
    states = [
        BodyState(nodes + 0.01 * up, still - 3.0 * body.speed_unit * up),
        BodyState(nodes * [1.0, 1.0, 0.6], still),
        BodyState(nodes * [1.0, 1.0, 0.5] + 0.01 * up, still - body.speed_unit * np.array([1.0, 0.0, 2.0])),
        BodyState(nodes, 2.0 * body.speed_unit * random.standard_normal(nodes.shape)),
        BodyState(nodes + 0.05 * up, 4.0 * body.speed_unit * random.standard_normal(nodes.shape)),
    ]
    shape = len(states), creature.muscles.segment_count
    activations = np.random.default_rng(0).choice([-1.0, 1.0], shape) * creature.muscles.bounds
    dt = body.time_unit / 5.0
    contacts, _, made = solved_together(creature, states, activations, dt)
    for world, (state, friction) in enumerate(zip(states, FRICTIONS, strict=True)):
        chosen = contacts.points[world, : int(contacts.counts[world])].numpy()
        alone = solved_alone(creature, friction, StepProblem(body, state, dt, DRAG), chosen, activations[world])
        assert (bool(made.converged[world]), int(made.iterations[world])) == (alone.converged, alone.iterations)
        np.testing.assert_allclose(made.velocities[world].numpy(), alone.velocities, atol=1e-6 * body.speed_unit)
    assert made.converged.any() and not made.converged.all()


def test_a_world_without_a_usable_tangent_stops_at_once(creature: Creature) -> None:
    """Worlds with NaN activations, on the ground and in the air, stop in their second iteration, after one tangent
    update; the others continue."""
    nodes = creature.start.positions
    still, up = np.zeros_like(nodes), np.array([0.0, 0.0, 1.0])
    states = [BodyState(nodes + (world > 1) * up, still) for world in range(4)]
    states.append(states[0])
    activations = np.zeros((5, creature.muscles.segment_count))
    activations[[1, 3]] = np.nan
    _, _, made = solved_together(creature, states, activations, creature.body.time_unit / 20.0)
    assert made.converged.tolist() == [True, False, True, False, True] and not made.is_singular.any()
    assert made.iterations[[1, 3]].tolist() == [2, 2]


def test_normal_bias_equals_that_of_one_world(creature: Creature, states: list[BodyState]) -> None:
    """The normal biases equal those of ``push_out_speeds``, including the speed limit; unused slots are zero."""
    one, dt = creature.stepper.solver, 0.01
    detector = ContactDetector(creature.geometry, device="cpu")
    beside = BatchSolver(detector, one.points, push_out_cap=0.05, penetration_tolerance=0.01, tolerance=1e-8)
    nodes = torch.from_numpy(np.stack([states[0].positions, states[0].positions - np.array([0.0, 0.0, 0.03])]))
    gaps, faces = detector.gaps_of_worlds(nodes)
    order = torch.argsort((gaps >= 0.003).int(), dim=1, stable=True).int()
    contacts = detector.contact_sets(order, (gaps < 0.003).sum(dim=1).int(), nodes, (gaps, faces))
    made = beside.normal_bias(contacts, dt).numpy()
    counts = contacts.counts.tolist()
    assert counts[0] < counts[1]
    for world, count in enumerate(counts):
        expected = push_out_speeds(contacts.gaps[world, :count].numpy(), dt, 0.05, 0.2, 0.01)
        np.testing.assert_allclose(made[world, :count], expected, rtol=0, atol=1e-15)
        assert not made[world, count:].any()
    assert made[1].min() == -0.05 and made[0].max() > 0.0
