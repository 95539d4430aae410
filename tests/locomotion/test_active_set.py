"""Active-set solver: the optimum satisfies the Karush-Kuhn-Tucker conditions to rounding, from good and bad guesses of
the active rows.
"""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.locomotion.active_set import WhitenedQp, solve_from_guess


def random_program(seed: int) -> tuple[np.ndarray, ...]:
    """Return P, q, A, lower and upper bounds of a feasible QP. There are more rows than can be active at once, and
    every fifth general row is repeated."""
    random = np.random.default_rng(seed)
    count = int(random.integers(3, 25))
    root = random.normal(size=(count, count))
    P = root @ root.T + 0.1 * np.eye(count)
    rows = random.normal(size=(3 * count, count)) * 10.0 ** random.uniform(-2.0, 2.0, (3 * count, 1))
    A = np.vstack([np.eye(count), rows, rows[::5]])
    at = A @ random.normal(size=count)
    spread = np.abs(A).sum(axis=1) * random.exponential(0.05, len(A))
    lower = np.where(random.random(len(A)) < 0.3, -np.inf, at - spread)
    return P, 20.0 * random.normal(size=count), A, lower, at + spread


@pytest.mark.parametrize("guess", ["none", "broken", "random"])
def test_the_kkt_conditions_hold(guess: str) -> None:
    """P x + q + A^T y = 0, A x is within the bounds, and multipliers have the sign of the active bound and are zero for
    inactive rows."""
    for seed in range(60):
        P, q, A, lower, upper = random_program(seed)
        reduced = WhitenedQp.of(P, q, A)
        random = np.random.default_rng(seed)
        low, high = reduced.values_at_minimum < lower, reduced.values_at_minimum > upper
        if guess == "none":
            low, high = np.zeros_like(low), np.zeros_like(high)
        elif guess == "random":
            low = random.random(len(low)) < 0.3
            high = (random.random(len(low)) < 0.3) & ~low
        found = solve_from_guess(reduced, lower, upper, low, high)
        assert found is not None and found.feasible
        y, at = found.multipliers, A @ found.x
        assert np.abs(P @ found.x + q + A.T @ y).max() < 1e-6 * (1.0 + np.abs(y).max())
        slack = 1e-7 * np.maximum(1.0, np.linalg.norm(A, axis=1))
        assert (at > lower - slack).all() and (at < upper + slack).all()
        least = 1e-6 * (1.0 + np.abs(y).max())
        assert (np.abs(at - upper) < 10.0 * slack)[y > least].all()
        assert (np.abs(at - lower) < 10.0 * slack)[y < -least].all()


def test_infeasible_bounds_are_detected() -> None:
    """The bounds of two equal rows are 0.1 apart, so the program, which also has other rows, is infeasible."""
    for seed in range(20):
        P, q, A, lower, upper = random_program(seed)
        row = len(q) + 1
        A, upper = np.vstack([A, A[row]]), np.r_[upper, np.inf]
        lower = np.r_[lower, upper[row] + 0.1]
        reduced = WhitenedQp.of(P, q, A)
        found = solve_from_guess(
            reduced, lower, upper, reduced.values_at_minimum < lower, reduced.values_at_minimum > upper
        )
        assert found is not None and not found.feasible


def test_a_sliver_between_two_bounds_has_an_optimum() -> None:
    """A row and its duplicate leave an interval of 1e-6 that contains a feasible point; the optimum is found in it."""
    for seed in range(20):
        P, q, A, lower, upper = random_program(seed)
        row = len(q) + int(np.flatnonzero(np.isfinite(lower[len(q) :]))[0])
        inside = 0.5 * (lower[row] + upper[row])  # the value of the row at a feasible point
        A, upper = np.vstack([A, A[row]]), np.r_[upper, np.inf]
        upper[row], lower = inside + 1e-6, np.r_[lower, inside]
        reduced = WhitenedQp.of(P, q, A)
        found = solve_from_guess(
            reduced, lower, upper, reduced.values_at_minimum < lower, reduced.values_at_minimum > upper
        )
        assert found is not None and found.feasible
        slack = 1e-7 * max(1.0, np.linalg.norm(A[row]))
        assert -slack < (A @ found.x)[-1] - inside < 1e-6 + slack


def test_bounds_are_met_without_a_linear_term() -> None:
    """For q = 0, whose unconstrained minimum is at zero, the solver finds a feasible point."""
    for seed in range(60):
        P, q, A, lower, upper = random_program(seed)
        reduced = WhitenedQp.of(P, 0.0 * q, A)
        found = solve_from_guess(
            reduced, lower, upper, reduced.values_at_minimum < lower, reduced.values_at_minimum > upper
        )
        assert found is not None and found.feasible


def test_a_minimum_within_its_bounds_is_the_optimum() -> None:
    """If the unconstrained minimum is feasible, it is returned with zero multipliers."""
    P, q, A, _, _ = random_program(3)
    reduced = WhitenedQp.of(P, q, A)
    at = A @ np.linalg.solve(P, -q)
    found = solve_from_guess(reduced, at - 1.0, at + 1.0, np.ones(len(at), bool), np.zeros(len(at), bool))
    assert found is not None
    assert np.allclose(found.x, np.linalg.solve(P, -q)) and not found.multipliers.any()


@pytest.mark.parametrize(("times", "feasible"), [(0.99, True), (1.01, False)])
def test_infeasibility_is_declared_by_a_cost_limit(times: float, feasible: bool) -> None:
    """x_1 >= s and x_k >= x_(k-1): the point nearest to 0 is (s, ..., s) with a cost of n s^2 / 2, here ``times`` a
    million; the search adds one row after another."""
    count = 6
    side = np.sqrt(2e6 * times / count)
    A = np.eye(count) - np.eye(count, k=-1)
    lower, nothing = np.r_[side, np.zeros(count - 1)], np.zeros(count, bool)
    found = solve_from_guess(
        WhitenedQp.of(np.eye(count), np.zeros(count), A), lower, np.full(count, np.inf), nothing, nothing
    )
    assert found is not None and found.feasible == feasible
    if feasible:
        np.testing.assert_allclose(found.x, side, rtol=1e-6)


def test_a_hessian_with_nan_has_no_optimum() -> None:
    """For a NaN in P, the result is None instead of an error, so that the caller can continue."""
    P, q, A, lower, upper = random_program(3)
    P[1, 1] = np.nan
    nothing = np.zeros(len(A), bool)
    assert solve_from_guess(WhitenedQp.of(P, q, A), lower, upper, nothing, nothing) is None


def test_earlier_programs_do_not_change_the_result() -> None:
    """Programs with more and with fewer constraints reuse the workspace; results are bitwise the same as with a new
    one."""
    programs = [random_program(seed) for seed in (4, 5, 6)]

    def found(P: np.ndarray, q: np.ndarray, A: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> list[np.ndarray]:
        reduced = WhitenedQp.of(P, q, A)
        best = solve_from_guess(
            reduced, lower, upper, reduced.values_at_minimum < lower, reduced.values_at_minimum > upper
        )
        assert best is not None and best.feasible
        return [best.x, best.multipliers]

    for P, q, A, lower, upper in programs:
        expected = found(P, q, A, lower, upper)
        # Solve programs with the same number of unknowns, first with more constraints, then with fewer.
        found(P, -q, np.vstack([A, -A]), np.r_[lower, -upper], np.r_[upper, -lower])
        found(P, 3.0 * q, A[: len(q) + 2], lower[: len(q) + 2], upper[: len(q) + 2])
        for got, value in zip(found(P, q, A, lower, upper), expected, strict=True):
            assert np.array_equal(got, value)


def test_whitened_coordinates() -> None:
    """In the variables z, the minimum is at z = 0, the cost elsewhere is higher by |z|^2 / 2, and rows have unit
    length."""
    for seed in range(20):
        P, q, A, _, _ = random_program(seed)
        rows = WhitenedQp.of(P, q, A)
        minimum = np.linalg.solve(P, -q)
        assert np.allclose(rows.minimum, minimum) and np.allclose(rows.values_at_minimum, A @ minimum)
        x = np.random.default_rng(seed).standard_normal(len(q))
        z = rows.whiten(x)
        cost = 0.5 * x @ P @ x + q @ x - (0.5 * minimum @ P @ minimum + q @ minimum)
        assert 0.5 * z @ z == pytest.approx(cost)
        assert np.allclose(rows.values_at_minimum + rows.row_norms * (rows.unit_rows @ z), A @ x)
        assert np.allclose(np.linalg.norm(rows.unit_rows, axis=1), 1.0)


def test_scaling_the_cost_scales_the_rows() -> None:
    """Doubling the Hessian divides the row norms by sqrt(2); an indefinite Hessian raises an error."""
    (P, q, A, *_), (Q, r, _, *_) = random_program(7), random_program(7)
    first, second = WhitenedQp.of(P, q, A), WhitenedQp.of(2.0 * Q, r + 1.0, A)
    units = second.unit_rows.copy()
    assert np.abs(first.unit_rows - units).max() < 1e-12 and np.allclose(
        second.row_norms * np.sqrt(2.0), first.row_norms
    )
    x = np.ones(len(q))
    assert np.linalg.norm(second.whiten(second.minimum)) < 1e-9 < np.linalg.norm(second.whiten(x) - first.whiten(x))
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        WhitenedQp.of(P - 2.0 * np.linalg.eigvalsh(P)[0] * np.eye(len(q)), q, A)


def test_a_corner_of_nearly_dependent_rows_and_a_contradicting_row() -> None:
    """Nearly dependent rows define a corner at which a further row is violated by 1e-4. The QP is infeasible, which the
    search reports instead of a numerical failure."""
    rng = np.random.default_rng(0)
    count = 40
    A = np.eye(count) + 1e-3 * rng.standard_normal((count, count))
    A = np.vstack([A + 0.4 * np.ones((count, count)), -np.ones((1, count))])
    corner = rng.standard_normal(count)
    lower = A @ corner
    lower[-1] += 1e-4
    reduced = WhitenedQp.of(np.eye(count), -10.0 * corner - 3.0, A)
    upper = np.full(len(A), np.inf)
    for guess in (np.zeros(len(A), bool), reduced.values_at_minimum < lower, np.ones(len(A), bool)):
        found = solve_from_guess(reduced, lower, upper, guess, np.zeros(len(A), bool))
        assert found is not None and not found.feasible
