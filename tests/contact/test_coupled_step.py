"""Coupled solve for velocities and contact forces (Eq. 4, 8, 9): contact, friction and conservation of both momenta,
for bodies that fall, rest, slide, stick on a slope, and rise out of the ground.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.contact import coupled_step
from egs_warp.contact import newton as responses
from egs_warp.contact.coupled_step import CoupledResult
from egs_warp.contact.detection import ContactDetector
from egs_warp.contact.newton import ContactLinearization
from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from tests.support.factors import is_definite
from tests.support.meshes import block_mesh
from tests.support.passive import PassiveBody, base_places, passive_body

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
DT = 1 / 60


def block(
    friction: float = 0.5,
    *,
    sag: float = 0.05,
    damping_ratio: float = 0.05,
    mesh: TetMesh | None = None,
    slope: float = 0.0,
    lift: float = 0.0,
) -> PassiveBody:
    """Create a soft block with 25 contact points at its base and four at its top, ``lift`` metres above a floor that
    slopes down towards +x by ``slope`` radians. Gravity is rotated instead of the floor."""
    level = make_body(mesh or block_mesh(), FLOOR, sag=sag, damping_ratio=damping_ratio, device="cpu")
    gravity = 9.81 * np.array([np.sin(slope), 0.0, -np.cos(slope)])
    body = SoftBody(level.mesh, level.assembly, level.node_mass, gravity, level.height)
    nodes = body.mesh.nodes
    top = [0.0, 0.0, nodes[:, 2].max()]
    state = BodyState(nodes + lift * FLOOR.normal, np.zeros_like(nodes))
    places = np.concatenate([base_places(body), base_places(body, 2) + top])
    return passive_body(body, places, plane=FLOOR, friction=friction, state=state)


def assert_obeys(standing: PassiveBody, before: BodyState, problem: StepProblem, result: CoupledResult) -> None:
    """Assert that the result satisfies normal complementarity, Coulomb's law, maximal dissipation and the balances of
    linear and angular momentum."""
    body, friction = standing.body, standing.solver.detector.geometry.friction
    contacts, forces = result.contacts, result.forces
    assert result.converged and result.residual < 1e-8
    speed = (contacts.jacobian @ result.velocities.ravel()).reshape(-1, 3)
    measure = speed[:, 0] + standing.solver.normal_bias(contacts, problem.dt)
    scale = np.sqrt(9.81 * body.height)
    if contacts.count:
        assert measure.min() > -1e-6 * scale and forces[:, 0].min() >= 0.0
        assert np.abs(np.minimum(measure / scale, forces[:, 0] / body.weight)).max() < 1e-6
        slip, pull = np.linalg.norm(speed[:, 1:], axis=1), np.linalg.norm(forces[:, 1:], axis=1)
        assert (pull <= friction * forces[:, 0] * (1 + 1e-9) + 1e-12).all()
        sliding = slip > 1e-4 * scale
        assert np.allclose(pull[sliding], friction * forces[sliding, 0], atol=1e-6 * body.weight)
        along = (forces[:, 1:] * speed[:, 1:]).sum(axis=1)
        assert np.allclose(along[sliding], -(pull * slip)[sliding], rtol=1e-4, atol=1e-6 * body.weight * scale)
    nodal = (contacts.jacobian.T @ forces.ravel()).reshape(-1, 3)
    gained = body.mass * (body.centre_of_mass(result.velocities) - body.centre_of_mass(before.velocities))
    total = nodal.sum(axis=0) + body.mass * body.gravity
    assert np.abs(gained - problem.dt * total).max() < 1e-7 * problem.residual_scale
    arms = before.positions - body.centre_of_mass(before.positions)
    turned = body.angular_momentum(problem.end_positions(result.velocities), result.velocities)
    turned = turned - body.angular_momentum(before.positions, before.velocities)
    torque = problem.dt * np.cross(arms, nodal).sum(axis=0)
    assert np.abs(turned - torque).max() < 1e-7 * problem.residual_scale * body.height


@pytest.mark.parametrize("push", [0.0, 0.5])
def test_a_block_comes_to_rest_and_every_step_obeys_coulombs_law(push: float) -> None:
    """Eq. (4), Eq. (9): the block is dropped by 2 % of its height, with and without a sideways push."""
    falling = block(lift=0.02)
    body = falling.body
    falling.state.velocities[:] = [push, 0.3 * push, 0.0]
    scale = np.sqrt(9.81 * body.height)
    for _ in range(60):
        before = falling.state
        problem, result = falling.advance(DT)
        assert_obeys(falling, before, problem, result)
    # At the end, the base of a pushed block is at rest, although the block still vibrates.
    speed = (result.contacts.jacobian @ result.velocities.ravel()).reshape(-1, 3)
    assert np.abs(speed[:, 1:]).max() < 5e-3 * scale
    if push == 0.0:
        assert falling.forces[:, 0].sum() == pytest.approx(body.weight, rel=3e-3)
        assert np.abs(falling.state.velocities).max() < 5e-3 * scale


def test_an_oblique_spinning_impact_obeys_coulombs_law() -> None:
    """Eq. (4), Eq. (9): contact, friction and both momenta for a body that translates and spins."""
    thrown = block(0.8, lift=0.03)
    body, x = thrown.body, thrown.state.positions
    v = np.array([1.5, 0.3, -1.0]) + np.cross([0.5, -1.0, 2.0], x - body.centre_of_mass(x))
    thrown.state, touched, slid = BodyState(x, v), 0, 0
    for _ in range(15):
        before = thrown.state
        problem, result = thrown.advance(DT)
        assert_obeys(thrown, before, problem, result)
        pressed = result.forces[:, 0] > 1e-3 * body.weight
        slip = np.linalg.norm((result.contacts.jacobian @ result.velocities.ravel()).reshape(-1, 3)[:, 1:], axis=1)
        touched += result.forces[:, 0].max(initial=0.0) > 0.1 * body.weight
        slid += bool((slip[pressed] > 1e-3).any())
    assert touched >= 3 and slid >= 1


def test_dropped_body_comes_to_rest_without_gaining_energy() -> None:
    """Eq. (4), Eq. (9): a body dropped from H/2 with muscles off gains at most 1e-7 m g H of energy in any step,
    and ends at rest on its base.
    """
    falling = block(0.8, lift=0.5)
    body, gaps_of = falling.body, falling.solver.detector.gaps
    unit = body.weight * body.height
    energies, deepest = [body.mechanical_energy(falling.state.positions, falling.state.velocities)], 0.0
    for _ in range(150):
        _, result = falling.advance(DT)
        assert result.converged
        state = falling.state
        energies.append(body.mechanical_energy(state.positions, state.velocities))
        gaps, _ = gaps_of(state.positions)
        deepest = min(deepest, gaps.min())
        gap = np.maximum(gaps[result.contacts.points], 0.0)
        assert (result.forces[:, 0] * gap).max(initial=0.0) <= 1e-4 * unit
    gains = np.diff(energies) / unit
    assert gains.max() < 1e-7
    assert deepest > -1e-3 * body.height
    assert energies[-1] < energies[0] - 0.45 * unit
    assert np.abs(falling.state.velocities).max() < 1e-2
    assert falling.forces[:, 0].sum() == pytest.approx(body.weight, rel=0.02)
    up = body.best_fit_rotation(falling.state.positions)[:, 2]
    assert up[2] > np.cos(np.radians(2.0))


@pytest.mark.parametrize("degrees", [15.0, 21.0, 22.6, 30.0])
def test_block_on_an_incline_sticks_or_slides(degrees: float) -> None:
    """Eq. (9), closed form: with mu = 0.4 (21.8 degrees) the block sticks or slides with a = g (sin - mu cos).

    The block is stiff and flat so that it does not tip. It starts at rest, and the mean over 20 steps is used.
    """
    angle, friction = np.radians(degrees), 0.4
    moving = block(friction, sag=0.002, mesh=block_mesh(4, 4, 3, (0.8, 0.8, 0.3)), slope=angle)
    body, speeds = moving.body, []
    for _ in range(40):
        before = moving.state
        problem, result = moving.advance(DT)
        assert_obeys(moving, before, problem, result)
        speeds.append(body.centre_of_mass(moving.state.velocities)[0])
    measured = (speeds[-1] - speeds[19]) / (20 * DT)
    expected = max(9.81 * (np.sin(angle) - friction * np.cos(angle)), 0.0)
    assert measured == pytest.approx(expected, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("degrees", [0.0, 15.0])
def test_a_resting_body_neither_sinks_nor_creeps(degrees: float) -> None:
    """Eq. (8), Eq. (9): on level ground, and on a slope with enough friction, the block stays at rest, and the contact
    forces carry its weight."""
    resting = block(0.5, sag=0.01, damping_ratio=0.5, slope=np.radians(degrees))
    body = resting.body
    for _ in range(200):
        _, result = resting.advance(DT)
        assert result.converged
    start, gaps = resting.state, resting.solver.detector.gaps(resting.state.positions)[0]
    for _ in range(120):
        _, result = resting.advance(DT)
        assert result.converged
    moved = np.abs(resting.state.positions - start.positions).max()
    assert moved < 1e-6 * body.height
    assert gaps.min() > -2e-3 * body.height
    net = (
        resting.solver.detector.contact_set(resting.points, start.positions).jacobian.toarray().T
        @ resting.forces.ravel()
    )
    assert np.allclose(net.reshape(-1, 3).sum(axis=0), -body.mass * body.gravity, atol=1e-4 * body.weight)


def test_a_sliding_block_stops_and_stays() -> None:
    """Eq. (9): a stiff flat block with the initial speed v slides by v^2 / (2 mu g) minus half of its displacement in
    the first step, and then sticks."""
    friction, speed = 0.5, 1.5
    sliding = block(friction, sag=0.002, mesh=block_mesh(4, 4, 3, (0.8, 0.8, 0.3)))
    body = sliding.body
    for _ in range(30):
        sliding.advance(DT / 2)
    start = body.centre_of_mass(sliding.state.positions)[0]
    sliding.state.velocities[:] += [speed, 0.0, 0.0]
    for _ in range(120):
        before = sliding.state
        problem, result = sliding.advance(DT / 2)
        assert_obeys(sliding, before, problem, result)
    way = body.centre_of_mass(sliding.state.positions)[0] - start
    # Implicit Euler uses the lower speed, at the end of each step, so the distance is shorter by v dt / 2.
    assert way == pytest.approx(speed**2 / (2 * friction * 9.81) - 0.25 * speed * DT, rel=0.02)
    assert np.abs(sliding.state.velocities).max() < 1e-2


@pytest.mark.parametrize("depth", [0.006, 0.02, 0.3])
def test_a_penetrating_body_is_pushed_out_to_the_tolerance(depth: float) -> None:
    """Eq. (8): points deeper than the tolerance rise by a fifth of the excess per step, up to the speed limit; other
    points stay at their depth."""
    sunk = block(sag=0.002, lift=-depth)
    height = sunk.body.height
    tolerance, cap = sunk.solver.penetration_tolerance, sunk.solver.push_out_cap
    for _ in range(3):
        gaps, _ = sunk.solver.detector.gaps(sunk.state.positions)
        _, result = sunk.advance(DT)
        assert result.converged
        rise = (result.contacts.jacobian @ result.velocities.ravel())[::3]
        wanted = np.minimum(0.2 * np.maximum(-gaps[result.contacts.points] - tolerance, 0.0) / DT, cap)
        pressed = result.forces[:, 0] > 0.0
        assert pressed.sum() >= 4
        np.testing.assert_allclose(rise[pressed], wanted[pressed], rtol=0, atol=1e-6 * np.sqrt(9.81 * height))
        assert (rise >= wanted - 1e-6 * np.sqrt(9.81 * height)).all()
    for _ in range(200):
        sunk.advance(DT)
    gaps, _ = sunk.solver.detector.gaps(sunk.state.positions)
    assert gaps.min() > -1.05 * tolerance


def on_one_corner(falling: PassiveBody) -> tuple[StepProblem, CoupledResult]:
    """Solve a step of the ``falling`` body that starts with one corner in its contact set."""
    x, solver = falling.state.positions, falling.solver
    problem = StepProblem(falling.body, BodyState(x, np.tile([0.0, 0.0, -1.0], (len(x), 1))), DT)
    contacts = solver.detector.contact_set(np.array([0]), x)
    response = ContactLinearization.of(problem.tangent(falling.factors, problem.rigid_guess, None), contacts)
    return problem, solver.solve(response, None, velocities=problem.rigid_guess, forces=np.zeros((1, 3)))


def test_points_that_would_penetrate_join_the_set() -> None:
    """A step that starts with one corner in its contact set ends with every point above the tolerance."""
    falling = block()
    solver = falling.solver
    problem, result = on_one_corner(falling)
    assert result.converged and result.contacts.count > 4 and result.contacts.points[0] == 0
    assert len(set(result.contacts.points)) == result.contacts.count
    gaps, _ = solver.detector.gaps(problem.end_positions(result.velocities))
    assert gaps.min() >= -solver.penetration_tolerance


def test_points_join_before_the_step_without_them_has_converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """If points are activated early, the solve ends with the same points in fewer iterations."""
    falling = block()
    _, soon = on_one_corner(falling)
    monkeypatch.setattr(coupled_step, "ACTIVATION_RESIDUAL", 0.0)
    _, late = on_one_corner(falling)
    assert soon.converged and late.converged and soon.iterations < late.iterations
    assert set(soon.contacts.points) == set(late.contacts.points)
    np.testing.assert_allclose(soon.velocities, late.velocities, atol=1e-7 * falling.body.speed_unit)


def test_a_tangent_that_yields_no_descent_is_replaced() -> None:
    """The tangent of a body without stiffness and with a billionth of the mass inverts elements at any step length. It
    is replaced by the body's own tangent, and the end velocities are the same."""
    standing = block()
    body, solver = standing.body, standing.solver
    squashed = BodyState(body.mesh.nodes * [1.0, 1.0, 0.9], np.zeros_like(body.mesh.nodes))
    problem = StepProblem(body, squashed, DT)
    light, masses = MultifrontalLdl(body.assembly.upper_pattern), np.zeros(body.assembly.upper_pattern.nnz)
    masses[body.assembly.diagonal_entries] = 1e-9 * np.repeat(body.node_mass, 3)
    assert is_definite(light, masses)
    contacts = solver.detector.contact_set(np.arange(25), squashed.positions)
    ends = []
    for tangent in (problem.tangent(standing.factors, problem.rigid_guess, None), Tangent(problem, light)):
        response = ContactLinearization.of(tangent, contacts)
        ends.append(solver.solve(response, None, velocities=problem.rigid_guess, forces=np.zeros((25, 3))))
    assert ends[0].converged and ends[1].converged and ends[1].factorization_count >= 1
    np.testing.assert_allclose(ends[1].velocities, ends[0].velocities, atol=1e-6 * body.speed_unit)


def test_a_linearization_predicts_the_step() -> None:
    """Eq. (8): contact forces change the velocities by the inverse of the tangent times their impulse. Columns that are
    passed in again give the same Delassus operator."""
    standing = block()
    x, solver = standing.state.positions @ Rotation.from_rotvec([0.0, 0.1, 0.2]).as_matrix().T, standing.solver
    problem = StepProblem(standing.body, BodyState(x, np.zeros_like(x)), DT)
    tangent = problem.tangent(standing.factors, problem.rigid_guess, None)
    contacts = solver.detector.contact_set(np.array([0, 7, 13, 24]), x)
    response = ContactLinearization.of(tangent, contacts)
    forces = np.random.default_rng(0).standard_normal((4, 3))
    moved = tangent.solve(DT * (contacts.jacobian.T @ forces.ravel()))
    np.testing.assert_allclose(response.columns @ forces.ravel(), moved, rtol=0, atol=1e-12 * np.abs(moved).max())
    speeds = contacts.jacobian @ moved
    np.testing.assert_allclose(response.delassus @ forces.ravel(), speeds, rtol=0, atol=1e-12 * np.abs(speeds).max())
    again = ContactLinearization.of(tangent, contacts, response.columns)
    np.testing.assert_array_equal(again.delassus, response.delassus)


def test_predicted_forces_obey_coulombs_law() -> None:
    """The prediction has exact contact instead of the paper's penalties (Eq. 10, 11). For any free velocities, normal
    forces are not negative, forces are within Coulomb's cone, and friction is opposite to the slip."""
    standing = block()
    solver, x = standing.solver, standing.state.positions
    problem = StepProblem(standing.body, standing.state, DT)
    contacts = solver.detector.contact_set(np.arange(0, 25, 3), x)
    response = ContactLinearization.of(problem.tangent(standing.factors, problem.rigid_guess, None), contacts)
    kinds = set()
    for seed in range(8):
        pace = 0.6 if seed % 2 else 0.02
        free = np.random.default_rng(seed).standard_normal(x.shape) * [pace, pace, 0.1] - [0.0, 0.0, 0.05 * seed]
        forces, missed = response.solve_coulomb(
            contacts.contact_velocities(free.ravel()),
            solver.normal_bias(contacts, DT),
            0.5,
            np.zeros((contacts.count, 3)),
        )
        speed = (contacts.jacobian @ free.ravel() + response.delassus @ forces.ravel()).reshape(-1, 3)
        slip, pull = np.linalg.norm(speed[:, 1:], axis=1), np.linalg.norm(forces[:, 1:], axis=1)
        assert missed < 1e-11 and forces[:, 0].min() >= 0.0 and speed[:, 0].min() > -1e-6
        assert (forces[:, 0] * speed[:, 0]).max() < 1e-6 * standing.body.weight
        assert (pull <= 0.5 * forces[:, 0] + 1e-9).all()
        sliding = (slip > 1e-4) & (forces[:, 0] > 0.0)
        np.testing.assert_allclose(pull[sliding], 0.5 * forces[sliding, 0], rtol=1e-6, atol=1e-9)
        along = (forces[:, 1:] * speed[:, 1:]).sum(axis=1)
        np.testing.assert_allclose(along[sliding], -(pull * slip)[sliding], rtol=1e-4)
        kinds |= set(np.where(forces[:, 0] == 0.0, "free", np.where(sliding, "slides", "sticks")).tolist())
    assert kinds == {"free", "slides", "sticks"}


def test_a_step_without_new_points_is_solved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gaps at the end of the step are evaluated twice: when the residual falls below the activation threshold, and
    at the end of the solve."""
    resting = block(sag=0.01, damping_ratio=0.5)
    for _ in range(5):
        resting.advance(DT)
    looks, gaps = [], ContactDetector.gaps
    monkeypatch.setattr(ContactDetector, "gaps", lambda *given: looks.append(1) or gaps(*given))
    _, result = resting.advance(DT)
    # Two further evaluations, before the step, are for the selection of points and for the contact set.
    assert result.converged and result.contacts.count > 4 and len(looks) == 4


def test_forces_that_violate_coulombs_law_end_no_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step does not end while its forces violate Coulomb's law, even if the equation of motion holds. Another tangent
    is tried; then the solve fails, so that the caller takes two half steps."""
    resting, answered = block(sag=0.01, damping_ratio=0.5), responses.coulomb_forces
    for _ in range(5):
        resting.advance(DT)
    start = resting.state, resting.points, resting.forces

    def advance(missed: list[float]) -> CoupledResult:
        resting.state, resting.points, resting.forces = start

        def forces(*given: Any) -> tuple[np.ndarray, float]:
            found, size = answered(*given)
            return found, missed.pop(0) if missed else size

        monkeypatch.setattr(responses, "coulomb_forces", forces)
        return resting.advance(DT)[1]

    plain = advance([])
    late = advance([1e-4] * plain.iterations)
    assert plain.converged and plain.factorization_count == 0
    assert late.converged and late.iterations > plain.iterations and late.factorization_count > 0
    np.testing.assert_allclose(late.velocities, plain.velocities, atol=1e-6)
    never = advance([1e-4] * 100)
    assert not never.converged and never.residual < 1e-8
