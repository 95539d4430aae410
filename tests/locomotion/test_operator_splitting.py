"""Iterations of operator splitting for unit-length rows, which are the same with a reused solver and with a new one."""

from __future__ import annotations

import numpy as np
import osqp
import scipy.sparse as sparse

from egs_warp.locomotion.operator_splitting import RHO, WARM_START_ITERATIONS, OsqpWarmStart, warm_start

SIZES = (3, 8, 9, 30)


def program(seed: int, rows: int, unknowns: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return unit-length rows, bounds that are feasible but violated by the unconstrained minimum, and a start."""
    rng = np.random.default_rng(seed)
    units = rng.standard_normal((rows, unknowns))
    units /= np.linalg.norm(units, axis=1)[:, None]
    at = units @ rng.standard_normal(unknowns)
    sides = at > 0.0
    return units, np.where(sides, 0.9 * at, -np.inf), np.where(sides, np.inf, 0.9 * at), rng.standard_normal(unknowns)


def by_osqp(units: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the result of OSQP through its public interface."""
    solver = osqp.OSQP(algebra="builtin")
    given = {"P": sparse.identity(len(start), format="csc"), "q": np.zeros(len(start)), "A": sparse.csc_matrix(units)}
    solver.setup(
        **given,
        l=lower,
        u=upper,
        rho=RHO,
        scaling=0,
        max_iter=WARM_START_ITERATIONS,
        adaptive_rho=False,
        polishing=False,
        verbose=False,
    )
    solver.warm_start(x=start, y=np.zeros(len(lower)))
    result = solver.solve(raise_error=False)
    return result.x, result.y


def test_iterations_equal_those_of_osqp_on_a_reused_solver() -> None:
    """A reused solver with padding rows, after other QPs, gives the iterates of OSQP."""
    kept = OsqpWarmStart(32, 12)
    for seed in range(6):
        for rows in SIZES:
            units, lower, upper, start = program(seed, rows)
            x, y = by_osqp(units, lower, upper, start)
            made = kept.run(units, lower, upper, start)
            np.testing.assert_allclose(made.x, x, atol=1e-9)
            np.testing.assert_allclose(made.multipliers, y, atol=1e-9)
            again = warm_start(units, lower, upper, start)
            np.testing.assert_allclose(again.multipliers, y, atol=1e-9)


def test_without_a_start_they_begin_at_the_minimum() -> None:
    units, lower, upper, _ = program(0, 8)
    x, _ = by_osqp(units, lower, upper, np.zeros(12))
    np.testing.assert_allclose(OsqpWarmStart(8, 12).run(units, lower, upper, None).x, x, atol=1e-12)
