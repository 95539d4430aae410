"""The cost of a step against what it says of positions and velocities, by differences."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.fem.body import BodyState, make_body
from egs_warp.fem.step_problem import StepProblem
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.objectives import SpinObjective, centre_of_mass_velocity
from egs_warp.locomotion.step_cost import LinearStep, QuadraticCost, effort_cost, objectives_cost
from tests.support.meshes import block_mesh

BODY = make_body(block_mesh(), Plane(np.array([0.0, 0.0, 1.0]), 0.0), device="cpu")
DT = 1 / 60


def example() -> tuple[StepProblem, LinearStep, np.ndarray]:
    rng = np.random.default_rng(0)
    nodes = BODY.mesh.nodes
    state = BodyState(nodes + 0.005 * rng.standard_normal(nodes.shape), 0.1 * rng.standard_normal(nodes.shape))
    linear = LinearStep(
        0.1 * rng.standard_normal(nodes.size), 0.1 * rng.standard_normal((nodes.size, 4)), rng.standard_normal((3, 4))
    )
    return StepProblem(BODY, state, DT), linear, 0.1 * rng.standard_normal(nodes.size)


def value(cost: QuadraticCost, x: np.ndarray) -> float:
    return float(0.5 * x @ cost.P @ x + cost.q @ x + cost.constant)


def test_objectives_are_weighted_squares_of_what_is_missed() -> None:
    problem, linear, _ = example()
    rng = np.random.default_rng(1)
    x, target, momentum = rng.standard_normal(4), rng.standard_normal(3), rng.standard_normal(3)
    objectives = [centre_of_mass_velocity(BODY, target, 2.0), SpinObjective(momentum, 5.0)]
    speed = float(np.sqrt(9.81 * BODY.height))
    velocities = (linear.base + linear.columns @ x).reshape(-1, 3)
    missed = (BODY.centre_of_mass(velocities) - target) / speed
    after = BODY.angular_momentum(problem.state.positions, problem.state.velocities) + linear.torques @ x
    gyration = np.sqrt(0.5 * np.trace(BODY.inertia(problem.state.positions)) / BODY.mass)
    turned = (after - momentum) / (BODY.mass * gyration * speed)
    expected = 2.0 * missed @ missed + 5.0 * turned @ turned
    assert value(objectives_cost(problem, linear, objectives, speed), x) == pytest.approx(expected, rel=1e-10)


def test_effort_is_the_energy_ahead_and_convex() -> None:
    """Value, slope and curvature at the unknowns that bring about what is foreseen, by differences of the energy."""
    problem, linear, foreseen = example()
    horizon = 0.16
    ahead = horizon * np.sqrt(BODY.height / 9.81)
    cost = effort_cost(problem, linear, foreseen, weight=0.1, horizon=horizon)
    unit = 0.1 / (BODY.weight * BODY.height)

    def energy(x: np.ndarray) -> float:
        moved = ahead * (linear.base + linear.columns @ x) - DT * foreseen
        end = problem.end_positions(foreseen.reshape(-1, 3)) + moved.reshape(-1, 3)
        return unit * BODY.assembly.energy(end, problem.damping)

    # Where the expansion is made: the start and what is foreseen alone.
    still = LinearStep(DT / ahead * foreseen, linear.columns, linear.torques)
    at_centre = effort_cost(problem, still, foreseen, weight=0.1, horizon=horizon)
    end = problem.end_positions(foreseen.reshape(-1, 3))
    assert at_centre.constant == pytest.approx(unit * BODY.assembly.energy(end, problem.damping), rel=1e-9)
    step = 1e-4
    for k in range(4):
        along = step * np.eye(4)[k]
        moved = (ahead * linear.columns @ along).reshape(-1, 3)
        slope = (
            BODY.assembly.energy(end + moved, problem.damping) - BODY.assembly.energy(end - moved, problem.damping)
        ) / (2.0 * step)
        assert at_centre.q[k] == pytest.approx(unit * slope, rel=1e-5)
    assert np.linalg.eigvalsh(cost.P).min() >= -1e-12 * np.abs(cost.P).max()
    # Near by, the model is the energy.
    x = 1e-3 * np.ones(4)
    small = LinearStep(DT / ahead * foreseen, 0.01 * linear.columns, linear.torques)
    modelled = value(effort_cost(problem, small, foreseen, weight=0.1, horizon=horizon), x)
    moved = (ahead * 0.01 * linear.columns @ x).reshape(-1, 3)
    assert modelled == pytest.approx(unit * BODY.assembly.energy(end + moved, problem.damping), rel=1e-7)
    assert np.isfinite(energy(x))
