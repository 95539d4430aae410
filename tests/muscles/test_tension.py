"""Muscles as an energy: derivatives, Eq. (7), Newton with it, and the slender column that a dead load would buckle."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sparse

from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.fem.factorisation import Factorisation
from egs_warp.fem.implicit_step import ImplicitStep, NewtonStatus, PenaltyTerms
from egs_warp.geometry.plane import Plane
from egs_warp.muscles.fibres import Fibre, FibreKind
from egs_warp.muscles.muscle_set import MuscleSet, attach_fibres, muscle_columns
from egs_warp.muscles.tension import MuscleTension
from tests.support.meshes import box_mesh

ROD = box_mesh((2, 2, 14), (0.08, 0.08, 1.0))


@pytest.fixture(scope="module")
def rod() -> SoftBody:
    return make_body(ROD, Plane(np.array([0.0, 0.0, 1.0]), 0.0), device="cpu")


def tendon(count: int) -> MuscleSet:
    """One fibre of ``count`` segments up the middle of the rod."""
    points = np.stack([np.zeros(count + 1), np.zeros(count + 1), np.linspace(0.05, 0.95, count + 1)], axis=1)
    return attach_fibres(ROD, [Fibre("spine", FibreKind.LONGITUDINAL, points, 1.0)])


def scattered(rng: np.random.Generator) -> MuscleTension:
    """Segments across the rod, some that pull and some that push."""
    points = rng.uniform([-0.03, -0.03, 0.1], [0.03, 0.03, 0.9], (6, 4, 3))
    muscles = attach_fibres(ROD, [Fibre(f"f{i}", FibreKind.USER, p, 5.0 + i) for i, p in enumerate(points)])
    return MuscleTension.of(muscles, rng.uniform(-1.0, 1.0, muscles.segment_count) * muscles.bounds)


def dense(product: Callable[[np.ndarray], np.ndarray], count: int) -> np.ndarray:
    """(3N, 3N) matrix of a linear map on (N, 3)."""
    return np.stack([product(column.reshape(-1, 3)).ravel() for column in np.eye(3 * count)], axis=1)


def test_force_and_stiffness_are_derivatives_of_the_energy() -> None:
    """Central differences; the stiffness is symmetric, and its factors rebuild it but for the slackest segments."""
    rng = np.random.default_rng(0)
    tension = scattered(rng)
    x = ROD.nodes + rng.normal(0.0, 0.004, ROD.nodes.shape)
    h = 1e-6
    for _ in range(3):
        along = rng.standard_normal(x.shape)
        slope = (tension.energy(x + h * along) - tension.energy(x - h * along)) / (2 * h)
        assert slope == pytest.approx(-float((tension.forces(x) * along).sum()), rel=1e-6)
        change = -(tension.forces(x + h * along) - tension.forces(x - h * along)) / (2 * h)
        assert np.abs(tension.stiffness(x).product(along) - change).max() < 1e-6 * np.abs(change).max()
    K = dense(tension.stiffness(x).product, len(x))
    across, rates = tension.stiffness(x).factors()
    np.testing.assert_allclose(K, K.T, rtol=0, atol=1e-12 * np.abs(K).max())
    np.testing.assert_allclose((across * rates) @ across.T, K, rtol=0, atol=1e-3 * np.abs(K).max())


def test_force_is_equation_7_and_makes_no_net_force_or_torque() -> None:
    """Eq. (7): A(p) a at any pose."""
    rng = np.random.default_rng(1)
    muscles = tendon(5)
    activations = rng.uniform(-1.0, 1.0, 5) * muscles.bounds
    x = ROD.nodes + rng.normal(0.0, 0.004, ROD.nodes.shape)
    forces = MuscleTension.of(muscles, activations).forces(x)
    np.testing.assert_allclose(forces.ravel(), muscle_columns(muscles, x) @ activations, rtol=0, atol=1e-14)
    scale = np.abs(forces).sum()
    assert np.abs(forces.sum(axis=0)).max() < 1e-14 * scale
    assert np.abs(np.cross(x, forces).sum(axis=0)).max() < 1e-14 * scale


def test_newton_balances_momentum_under_tension(rod: SoftBody) -> None:
    """Eq. (4): the muscles add none; the gradient, muscles and all, vanishes to the tolerance."""
    rng = np.random.default_rng(2)
    x = ROD.nodes + rng.normal(0.0, 0.002, ROD.nodes.shape)
    state = BodyState(x, rng.normal(0.0, 0.3, x.shape))
    step = ImplicitStep(rod, state, 1 / 60, Factorisation(rod))
    tension, gravity = scattered(rng), rod.node_mass[:, None] * rod.gravity
    result = step.minimise(gravity, state.velocities, tension=tension)
    assert result.status is NewtonStatus.CONVERGED
    gained = rod.mass * rod.centre_of_mass(result.velocities - state.velocities)
    np.testing.assert_allclose(gained, rod.mass * rod.gravity / 60, rtol=0, atol=1e-6 * rod.weight / 60)
    left = step.gradient(result.velocities, gravity + tension.forces(step.end_positions(result.velocities)))
    assert np.linalg.norm(left) < 1.1e-6 * rod.weight / 60


def held(rod: SoftBody, step: ImplicitStep) -> PenaltyTerms:
    """Stiff springs that keep the rod's foot where it is."""
    feet = np.flatnonzero(ROD.nodes[:, 2] < 0.01)
    stiffness = 1e4 * rod.weight
    where = rod.assembly.entries_of_node_pairs(feet, feet)[:, [0, 4, 8]]

    def stretch(v: np.ndarray) -> np.ndarray:
        return (step.end_positions(v) - ROD.nodes)[feet]

    def gradient(v: np.ndarray) -> np.ndarray:
        force = np.zeros_like(v)
        force[feet] = step.dt * stiffness * stretch(v)
        return force

    def add(_: np.ndarray, entries: np.ndarray) -> None:
        entries[where] += step.dt**2 * stiffness

    return PenaltyTerms(lambda v: 0.5 * stiffness * float((stretch(v) ** 2).sum()), gradient, add)


def press(rod: SoftBody, load: float, *, follows: bool) -> np.ndarray:
    """(N, 3) the rod, nudged sideways, after long steps under its tendon's pull of ``load`` newtons."""
    muscles = tendon(6)
    tension = MuscleTension(muscles.difference_rows, np.full(6, load))
    nudge = 0.01 * ROD.nodes[:, 2:] ** 2 * [1.0, 0.0, 0.0]
    state = BodyState(ROD.nodes + nudge, np.zeros_like(nudge))
    for _ in range(6):
        step = ImplicitStep(rod, state, 0.5, Factorisation(rod))
        dead = np.zeros_like(nudge) if follows else tension.forces(state.positions)
        result = step.minimise(dead, np.zeros_like(nudge), held(rod, step), tension=tension if follows else None)
        state = BodyState(step.end_positions(result.velocities), np.zeros_like(nudge))
    return state.positions


def test_a_tendon_holds_the_rod_straight_that_its_dead_load_buckles(rod: SoftBody) -> None:
    """A tendon inside a rod cannot buckle it (its thrust bends with the rod);
    with its direction frozen over a step it does.
    """
    second_moment, length = 0.08**4 / 12, 0.9
    euler = np.pi**2 * rod.young_modulus * second_moment / (4 * length**2)
    straight, buckled = press(rod, 8.0 * euler, follows=True), press(rod, 8.0 * euler, follows=False)
    top = ROD.nodes[:, 2] > 0.99
    assert abs(straight[top, 0].mean()) < 0.01
    assert abs(buckled[top, 0].mean()) > 0.05


@pytest.mark.parametrize(("share", "dt"), [(0.2, 0.02), (3.0, 1.0)])
def test_the_tangent_is_inverted_even_where_the_elastic_part_is_indefinite(
    rod: SoftBody, share: float, dt: float
) -> None:
    """A free rod pressed by its tendon with ``share`` of Euler's load, below and above it; against dense matrices."""
    euler = np.pi**2 * rod.young_modulus * 0.08**4 / 12 / 0.9**2
    tension = MuscleTension(tendon(6).difference_rows, np.full(6, share * euler))
    still = np.zeros_like(ROD.nodes)
    state = BodyState(ROD.nodes, still)
    for _ in range(4):
        step = ImplicitStep(rod, state, dt, Factorisation(rod))
        state = BodyState(step.end_positions(step.minimise(still, still, tension=tension).velocities), still)
    step = ImplicitStep(rod, state, dt, Factorisation(rod))
    upper = rod.assembly.matrix(step.matrix_entries(still, projected=False))
    elastic = (upper + sparse.triu(upper, 1).T).toarray()
    whole = elastic + step.dt**2 * dense(tension.stiffness(state.positions).product, len(still))
    assert (np.linalg.eigvalsh(elastic).min() > 0.0) == (share < 1.0)
    assert np.linalg.eigvalsh(whole).min() > 0.0
    right = np.random.default_rng(3).standard_normal((whole.shape[0], 4))
    found = step.tangent(still, tension)(right)
    np.testing.assert_allclose(whole @ found, right, rtol=0, atol=1e-6 * np.abs(right).max())
