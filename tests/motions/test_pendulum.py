"""Plan of the inverted pendulum, compared with its equation of motion solved by SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from egs_warp.motions.pendulum import FallingPendulum, PendulumPlan, drift, max_lag

RATE = 4.4


def test_a_plan_solves_the_pendulum_and_ends_over_the_pressure() -> None:
    """The solution of c'' = w^2 (c - p) with the planned initial divergent component follows the plan and does not
    diverge, although p jumps."""
    step = 0.05
    pressure = np.array([[0.1, 0.0]] * 8 + [[0.0, 0.2]] * 6 + [[0.3, 0.1]] * 30)
    plan = PendulumPlan.from_pressure(pressure, step, RATE)
    place = np.array([0.08, 0.01])
    state = np.concatenate([place, RATE * (plan.divergent[0] - place)])
    for k, p in enumerate(pressure):
        solved = solve_ivp(
            lambda _, s, p=p: [*s[2:], *(RATE**2 * (s[:2] - p))], (0.0, step), state, rtol=1e-11, atol=1e-13
        )
        state = solved.y[:, -1]
        assert state[:2] + state[2:] / RATE == pytest.approx(plan.divergent[k + 1], abs=1e-6)
    assert state[:2] == pytest.approx([0.3, 0.1], abs=2e-3)


def test_a_plan_is_interpolated_and_constant_after_its_end() -> None:
    plan = PendulumPlan.from_pressure(np.array([[0.0, 0.0], [1.0, 0.0]]), 0.1, RATE)
    pressure, divergent = plan.at(0.05)
    assert pressure == pytest.approx([0.0, 0.0])
    assert divergent == pytest.approx(0.5 * (plan.divergent[0] + plan.divergent[1]))
    assert plan.at(9.0)[0] == pytest.approx([1.0, 0.0]) and plan.at(9.0)[1] == pytest.approx([1.0, 0.0])


def test_an_error_of_the_divergent_component_grows() -> None:
    """The error follows x' = w (x - p) for a time t, with an offset p of the centre of pressure."""
    off, push, time = np.array([0.01, -0.02]), np.array([0.03, 0.01]), 0.4
    solved = solve_ivp(lambda _, x: RATE * (x - push), (0.0, time), off, rtol=1e-11, atol=1e-13).y[:, -1]
    assert drift(off, push, float(np.exp(RATE * time))) == pytest.approx(solved, abs=1e-8)


def test_the_largest_lag_is_corrected_at_the_end() -> None:
    """With the centre of pressure at the rear edge, a divergent component that starts behind its plan by the largest
    lag reaches it at the end of the plan."""
    step, pressure, rear = 0.05, np.array([0.02] * 6 + [0.05] * 8), -0.03
    behind = -max_lag(pressure - rear, step, RATE)
    for p in pressure:
        behind = drift(np.array([behind]), np.array([rear - p]), float(np.exp(RATE * step)))[0]
    assert behind == pytest.approx(0.0, abs=1e-12)


def test_a_falling_pendulum_solves_its_equation() -> None:
    """The plan satisfies c'' = w^2 (c - p), by central differences, and x = c + c' / w, and begins at the given
    start."""
    fall = FallingPendulum(np.array([0.1, 0.0]), np.array([0.3, 0.1]), np.array([0.2, 0.05]), 3.0)
    assert np.allclose(fall.com_at(0.0), fall.com) and np.allclose(fall.capture_at(0.0), fall.capture)
    h, t = 1e-4, 0.4
    before, now, after = (fall.com_at(t + k * h) for k in (-1, 0, 1))
    assert np.allclose((after - 2.0 * now + before) / h**2, 9.0 * (now - fall.edge), rtol=1e-5)
    assert np.allclose((after - before) / (2.0 * h), fall.velocity_at(t), rtol=1e-6)
    assert np.allclose(fall.capture_at(t), now + fall.velocity_at(t) / 3.0)
