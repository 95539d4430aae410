"""Physical laws for any body, pose and motion, with a few cases by Hypothesis in the quick form and hundreds in the
long one."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from egs_warp.contact.coupled_step import CoupledResult
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.step_problem import StepProblem
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.stepper import WarmStart
from egs_warp.muscles.muscle_set import automatic_muscles
from egs_warp.muscles.tension import MuscleEnergy
from tests.support.creatures import coarse_creature
from tests.support.meshes import block_mesh, coarse_stool
from tests.support.passive import passive_body
from tests.support.properties import examples
from tests.support.random_bodies import FLOOR, Shape, Throw, shapes, standing, throws

QUICK, LONG = 12, int(os.environ.get("EGS_WARP_CASES", "40"))
at_length = pytest.mark.parametrize("count", [QUICK, pytest.param(LONG, marks=pytest.mark.slow)], ids=["quick", "long"])
pytestmark = pytest.mark.hypothesis
frictions = st.sampled_from([0.0, 0.3, 0.8, 1.5])


def drawn(count: int, **given_: st.SearchStrategy[Any]) -> Callable[[Callable[..., None]], Callable[[], None]]:
    """Return a decorator that tests a law on ``count`` cases."""
    profile = settings(
        max_examples=examples(count),
        # Shrinking would take minutes, so a failing case is printed as it was generated.
        phases=[Phase.generate],
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    return lambda law: profile(given(**given_)(law))


def some_tension(shape: Shape, share: float) -> MuscleEnergy:
    """Return automatic muscles of the body with random tensions up to ``share`` of their bounds, and compressive ones
    up to a third of that."""
    body = shape.body()
    muscles = automatic_muscles(body.mesh, FLOOR.normal, body_weight=body.weight, height=body.height)
    pulls = np.random.default_rng(shape.seed).uniform(-share / 3.0, share, muscles.segment_count)
    return MuscleEnergy.of(muscles, pulls * muscles.bounds)


@at_length
def test_both_momenta_of_free_flight(count: int) -> None:
    """Eq. (4), closed form: in each step, the linear momentum grows by m g dt and the angular momentum is constant, to
    rounding, for any muscle forces."""

    @drawn(count, shape=shapes(), throw=throws(), share=st.sampled_from([0.0, 0.1, 0.5]))
    def law(shape: Shape, throw: Throw, share: float) -> None:
        body, dt = shape.body(), 1.0 / 60.0
        start = throw.state(body)
        flying, tension = passive_body(body, state=start), some_tension(shape, share)
        spin = body.angular_momentum(start.positions, start.velocities)
        speed = body.centre_of_mass(start.velocities)
        for step in range(1, 5):
            _, result = flying.advance(dt, tension)
            end = flying.state
            assert result.converged and body.assembly.determinants(end.positions).min() > 0.0
            gained = body.centre_of_mass(end.velocities) - speed - step * dt * body.gravity
            assert np.abs(gained).max() < 1e-12 * body.speed_unit
            turned = body.angular_momentum(end.positions, end.velocities) - spin
            assert np.abs(turned).max() < 1e-12 * body.mass * body.height * body.speed_unit

    law()


def spin_work(problem: StepProblem, result: CoupledResult) -> float:
    """Return the work, J, of the momentum correction w x r in a step without muscles: w times the angular momentum of
    the end velocities about the lever arms at the start."""
    given = problem.momentum_correction(problem.internal_gradient(result.velocities, None))
    momenta = problem.node_mass[:, None] * np.cross(problem.lever_arms, result.velocities)
    return float(given @ momenta.sum(axis=0))


def test_restored_spin_adds_energy_only_at_the_start() -> None:
    """An unstretched soft block that spins as fast as in these tests is stretched in its first step. In this step,
    restoring the spin adds energy, but less than a fifth of the work of the correction; afterwards, the energy
    decreases."""
    shape = Shape((3, 2, 4), (0.294, 0.392, 0.333), 1.16, sag=0.05, poisson_ratio=0.137, damping_ratio=0.05, seed=3657)
    throw = Throw((2.72, 0.0, 0.5), (0.0, 0.0186, 0.0), (0.0, 0.0, 0.0), (1.5, 0.0, -1.42), noise=0.0, seed=0)
    body = shape.body()
    flying, unit = passive_body(body, state=throw.state(body)), body.weight * body.height
    energies, works = [body.mechanical_energy(flying.state.positions, flying.state.velocities) / unit], []
    for _ in range(20):
        problem, result = flying.advance(body.time_unit / 20.0)
        energies.append(body.mechanical_energy(flying.state.positions, flying.state.velocities) / unit)
        works.append(spin_work(problem, result) / unit)
    gains = np.diff(energies)
    assert 5e-4 < gains[0] < 7e-4 and gains[0] < 0.2 * works[0]
    assert np.all(gains[1:] < -1e-5) and max(energies[3:]) < energies[0]


@at_length
def test_contact_gives_no_energy_and_both_momenta_are_its_impulse(count: int) -> None:
    """Eq. (4), (8), (9): for a body thrown at the floor without muscles, the mechanical energy decreases in every step
    except for the work of the restored spin, contact forces do no positive work, and momenta change only by the
    impulses and torques of weight and contact.
    """

    @drawn(count, shape=shapes(), throw=throws(), friction=frictions)
    def law(shape: Shape, throw: Throw, friction: float) -> None:
        body = shape.body()
        thrown = standing(body, friction, throw.state(body, lift=0.02))
        unit, dt = body.weight * body.height, body.time_unit / 20.0
        for _ in range(15):
            before = thrown.state
            problem, result = thrown.advance(dt)
            end = thrown.state
            assert result.converged and body.assembly.determinants(end.positions).min() > 0.0
            speeds = (result.contacts.jacobian @ result.velocities.ravel()).reshape(-1, 3)
            assert dt * float((result.forces * speeds).sum()) <= 1e-10 * unit
            energies = [body.mechanical_energy(state.positions, state.velocities) for state in (before, end)]
            assert energies[1] < energies[0] + max(spin_work(problem, result), 0.0) + 1e-9 * unit
            pushes = (result.contacts.jacobian.T @ result.forces.ravel()).reshape(-1, 3)
            gained = body.mass * (body.centre_of_mass(end.velocities) - body.centre_of_mass(before.velocities))
            impulse = dt * (pushes.sum(axis=0) + body.mass * body.gravity)
            assert np.abs(gained - impulse).max() < 1e-10 * problem.residual_scale
            arms = before.positions - body.centre_of_mass(before.positions)
            spins = [body.angular_momentum(state.positions, state.velocities) for state in (before, end)]
            twist = dt * np.cross(arms, pushes).sum(axis=0)
            assert np.abs(spins[1] - spins[0] - twist).max() < 1e-10 * problem.residual_scale * body.height

    law()


@at_length
def test_reflection_rotation_and_translation_change_nothing(count: int) -> None:
    """Eq. (4), (8), (9): the mirrored body with a mirrored throw has the mirrored motion; a body that is rotated about
    the vertical and translated has the same motion.
    """
    sideways = np.array([3.0, -2.0, 0.0])

    @drawn(
        count, shape=shapes(), throw=throws(), friction=frictions, angle=st.floats(-3.1, 3.1), mirrored=st.booleans()
    )
    def law(shape: Shape, throw: Throw, friction: float, angle: float, mirrored: bool) -> None:
        turn = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
        change = np.diag([-1.0, 1.0, 1.0]) if mirrored else turn
        body = shape.body()
        start = throw.state(body, lift=0.02)
        one = standing(body, friction, start)
        moved = BodyState(start.positions @ change.T + sideways, start.velocities @ change.T)
        other = standing(shape.body(mirrored=mirrored), friction, moved)
        for _ in range(12):
            one.advance(body.time_unit / 20.0)
            other.advance(body.time_unit / 20.0)
        expected = one.state.positions @ change.T + sideways
        assert np.abs(other.state.positions - expected).max() < 1e-7 * body.height

    law()


@at_length
def test_more_friction_never_slides_farther(count: int) -> None:
    """Eq. (9): a flat block that is pushed uphill, downhill or across a slope slides less far with more friction; on
    level ground the distance is proportional to 1 / mu.
    """

    @drawn(
        count,
        shape=shapes(stiff=True),
        angle=st.floats(0.0, 2.0 * np.pi),
        speed=st.floats(0.3, 1.0),
        friction=st.floats(0.3, 0.6),
        more=st.floats(1.05, 2.0),
        slope=st.sampled_from([0.0, 0.1, 0.25]),
    )
    def law(shape: Shape, angle: float, speed: float, friction: float, more: float, slope: float) -> None:
        body = shape.body(up=np.array([np.sin(slope), 0.0, np.cos(slope)]))
        push = speed * body.speed_unit * np.array([np.cos(angle), np.sin(angle), 0.0])
        ways = [slipped(body, push, mu) for mu in (friction, more * friction)]
        assert ways[1] < ways[0] + 1e-6 * body.height
        if slope == 0.0:
            expected = [stopping_way(speed, mu) for mu in (friction, more * friction)]
            assert ways[0] / ways[1] == pytest.approx(expected[0] / expected[1], rel=0.1)

    law()


def stopping_way(speed: float, friction: float) -> float:
    """Return the sliding distance, in body heights, of a point with the initial speed ``speed`` sqrt(g H), in 30 steps
    of implicit Euler. It is less than v^2 / (2 mu g), because each step uses its lower end speed."""
    step = 0.1
    return sum(step * max(speed - k * step * friction, 0.0) for k in range(1, 31))


def slipped(body: SoftBody, push: np.ndarray, friction: float) -> float:
    """Return the path length of the centre of mass along the ground in 30 steps, m."""
    nodes = body.mesh.nodes
    pushed = standing(body, friction, BodyState(nodes, np.tile(push, (len(nodes), 1))))
    way, before = 0.0, body.centre_of_mass(nodes)
    for _ in range(30):
        pushed.advance(body.time_unit / 10.0)
        after = body.centre_of_mass(pushed.state.positions)
        way += float(np.linalg.norm((after - before)[:2]))
        before = after
    return way


@at_length
def test_steps_converge_at_order_one(count: int) -> None:
    """Eq. (4), Eq. (6): if the motion of a free body over a fraction of its longest period is computed in n, 2 n and 4
    n steps, the second difference of the results is about half of the first.
    """

    @drawn(count // 2 if count > QUICK else 3, shape=shapes(), throw=throws())
    def law(shape: Shape, throw: Throw) -> None:
        body, smooth = shape.body(), replace(throw, noise=0.0)
        time, ends = 0.25 * np.sqrt(shape.sag) * body.time_unit, []
        for steps in (64, 128, 256):
            flying = passive_body(body, state=smooth.state(body))
            for _ in range(steps):
                _, result = flying.advance(time / steps)
                assert result.converged
            ends.append(flying.state.positions)
        first, second = (np.linalg.norm(a - b) for a, b in zip(ends[:-1], ends[1:], strict=True))
        assert np.log2(first / second) > 0.85

    law()


@pytest.mark.slow
@pytest.mark.parametrize("strength", [4.0, 40.0])
@pytest.mark.parametrize(
    "mesh",
    [
        pytest.param(block_mesh(), id="block"),
        pytest.param(
            coarse_stool(), id="stool", marks=pytest.mark.skipif(LONG < 300, reason="EGS_WARP_CASES=300 runs it")
        ),
    ],
)
def test_no_element_is_inverted_in_2000_frames_of_random_activations(mesh: TetMesh, strength: float) -> None:
    """In every frame, all muscles get random activations within the bounds for ``strength``, which is the default or
    ten times as large."""
    made = coarse_creature(mesh, forward=np.array([1.0, 0.0, 0.0]), strength=strength)
    stepper, state, memory = made.stepper, made.start, made.stepper.initial_memory()
    random, bounds, least = np.random.default_rng(7), made.stepper.muscles.bounds, np.inf
    for _ in range(2000):
        activations = random.uniform(-1.0, 1.0, len(bounds)) * bounds
        report = stepper.step_with_activations(state, memory, activations, 1.0 / 60.0)
        state, memory = report.state, WarmStart.from_report(report)
        assert report.converged and np.isfinite(state.velocities).all()
        least = min(least, stepper.body.assembly.determinants(state.positions).min())
        assert least > 0.0
    assert least < 0.99


@pytest.mark.cuda
@at_length
def test_cpu_and_cuda_give_the_same_motion(count: int) -> None:
    """Eq. (4), (8), (9): after 15 steps of a thrown body, the positions with elements and gaps computed on the CPU and
    on the GPU agree to 1e-9 H, for any muscle forces.
    """

    @drawn(count, shape=shapes(), throw=throws(), friction=frictions, share=st.sampled_from([0.0, 0.1, 0.5]))
    def law(shape: Shape, throw: Throw, friction: float, share: float) -> None:
        ends, tension = [], some_tension(shape, share)
        for device in ("cpu", "cuda:0"):
            body = shape.body(device=device)
            thrown = standing(body, friction, throw.state(body, lift=0.02), device=device)
            for _ in range(15):
                thrown.advance(body.time_unit / 20.0, tension)
            ends.append(thrown.state.positions)
        assert np.abs(ends[0] - ends[1]).max() < 1e-9 * body.height

    law()
