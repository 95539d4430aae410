"""Linearisations and iterates on every device, which equal those of the host."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

from egs_warp.contact.device_newton import DeviceContactLinearizer
from egs_warp.contact.newton import ContactLinearization, ContactLinearizer, NewtonIterate
from egs_warp.contact.newton_convergence import NewtonProgress
from egs_warp.fem import tiled_cholesky
from egs_warp.fem.body import BodyState
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.pipelines.creature import Creature
from tests.support.creatures import coarse_pawn
from tests.support.device_steps import on_device


@pytest.fixture(scope="module")
def creature() -> Creature:
    return coarse_pawn()


def pulled(creature: Creature, seed: int, strength: float = 0.3) -> MuscleEnergy:
    muscles = creature.muscles
    shares = np.random.default_rng(seed).standard_normal(muscles.segment_count)
    return MuscleEnergy.of(muscles, strength * muscles.bounds * shares)


def problems(stepper: LocomotionStepper, creature: Creature) -> list[StepProblem]:
    """Create steps of two sizes for a falling, vibrating body, without drag and with it."""
    nodes, random = creature.start.positions, np.random.default_rng(0)
    state = BodyState(nodes, np.array([0.1, 0.0, -0.3]) + 0.02 * random.standard_normal(nodes.shape))
    return [StepProblem(stepper.body, state, dt, drag) for dt, drag in ((0.01, 0.0), (0.005, 0.3), (0.01, 0.0))]


def assert_alike(one: NewtonIterate, other: NewtonIterate) -> None:
    assert other.residual_norm == pytest.approx(one.residual_norm, rel=1e-9) and np.isfinite(
        one.residual_norm
    ) == np.isfinite(other.residual_norm)
    for got, expected in zip(
        (other.free_contact_velocities, other.velocities), (one.free_contact_velocities, one.velocities), strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(other.forces, one.forces, rtol=0, atol=1e-13)


@pytest.mark.parametrize("points", [np.array([0, 7, 13, 24]), np.zeros(0, int), np.arange(11)])
def test_iterates_equal_those_of_the_host(
    creature: Creature, points: np.ndarray, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compare the initial iterate, full and partial trial steps, further trials, and a new tangent with the muscles'
    stiffness, for several problems, because a GPU records graphs in the first and replays them in the others."""
    stepper = on_device(creature, device, monkeypatch)
    respond, factors = stepper.linearizer, stepper.factors
    assert isinstance(respond, DeviceContactLinearizer)
    for number, problem in enumerate(problems(stepper, creature)):
        contacts = creature.stepper.solver.detector.contact_set(points, problem.state.positions)
        tension, random = pulled(creature, number), np.random.default_rng(number)
        first, second, third = random.standard_normal((3, len(points), 3))
        tangent = problem.tangent(factors, problem.rigid_guess, None)
        host, there = ContactLinearization.of(tangent, contacts), respond(tangent, contacts)
        columns = there.columns.cpu().numpy()
        np.testing.assert_allclose(columns, host.columns, rtol=0, atol=1e-13 * np.abs(host.columns).max(initial=1e-300))
        np.testing.assert_allclose(there.delassus, host.delassus, rtol=1e-10, atol=1e-16)
        one, other = (
            host.iterate_at(tension, problem.rigid_guess, first),
            there.iterate_at(tension, problem.rigid_guess, first),
        )
        assert_alike(one, other)
        assert_alike(one.line_search_point(second), other.line_search_point(second))
        one, other = one.line_search_point(third, 0.5), other.line_search_point(third, 0.5)
        assert_alike(one, other)
        one, other = one.line_search_point(second), other.line_search_point(second)
        assert_alike(one, other)
        one, moved = one.with_new_tangent(), other.with_new_tangent()
        assert_alike(one, moved)
        assert_alike(one.line_search_point(first), moved.line_search_point(first))
        host, there = one.linearization, moved.linearization
        np.testing.assert_allclose(there.delassus, host.delassus, rtol=1e-9, atol=1e-15)
        assert_alike(
            host.iterate_at(None, problem.rigid_guess, third), there.iterate_at(None, problem.rigid_guess, third)
        )


def test_an_inverted_element_gives_nan(creature: Creature, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step that inverts an element is reported; the iterate before it remains usable."""
    stepper = on_device(creature, device, monkeypatch)
    respond, (problem, *_) = stepper.linearizer, problems(stepper, creature)
    contacts = creature.stepper.solver.detector.contact_set(np.arange(6), problem.state.positions)
    tangent = problem.tangent(stepper.factors, problem.rigid_guess, None)
    forces = np.zeros((6, 3))
    assert respond.predict_velocities(tangent, contacts, pulled(creature, 1, 1e4), problem.rigid_guess, forces) is None
    there, crushed = respond(tangent, contacts), np.full((6, 3), 1e4 * creature.body.weight)
    place = there.iterate_at(None, problem.rigid_guess, forces)
    assert np.isfinite(place.residual_norm) and not np.isfinite(place.line_search_point(crushed).residual_norm)
    host = ContactLinearization.of(tangent, contacts).iterate_at(None, problem.rigid_guess, forces)
    near = place.line_search_point(crushed, 1e-6)
    assert near.residual_norm == pytest.approx(host.line_search_point(crushed, 1e-6).residual_norm, rel=1e-6)


def test_nan_of_an_earlier_step_is_ignored(creature: Creature, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """NaN values that an earlier step has left in the workspace, from a matrix without factors or a diverged iterate,
    do not affect a step."""
    stepper = on_device(creature, device, monkeypatch)
    respond, (problem, *_) = stepper.linearizer, problems(stepper, creature)
    assert isinstance(respond, DeviceContactLinearizer)
    contacts = creature.stepper.solver.detector.contact_set(np.arange(6), problem.state.positions)
    tangent = problem.tangent(stepper.factors, problem.rigid_guess, None)
    tension, forces = pulled(creature, 3, 0.02), np.ones((6, 3))
    expected = ContactLinearizer().predict_velocities(tangent, contacts, tension, problem.rigid_guess, forces)
    room = respond.workspace_for(contacts)
    for _ in range(3):
        for part in (
            room.columns,
            room.delassus,
            room.end_positions,
            room._base,
            room._trial,
            room._force_velocities,
            respond.factors.rotation_operator,
        ):
            part.fill_(np.nan)
        found = respond.predict_velocities(tangent, contacts, tension, problem.rigid_guess, forces)
        assert found is not None and expected is not None
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
        room._trial.fill_(np.nan)
        assert_alike(
            ContactLinearization.of(tangent, contacts).iterate_at(tension, problem.rigid_guess, forces),
            respond(tangent, contacts).iterate_at(tension, problem.rigid_guess, forces),
        )


def test_evicted_data_are_uploaded_again(creature: Creature, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The workspace holds two iterates; an evicted one is uploaded again and gives the same step. It holds one
    linearisation; using an older one raises an error.
    """
    stepper = on_device(creature, device, monkeypatch)
    respond, (problem, *_) = stepper.linearizer, problems(stepper, creature)
    contacts = creature.stepper.solver.detector.contact_set(np.arange(6), problem.state.positions)
    tangent = problem.tangent(stepper.factors, problem.rigid_guess, None)
    old, forces = respond(tangent, contacts), np.zeros((6, 3))
    first = old.iterate_at(None, problem.rigid_guess, forces)
    second = first.line_search_point(forces)
    second.line_search_point(forces)
    assert_alike(first.line_search_point(forces), second)
    shift = np.zeros(6)
    begun = first.newton_steps(shift, 0.8)
    # With a stricter tolerance, the loop on the device continues beyond the first step.
    progress = NewtonProgress(1e-12, -1.0, np.inf)
    again = first.newton_steps(shift, 0.8, progress)
    assert progress.steps > 1
    for one, other in (
        (first.newton_steps(shift, 0.8), begun),
        (again.trial.newton_steps(shift, 0.8), again.trial.newton_steps(shift, 0.8)),
        (begun.trial.newton_steps(shift, 0.8), begun.trial.newton_steps(shift, 0.8)),
    ):
        np.testing.assert_allclose(one.forces, other.forces, rtol=0, atol=1e-10)
        assert_alike(one.trial, other.trial)
    respond(tangent, contacts)
    for left in (first, second):
        with pytest.raises(AssertionError):
            left.line_search_point(forces)
        with pytest.raises(AssertionError):
            left.newton_steps(shift, 0.8)
    with pytest.raises(AssertionError):
        old.iterate_at(None, problem.rigid_guess, forces)


def test_contacts_do_not_depend_on_the_prefetch(
    creature: Creature, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The contact selection is correct after a prefetch for the same step, and after one for another state, step size
    or set of points."""
    stepper = on_device(creature, device, monkeypatch)
    first, second, _ = problems(stepper, creature)
    lifted = BodyState(creature.start.positions + [0.0, 0.0, 0.004], first.state.velocities)
    steps = [
        (first, np.array([3, 8])),
        (StepProblem(stepper.body, lifted, 0.01), np.arange(20)),
        (second, np.arange(5)),
    ]
    seen = set()
    for problem, before in steps:
        loaded, (gaps, _) = np.ones(len(before), bool), stepper.detector.gaps(problem.ballistic_positions)
        expected = stepper.selector.select(before, loaded, gaps)
        for ahead, points in [*steps, (problem, np.arange(2))]:
            stepper.linearizer.prefetch_contacts(ahead.state, ahead.dt, points, np.ones(len(points), bool))
            found = stepper.linearizer.select_contacts(problem, before, loaded)
            assert found is not None and np.array_equal(found.points, expected)
        seen.add(tuple(expected))
    assert len(seen) == 3


def test_a_tangent_whose_sum_is_indefinite_equals_the_host_s(
    creature: Creature, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the low-rank update by the muscles' stiffness fails, the whole matrix is factored; the iterate equals the
    host's."""
    stepper = on_device(creature, device, monkeypatch)
    problem, *_ = problems(stepper, creature)
    contacts = creature.stepper.solver.detector.contact_set(np.arange(6), problem.state.positions)
    tension, forces = pulled(creature, 2), np.ones((6, 3))
    tangent = problem.tangent(stepper.factors, problem.rigid_guess, None)
    place = (
        stepper.linearizer(tangent, contacts)
        .iterate_at(tension, problem.rigid_guess, forces)
        .line_search_point(2.0 * forces)
    )
    monkeypatch.setattr(
        tiled_cholesky._InverseFactor, "add_low_rank", lambda root, directions, sign: 0.0 * directions[0, 0]
    )
    found = place.with_new_tangent()
    # Nothing has synchronised with the device before this access.
    assert len(found.free_contact_velocities) == 18
    whole = problem.tangent(stepper.factors, place.velocities, tension)
    expected = ContactLinearization.of(whole, contacts).iterate_at(tension, place.velocities, place.forces)
    assert_alike(expected, found)
    assert_alike(expected.line_search_point(forces), found.line_search_point(forces))
