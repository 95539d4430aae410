"""The QP adapter: optimality, bounds-only updates against fresh set-ups, and honest status."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.qp import QpStatus, QuadraticProgram


def random_program(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((20, 20))
    return root @ root.T / 20 + 0.1 * np.eye(20), rng.standard_normal(20), rng.standard_normal((30, 20))


def test_closed_form() -> None:
    """min (x-2)^2 + (y+1)^2 with x <= 1, y free: (1, -1), and the multiplier is positive where the upper bound pushes."""
    program = QuadraticProgram(2 * np.eye(2), np.array([-4.0, 2.0]), np.eye(2))
    solution = program.solve(np.array([-np.inf, -np.inf]), np.array([1.0, np.inf]))
    assert solution.status is QpStatus.SOLVED
    assert np.allclose(solution.x, [1.0, -1.0], atol=1e-5) and np.allclose(solution.multipliers, [2.0, 0.0], atol=1e-4)
    assert solution.objective == pytest.approx(-4.0, abs=1e-4)


def test_bounds_only_updates_give_the_optimum_of_a_fresh_set_up() -> None:
    """Eq. (13): rows switch between free, one-sided and held, as contact states do; KKT holds and x is that of a fresh solver."""
    P, q, A = random_program(0)
    rng = np.random.default_rng(1)
    program = QuadraticProgram(P, q, A)
    for _ in range(12):
        kind = rng.integers(0, 4, 30) * (rng.random(30) < 0.5)
        lower = np.where(kind > 0, 0.0, -1.0)
        upper = np.where(kind == 3, 0.0, np.where(kind > 0, np.inf, 1.0))
        warm = program.solve(lower, upper)
        fresh = QuadraticProgram(P, q, A).solve(lower, upper)
        assert warm.status is fresh.status is QpStatus.SOLVED
        assert np.abs(warm.x - fresh.x).max() < 2e-3
        assert warm.objective == pytest.approx(fresh.objective, abs=1e-4)
        assert np.abs(P @ warm.x + q + A.T @ warm.multipliers).max() < 1e-3
        assert (A @ warm.x - upper).max() < 1e-4 and (lower - A @ warm.x).max() < 1e-4


def test_infeasible_bounds_are_reported_and_the_next_solve_recovers() -> None:
    """OSQP returns garbage in x when infeasible: it must not come back, nor spoil the next warm start."""
    P, q, A = random_program(2)
    A = np.vstack([A, A[0]])
    program = QuadraticProgram(P, q, A)
    lower, upper = np.full(31, -1.0), np.ones(31)
    first = program.solve(lower, upper)
    broken = lower.copy(), upper.copy()
    broken[0][30], broken[1][0] = 0.5, 0.0
    bad = program.solve(*broken)
    assert bad.status is QpStatus.INFEASIBLE and not bad.usable
    assert bad.objective == np.inf and not bad.x.any()
    again = program.solve(lower, upper)
    assert again.status is QpStatus.SOLVED and np.abs(again.x - first.x).max() < 2e-3


def test_same_solves_give_the_same_bits() -> None:
    """No step of the solver may depend on the clock."""
    P, q, A = random_program(3)
    runs = []
    for _ in range(2):
        program = QuadraticProgram(P, q, A)
        solutions = [program.solve(np.full(30, -s), np.full(30, s)) for s in (1.0, 0.1, 0.5)]
        runs.append(np.concatenate([s.x for s in solutions] + [s.multipliers for s in solutions]))
    assert runs[0].tobytes() == runs[1].tobytes()
