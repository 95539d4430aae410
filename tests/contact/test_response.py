"""Newton steps with contact on the host: what they say of the step's equation is what the equation says (Eq. 4, 8)."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.contact.response import ContactResponse, HostIterate, HostResponder
from egs_warp.fem.body import BodyState
from egs_warp.fem.sparse_factors import SparseFactors
from egs_warp.fem.step_problem import StepProblem
from egs_warp.muscles.tension import MuscleTension
from egs_warp.pipelines.creature import Creature
from tests.support.creatures import coarse_pawn

DT = 0.01


@pytest.fixture(scope="module")
def creature() -> Creature:
    return coarse_pawn()


def falling(creature: Creature) -> tuple[StepProblem, MuscleTension, np.random.Generator]:
    """A step of a body that falls and trembles, and muscles that pull."""
    random = np.random.default_rng(0)
    nodes, muscles = creature.start.positions, creature.muscles
    state = BodyState(nodes, np.array([0.1, 0.0, -0.3]) + 0.02 * random.standard_normal(nodes.shape))
    return (
        StepProblem(creature.body, state, DT, 0.2),
        MuscleTension.of(muscles, 0.3 * muscles.bounds * random.standard_normal(muscles.segment_count)),
        random,
    )


def test_a_newton_step_solves_the_linear_equation(creature: Creature) -> None:
    """A body that the tangent speaks true of (the residual is linear where it is looked at so near) has nothing left
    to miss after a whole step, and half as much after half of one; the contacts' speeds are of the step without
    forces."""
    problem, tension, random = falling(creature)
    factors, solver = SparseFactors(creature.body.assembly.upper_pattern), creature.stepper.solver
    contacts = solver.detector.contact_set(np.arange(0, 40, 7), problem.state.positions)
    velocities = problem.start
    for _ in range(12):
        tangent = problem.tangent(factors, velocities, tension)
        velocities = velocities - tangent.solve(problem.residual(velocities, tension).ravel()).reshape(velocities.shape)
    response = ContactResponse.of(problem.tangent(factors, velocities, tension), contacts)
    small = 1e-5 * creature.body.weight * random.standard_normal((contacts.count, 3))
    still = response.at(tension, velocities, np.zeros_like(small))
    whole, half = still.toward(small), still.toward(small, 0.5)
    assert still.size < 1e-10 and whole.size < 1e-9 and half.size < 1e-9
    assert np.array_equal(whole.forces, small) and np.array_equal(half.forces, 0.5 * small)
    moved = problem.dt * response.tangent.solve(contacts.frame.T @ small.ravel())
    np.testing.assert_allclose((whole.velocities - velocities).ravel(), moved, atol=1e-9 * np.abs(moved).max())
    expected = contacts.speeds(velocities.ravel())
    np.testing.assert_allclose(still.speeds, expected, atol=1e-9 * np.abs(expected).max())
    missing = response.at(tension, velocities, small)
    push = np.linalg.norm(problem.dt * contacts.pushes(small)) / problem.unit
    assert missing.size == pytest.approx(push, rel=1e-6)


def test_another_tangent_changes_the_newton_step_alone(creature: Creature) -> None:
    """Made where the iterate is, with the muscles' stiffness in it."""
    problem, tension, random = falling(creature)
    contacts = creature.stepper.solver.detector.contact_set(np.arange(5), problem.state.positions)
    first, second = (
        ContactResponse.of(
            problem.tangent(SparseFactors(creature.body.assembly.upper_pattern), problem.start, stiff), contacts
        )
        for stiff in (None, tension)
    )
    forces = random.standard_normal((5, 3))
    place = first.at(tension, problem.start, forces)
    fresh = second.at(tension, problem.start, forces)
    speeds = place.speeds.copy()
    other = place.anew()
    assert np.array_equal(place.speeds, speeds)
    assert other.size == place.size == fresh.size and np.array_equal(other.speeds, fresh.speeds)
    assert np.abs(other.speeds - place.speeds).max() > 1e-6
    assert np.array_equal(other.toward(forces).velocities, fresh.toward(forces).velocities)


def test_a_wider_response_is_that_of_all_its_contacts(creature: Creature) -> None:
    problem, _, _ = falling(creature)
    detector = creature.stepper.solver.detector
    tangent = problem.tangent(SparseFactors(creature.body.assembly.upper_pattern), problem.start, None)
    few, many = (detector.contact_set(np.arange(count), problem.state.positions) for count in (3, 8))
    wide, whole = ContactResponse.of(tangent, few).wider(many), ContactResponse.of(tangent, many)
    np.testing.assert_allclose(wide.columns, whole.columns, rtol=0, atol=1e-13 * np.abs(whole.columns).max())
    np.testing.assert_allclose(wide.delassus, whole.delassus, rtol=0, atol=1e-13 * np.abs(whole.delassus).max())


def test_a_step_ahead_is_newton_s_with_forces_as_they_are(creature: Creature) -> None:
    """And none where it would invert an element."""
    problem, tension, random = falling(creature)
    respond = HostResponder()
    contacts = creature.stepper.solver.detector.contact_set(np.arange(6), problem.state.positions)
    tangent = problem.tangent(SparseFactors(creature.body.assembly.upper_pattern), problem.start, None)
    forces = random.standard_normal((6, 3))
    ahead = respond.ahead(tangent, contacts, tension, problem.start, forces)
    whole = respond(tangent, contacts).at(tension, problem.start, forces).toward(forces)
    assert ahead is not None and whole.feasible
    np.testing.assert_allclose(ahead, whole.velocities, atol=1e-12)
    torn = MuscleTension(tension.rows, 1e4 * tension.tensions, tension.rest_lengths)
    assert respond.ahead(tangent, contacts, torn, problem.start, forces) is None
    assert not respond(tangent, contacts).at(torn, problem.start, forces).toward(forces).feasible


@pytest.mark.parametrize("pulled", [True, False])
def test_kernels_say_what_arrays_say(creature: Creature, pulled: bool) -> None:
    """Sizes, contact speeds and Newton steps, whole and in part; with the muscles' stiffness in the tangent, too."""
    problem, tension, random = falling(creature)
    contacts = creature.stepper.solver.detector.contact_set(np.arange(0, 36, 5), problem.state.positions)
    stiff = tension if pulled else None
    tangent = problem.tangent(SparseFactors(creature.body.assembly.upper_pattern), problem.start, stiff)
    response = ContactResponse.of(tangent, contacts)
    first, wanted = 0.1 * creature.body.weight * random.standard_normal((2, contacts.count, 3))
    arrays = HostIterate(response, tension, problem.start, first)
    vectors = response.at(tension, problem.start, first)
    assert type(vectors) is not HostIterate
    for length in (1.0, 0.3, None):
        assert vectors.feasible and vectors.size == pytest.approx(arrays.size, rel=1e-11)
        np.testing.assert_allclose(vectors.speeds, arrays.speeds, rtol=0, atol=1e-12 * np.abs(arrays.speeds).max())
        np.testing.assert_allclose(vectors.velocities, arrays.velocities, rtol=0, atol=1e-12)
        np.testing.assert_allclose(vectors.forces, arrays.forces, rtol=1e-14)
        if length is not None:
            vectors, arrays = vectors.toward(wanted, length), arrays.toward(wanted, length)
