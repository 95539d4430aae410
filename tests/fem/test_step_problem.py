"""Equation of a step (Eq. 4, 6): the residual as derivative of an energy, the tangent as derivative of the residual,
conservation of linear and angular momentum, and closed forms of free fall, spin, drag and a sagging column.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.fem.linear_solver import FactorStatus
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.geometry.plane import Plane
from egs_warp.muscles.muscle_set import automatic_muscles
from egs_warp.muscles.tension import MuscleEnergy
from tests.support.factors import is_definite
from tests.support.meshes import block_mesh
from tests.support.passive import passive_body
from tests.support.states import bent_state, spinning_state

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
DT = 1 / 60


@pytest.fixture(scope="module")
def body() -> SoftBody:
    return make_body(block_mesh(), FLOOR, device="cpu")


def some_tension(body: SoftBody) -> MuscleEnergy:
    muscles = automatic_muscles(body.mesh, FLOOR.normal, body_weight=body.weight, height=body.height)
    share = np.random.default_rng(5).uniform(-0.05, 0.3, muscles.segment_count)
    return MuscleEnergy.of(muscles, share * muscles.bounds)


@pytest.fixture(scope="module")
def tension(body: SoftBody) -> MuscleEnergy:
    return some_tension(body)


@pytest.mark.parametrize("muscles", [False, True])
def test_the_residual_is_the_derivative_of_an_energy_up_to_a_rotation(device: str, muscles: bool) -> None:
    """Eq. (4), Eq. (6): the residual equals the gradient of Phi(v), by central differences, minus M times the rigid
    rotation of the momentum correction, with drag and Rayleigh damping.
    """
    body = make_body(block_mesh(), FLOOR, device=device)
    problem = StepProblem(body, bent_state(body), DT, drag=0.7)
    tension = some_tension(body) if muscles else None
    rng = np.random.default_rng(1)
    v = problem.state.velocities + 0.3 * rng.standard_normal(problem.state.velocities.shape)

    def phi(velocities: np.ndarray) -> float:
        end = problem.end_positions(velocities)
        change = velocities - problem.state.velocities
        kinetic = 0.5 * float((problem.node_mass[:, None] * (change**2 + DT * 0.7 * velocities**2)).sum())
        pull = 0.0 if tension is None else tension.tensions @ np.linalg.norm(tension.rows @ end, axis=1)
        weight = DT * float((problem.node_mass[:, None] * velocities @ body.gravity[:, None]).sum())
        return kinetic + body.assembly.energy(end, problem.damping) + pull - weight

    spin = problem.momentum_correction(problem.internal_gradient(v, tension))
    turned = problem.node_mass[:, None] * (problem.rotation_modes @ spin).reshape(v.shape)
    assert np.linalg.norm(spin) > 1e-3
    gradient = problem.residual(v, tension) + turned
    for _ in range(4):
        along = rng.standard_normal(v.shape)
        h = 1e-5
        slope = (phi(v + h * along) - phi(v - h * along)) / (2 * h)
        assert slope == pytest.approx(np.sum(gradient * along), rel=1e-6)


@pytest.mark.parametrize("drag", [0.0, 0.7])
@pytest.mark.parametrize("muscles", [False, True])
def test_the_tangent_inverts_the_derivative(body: SoftBody, tension: MuscleEnergy, drag: float, muscles: bool) -> None:
    """With muscles and the momentum projection, central differences of the residual along J^-1 b equal b."""
    problem, pull = StepProblem(body, spinning_state(body), DT, drag), tension if muscles else None
    v = problem.state.velocities + DT * body.gravity
    tangent = problem.tangent(MultifrontalLdl(body.assembly.upper_pattern), v, pull)
    for seed in range(3):
        impulse = np.random.default_rng(seed).standard_normal(v.size) * problem.residual_scale
        along = tangent.solve(impulse).reshape(v.shape)
        h = 1e-4 / np.abs(along).max()
        change = (problem.residual(v + h * along, pull) - problem.residual(v - h * along, pull)) / (2 * h)
        # The tolerance allows for muscles with less than a thousandth of the largest stiffness, which the Woodbury term
        # omits.
        assert np.abs(change.ravel() - impulse).max() < (2e-3 if muscles else 1e-6) * np.abs(impulse).max()


def test_every_column_has_the_momenta_of_its_impulse(body: SoftBody, tension: MuscleEnergy) -> None:
    problem = StepProblem(body, spinning_state(body), DT)
    tangent = problem.tangent(MultifrontalLdl(body.assembly.upper_pattern), problem.state.velocities, tension)
    impulses = np.random.default_rng(6).standard_normal((problem.state.velocities.size, 5))
    columns = tangent.solve(impulses)
    assert np.abs(problem.momenta @ columns - problem.rotation_modes.T @ impulses).max() < 1e-10
    linear = (np.repeat(body.node_mass, 3)[:, None] * columns).reshape(-1, 3, 5).sum(axis=0)
    assert np.abs(linear - impulses.reshape(-1, 3, 5).sum(axis=0)).max() < 1e-10


@pytest.mark.parametrize("muscles", [False, True])
def test_an_indefinite_stiffness_is_projected_and_keeps_the_momenta(
    body: SoftBody, tension: MuscleEnergy, muscles: bool
) -> None:
    """For a body compressed to 40 % in a long step, the exact matrix has negative pivots, with and without muscles. Its
    definite approximation conserves the momenta, too."""
    squashed = BodyState(body.mesh.nodes * [1.1, 1.1, 0.4], np.zeros_like(body.mesh.nodes))
    problem, factors = StepProblem(body, squashed, 1.0), MultifrontalLdl(body.assembly.upper_pattern)
    entries = body.assembly.hessian_entries(squashed.positions, problem.damping, factor=1.0)
    entries[body.assembly.diagonal_entries] += np.repeat(body.node_mass, 3)
    assert not is_definite(factors, entries)
    tangent = problem.tangent(factors, squashed.velocities, tension if muscles else None)
    assert factors.negative_pivots == 0
    impulses = np.random.default_rng(7).standard_normal((squashed.velocities.size, 3))
    assert np.abs(problem.momenta @ tangent.solve(impulses) - problem.rotation_modes.T @ impulses).max() < 1e-10


def test_only_queued_factors_without_a_result_are_replaced() -> None:
    """A tangent is used unchanged if no factorisation is queued for it, or if the queued one succeeds. Otherwise, a
    positive definite approximation at the same velocities is factored."""
    near: list[np.ndarray] = []
    problem: Any = SimpleNamespace(factor_near=lambda factors, velocities: near.append(velocities))
    velocities = np.zeros((4, 3))
    queued, ready = (SimpleNamespace(status=status) for status in (FactorStatus.NONE, FactorStatus.DEFINITE))
    given: list[tuple[Any, np.ndarray | None]] = [(queued, None), (ready, velocities), (queued, velocities)]
    assert [Tangent(problem, *each).wait() for each in given] == [True, True, False]
    assert len(near) == 1 and near[0] is velocities


@pytest.mark.parametrize("inverting", [False, True])
def test_a_compressed_body_and_an_inverting_start_are_solved(body: SoftBody, inverting: bool) -> None:
    """For a body compressed to 55 %, at rest or with velocities that would invert elements, the step ends with a small
    residual and J > 0.
    """
    squashed = body.mesh.nodes * [1.1, 1.1, 0.55]
    fast = -2.0 * squashed / DT * [0, 0, 1]
    flying = passive_body(body, state=BodyState(squashed, fast if inverting else np.zeros_like(squashed)))
    assert StepProblem(body, flying.state, DT).is_inversion_free(flying.state.velocities) != inverting
    problem, result = flying.advance(DT)
    assert result.converged and problem.is_inversion_free(result.velocities)
    assert np.linalg.norm(problem.residual(result.velocities, None)) <= 1e-8 * problem.residual_scale


def test_a_step_reports_that_it_does_not_converge(body: SoftBody) -> None:
    """The tolerance of 1e-25 is below rounding errors, so no solve reaches it."""
    _, result = passive_body(body, state=bent_state(body), tolerance=1e-25).advance(DT)
    assert not result.converged
    assert 1e-25 < result.residual < 1e-9


def fall(
    body: SoftBody, start: BodyState, dt: float, steps: int, tension: MuscleEnergy | None = None, *, drag: float = 0.0
) -> tuple[list[BodyState], float]:
    """Return the states of a free flight and the sum of the momentum corrections, rad/s."""
    flying, states, given = passive_body(body, state=start), [start], 0.0
    for _ in range(steps):
        problem, result = flying.advance(dt, tension, drag=drag)
        assert result.converged
        states.append(flying.state)
        given += float(
            np.linalg.norm(problem.momentum_correction(problem.internal_gradient(result.velocities, tension)))
        )
    return states, given


@pytest.mark.parametrize("muscles", [False, True])
def test_free_fall_follows_the_discrete_parabola(body: SoftBody, tension: MuscleEnergy, muscles: bool) -> None:
    """Eq. (4): in flight the centre of mass is at x0 + n dt v0 + g dt^2 n (n + 1) / 2, to 1e-6 H, for any deformation.
    The angular momentum is conserved to rounding, while implicit Euler alone loses spin.
    """
    start = spinning_state(body) if muscles else bent_state(body)
    states, given_back = fall(body, start, DT, 30, tension if muscles else None)
    com, speed = body.centre_of_mass(start.positions), body.centre_of_mass(start.velocities)
    n = np.arange(31)[:, None]
    discrete = com + n * DT * speed + 0.5 * DT**2 * n * (n + 1) * body.gravity
    measured = np.array([body.centre_of_mass(s.positions) for s in states])
    assert np.abs(measured - discrete).max() < 1e-6 * body.height
    spins = np.array([body.angular_momentum(s.positions, s.velocities) for s in states])
    assert np.abs(spins - spins[0]).max() < 1e-10 * np.abs(spins[0]).max()
    assert given_back > 1e-3
    # The body must deform, because the test would be trivial for a rigid one.
    assert np.ptp([body.assembly.energy(s.positions) for s in states]) > 1e-3


def test_free_fall_converges_at_rate_one(body: SoftBody) -> None:
    """Eq. (4): the distance to the true parabola at a fixed time is proportional to the step size (order 0.98 to
    1.02)."""
    start, end_time = bent_state(body), 0.2
    com, speed = body.centre_of_mass(start.positions), body.centre_of_mass(start.velocities)
    true = com + end_time * speed + 0.5 * end_time**2 * body.gravity
    errors = []
    for steps in (6, 12, 24):
        states, _ = fall(body, start, end_time / steps, steps)
        errors.append(np.linalg.norm(body.centre_of_mass(states[-1].positions) - true))
    rates = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.abs(rates - 1.0).max() < 0.02


@pytest.mark.parametrize("damping_ratio", [0.0, 0.05])
def test_spin_survives_a_free_half_turn(damping_ratio: float) -> None:
    """A free half turn in 24 steps conserves the angular momentum to rounding, and the rotation is 180 degrees to
    within 3 degrees; implicit Euler alone would lose 10 % of the spin.

    This holds with and without damping, because Eq. (6) does not damp rotations. The body is stiff, since a soft one
    expands under the spin and therefore rotates more slowly.
    """
    body = make_body(block_mesh(), FLOOR, sag=1e-3, damping_ratio=damping_ratio, device="cpu")
    steps = 24
    omega = np.array([0.0, 0.0, np.pi / (steps * DT)])
    rest = body.mesh.nodes
    arms = rest - body.centre_of_mass(rest)
    states, given_back = fall(body, BodyState(rest, np.cross(omega, arms)), DT, steps)
    spins = np.array([body.angular_momentum(s.positions, s.velocities) for s in states])
    assert np.abs(spins - spins[0]).max() < 1e-12 * np.abs(spins[0]).max()
    turn = Rotation.from_matrix(body.best_fit_rotation(states[-1].positions))
    assert np.degrees(turn.magnitude()) == pytest.approx(180.0, abs=3.0)
    assert given_back > 0.1 * omega[2]


def test_damping_resists_deformation_but_no_rigid_motion(body: SoftBody) -> None:
    """Eq. (6): a rigid motion of a deformed body, however large, causes no damping force; other motions dissipate the
    power -v.f >= 0.
    """
    problem = StepProblem(body, bent_state(body), DT)
    assembly, start = body.assembly, problem.state.positions

    def damping(end: np.ndarray) -> np.ndarray:
        return problem.internal_gradient((end - start) / DT, None) - assembly.gradient(end)

    moved = start @ Rotation.from_rotvec([0.3, -2.0, 0.9]).as_matrix().T + [1.0, -2.0, 0.5]
    strain = 0.03 * np.random.default_rng(5).standard_normal(moved.shape)
    end = start + DT * strain
    strained = damping(end)
    assert np.abs(damping(moved)).max() < 1e-11 * np.abs(strained).max()
    assert np.sum(strained * strain) > 0.0
    assert np.sum(strained * strain) == pytest.approx(
        2.0 / DT * (assembly.energy(end, problem.damping) - assembly.energy(end)), rel=1e-2
    )


def test_drag_slows_free_flight_exponentially(body: SoftBody) -> None:
    """Eq. (6): in each implicit step, drag alpha changes the velocity v of the centre of mass to (v + g dt) / (1 +
    alpha dt), and the angular momentum L to L / (1 + alpha dt).
    """
    alpha, start = 2.0, spinning_state(body)
    states, _ = fall(body, start, DT, 3, drag=alpha)
    for before, after in zip(states[:-1], states[1:], strict=True):
        speed = body.centre_of_mass(before.velocities) + DT * body.gravity
        assert np.allclose(body.centre_of_mass(after.velocities), speed / (1 + alpha * DT), atol=1e-9)
        spin = body.angular_momentum(before.positions, before.velocities) / (1 + alpha * DT)
        assert np.allclose(body.angular_momentum(after.positions, after.velocities), spin, rtol=1e-10, atol=0)


def test_column_sags_by_half_the_sag_ratio() -> None:
    """With E = rho g H / sag a column on a frictionless ground shortens by sag/2 (Poisson ratio 0, linear
    limit), and its base stays where it is.

    See docs/concepts/cage.md.
    """
    sag = 0.01
    mesh = block_mesh(3, 3, 17, (0.3, 0.3, 1.0))
    column = make_body(mesh, FLOOR, sag=sag, poisson_ratio=0.0, device="cpu")
    base = mesh.nodes[:, 2] < 1e-9
    standing = passive_body(column, mesh.nodes[base], plane=FLOOR, friction=0.0)
    dt = 0.05 / np.sqrt(9.81)
    for _ in range(100):
        before = standing.state.positions
        standing.state = BodyState(before, np.zeros_like(before))
        _, result = standing.advance(dt)
        assert result.converged
        dt = min(dt * 1.3, 0.2 / np.sqrt(9.81))
        if np.abs(standing.state.positions - before).max() < 1e-7:
            break
    settled = standing.state.positions
    shortening = 1.0 - settled[mesh.nodes[:, 2] > 1 - 1e-9, 2].mean()
    assert np.abs(settled[base, 2]).max() < 3e-5
    assert shortening == pytest.approx(sag / 2, rel=0.02)  # the next term of the closed form is of order sag^2
