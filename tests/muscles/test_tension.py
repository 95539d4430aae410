"""Muscle energy: derivatives, Eq. (7), a step under tension, and buckling of a slender rod."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sparse
from scipy.optimize import minimize

from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.step_problem import StepProblem
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.synergies import Synergies
from egs_warp.muscles.fibres import Fibre, FibreKind
from egs_warp.muscles.muscle_set import MuscleSet, attach_fibres
from egs_warp.muscles.tension import MuscleEnergy, SynergyColumns, activation_jacobian, shortening
from tests.support.creatures import coarse_pawn
from tests.support.meshes import box_mesh
from tests.support.passive import passive_body

ROD = box_mesh((2, 2, 14), (0.08, 0.08, 1.0))


@pytest.fixture(scope="module")
def rod() -> SoftBody:
    return make_body(ROD, Plane(np.array([0.0, 0.0, 1.0]), 0.0), device="cpu")


def tendon(count: int) -> MuscleSet:
    """Create one fibre of ``count`` segments along the axis of the rod."""
    points = np.stack([np.zeros(count + 1), np.zeros(count + 1), np.linspace(0.05, 0.95, count + 1)], axis=1)
    return attach_fibres(ROD, [Fibre("spine", FibreKind.LONGITUDINAL, points, 1.0)])


def scattered(rng: np.random.Generator) -> MuscleEnergy:
    """Create random segments with positive and negative tensions."""
    points = rng.uniform([-0.03, -0.03, 0.1], [0.03, 0.03, 0.9], (6, 4, 3))
    muscles = attach_fibres(ROD, [Fibre(f"f{i}", FibreKind.USER, p, 5.0 + i) for i, p in enumerate(points)])
    return MuscleEnergy.of(muscles, rng.uniform(-1.0, 1.0, muscles.segment_count) * muscles.bounds)


def dense(tension: MuscleEnergy, x: np.ndarray) -> np.ndarray:
    """Return the stiffness matrix (3N, 3N) of all segments, N/m."""
    across, rates = tension.hessian(x).factors(min_relative_stiffness=0.0)
    return (across * rates) @ across.T


def test_segments_of_a_compressed_rod_are_shorter() -> None:
    """If a rod is compressed by a tenth of its length, rotated and translated, its segments are shorter by a tenth."""
    muscles, turned = tendon(3), np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    pressed = (ROD.nodes * [1.0, 1.0, 0.9]) @ turned.T + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(shortening(muscles, ROD.nodes, pressed), 0.1 * muscles.rest_lengths, rtol=1e-9)
    np.testing.assert_allclose(shortening(muscles, pressed, ROD.nodes), -0.1 * muscles.rest_lengths, rtol=1e-9)


@pytest.mark.parametrize("shortened", [1.0, 0.55, 0.2], ids=["long", "short", "slack"])
def test_force_and_stiffness_are_derivatives_of_the_energy(shortened: float) -> None:
    """Force and stiffness equal central differences. The low-rank factors omit only the slackest segments. The tension
    decreases below 0.7 of the rest length and is zero below 0.3.
    """
    rng = np.random.default_rng(0)
    tension = scattered(rng)
    x = shortened * ROD.nodes + rng.normal(0.0, 0.004, ROD.nodes.shape)
    K = dense(tension, x)
    h = 1e-6
    for _ in range(3):
        along = rng.standard_normal(x.shape)
        slope = (tension.energy(x + h * along) - tension.energy(x - h * along)) / (2 * h)
        exact = float((tension.gradient(x) * along).sum())
        assert slope == pytest.approx(exact, rel=1e-6, abs=1e-9)
        change = (tension.gradient(x + h * along) - tension.gradient(x - h * along)) / (2 * h)
        assert np.abs((K @ along.ravel()).reshape(x.shape) - change).max() <= 1e-6 * np.abs(change).max()
    across, rates = tension.hessian(x).factors(min_relative_stiffness=1e-3)
    assert across.shape[1] == len(rates) <= 3 * len(tension.tensions)
    np.testing.assert_allclose((across * rates) @ across.T, K, rtol=0, atol=1e-3 * np.abs(K).max())


@pytest.mark.parametrize("shortened", [1.0, 0.55, 0.2, 0.0], ids=["long", "short", "slack", "in a point"])
def test_the_kernel_adds_the_force_to_that_of_the_elements(rod: SoftBody, shortened: float) -> None:
    """Eq. (7): the sum of elastic and muscle forces equals ``gradient`` to rounding, for several sets of muscles in
    turn."""
    rng = np.random.default_rng(3)
    x = ROD.nodes + rng.normal(0.0, 0.002, ROD.nodes.shape)
    for tension in (scattered(rng), MuscleEnergy.of(tendon(5), rng.normal(size=5)), scattered(rng)):
        # With longer rest lengths, the segments are shorter relative to rest.
        held = MuscleEnergy(tension.rows, tension.tensions, tension.rest_lengths / max(shortened, 1e-9))
        forces = rod.assembly.gradient(x, None, held) - rod.assembly.gradient(x)
        expected = held.gradient(x)
        assert np.abs(forces - expected).max() <= 1e-12 * max(
            np.abs(expected).max(), np.abs(rod.assembly.gradient(x)).max()
        )


def test_full_tension_has_the_energy_of_its_length() -> None:
    """The energy is sum T L plus a constant if no segment is shorter than 0.7 of its rest length, so the force is that
    of Eq. (7). Between 0.3 and 0.7, the work is half of the work at full tension; below 0.3 it is zero.
    """
    muscles = tendon(5)
    activations = np.linspace(0.1, 0.3, 5) * muscles.bounds
    tension = MuscleEnergy.of(muscles, activations)

    def energy(scale: float) -> float:
        return tension.energy(scale * ROD.nodes)

    full = float(tension.tensions @ muscles.rest_lengths)
    assert energy(1.3) - energy(0.8) == pytest.approx(0.5 * full, rel=1e-12)
    assert energy(0.7) - energy(0.3) == pytest.approx(0.2 * full, rel=1e-12)
    assert energy(0.3) == pytest.approx(0.0, abs=1e-15 * full) and energy(0.0) == 0.0
    assert not tension.gradient(0.2 * ROD.nodes).any() and not tension.gradient(0.0 * ROD.nodes).any()


def test_force_is_equation_7_and_makes_no_net_force_or_torque() -> None:
    """Eq. (7): in any pose, the force is A(p) a, with zero resultant force and torque."""
    rng = np.random.default_rng(1)
    muscles = tendon(5)
    activations = rng.uniform(-1.0, 1.0, 5) * muscles.bounds
    x = ROD.nodes + rng.normal(0.0, 0.004, ROD.nodes.shape)
    forces = -MuscleEnergy.of(muscles, activations).gradient(x)
    np.testing.assert_allclose(forces.ravel(), activation_jacobian(muscles, x) @ activations, rtol=0, atol=1e-14)
    scale = np.abs(forces).sum()
    assert np.abs(forces.sum(axis=0)).max() < 1e-14 * scale
    assert np.abs(np.cross(x, forces).sum(axis=0)).max() < 1e-14 * scale


def test_a_step_balances_momentum_under_tension(rod: SoftBody) -> None:
    """Eq. (4): the muscles add neither linear nor angular momentum while they deform the rod."""
    rng = np.random.default_rng(2)
    x = ROD.nodes + rng.normal(0.0, 0.002, ROD.nodes.shape)
    state, tension = BodyState(x, rng.normal(0.0, 0.3, x.shape)), scattered(rng)
    problem, result = passive_body(rod, state=state).advance(1 / 60, tension)
    assert result.converged
    assert np.linalg.norm(problem.residual(result.velocities, tension)) <= 1e-8 * problem.residual_scale
    gained = rod.mass * rod.centre_of_mass(result.velocities - state.velocities)
    np.testing.assert_allclose(gained, rod.mass * rod.gravity / 60, rtol=0, atol=1e-8 * rod.weight / 60)
    spins = [
        rod.angular_momentum(state.positions, state.velocities),
        rod.angular_momentum(problem.end_positions(result.velocities), result.velocities),
    ]
    np.testing.assert_allclose(*spins, rtol=0, atol=1e-8 * problem.residual_scale * rod.height)
    _, slack = passive_body(rod, state=state).advance(1 / 60)
    assert np.abs(result.velocities - slack.velocities).max() > 1e-2


def equilibrium(
    start: np.ndarray,
    free: np.ndarray,
    energy: Callable[[np.ndarray], float],
    gradient: Callable[[np.ndarray], np.ndarray],
    hessian: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """Return the minimum (N, 3) of ``energy`` near ``start`` (N, 3) over the ``free`` (N,) nodes, by a trust-region
    method."""
    moving = np.repeat(free, 3)

    def whole(y: np.ndarray) -> np.ndarray:
        x = start.flatten()
        x[moving] = y
        return x.reshape(start.shape)

    found = minimize(
        lambda y: energy(whole(y)),
        start.ravel()[moving],
        jac=lambda y: gradient(whole(y)).ravel()[moving],
        hess=lambda y: hessian(whole(y))[np.ix_(moving, moving)],
        method="trust-exact",
        options={"gtol": 1e-4, "maxiter": 300, "initial_trust_radius": 0.05},
    )
    assert found.success, found.message
    return whole(found.x)


def press(rod: SoftBody, load: float, *, follows: bool) -> np.ndarray:
    """Return the shape (N, 3) of the rod with a clamped base and a small sideways perturbation, under the tension
    ``load``, N, of its tendon."""
    assembly, muscles = rod.assembly, tendon(6)
    tension = MuscleEnergy(muscles.difference_rows, np.full(6, load), muscles.rest_lengths)
    x = ROD.nodes + 0.01 * ROD.nodes[:, 2:] ** 2 * [1.0, 0.0, 0.0]

    def elastic(positions: np.ndarray) -> np.ndarray:
        upper = assembly.matrix(assembly.hessian_entries(positions))
        return (upper + sparse.triu(upper, 1).T).toarray()

    free = ROD.nodes[:, 2] > 0.01
    for _ in range(1 if follows else 6):
        pull = -tension.gradient(x)
        if follows:
            x = equilibrium(
                x,
                free,
                lambda p: assembly.energy(p) + tension.energy(p),
                lambda p: assembly.gradient(p) + tension.gradient(p),
                lambda p: elastic(p) + dense(tension, p),
            )
        else:
            x = equilibrium(
                x,
                free,
                lambda p, pull=pull: assembly.energy(p) - float((pull * p).sum()),
                lambda p, pull=pull: assembly.gradient(p) - pull,
                elastic,
            )
    return x


@pytest.mark.slow
def test_a_tendon_holds_straight_the_rod_that_a_dead_load_buckles(rod: SoftBody) -> None:
    """A tendon inside a rod cannot buckle the rod, because its tension follows the bend. A load of the same size with a
    fixed direction buckles the rod.
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
    """A free rod is compressed by its tendon with ``share`` times Euler's buckling load. Solutions for
    the tangent satisfy the dense equations up to a rigid rotation, below this load and also above it, although the
    elastic part is indefinite above."""
    euler = np.pi**2 * rod.young_modulus * 0.08**4 / 12 / 0.9**2
    tension = MuscleEnergy(tendon(6).difference_rows, np.full(6, share * euler), tendon(6).rest_lengths)
    still = np.zeros_like(ROD.nodes)
    pressed = passive_body(rod)
    for _ in range(4):
        _, result = pressed.advance(dt, tension)
        assert result.converged
        pressed.state = BodyState(pressed.state.positions, still)
    problem = StepProblem(rod, pressed.state, dt)
    entries = rod.assembly.hessian_entries(pressed.state.positions, problem.damping, factor=dt**2)
    entries[rod.assembly.diagonal_entries] += np.repeat(rod.node_mass, 3)
    upper = rod.assembly.matrix(entries)
    elastic = (upper + sparse.triu(upper, 1).T).toarray()
    whole = elastic + dt**2 * dense(tension, pressed.state.positions)
    assert (np.linalg.eigvalsh(elastic).min() > 0.0) == (share < 1.0)
    assert np.linalg.eigvalsh(whole).min() > 0.0
    right = np.random.default_rng(3).standard_normal((whole.shape[0], 4))
    tangent = problem.tangent(MultifrontalLdl(rod.assembly.upper_pattern), still, tension)
    found = tangent.solve(right)
    # The solutions differ by the rigid rotation that conserves the angular momentum.
    turned = problem.momenta.T
    missing = right - whole @ found
    missing = missing - turned @ np.linalg.lstsq(turned, missing, rcond=None)[0]
    np.testing.assert_allclose(missing, 0.0, rtol=0, atol=1e-6 * np.abs(right).max())
    np.testing.assert_allclose(problem.momenta @ found, problem.rotation_modes.T @ right, rtol=0, atol=1e-9)


def test_impulses_of_groups_are_the_columns_of_their_muscles() -> None:
    """The impulse of a group is the sum of the columns (Eq. 7) of its muscles at their bounds, times the step size, for
    one and for several muscles per group, at rest and in a deformed body with slack segments."""
    creature = coarse_pawn()
    muscles, rest = creature.muscles, creature.body.mesh.nodes
    bent = rest * [1.0, 1.0, 0.6] + 0.01 * np.random.default_rng(0).standard_normal(rest.shape)
    other = np.arange(3.0 * len(rest))
    for most in (muscles.segment_count, 7):
        synergies = Synergies((np.arange(muscles.segment_count) % most).astype(np.int32))
        impulses = SynergyColumns(muscles, synergies.group_from_muscle)
        for positions in (rest, bent):
            found = impulses.with_base(other, positions, 0.02)
            each = activation_jacobian(muscles, positions).toarray() * muscles.bounds
            expected = 0.02 * (each @ synergies.members.toarray())
            assert found.shape == (3 * len(rest), most + 1)
            np.testing.assert_allclose(found[:, :-1], expected, atol=1e-12 * np.abs(expected).max())
            np.testing.assert_array_equal(found[:, -1], other)
