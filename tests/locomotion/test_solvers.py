"""Adapters of the QP solvers: optimality, updated bounds compared with new solvers, and correct status."""

from __future__ import annotations

import builtins
import os
import signal
import threading
import time
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.locomotion import operator_splitting
from egs_warp.locomotion.active_set import Optimum, WhitenedQp, solve_from_guess
from egs_warp.locomotion.operator_splitting import QpStatus, SplittingResult
from egs_warp.locomotion.solvers import QpSolver, quadratic_program

SOLVERS = pytest.mark.parametrize(("solver", "accuracy"), [(QpSolver.OSQP, 1e-4), (QpSolver.DAQP, 1e-6)])


def random_program(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((20, 20))
    return root @ root.T / 20 + 0.1 * np.eye(20), rng.standard_normal(20), rng.standard_normal((30, 20))


@SOLVERS
def test_closed_form(solver: QpSolver, accuracy: float) -> None:
    """For min (x-2)^2 + (y+1)^2 with x <= 1 and y free, the optimum is (1, -1), and the multiplier of the active upper
    bound is positive.
    """
    program = quadratic_program(2 * np.eye(2), np.array([-4.0, 2.0]), np.eye(2), solver=solver)
    solution = program.solve(np.array([-np.inf, -np.inf]), np.array([1.0, np.inf]))
    assert solution.status is QpStatus.SOLVED
    assert np.allclose(solution.x, [1.0, -1.0], atol=accuracy)
    assert np.allclose(solution.multipliers, [2.0, 0.0], atol=accuracy)
    assert solution.objective == pytest.approx(-4.0, abs=accuracy)


@SOLVERS
def test_updated_bounds_give_the_optimum_of_a_new_solver(solver: QpSolver, accuracy: float) -> None:
    """Eq. (13): rows change between free, one-sided and equality, as contact states do; the KKT conditions hold, and x
    equals the result of a new solver.
    """
    P, q, A = random_program(0)
    for rows in (A, np.vstack([np.eye(20), A[:10]])):  # bounds on variables first, as in the contact program
        rng = np.random.default_rng(1)
        program = quadratic_program(P, q, rows, solver=solver)
        for _ in range(12):
            kind = rng.integers(0, 4, 30) * (rng.random(30) < 0.5)
            lower = np.where(kind > 0, 0.0, -1.0)
            upper = np.where(kind == 3, 0.0, np.where(kind > 0, np.inf, 1.0))
            warm = program.solve(lower, upper)
            fresh = quadratic_program(P, q, rows, solver=solver).solve(lower, upper)
            assert warm.status is fresh.status is QpStatus.SOLVED
            assert np.abs(warm.x - fresh.x).max() < 20 * accuracy
            assert warm.objective == pytest.approx(fresh.objective, abs=accuracy)
            assert np.abs(P @ warm.x + q + rows.T @ warm.multipliers).max() < 10 * accuracy
            assert (rows @ warm.x - upper).max() < accuracy and (lower - rows @ warm.x).max() < accuracy


def test_a_similar_program_needs_no_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the active set of a solved program, the optimum is that of OSQP, without OSQP iterations; an infeasible
    program has no solution."""
    for seed in range(12):
        P, q, A = random_program(seed)
        lower, upper = np.full(30, -0.1), np.full(30, 0.2)
        asked = quadratic_program(P, q, A).solve(lower, upper)
        with monkeypatch.context() as patch:
            patch.setattr(operator_splitting, "_run_osqp", None)
            beside = quadratic_program(P, q, A).solve(lower, upper, skip_splitting=True)
            rows, below = np.vstack([A, A[:1]]), np.append(lower, 0.3)
            none = quadratic_program(P, q, rows).solve(below, np.append(upper, 1.0), skip_splitting=True)
        assert np.abs(asked.x - beside.x).max() < 1e-9 and asked.status is beside.status is QpStatus.SOLVED
        assert (np.abs(asked.multipliers) > 1e-6).sum() > 5
        assert np.abs(asked.multipliers - beside.multipliers).max() < 1e-7
        assert none.status is QpStatus.INFEASIBLE


def test_each_solver_name_selects_its_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    """DAQP works without OSQP; only the solver named osqp needs it."""
    P, q, A = random_program(0)
    lower, upper = np.r_[0.0, np.full(29, -0.1)], np.r_[0.0, np.full(29, 0.2)]
    expected = quadratic_program(P, q, A, solver="osqp").solve(lower, upper)
    monkeypatch.setattr(operator_splitting, "_run_osqp", None)
    found = quadratic_program(P, q, A, solver="daqp").solve(lower, upper)
    assert found.status is QpStatus.SOLVED and np.abs(found.x - expected.x).max() < 1e-3
    with pytest.raises(TypeError):
        quadratic_program(P, q, A, solver="osqp").solve(lower, upper)


def test_an_uncertain_result_is_not_used_as_a_guess(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a loose infeasibility certificate, with which OSQP returns garbage in x, the active-set method starts with
    the rows that the unconstrained minimum violates."""
    P, q, A = random_program(5)
    lower, upper = np.full(30, -0.1), np.full(30, 0.2)
    guesses = []

    def noted(rows: WhitenedQp, *rest: np.ndarray) -> Optimum | None:
        guesses.append(rest[2:])
        return solve_from_guess(rows, *rest)

    asked = quadratic_program(P, q, A).solve(lower, upper)
    monkeypatch.setattr("egs_warp.locomotion.solvers.solve_from_guess", noted)
    uncertain = SplittingResult(QpStatus.INFEASIBLE, np.full(20, 2.143e9), np.zeros(30))
    monkeypatch.setattr("egs_warp.locomotion.solvers.warm_start", lambda *given: uncertain)
    monkeypatch.setattr("egs_warp.locomotion.solvers.OsqpIterations", None)
    doubted = quadratic_program(P, q, A).solve(lower, upper)
    ((low, high),) = guesses
    free = A @ np.linalg.solve(P, -q)
    assert np.array_equal(low, free < lower - 1e-5) and np.array_equal(high, free > upper + 1e-5)
    assert doubted.status is QpStatus.SOLVED and np.abs(doubted.x - asked.x).max() < 1e-9


@SOLVERS
def test_infeasible_bounds_are_reported_and_the_next_solve_recovers(solver: QpSolver, accuracy: float) -> None:
    """For an infeasible program, OSQP returns garbage in x, which must neither be returned nor be used for the next
    warm start."""
    P, q, A = random_program(2)
    A = np.vstack([A, A[0]])
    program = quadratic_program(P, q, A, solver=solver)
    lower, upper = np.full(31, -1.0), np.ones(31)
    first = program.solve(lower, upper)
    broken = lower.copy(), upper.copy()
    broken[0][30], broken[1][0] = 0.5, 0.0
    bad = program.solve(*broken)
    assert bad.status is QpStatus.INFEASIBLE and not bad.usable
    assert bad.objective == np.inf and not bad.x.any()
    again = program.solve(lower, upper)
    assert again.status is QpStatus.SOLVED and np.abs(again.x - first.x).max() < 20 * accuracy


@SOLVERS
def test_repeated_rows_may_all_be_active(solver: QpSolver, accuracy: float) -> None:
    """A sticking contact has n_d equality rows of rank two. Linearly dependent equality rows that agree have a
    solution."""
    P, q, A = random_program(4)
    A = np.vstack([A[:4], A[:4], A[0] + A[1]])
    solution = quadratic_program(P, q, A, solver=solver).solve(np.zeros(9), np.zeros(9))
    assert solution.status is QpStatus.SOLVED and np.abs(A @ solution.x).max() < accuracy
    assert np.abs(P @ solution.x + q + A.T @ solution.multipliers).max() < 10 * accuracy


def test_an_iteration_limit_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the iteration limit, the point is usable if it nearly satisfies the bounds; otherwise it would have a wrong,
    low objective and is discarded.
    """
    P, q, A = random_program(0)
    monkeypatch.setattr("egs_warp.locomotion.solvers.ACCURACY", 1e-30)
    program = quadratic_program(P, q, A)
    # With an equality row, the program is left to OSQP alone.
    near = program.solve(np.zeros(30), np.r_[0.0, np.full(29, np.inf)])
    assert near.status is QpStatus.ITERATION_LIMIT and near.usable
    assert near.status.value == "the iteration limit was reached near the bounds; the last point is used"
    monkeypatch.setattr("egs_warp.locomotion.solvers.MAX_VIOLATION", 0.0)
    far = program.solve(np.zeros(30), np.r_[0.0, np.full(29, np.inf)])
    assert far.status is QpStatus.FAILED and not far.usable and far.objective == np.inf


def test_a_program_whose_bounds_are_all_slack(capfd: pytest.CaptureFixture[str]) -> None:
    """If no bound is active, as in the QP of a body in flight, the result equals the unconstrained minimum up to
    rounding, and the solver prints nothing."""
    P, q, A = random_program(1)
    solution = quadratic_program(P, q, A).solve(np.full(30, -1e3), np.full(30, 1e3))
    assert solution.status is QpStatus.SOLVED and np.abs(P @ solution.x + q).max() < 1e-9
    assert not solution.multipliers.any() and not capfd.readouterr().out


def test_same_solves_give_the_same_bits() -> None:
    """Iterations of a solver must not depend on the clock."""
    P, q, A = random_program(3)
    for solver in (QpSolver.OSQP, QpSolver.DAQP):
        runs = []
        for _ in range(2):
            program = quadratic_program(P, q, A, solver=solver)
            solutions = [program.solve(np.full(30, -s), np.full(30, s)) for s in (1.0, 0.1, 0.5)]
            runs.append(np.concatenate([s.x for s in solutions] + [s.multipliers for s in solutions]))
        assert runs[0].tobytes() == runs[1].tobytes()


def test_daqp_is_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    """The engine does not need DAQP; selecting it without the package gives an error that names the remedy."""
    real = builtins.__import__

    def without(name: str, *rest: Any, **options: Any) -> ModuleType:
        if name == "daqp":
            raise ImportError(name)
        return real(name, *rest, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    P, q, A = random_program(0)
    with pytest.raises(
        UserError, match=r"^QP solver daqp: the package is not installed; pip install daqp, or use osqp$"
    ):
        quadratic_program(P, q, A, solver=QpSolver.DAQP)


def test_ctrl_c_while_osqp_runs_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """OSQP catches the signal and reports that it was interrupted."""
    random = np.random.default_rng(3)
    A = random.normal(size=(400, 200))
    monkeypatch.setattr("egs_warp.locomotion.solvers.ACCURACY", 1e-15)
    program = quadratic_program(np.eye(200), 10.0 * random.normal(size=200), A, solver="osqp")
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        timer.start()
        while time.monotonic() - began < 30.0:
            # With an equality row, the program is left to OSQP alone.
            program.solve(np.r_[0.0, np.full(399, -1e-3)], np.r_[0.0, np.full(399, 1e-3)])
