"""Equations of a batch, which agree with the equations of each world alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from egs_warp.fem.batch_problem import BatchBody, BatchProblem, apply_inverse
from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.geometry.plane import Plane
from egs_warp.muscles.muscle_set import MuscleSet, automatic_muscles
from egs_warp.muscles.tension import MuscleEnergy
from tests.support.meshes import block_mesh
from tests.support.states import bent_state, spinning_state

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
DT, DRAG = 1 / 60, 0.7


@pytest.fixture(scope="module")
def body() -> SoftBody:
    return make_body(block_mesh(), FLOOR, device="cpu")


@pytest.fixture(scope="module")
def muscles(body: SoftBody) -> MuscleSet:
    return automatic_muscles(body.mesh, FLOOR.normal, body_weight=body.weight, height=body.height)


@pytest.fixture(scope="module")
def activations(muscles: MuscleSet) -> np.ndarray:
    """Return activations (3, M), m: contractions and a few extensions, some of them negligible."""
    share = np.random.default_rng(5).uniform(-0.05, 0.3, (3, muscles.segment_count))
    share[:, ::7] *= 1e-5
    return share * muscles.bounds


@pytest.fixture(scope="module")
def states(body: SoftBody) -> list[BodyState]:
    return [spinning_state(body), bent_state(body, seed=1), BodyState(body.mesh.nodes, 0.0 * body.mesh.nodes)]


@pytest.fixture(scope="module")
def alone(body: SoftBody, states: list[BodyState]) -> list[StepProblem]:
    return [StepProblem(body, state, DT, DRAG) for state in states]


@pytest.fixture(scope="module")
def beside(body: SoftBody, muscles: MuscleSet, states: list[BodyState]) -> BatchProblem:
    """Create the batch of the same three worlds in slots 0, 1 and 3 of four."""
    return problem_of(BatchBody(body, muscles, 4, panel=32), states)


def problem_of(common: BatchBody, states: list[BodyState], *, dt: float = DT, drag: float = DRAG) -> BatchProblem:
    positions, velocities = (
        torch.from_numpy(np.stack([getattr(state, name) for state in states])) for name in ("positions", "velocities")
    )
    return BatchProblem.at(common, torch.tensor([0, 1, 3])[: len(states)], positions, velocities, dt=dt, drag=drag)


def tried(states: list[BodyState]) -> np.ndarray:
    """Return trial velocities (3, N, 3), m/s."""
    random = np.random.default_rng(2)
    return np.stack([state.velocities + 0.1 * random.standard_normal(state.velocities.shape) for state in states])


def same(beside: torch.Tensor, alone: list[np.ndarray], *, rel: float = 1e-12) -> None:
    for one, other in zip(beside.numpy(), alone, strict=True):
        np.testing.assert_allclose(one.reshape(other.shape), other, rtol=0, atol=rel * np.abs(other).max() + 1e-300)


def test_initial_values_of_a_step(body: SoftBody, beside: BatchProblem, alone: list[StepProblem]) -> None:
    assert beside.residual_scale == pytest.approx(alone[0].residual_scale) and beside.inertia_ratio == pytest.approx(
        1.0 + DT * DRAG
    )
    same(beside.rotation_modes, [one.rotation_modes for one in alone])
    same(beside.momenta, [one.momenta for one in alone])
    same(beside.inverse_inertia, [np.linalg.inv(one.inertia) for one in alone])
    same(beside.rigid_guess[:2], [one.rigid_guess for one in alone[:2]])
    assert np.abs(beside.rigid_guess[2].numpy()).max() < 1e-12
    centres = [body.centre_of_mass(one.state.positions) for one in alone]
    same(beside.worlds.centre(beside.state.positions), centres)


@pytest.mark.parametrize("pulling", [False, True])
def test_residuals(
    states: list[BodyState],
    muscles: MuscleSet,
    activations: np.ndarray,
    beside: BatchProblem,
    alone: list[StepProblem],
    pulling: bool,
) -> None:
    """Forces, momentum corrections and residuals equal the results of single worlds, with and without muscles."""
    given = tried(states)
    velocities, tensions = torch.from_numpy(given), torch.from_numpy(muscles.stiffness * activations)
    pulls = [MuscleEnergy.of(muscles, one) if pulling else None for one in activations]
    internal = beside.internal_gradient(velocities, tensions if pulling else None)
    expected = [one.internal_gradient(v, pull) for one, v, pull in zip(alone, given, pulls, strict=True)]
    same(internal, expected)
    spins = [one.momentum_correction(gradient) for one, gradient in zip(alone, expected, strict=True)]
    assert min(np.linalg.norm(spin) for spin in spins) > 1e-4
    same(beside.momentum_correction(internal), spins, rel=1e-10)
    residuals = [one.residual(v, pull) for one, v, pull in zip(alone, given, pulls, strict=True)]
    same(beside.residual(velocities, tensions if pulling else None), residuals)
    same(beside.end_positions(velocities), [one.end_positions(v) for one, v in zip(alone, given, strict=True)])


def test_a_world_with_an_inverted_element_is_not_feasible(
    body: SoftBody, states: list[BodyState], beside: BatchProblem, alone: list[StepProblem]
) -> None:
    given = tried(states)
    given[1] -= 2.0 * (states[1].positions - body.centre_of_mass(states[1].positions)) / DT
    assert beside.is_inversion_free(torch.from_numpy(given)).tolist() == [True, False, True]
    assert [one.is_inversion_free(v) for one, v in zip(alone, given, strict=True)] == [True, False, True]


def tangents(
    body: SoftBody, problems: list[StepProblem], given: np.ndarray, pulls: list[MuscleEnergy] | list[None]
) -> list[Tangent]:
    return [
        one.tangent(MultifrontalLdl(body.assembly.upper_pattern), v, pull)
        for one, v, pull in zip(problems, given, pulls, strict=True)
    ]


@pytest.mark.parametrize("pulling", [False, True])
@pytest.mark.parametrize("chunk_bytes", [1, 2**31])
def test_tangents(
    body: SoftBody,
    states: list[BodyState],
    muscles: MuscleSet,
    activations: np.ndarray,
    alone: list[StepProblem],
    pulling: bool,
    chunk_bytes: int,
) -> None:
    """Velocity changes by impulses equal the changes in single worlds, with and without the stiffness of muscles. A
    momentum projection that is passed in is reused."""
    beside = problem_of(BatchBody(body, muscles, 4, panel=32, chunk_bytes=chunk_bytes), states)
    given, impulses = tried(states), np.random.default_rng(3).standard_normal((3, given_size(body), 4))
    pulls = [MuscleEnergy.of(muscles, one) for one in activations] if pulling else [None] * 3
    tensions = torch.from_numpy(muscles.stiffness * activations) if pulling else None
    assert beside.factor(torch.from_numpy(given), tensions).tolist() == [True] * 3
    expected = [one.solve(b) for one, b in zip(tangents(body, alone, given, pulls), impulses, strict=True)]
    made, turning = apply_inverse(beside, torch.from_numpy(impulses))
    same(made, expected, rel=1e-9)
    again, kept = apply_inverse(beside, torch.from_numpy(impulses[:, :, :1]), turning)
    assert kept is turning
    same(again, [one[:, :1] for one in expected], rel=1e-9)


def test_tangents_of_muscles_that_are_half_slack(
    body: SoftBody, muscles: MuscleSet, activations: np.ndarray, states: list[BodyState], alone: list[StepProblem]
) -> None:
    """Muscles have 0.35 to 0.65 of their rest lengths, where the tension depends on the length. Velocity changes equal
    the changes in single worlds and differ from the changes without muscles."""
    half = replace(muscles, rest_lengths=muscles.rest_lengths / np.linspace(0.35, 0.65, muscles.segment_count))
    beside, given, pulls = problem_of(BatchBody(body, half, 4), states), tried(states), np.abs(activations)
    assert beside.factor(torch.from_numpy(given), torch.from_numpy(half.stiffness * pulls)).all()
    impulses = np.random.default_rng(4).standard_normal((3, given_size(body), 3))
    made, _ = apply_inverse(beside, torch.from_numpy(impulses))
    pulling = tangents(body, alone, given, [MuscleEnergy.of(half, one) for one in pulls])
    expected = [one.solve(b) for one, b in zip(pulling, impulses, strict=True)]
    same(made, expected, rel=1e-9)
    for one, plain, b in zip(expected, tangents(body, alone, given, [None] * 3), impulses, strict=True):
        assert np.abs(one - plain.solve(b)).max() > 1e-3 * np.abs(one).max()


def given_size(body: SoftBody) -> int:
    return 3 * len(body.mesh.nodes)


def test_an_indefinite_world_is_projected_and_one_with_nan_has_no_factors(body: SoftBody, muscles: MuscleSet) -> None:
    """In a long step, the body of the first world is compressed to 40 %, that of the second has NaN velocities, and
    that of the third is at rest."""
    rest = BodyState(body.mesh.nodes, np.zeros_like(body.mesh.nodes))
    squashed = BodyState(body.mesh.nodes * [1.1, 1.1, 0.4], rest.velocities)
    states = [squashed, rest, rest]
    beside = problem_of(BatchBody(body, muscles, 4), states, dt=1.0, drag=0.0)
    velocities = np.zeros((3, *rest.velocities.shape))
    velocities[1, 0, 0] = np.nan
    fine = beside.factor(torch.from_numpy(velocities), torch.zeros((3, muscles.segment_count), dtype=torch.float64))
    assert fine.tolist() == [True, False, True]
    alone = [StepProblem(body, state, 1.0) for state in (squashed, rest)]
    impulses = np.random.default_rng(7).standard_normal((given_size(body), 3))
    whole = tangents(body, alone, velocities[[0, 2]], [None, None])
    made, _ = apply_inverse(beside, torch.from_numpy(np.stack([impulses] * 3)))
    same(made[[0, 2]], [one.solve(impulses) for one in whole], rel=1e-9)


def test_muscles_that_would_make_a_world_indefinite_are_left_out(body: SoftBody, muscles: MuscleSet) -> None:
    """With negative tensions a thousand times the maximum, the tangent is that of the elements alone."""
    rest = BodyState(body.mesh.nodes, np.zeros_like(body.mesh.nodes))
    beside = problem_of(BatchBody(body, muscles, 4), [rest, rest], drag=0.0)
    pushes = torch.from_numpy(np.stack([-1e3 * muscles.stiffness * muscles.bounds, 0.0 * muscles.bounds]))
    assert beside.factor(torch.zeros((2, *rest.velocities.shape), dtype=torch.float64), pushes).tolist() == [True, True]
    impulses = torch.from_numpy(np.random.default_rng(8).standard_normal((given_size(body), 2))).expand(2, -1, -1)
    made, _ = apply_inverse(beside, impulses)
    np.testing.assert_allclose(made[0], made[1], rtol=0, atol=1e-12 * float(made.abs().max()))
