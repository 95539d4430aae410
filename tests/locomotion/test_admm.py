"""OSQP's operator splitting as kernels, against OSQP itself and the optimality conditions."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.locomotion.admm import AdmmPrograms, AdmmResult, AdmmStatus, DenseQp
from egs_warp.locomotion.operator_splitting import AdmmSplitting, OperatorSplitting, OsqpSplitting


def random_program(seed: int) -> tuple[DenseQp, np.ndarray, np.ndarray]:
    """Return a QP of random size, with rows of different lengths, equality, one-sided and free rows, and feasible
    bounds."""
    random = np.random.default_rng(seed)
    n, m = int(random.integers(2, 20)), int(random.integers(1, 50))
    root = random.normal(size=(n, n))
    A = random.normal(size=(m, n)) * 10.0 ** random.uniform(-2.0, 1.0, (m, 1))
    at = A @ random.normal(size=n)
    kind = random.integers(0, 5, m)
    # Fewer equations than unknowns.
    kind[np.flatnonzero(kind == 0)[n // 2 :]] = 1
    lower = np.where(kind == 0, at, np.where(kind > 2, -np.inf, at - random.exponential(0.3, m)))
    upper = np.where(kind == 0, at, np.where(kind % 2 == 0, np.inf, at + random.exponential(0.3, m)))
    return DenseQp(root @ root.T + 0.1 * np.eye(n), 3.0 * random.normal(size=n), A), lower, upper


def by_osqp(program: DenseQp, lower: np.ndarray, upper: np.ndarray, *, accuracy: float, iterations: int) -> AdmmResult:
    return (
        OsqpSplitting(program.P, program.q, accuracy=accuracy).full_run(program.A, iterations).run(lower, upper, None)
    )


def by_kernels(
    program: DenseQp, lower: np.ndarray, upper: np.ndarray, *, device: str, accuracy: float, iterations: int
) -> AdmmResult:
    splitting = AdmmSplitting(program.P, program.q, accuracy=accuracy, device=device)
    return splitting.full_run(program.A, iterations).run(lower, upper, None)


def test_batched_programs_of_many_sizes_end_as_in_osqp(device: str) -> None:
    """At full accuracy, |x - x'| is at most 1e-6 of the largest |x|, and multipliers and status are equal."""
    made = [random_program(seed) for seed in range(40)]
    programs, lowers, uppers = zip(*made, strict=True)
    together = AdmmPrograms(programs, device=device)
    ends = together.solve(lowers, uppers, [None] * len(made), accuracy=1e-10, iterations=20000)
    for (program, lower, upper), end in zip(made, ends, strict=True):
        asked = by_osqp(program, lower, upper, accuracy=1e-10, iterations=20000)
        assert end.status is asked.status is AdmmStatus.SOLVED
        assert np.abs(end.x - asked.x).max() <= 1e-6 * max(1.0, np.abs(asked.x).max())
        assert np.abs(end.multipliers - asked.multipliers).max() <= 1e-5 * max(1.0, np.abs(asked.multipliers).max())
        slope = program.P @ end.x + program.q + program.A.T @ end.multipliers
        assert np.abs(slope).max() < 1e-8 * (1.0 + np.abs(program.P @ end.x).max())
        at = program.A @ end.x
        assert (at > lower - 1e-7).all() and (at < upper + 1e-7).all()


def test_iterations_are_those_of_osqp(device: str) -> None:
    """The iterates are equal to rounding not only at the end, but also after one iteration, after several, and after a
    change of rho."""
    for seed in range(8):
        program, lower, upper = random_program(seed)
        for count in (1, 30, 130):
            asked = by_osqp(program, lower, upper, accuracy=1e-30, iterations=count)
            made = by_kernels(program, lower, upper, device=device, accuracy=1e-30, iterations=count)
            assert made.iterations == asked.iterations == count
            assert np.abs(made.x - asked.x).max() < 1e-8 * max(1.0, np.abs(asked.x).max())
            largest = max(1.0, np.abs(asked.multipliers).max())
            assert np.abs(made.multipliers - asked.multipliers).max() < 1e-8 * largest


def test_a_solved_program_warm_starts_the_next(device: str) -> None:
    """After a small change of the bounds a fraction of the iterations is enough; the same holds for a given x with the
    previous multipliers, as in OSQP."""
    program, lower, upper = random_program(4)
    both: list[OperatorSplitting] = [
        OsqpSplitting(program.P, program.q, accuracy=1e-8),
        AdmmSplitting(program.P, program.q, accuracy=1e-8, device=device),
    ]
    ran = []
    for splitting in both:
        iterations = splitting.full_run(program.A, 20000)
        first = iterations.run(lower, upper, None)
        again = iterations.run(lower, upper + 1e-6, None)
        started = iterations.run(lower, upper, first.x)
        assert first.status is again.status is started.status is AdmmStatus.SOLVED
        assert first.iterations > 200 > 2 * max(again.iterations, started.iterations)
        assert np.abs(started.x - first.x).max() < 1e-6
        ran.append([first.iterations, again.iterations, started.iterations])
    assert ran[0] == ran[1]


def test_infeasible_bounds_are_detected_and_leave_no_warm_start(device: str) -> None:
    """Two rows that exclude each other give a certificate in both solvers; the next solve starts from zero."""
    for seed in range(10):
        program, lower, upper = random_program(seed)
        given = DenseQp(program.P, program.q, np.vstack([program.A, program.A[:1]]))
        held = program.A[0] @ np.ones(len(program.q))
        out = np.r_[held, lower[1:], held + 0.5], np.r_[held, upper[1:], np.inf]
        asked = by_osqp(given, *out, accuracy=1e-8, iterations=4000)
        programs = AdmmPrograms([given], device=device)
        (made,) = programs.solve([out[0]], [out[1]], [None], accuracy=1e-8, iterations=4000)
        assert made.status is asked.status is AdmmStatus.INFEASIBLE
        back = np.r_[lower, -np.inf], np.r_[upper, np.inf]
        (after,) = programs.solve([back[0]], [back[1]], [None], accuracy=1e-10, iterations=20000)
        fresh = by_osqp(program, lower, upper, accuracy=1e-10, iterations=20000)
        assert after.status is AdmmStatus.SOLVED
        assert np.abs(after.x - fresh.x).max() <= 1e-6 * max(1.0, np.abs(fresh.x).max())


def test_certificates_equal_those_of_osqp(device: str) -> None:
    """Two rows are nearly parallel, so that their multipliers grow together for many iterations. OSQP reports
    infeasibility exactly if their bounds cross, however slightly."""
    for crossed, ending in ((-5e-5, AdmmStatus.SOLVED), (5e-5, AdmmStatus.INFEASIBLE)):
        program = DenseQp(np.eye(2), np.array([0.0, 100.0]), np.array([[1.0, 0.0], [1.0, 3e-5]]))
        bounds = np.array([-np.inf, 1.0 + crossed]), np.array([1.0, np.inf])
        asked = by_osqp(program, *bounds, accuracy=1e-8, iterations=300)
        made = by_kernels(program, *bounds, device=device, accuracy=1e-8, iterations=300)
        assert made.status is asked.status is ending


def test_statuses_equal_those_of_osqp(device: str) -> None:
    """Residuals are within the accuracy, within ten times the accuracy at the last iteration, and larger."""
    endings = []
    for seed in range(12):
        program, lower, upper = random_program(seed)
        for accuracy in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5):
            asked = by_osqp(program, lower, upper, accuracy=accuracy, iterations=50)
            made = by_kernels(program, lower, upper, device=device, accuracy=accuracy, iterations=50)
            assert made.status is asked.status and made.iterations == asked.iterations
            endings.append(made.status)
    assert min(endings.count(one) for one in (AdmmStatus.SOLVED, AdmmStatus.INEXACT, AdmmStatus.LIMIT)) >= 5


def test_nan_is_no_solution(device: str) -> None:
    program, lower, upper = random_program(0)
    q = program.q.copy()
    q[0] = np.nan
    made = by_kernels(DenseQp(program.P, q, program.A), lower, upper, device=device, accuracy=1e-8, iterations=100)
    assert made.status is AdmmStatus.FAILED


def test_a_singular_hessian_has_one_value_and_many_points(device: str) -> None:
    """If x is not unique, objective and row values equal those of OSQP."""
    random = np.random.default_rng(5)
    root = random.normal(size=(12, 4))
    A = np.vstack([np.eye(12), random.normal(size=(6, 12))])
    program = DenseQp(root @ root.T, random.normal(size=12), A)
    lower, upper = np.full(18, -1.0), np.full(18, 1.0)
    made = by_kernels(program, lower, upper, device=device, accuracy=1e-10, iterations=50000)
    asked = by_osqp(program, lower, upper, accuracy=1e-10, iterations=50000)
    assert made.status is asked.status is AdmmStatus.SOLVED
    values = [0.5 * x @ program.P @ x + program.q @ x for x in (made.x, asked.x)]
    assert values[0] == pytest.approx(values[1], abs=1e-8)
    assert np.abs(root.T @ (made.x - asked.x)).max() < 1e-6
    assert (np.abs(A @ made.x) < 1.0 + 1e-8).all()
