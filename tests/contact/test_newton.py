"""Newton steps with contact on the host, compared with the equation of the step (Eq. 4, 8)."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.contact.newton import ContactLinearization, ContactLinearizer
from egs_warp.fem.body import BodyState
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.step_problem import StepProblem
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.pipelines.creature import Creature
from tests.support.creatures import coarse_pawn

DT = 0.01


@pytest.fixture(scope="module")
def creature() -> Creature:
    return coarse_pawn()


def falling(creature: Creature) -> tuple[StepProblem, MuscleEnergy, np.random.Generator]:
    """Create a step of a falling, vibrating body with active muscles."""
    random = np.random.default_rng(0)
    nodes, muscles = creature.start.positions, creature.muscles
    state = BodyState(nodes, np.array([0.1, 0.0, -0.3]) + 0.02 * random.standard_normal(nodes.shape))
    return (
        StepProblem(creature.body, state, DT, 0.2),
        MuscleEnergy.of(muscles, 0.3 * muscles.bounds * random.standard_normal(muscles.segment_count)),
        random,
    )


def test_a_newton_step_solves_the_linear_equation(creature: Creature) -> None:
    """Near the solution, the residual is linear, so it vanishes after a full step with the new contact forces and after
    a half step with half of them. The free contact velocities are those of the step without forces.
    """
    problem, tension, random = falling(creature)
    factors, solver = MultifrontalLdl(creature.body.assembly.upper_pattern), creature.stepper.solver
    contacts = solver.detector.contact_set(np.arange(0, 40, 7), problem.state.positions)
    velocities = problem.rigid_guess
    for _ in range(12):
        tangent = problem.tangent(factors, velocities, tension)
        velocities = velocities - tangent.solve(problem.residual(velocities, tension).ravel()).reshape(velocities.shape)
    response = ContactLinearization.of(problem.tangent(factors, velocities, tension), contacts)
    small = 1e-5 * creature.body.weight * random.standard_normal((contacts.count, 3))
    still = response.iterate_at(tension, velocities, np.zeros_like(small))
    whole, half = still.line_search_point(small), still.line_search_point(small, 0.5)
    assert still.residual_norm < 1e-10 and whole.residual_norm < 1e-9 and half.residual_norm < 1e-9
    assert np.array_equal(whole.forces, small) and np.array_equal(half.forces, 0.5 * small)
    moved = problem.dt * response.tangent.solve(contacts.jacobian.T @ small.ravel())
    np.testing.assert_allclose((whole.velocities - velocities).ravel(), moved, atol=1e-9 * np.abs(moved).max())
    expected = contacts.contact_velocities(velocities.ravel())
    np.testing.assert_allclose(still.free_contact_velocities, expected, atol=1e-9 * np.abs(expected).max())
    missing = response.iterate_at(tension, velocities, small)
    push = np.linalg.norm(problem.dt * contacts.nodal_forces(small)) / problem.residual_scale
    assert missing.residual_norm == pytest.approx(push, rel=1e-6)


def test_a_new_tangent_changes_only_the_newton_step(creature: Creature) -> None:
    """The new tangent is evaluated at the iterate and includes the stiffness of the muscles."""
    problem, tension, random = falling(creature)
    contacts = creature.stepper.solver.detector.contact_set(np.arange(5), problem.state.positions)
    first, second = (
        ContactLinearization.of(
            problem.tangent(MultifrontalLdl(creature.body.assembly.upper_pattern), problem.rigid_guess, stiff), contacts
        )
        for stiff in (None, tension)
    )
    forces = random.standard_normal((5, 3))
    place = first.iterate_at(tension, problem.rigid_guess, forces)
    fresh = second.iterate_at(tension, problem.rigid_guess, forces)
    speeds = place.free_contact_velocities.copy()
    other = place.with_new_tangent()
    assert np.array_equal(place.free_contact_velocities, speeds)
    assert other.residual_norm == place.residual_norm == fresh.residual_norm and np.array_equal(
        other.free_contact_velocities, fresh.free_contact_velocities
    )
    assert np.abs(other.free_contact_velocities - place.free_contact_velocities).max() > 1e-6
    assert np.array_equal(other.line_search_point(forces).velocities, fresh.line_search_point(forces).velocities)


def test_a_wider_response_is_that_of_all_its_contacts(creature: Creature) -> None:
    problem, _, _ = falling(creature)
    detector = creature.stepper.solver.detector
    tangent = problem.tangent(MultifrontalLdl(creature.body.assembly.upper_pattern), problem.rigid_guess, None)
    few, many = (detector.contact_set(np.arange(count), problem.state.positions) for count in (3, 8))
    wide, whole = (
        ContactLinearization.of(tangent, few).with_added_contacts(many),
        ContactLinearization.of(tangent, many),
    )
    np.testing.assert_allclose(wide.columns, whole.columns, rtol=0, atol=1e-13 * np.abs(whole.columns).max())
    np.testing.assert_allclose(wide.delassus, whole.delassus, rtol=0, atol=1e-13 * np.abs(whole.delassus).max())


def test_the_prefetched_step_is_a_newton_step_with_fixed_forces(creature: Creature) -> None:
    """The result is None if the step would invert an element."""
    problem, tension, random = falling(creature)
    respond = ContactLinearizer()
    contacts = creature.stepper.solver.detector.contact_set(np.arange(6), problem.state.positions)
    tangent = problem.tangent(MultifrontalLdl(creature.body.assembly.upper_pattern), problem.rigid_guess, None)
    forces = random.standard_normal((6, 3))
    ahead = respond.predict_velocities(tangent, contacts, tension, problem.rigid_guess, forces)
    whole = respond(tangent, contacts).iterate_at(tension, problem.rigid_guess, forces).line_search_point(forces)
    assert ahead is not None and np.isfinite(whole.residual_norm)
    np.testing.assert_allclose(ahead, whole.velocities, atol=1e-12)
    torn = MuscleEnergy(tension.rows, 1e4 * tension.tensions, tension.rest_lengths)
    assert respond.predict_velocities(tangent, contacts, torn, problem.rigid_guess, forces) is None
    start = respond(tangent, contacts).iterate_at(torn, problem.rigid_guess, forces)
    assert not np.isfinite(start.line_search_point(forces).residual_norm)
